"""The actor-critic: an intake (the encoder of observations), a memory, an output to act, and a
critic, which may see more than the actor.

Axes: T time, B lanes. On a GPU matrix products run in bfloat16 with float32 weights, on the CPU in
float32.
"""

import copy
from typing import Annotated, Any, Literal

import torch
from pydantic import AfterValidator, Field
from torch import nn

from megastep.agents.generator import SeededGenerator
from megastep.agents.imports import resolve
from megastep.agents.networks import cores as cores
from megastep.agents.networks import encoders, heads
from megastep.agents.networks.critic import Critic
from megastep.arrdict import arrdict
from megastep.dotdict import mapping
from megastep.settings import checked


def _known(table):
    """The check of a name: a word of the table, or an import path."""

    def check(name):
        resolve(name, table)
        return name

    return AfterValidator(check)


class Policy(nn.Module):
    """Acts on worlds: `decision, state = policy(world, state)`, starting from `policy.initial(B)`.
    A world is what an environment's `step` returns, a decision what it takes.

    `core` and `encoder` are names in `memory.CORES` and `encoders.ENCODERS`, or import paths
    of others; `layers` is how many cores stand one above the other. `output` is "softmax", which
    samples actions by their probabilities, or "duelling", which takes the one of most value.
    `critic` is "asymmetric", which also sees a world's `privileged` of `privileged_space` where
    there is such a space; "plain", which sees what the actor sees; or None, for a policy that only
    acts, as one of action values always is. Nothing privileged reaches the actions; but
    `prediction_error` can teach the memory what the critic knows.

    `seed` decides the first weights and, where no generator is given, the sampled actions. The
    weights are in `state_dict()`, those that only training needs under "critic." and "prediction.";
    where the random stream is, is in `random.state_dict()`, which a learner saves. ValueError if
    the width or the layers are out of range, or a space is of no known kind.
    """

    @checked
    def __init__(
        self,
        obs_space: Any,
        action_space: Any,
        privileged_space: Any = None,
        *,
        width: Annotated[int, Field(ge=1, le=8192)] = 128,
        core: Annotated[str, _known(cores.CORES)] = "lstm",
        layers: Annotated[int, Field(ge=1, le=8)] = 1,
        encoder: Annotated[str, _known(encoders.ENCODERS)] = "linear",
        output: Literal["softmax", "duelling"] = "softmax",
        critic: Literal["asymmetric", "plain"] | None = "asymmetric",
        bf16: bool = True,
        seed: int = 1,
    ):
        super().__init__()
        critic = None if output == "duelling" else critic
        self.width, self.layers, self.bf16, self.output_kind = width, layers, bf16, output
        self.privileged_space = privileged_space if critic == "asymmetric" else None
        self.random = SeededGenerator(seed)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.intake = heads.intake(obs_space, width, encoder)
            self.core = cores.make_core(core, width, layers)
            self.output = heads.output(action_space, width, output)
            self.critic = None if critic is None else Critic(width, self.privileged_space)
            if self.privileged_space:
                self.prediction = nn.Linear(width, self.critic.intake.n_features)

    @property
    def device(self) -> torch.device:
        return next(self.parameters()).device

    @property
    def activation_bytes(self) -> int:
        """About how many bytes learning takes per step of one lane, beside the step itself: some 24
        activations of 4 bytes per unit, and 8 for each layer above the first.
        """
        return 4 * (24 + 8 * (self.layers - 1)) * self.width

    def initial(self, n_lanes: int, device: torch.device | str | None = None) -> arrdict:
        """The state of B lanes at the start of an episode: arrdict of (B, ...) float32."""
        return self.core.initial(n_lanes, self.device if device is None else device)

    def forward(
        self,
        world: arrdict,
        state: arrdict,
        sample: bool = True,
        generator: torch.Generator | None = None,
    ) -> tuple[arrdict, arrdict]:
        """One step for all lanes: (decision, state) from world.obs and world.reset, which clears a
        lane's state.

        decision is arrdict(actions, logits, logprobs (B,), features (B, width)). Actions are
        sampled with `generator`, by default the policy's own, or are the likeliest if not `sample`.
        """
        out = self.unroll(mapping(torch.unsqueeze)(world["obs"], 0), world["reset"][None], state)
        logits = mapping(torch.squeeze)(out["logits"], 0)
        if sample:
            generator = self.random.on(self.device) if generator is None else generator
            actions = self.output.sample(logits, generator)
        else:
            actions = self.output.greedy(logits)
        decision = arrdict(
            actions=actions,
            logits=logits,
            logprobs=self.output.logprob(logits, actions),
            features=out["features"][0],
        )
        return decision, out["state"]

    def unroll(self, obs: Any, reset: torch.Tensor, state: arrdict) -> arrdict:
        """Many steps for all lanes: obs (T, B, ...), reset (T, B) and the state before them. The
        state is cleared inside the sequence where reset. Returns arrdict(logits (T, B, ...),
        features (T, B, width) that they were made from, state after the last step).
        """
        with self.compute_dtype():
            encoded = self.intake(obs)
            outputs, state = self.core(encoded, reset, state)
            # what needs no memory does not have to pass through it
            features = encoded + outputs
            return arrdict(logits=self.output(features), features=features, state=state)

    def value(self, features: torch.Tensor, privileged: Any = None) -> torch.Tensor:
        """The return expected by the critic, (...,) float32, from features (..., width) and, if it
        is asymmetric, from the world's `privileged`.
        """
        with self.compute_dtype():
            return self.critic(features, privileged)

    def prediction_error(self, features: torch.Tensor, privileged: Any) -> torch.Tensor:
        """(T, B): how badly the features of `unroll` tell what the critic sees, as a mean squared
        error in standard deviations. An auxiliary loss that only shapes the memory (Mirowski et al.
        2017; of privileged information: Lambrechts et al. 2024).
        """
        with torch.no_grad():
            target = self.critic.intake.encoded(privileged)
        with self.compute_dtype():
            predicted = self.prediction(features)
        return (predicted - target).square().mean(-1)

    def compute_dtype(self) -> torch.autocast:
        """The context in which matrix products are taken. Within one of them autocast casts a
        weight once, however often it is used.
        """
        return torch.autocast(
            self.device.type, torch.bfloat16, enabled=self.bf16 and self.device.type == "cuda"
        )

    def actor(self) -> "Policy":
        """A copy that only acts, with weights of its own that need no gradient."""
        absent = {id(getattr(self, name, None)): None for name in ("critic", "prediction")}
        actor = copy.deepcopy(self, {id(self.random): SeededGenerator(self.random.seed), **absent})
        actor.privileged_space = None
        return actor.requires_grad_(False)

    def update_stats(
        self, obs: Any, privileged: Any = None, taken: torch.Tensor | bool = True
    ) -> None:
        """Takes what B lanes and their critic saw, or those `taken`, () or (B,) bool, into account
        in how it is standardised from now on.
        """
        self.intake.update_stats(obs, taken)
        if self.privileged_space:
            self.critic.intake.update_stats(privileged, taken)
