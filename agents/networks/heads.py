"""Network layers built from spaces: an *intake* turns observations into a vector, an *output* turns
a vector into actions, by probabilities or by action values.

    intake = heads.intake(env.obs_space, width)     # (..., A, C, H, W), (..., A, D) -> (..., width)
    output = heads.output(env.action_space, width)  # (..., width) -> log-probabilities (..., A, n)
    logits = nn.Sequential(intake, output)(world.obs)
    actions = output.sample(logits)                 # (..., A) integers, or numbers within bounds

Nested dicts of spaces give nested dicts of logits and actions. Nothing here synchronises. `...` are
any leading axes, such as (B,) lanes or (T, B) time and lanes; A agents that one lane controls, n
choices of each.
"""

import math
import typing
from collections.abc import Callable, Mapping

import torch
from torch import nn

from megastep import spaces
from megastep.agents.generator import draw
from megastep.agents.networks.fused import DTYPES, LIBRARY, fused
from megastep.agents.networks.intakes import ConcatIntake
from megastep.agents.networks.linear import cast, compute_dtype, linear
from megastep.arrdict import arrdict
from megastep.imports import import_object
from megastep.kernels.build.launch import launch
from megastep.types import Space, Tree

intake = ConcatIntake
#: Outputs of continuous actions by name.
CONTINUOUS_OUTPUTS = {
    "gaussian": "megastep.agents.networks.continuous_outputs:GaussianOutput",
    "beta": "megastep.agents.networks.continuous_outputs:BetaOutput",
}
#: Score of an action that a mask forbids: its probability is 0, and no sum with it is NaN.
FORBIDDEN = -1e9
# below the smallest exponential sample in float32, and far from underflow
_TINY = 1e-20
_MAX_CHOICES = LIBRARY.constants["ACT_THREADS"]


