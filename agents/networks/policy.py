"""The policy: an intake of observations, a recurrent core, an output of actions, and a critic that
may see more than the actor.

T time, B lanes. On a GPU matrix products run in bfloat16 with float32 weights, on a CPU in float32.
"""

import copy
import functools
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

import torch
from pydantic import AfterValidator, Field, SkipValidation
from torch import nn

from megastep.agents.generator import SeededGenerator, seeded, stream_seed
from megastep.agents.networks import cores, heads, intakes, running_norm
from megastep.agents.networks.linear import ComputeDtype
from megastep.agents.networks.side_stream import overlap
from megastep.arrdict import arrdict
from megastep.devices import set_threads, threads
from megastep.dotdict import leaves, mapping
from megastep.imports import import_path, known_name
from megastep.settings import checked
from megastep.types import Env, Space, Tree, optional

if TYPE_CHECKING:
    from megastep.agents.types import Moments

#: Prefixes of the weights that acting does not need, in a policy's `state_dict`.
TRAINING_ONLY = ("critic.", "prediction.")


_IsCore, _IsEncoder = (
    AfterValidator(functools.partial(known_name, names=tuple(table)))
    for table in (cores.CORES, intakes.ENCODERS)
)


class Policy(nn.Module):
    """Acts on worlds: `decision, state = policy(world, state)`, starting from `policy.initial(B)`.

    A world is the dict that an environment's `step` returns, a decision the dict that it takes.
    Only the critic sees privileged observations.

    Args:
        obs_space: the environment's observation space; or the environment, whose spaces it takes,
            and whose device it is on.
        action_space: the environment's action space; None with an environment.
        privileged_space: space of what only the critic sees, or None.
        width: units of the recurrent core and of all features.
        core: a name in `cores.CORES`, a class, or its import path.
        layers: recurrent cores, stacked with residual connections.
        encoder: encoder of images, a name in `intakes.ENCODERS`, a class, or its import path.
        activation: of the intake, and of the hidden layer of the core "none": "relu" or "tanh".
        output: "softmax" samples actions by their probabilities, continuous ones too; "duelling"
            takes the action of the highest value.
        continuous: distribution of continuous actions, a name in
            `heads.CONTINUOUS_OUTPUTS`.
        critic: "asymmetric" sees privileged observations, if there are any; "plain" sees what the
            actor sees; None: no critic. A duelling policy never has one.
        bf16: on a GPU, runs matrix products in bfloat16.
        seed: seed of the initial weights, and of the actions unless a generator is given.

    Attributes:
        generator: the `SeededGenerator` of the actions. A learner saves its state.
        obs_space, action_space, settings: what it was made of, `settings` from `width` to `bf16`.
        norms: the running statistics of observations, the critic's too.

    Weights used in training only are under `TRAINING_ONLY` in `state_dict()`.

    Raises:
        ValueError: if an argument is out of range, or a space is of an unknown kind.
    """

    _carried: arrdict | None = None  # hidden state, by `act`

    @checked
    def __init__(
        self,
        obs_space: SkipValidation[Space | Env],
        action_space: SkipValidation[Space | None] = None,
        privileged_space: SkipValidation[Space | None] = None,
        *,
        width: Annotated[int, Field(ge=1, le=8192)] = 256,
        core: Annotated[str | type, _IsCore] = "lstm",
        layers: Annotated[int, Field(ge=1, le=8)] = 1,
        encoder: Annotated[str | type, _IsEncoder] = "linear",
        activation: Literal["relu", "tanh"] = "relu",
        output: Literal["softmax", "duelling"] = "softmax",
        continuous: Literal["gaussian", "beta"] = "gaussian",
        critic: Literal["asymmetric", "plain"] | None = "asymmetric",
        bf16: bool = True,
        seed: int = 1,
    ):
        super().__init__()
        device = None
        if action_space is None:
            env = cast(Env, obs_space)
            if not hasattr(env, "obs_space"):
                raise ValueError("a policy needs an action space too: Policy(env), or both spaces")
            obs_space, action_space, device = env.obs_space, env.action_space, env.device
            privileged_space = optional(env, "privileged_space")
        core, encoder = import_path(core), import_path(encoder)
        self.obs_space, self.action_space = obs_space, action_space
        self.settings = dict(
            **dict(width=width, core=core, layers=layers, encoder=encoder, activation=activation),
            **dict(output=output, continuous=continuous, critic=critic, bf16=bf16),
        )
        critic, self.seed = None if output == "duelling" else critic, seed
        self.width, self.layers, self.bf16, self.output_kind = width, layers, bf16, output
        self.privileged_space = privileged_space if critic == "asymmetric" else None
        self.generator = SeededGenerator(stream_seed(seed, "policy"))
        with seeded(seed):
            self.intake = heads.intake(obs_space, width, encoder, activation)
            self.core = cores.make_core(core, width, layers, activation)
            self.output = heads.output(action_space, width, output, continuous)
            self.norms = [*self.intake.running_norms]
            self.critic: Any = None
            if critic is not None:
                from megastep.agents.networks.critic import Critic  # who acts has none

                self.critic = Critic(width, self.privileged_space)
                if self.privileged_space:
                    self.norms += self.critic.intake.running_norms
                    self.prediction = nn.Linear(width, self.critic.intake.n_features)
        if device is not None:
            self.to(device)

    @property
    def device(self) -> torch.device:
        """Device of the weights."""
        return self.intake.project.weight.device  # `parameters` walks through all modules

    def initial(self, n_lanes: int, device: torch.device | str | None = None) -> arrdict:
        """Returns the hidden state of B lanes at the start of an episode: (B, ...) float32."""
        return self.core.initial(n_lanes, self.device if device is None else device)

    def forward(
        self,
        world: arrdict,
        state: arrdict,
        sample: bool = True,
        generator: torch.Generator | None = None,
        **options: torch.Tensor,
    ) -> tuple[arrdict, arrdict]:
        """Acts for one step. Returns arrdict(actions, logits, logprobs (B,), features (B, width))
        and the next hidden state.

        Args:
            world: has `obs`, and `reset` (B,), which clears a lane's hidden state. Actions that its
                `mask`, if it has one, forbids are not taken.
            state: hidden state.
            sample: samples actions; if false, takes the most likely or best ones.
            generator: generator of the actions. Default: the policy's.
            options: further arguments of the output's `sample`, such as epsilon.
        """
        if sample and generator is None:
            generator = self.generator.on(self.device)
        with self.compute_dtype():
            sequence = self.intake(world["obs"])[None], world["reset"][None]  # of one step
            features, state = cores.with_residual(self.core, *sequence, state)
            if (mask := world.get("mask")) is not None:
                options["mask"] = mask
            logits, actions, logprobs = self.output.act(features[0], sample, generator, **options)
        decision = arrdict(actions=actions, logits=logits, logprobs=logprobs, features=features[0])
        return decision, state

    @torch.no_grad()
    def act(self, world: arrdict, greedy: bool = False) -> arrdict:
        """Returns the decision for the world that follows the last one, whose hidden state the
        policy carries: `world = env.step(policy.act(world))`. Takes the most likely or best actions
        if `greedy`.
        """
        n_lanes = len(world["reset"])
        if self._carried is None or any(len(leaf) != n_lanes for leaf in leaves(self._carried)):
            self._carried = self.initial(n_lanes)
        decision, self._carried = self(world, self._carried, sample=not greedy)
        return decision

    def unroll(
        self, obs: Tree, reset: torch.Tensor, state: arrdict, burn_in: int = 0, mask: Tree = None
    ) -> arrdict:
        """Runs over a sequence without acting. Returns arrdict(logits (T, B, ...), features
        (T, B, width), state after the sequence).

        Args:
            obs: (T, B, ...) per leaf.
            reset: (T, B) bool; clears a lane's hidden state before the step.
            state: hidden state before the sequence.
            burn_in: steps at the start, fewer than T, that only warm up the hidden state. They have
                no gradients, and the result leaves them out.
            mask: (T, B, A, n) bool per discrete action space, allowed actions. None: all.
        """
        with self.compute_dtype():
            n_apart = burn_in if torch.is_grad_enabled() else 0  # without gradients, one pass does
            if n_apart:
                first = mapping(lambda leaf: leaf[:n_apart])(obs)
                state = self.warm_up(first, reset[:n_apart], state)
                obs, reset = mapping(lambda leaf: leaf[n_apart:])(obs), reset[n_apart:]
            features, state = self._features(obs, reset, state)
            features = features[burn_in - n_apart :]
            logits = self.output(features)
            if mask is not None:
                logits = self.output.masked(logits, mapping(lambda leaf: leaf[burn_in:])(mask))
            return arrdict(logits=logits, features=features, state=state)

    @torch.no_grad()
    def warm_up(self, obs: Tree, reset: torch.Tensor, state: arrdict) -> arrdict:
        """Returns the hidden state after a sequence, without gradients; see `unroll`."""
        with self.compute_dtype():
            _, state = self._features(obs, reset, state)
        # autocast would give these casts of the weights, which have no gradients, to later steps
        torch.clear_autocast_cache()
        return state

    def _features(self, obs, reset, state, lanes=None) -> tuple[torch.Tensor, arrdict]:
        return cores.with_residual(self.core, self.intake(obs, lanes), reset, state)

    def value(self, features: torch.Tensor, privileged: Tree | None = None) -> torch.Tensor:
        """Returns the critic's value (...,) float32 of features (..., width) and, if it is
        asymmetric, of privileged observations.
        """
        if self.critic is None:
            raise ValueError("the policy has no critic; files of agents and snapshots have none")
        with self.compute_dtype():
            return self.critic(features, self.critic.encode(privileged))

    def prediction_error(self, features: torch.Tensor, privileged: Tree) -> torch.Tensor:
        """Returns the error (T, B) of predicting the encoded privileged observations from features:
        a mean squared error in standard deviations. Arguments are those of `value`.

        An auxiliary loss that trains the core and not the critic (Lambrechts et al. 2024).
        """
        from megastep.agents.networks.critic import prediction_error

        with self.compute_dtype():
            encoded = self.critic.encode(privileged)
            return prediction_error(self.prediction, features, encoded)

    def terms(
        self,
        obs: Tree,
        reset: torch.Tensor,
        state: arrdict,
        actions: Tree,
        privileged: Tree | None = None,
        lanes: torch.Tensor | None = None,
        has_errors: bool = True,
        mask: Tree = None,
    ) -> arrdict:
        """Returns what a loss needs of a sequence, (T, B) float32 each: `logprobs` of the actions
        (T, B, ...), `entropies`, `values`, and `errors` of `prediction_error`, None without a
        `privileged_space` or `has_errors`; and `features` (T, B, width). With `lanes` (M,) int64
        only of these lanes of `obs` and `privileged`: other arguments have M lanes then, not B, and
        are those of `unroll` and `value`.
        """
        from megastep.agents.networks.critic import head_terms, start_heads

        prediction = self.prediction if self.privileged_space and has_errors else None
        heads_of = self.output, self.critic, prediction

        encode = functools.partial(self.critic.encode, privileged, lanes)
        start = functools.cache(functools.partial(start_heads, *heads_of, encode, mask))
        with self.compute_dtype():
            with overlap(start):
                features, _ = self._features(obs, reset, state, lanes)
            encoded, started = start()
            terms = head_terms(*heads_of, features, encoded, actions, mask, started)
        names = "logprobs", "entropies", "errors", "values", "features"
        return arrdict(zip(names, (*terms, features), strict=True))

    def compute_dtype(self) -> torch.autocast:
        """Returns the autocast context of matrix products. A weight is cast to bfloat16 once."""
        if self.bf16 and self.device.type == "cuda":
            return ComputeDtype("cuda", torch.bfloat16, self.parameters)
        return torch.autocast(self.device.type, enabled=False)

    def actor(self) -> "Policy":
        """Returns a copy that only acts, with its own weights, which need no gradient."""
        absent = {id(getattr(self, name, None)): None for name in ("critic", "prediction")}
        generator = SeededGenerator(self.generator.seed)
        actor = copy.deepcopy(self, {id(self.generator): generator, **absent})
        actor.privileged_space, actor.norms = None, actor.intake.running_norms
        return actor.requires_grad_(False)

    def update_stats(
        self, obs: Tree, privileged: Tree | None = None, is_counted: torch.Tensor | bool = True
    ) -> None:
        """Adds observations (B, ...) of the lanes that count, () or (B,) bool, to the running
        statistics of the actor's and the critic's intake, those of all ranks together.
        """
        from megastep.agents.distributed.pooling import pool_moments  # who acts has no ranks

        moments = pool_moments(*self.moments(obs, privileged, is_counted))
        running_norm.add_moments(self.norms, moments)

    def moments(
        self, obs: Tree, privileged: Tree | None = None, is_counted: torch.Tensor | bool = True
    ) -> "list[Moments]":
        """Returns the moments of this rank's observations, see `update_stats`."""
        observations = self.intake.normalised_leaves(obs)
        if self.privileged_space:
            observations += self.critic.intake.normalised_leaves(privileged)
        return running_norm.moments_of(self.norms, observations, is_counted)

    def clear_stats(self) -> None:
        """Makes observations and values 0 until there are statistics of them, so that learning does
        not depend on their units.
        """
        for norm in self.norms:
            norm.clear()
        if self.critic is not None:
            self.critic.output.clear()


def share_threads(width: int) -> None:
    """Gives kernels all threads of the CPU, and PyTorch one per 128 units of a layer."""
    n_threads = threads()
    set_threads(n_threads)
    torch.set_num_threads(max(1, min(n_threads, width // 128)))