class Output(nn.Module):
    """Base of the outputs of one kind of actions.

    A subclass has `forward(x)`, which returns logits, `sample`, `greedy`, `logprob`, and `entropy`
    ("softmax" and continuous actions) or `action_value` ("duelling").
    """

    sample: Callable[..., Tree]
    greedy: Callable[..., Tree]
    logprob: Callable[..., torch.Tensor]
    entropy: Callable[..., torch.Tensor]
    action_value: Callable[..., torch.Tensor]

    def act(
        self,
        x: torch.Tensor,
        sample: bool = True,
        generator: torch.Generator | None = None,
        mask: Tree = None,
        **options: torch.Tensor,
    ) -> tuple[Tree, Tree, torch.Tensor]:
        """Returns logits, actions and the actions' log-probability (B,) of features (B, width).

        Args:
            sample: samples; if false, takes the most likely or best actions.
            generator: generator of the samples.
            mask: allowed actions, as for `masked`. None: all.
            options: further arguments of `sample`.
        """
        logits = self(x) if mask is None else self.masked(self(x), mask)
        actions = self.sample(logits, generator, **options) if sample else self.greedy(logits)
        return logits, actions, self.logprob(logits, actions)

    def masked(self, logits: Tree, mask: Tree) -> Tree:
        """Returns logits with which only actions that a mask (..., A, n) bool allows are chosen;
        all, if actions are continuous.
        """
        return logits

    def terms(self, logits: Tree, actions: Tree) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns the log-probability of actions and the entropy, (...,) each."""
        return self.logprob(logits, actions), self.entropy(logits)


def output(space: Space, width: int, kind: str = "softmax", continuous: str = "gaussian") -> Output:
    """Returns a module from vectors (..., width) to logits of an action space; see `Output`.

    Args:
        space: action space, a MultiDiscrete, a MultiContinuous or nested dicts.
        width: number of features.
        kind: of integers: "softmax" samples by probability, "duelling" by value.
        continuous: a name in `CONTINUOUS_OUTPUTS`, for continuous actions.

    Raises:
        ValueError: if a space is of an unknown kind, or actions that need values are continuous.
    """
    if isinstance(space, dict) and space:
        return DictOutput({key: output(s, width, kind, continuous) for key, s in space.items()})
    if isinstance(space, spaces.MultiDiscrete):
        if kind == "softmax":
            return MultiDiscreteOutput(space, width)
        return import_object("megastep.agents.networks.duelling_output:DuellingOutput")(
            space, width
        )
    if not isinstance(space, spaces.MultiContinuous):
        raise ValueError(
            f"no output is known for the action space {space!r}: use MultiDiscrete, "
            "MultiContinuous or dicts of them"
        )
    if kind == "duelling":
        raise ValueError(
            f"action values (agent.output=duelling, which R2D2 learns) need discrete actions, not "
            f"{space!r}: use learner=ppo or learner=vtrace with agent.output=softmax"
        )
    return import_object(CONTINUOUS_OUTPUTS[continuous])(space, width)


# ---- One choice out of n ----


def _act_on_gpu(
    output, x, sample=True, generator=None, mask=None
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    dtype = compute_dtype(output.linear.weight)
    weight, bias = (cast(leaf, dtype) for leaf in output.linear.parameters())
    features, (n_agents, n_choices) = x.to(dtype).contiguous(), output.shape
    n_lanes, width = features.shape
    logits, noise = features.new_empty(n_lanes, *output.shape, dtype=torch.float32), None
    if sample:
        noise = draw(output, torch.Tensor.exponential_, logits.shape, generator, x.device)
    actions = torch.empty(n_lanes, n_agents, dtype=torch.int64, device=x.device)
    logprobs = torch.empty_like(logits[:, 0, 0])
    launch(
        *(LIBRARY, f"categorical_act_{DTYPES[dtype]}", x.device, _MAX_CHOICES * n_lanes),
        **dict(features=features, weight=weight, bias=bias, noise=noise),
        **dict(logits=logits, actions=actions, logprobs=logprobs),
        **dict(n_lanes=n_lanes, width=width, n_agents=n_agents, n_choices=n_choices),
    )
    return logits, actions, logprobs


def _acts_on_gpu(output, x, sample=True, generator=None, mask=None) -> bool:
    is_known = compute_dtype(output.linear.weight) in DTYPES and not x.shape[-1] % 8
    is_small = output.shape[1] <= _MAX_CHOICES and mask is None
    return x.is_cuda and is_known and is_small and not torch.is_grad_enabled()


class MultiDiscreteOutput(Output):
    """One categorical choice out of n per agent.

    Logits are log-probabilities (..., A, n), actions (..., A) int64. `logprob` and `entropy` (...,)
    belong to the lane's joint action: they are summed over its agents.
    """

    act = fused(_act_on_gpu, _acts_on_gpu)(Output.act)

    def __init__(self, space: spaces.MultiDiscrete, width: int):
        super().__init__()
        self.shape = (space.n_agents, space.n_actions)
        self.linear = nn.Linear(width, math.prod(self.shape))
        # A hundredth of the usual gain, so that the first policy is almost uniform (Andrychowicz et
        # al. 2021)
        nn.init.orthogonal_(self.linear.weight, gain=0.01)
        nn.init.zeros_(self.linear.bias)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        scores = linear(x, self.linear).float()
        return scores.unflatten(-1, self.shape).log_softmax(-1)

    def masked(self, logits: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        """Returns log-probabilities among the allowed actions."""
        return logits.masked_fill(~mask, FORBIDDEN).log_softmax(-1)

    def sample(
        self, logits: torch.Tensor, generator: torch.Generator | None = None
    ) -> torch.Tensor:
        """Samples actions by the Gumbel-max trick."""
        noise = draw(self, torch.Tensor.exponential_, logits.shape, generator, logits.device)
        return (logits - noise.clamp_(min=_TINY).log_()).argmax(-1)

    def greedy(self, logits: torch.Tensor) -> torch.Tensor:
        """Returns the most likely actions."""
        return logits.argmax(-1)

    def logprob(self, logits: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        """Returns the log-probability (...,) of actions."""
        return logits.gather(-1, actions.long()[..., None]).squeeze(-1).sum(-1)

    def entropy(self, logits: torch.Tensor) -> torch.Tensor:
        """Returns the entropy (...,) in nats."""
        return -(logits.exp() * logits).sum((-1, -2))


# ---- Dicts of actions ----


class DictOutput(Output):
    """Independent outputs by key. Logits and actions are arrdicts with the same keys; `logprob`,
    `entropy` and `action_value` (...,) are summed over the keys. Keys that a mask has not are not
    masked. ValueError if a key is the name of an attribute that every ``nn.ModuleDict`` has.
    """

    def __init__(self, outputs: Mapping[str, nn.Module]):
        super().__init__()
        for key in outputs:
            if hasattr(nn.ModuleDict(), key):
                raise ValueError(
                    f"an action space cannot have the key {key!r}, which PyTorch's modules use; "
                    f"rename it, for example to {key}_"
                )
        self.outputs = nn.ModuleDict(outputs)

    def _each(self, method: str, *trees: Tree, **options) -> arrdict:
        """Returns by key what a method of each output returns of these trees' parts."""
        return arrdict(
            {
                key: getattr(output, method)(*(tree[key] for tree in trees), **options)
                for key, output in self.outputs.items()
            }
        )

    def forward(self, x: torch.Tensor) -> arrdict:
        return arrdict({key: output(x) for key, output in self.outputs.items()})

    def masked(self, logits: Tree, mask: Tree) -> arrdict:
        """Masks key by key."""
        outputs = typing.cast("Mapping[str, Output]", self.outputs)
        keys = [key for key in logits if mask.get(key) is not None]
        return arrdict(logits, **{key: outputs[key].masked(logits[key], mask[key]) for key in keys})

    def sample(
        self, logits: Tree, generator: torch.Generator | None = None, **options: torch.Tensor
    ) -> arrdict:
        """Samples actions, key by key."""
        return self._each("sample", logits, generator=generator, **options)

    def greedy(self, logits: Tree) -> arrdict:
        """Returns the most likely or best actions."""
        return self._each("greedy", logits)

    def logprob(self, logits: Tree, actions: Tree) -> torch.Tensor:
        """Returns the log-probability (...,) of actions."""
        return _total(self._each("logprob", logits, actions))

    def entropy(self, logits: Tree) -> torch.Tensor:
        """Returns the entropy (...,) in nats."""
        return _total(self._each("entropy", logits))

    def action_value(self, logits: Tree, actions: Tree) -> torch.Tensor:
        """Returns the value (...,) of actions."""
        return _total(self._each("action_value", logits, actions))


def _total(parts: Mapping[str, torch.Tensor]) -> torch.Tensor:
    return typing.cast(torch.Tensor, sum(parts.values()))  # there is at least one
