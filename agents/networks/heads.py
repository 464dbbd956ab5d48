"""Network layers made from spaces: an *intake* turns observations into a vector, an output turns a
vector into actions.

Axes: `...` any leading axes, such as (B,) lanes or (T, B) time and lanes; A the agents that one
lane controls.

    intake = heads.intake(env.obs_space, width)     # (..., A, C, H, W), (..., A, D) -> (..., width)
    output = heads.output(env.action_space, width)  # (..., width) -> log-probabilities (..., A, n)
    logits = nn.Sequential(intake, output)(world.obs)
    actions = output.sample(logits)                 # (..., A) integers

Nested dicts of spaces give nested dicts of logits and actions. Nothing here synchronises.
"""

import math
from typing import Any

import torch
from torch import nn
from torch.nn import functional as F

from megastep import spaces
from megastep.agents.networks.encoders import encoder_of
from megastep.agents.networks.precision import compute_dtype
from megastep.agents.networks.running_norm import RunningNorm
from megastep.arrdict import arrdict

_TINY = 1e-20  # below the smallest exponential number that float32 gives, far from underflow


def _paths(space, path=()):
    """(path, space) for every leaf of a tree of spaces that has anything in it."""
    if isinstance(space, dict):
        for key, child in space.items():
            yield from _paths(child, (*path, key))
    elif not isinstance(space, spaces.MultiEmpty):
        yield path, space


class ConcatIntake(nn.Module):
    """Encodes every leaf of an observation, joins the features, and projects them to one vector
    (..., width), rectified.

    At the start every leaf weighs the same, however many numbers it has: a weight's variance is
    2 / (leaves x leaf's features), which keeps the vector's size that of the inputs (He et al.
    2015).
    """

    def __init__(self, space, width, encoder="linear"):
        super().__init__()
        leaves = list(_paths(space))
        if not leaves:
            raise ValueError(f"the observation space {space!r} has nothing in it to encode")
        self.paths = [path for path, _ in leaves]
        self.encoders = nn.ModuleList(
            encoder_of(leaf, encoder, ".".join(path)) for path, leaf in leaves
        )
        self.norms = nn.ModuleList(
            nn.Identity() if isinstance(leaf, spaces.MultiDiscrete) else RunningNorm(leaf)
            for _, leaf in leaves
        )
        sizes = [e.n_features for e in self.encoders]
        self.n_features = sum(sizes)
        # GPUs multiply matrices of whole multiples of 8 columns several times faster
        self.n_padding = -self.n_features % 8
        self.project = nn.Linear(self.n_features + self.n_padding, width)
        with torch.no_grad():
            self.project.bias.zero_()
            blocks = self.project.weight.split([*sizes, self.n_padding], dim=1)
            blocks[-1].zero_()
            for block, size in zip(blocks, sizes):
                block.normal_(std=math.sqrt(2 / (len(sizes) * size)))

    def forward(self, obs):
        features = self._encoded(obs)
        if self.n_padding:
            features.append(features[0].new_zeros((*features[0].shape[:-1], self.n_padding)))
        return F.relu(self.project(torch.cat(features, dim=-1)))

    def encoded(self, obs: Any) -> torch.Tensor:
        """All leaves, standardised, encoded and joined, (..., n_features)."""
        return torch.cat(self._encoded(obs), dim=-1)

    def _encoded(self, obs):
        dtype = compute_dtype(self.project.weight)
        return [encoder(norm(leaf)).to(dtype) for leaf, norm, encoder in self._leaves(obs)]

    def update_stats(self, obs: Any, taken: torch.Tensor | bool = True) -> None:
        """Takes observations (B, ...), or those `taken`, () or (B,) bool, into account in how they
        are standardised from now on.
        """
        for leaf, norm, _ in self._leaves(obs):
            if isinstance(norm, RunningNorm):
                norm.update_stats(leaf, taken)

    def _leaves(self, obs):
        for path, norm, encoder in zip(self.paths, self.norms, self.encoders, strict=True):
            leaf = obs
            for key in path:
                leaf = leaf[key]
            yield leaf, norm, encoder


def intake(space: Any, width: int, encoder: str = "linear") -> ConcatIntake:
    """A module from observations of this space, or dict of spaces, to vectors (..., width).

    Observations may be of any dtype; their features are cast to the one that is computed in
    (`precision.compute_dtype`). `encoder` is that of images: 'linear', as so many numbers; 'conv',
    by convolutions; or an import path. ValueError if the space is of no known kind.
    """
    return ConcatIntake(space, width, encoder)


class MultiDiscreteOutput(nn.Module):
    """One choice out of n for every agent. Logits are log-probabilities (..., A, n), actions (...,
    A) int64.

    `logprob` and `entropy` are those of the lane's joint action, (...,): the sum over its agents.
    """

    def __init__(self, space, width):
        super().__init__()
        self.shape = (space.n_agents, space.n_actions)
        self.core = nn.Linear(width, math.prod(self.shape))
        # A hundredth of the usual size, so that the first policy is close to uniform (Andrychowicz
        # et al. 2021)
        nn.init.orthogonal_(self.core.weight, gain=0.01)
        nn.init.zeros_(self.core.bias)

    def forward(self, x):
        scores = self.core(x.to(compute_dtype(self.core.weight))).float()
        return scores.unflatten(-1, self.shape).log_softmax(-1)

    def sample(self, logits, generator=None):
        """Samples actions: the maximum of log-probability plus Gumbel noise is distributed as the
        probabilities.
        """
        noise = torch.empty_like(logits).exponential_(generator=generator).clamp_(min=_TINY).log_()
        return (logits - noise).argmax(-1)

    def greedy(self, logits):
        return logits.argmax(-1)

    def logprob(self, logits, actions):
        return logits.gather(-1, actions.long()[..., None]).squeeze(-1).sum(-1)

    def entropy(self, logits):
        return -(logits.exp() * logits).sum((-1, -2))


class DuellingOutput(nn.Module):
    """The value of each choice out of n for every agent, (..., A, n), in whatever scale a learner
    fits: the lane's value, which all choices share, and what each is better than their mean, each
    behind a hidden layer (Wang et al. 2016).

    `logits` are these values, and the policy that samples takes the best action, but for one in
    twenty: what always does the best it knows may stand before a wall for ever. `action_value` is
    that of the lane's joint action, (...,): the sum over its agents (Sunehag et al. 2018).
    """

    epsilon = 0.05

    def __init__(self, space, width):
        super().__init__()
        self.shape = (space.n_agents, space.n_actions)
        self.hidden = nn.Linear(width, 2 * width)
        self.value = nn.Linear(width, space.n_agents)
        self.advantage = nn.Linear(width, math.prod(self.shape))
        # its bias is random: with none, features of 0 would leave every unit at the edge of what
        # it can learn from
        nn.init.orthogonal_(self.hidden.weight, gain=2**0.5)
        for layer in self.value, self.advantage:
            nn.init.orthogonal_(layer.weight, gain=0.1)
            nn.init.zeros_(layer.bias)

    def forward(self, x):
        hidden = F.relu(self.hidden(x.to(compute_dtype(self.hidden.weight))))
        # in bfloat16 a large return would be off by more than one action is better than another
        with torch.autocast(x.device.type, enabled=False):
            value, advantage = hidden.float().chunk(2, -1)
            value = self.value(value)[..., None]
            advantage = self.advantage(advantage).unflatten(-1, self.shape)
        return value + advantage - advantage.mean(-1, keepdim=True)

    def sample(self, logits, generator=None, epsilon=None):
        """The best actions, or any, with probability epsilon (...,), by lane."""
        epsilon = self.epsilon if epsilon is None else epsilon[..., None]
        best = self.greedy(logits)
        how = dict(generator=generator, device=logits.device)
        drawn = torch.randint(logits.shape[-1], best.shape, **how)
        is_drawn = torch.rand(best.shape, **how) < epsilon
        return torch.where(is_drawn, drawn, best)

    def greedy(self, logits):
        return logits.argmax(-1)

    def logprob(self, logits, actions):
        n, is_best = logits.shape[-1], actions == self.greedy(logits)
        return ((1 - self.epsilon) * is_best + self.epsilon / n).log().sum(-1)

    def action_value(self, logits, actions):
        return logits.gather(-1, actions.long()[..., None]).squeeze(-1).sum(-1)


class DictOutput(nn.Module):
    """A dict of choices, made independently; `logprob`, `entropy` and `action_value` (...,) are
    summed over it.
    """

    def __init__(self, space, width, kind):
        super().__init__()
        outputs = {key: output(child, width, kind) for key, child in space.items()}
        self.outputs = nn.ModuleDict(outputs)

    def _each(self, f):
        return arrdict({key: f(key, child) for key, child in self.outputs.items()})

    def forward(self, x):
        return self._each(lambda key, child: child(x))

    def sample(self, logits, generator=None, **how):
        return self._each(lambda key, child: child.sample(logits[key], generator, **how))

    def greedy(self, logits):
        return self._each(lambda key, child: child.greedy(logits[key]))

    def logprob(self, logits, actions):
        return sum(self._each(lambda key, child: child.logprob(logits[key], actions[key])).values())

    def entropy(self, logits):
        return sum(self._each(lambda key, child: child.entropy(logits[key])).values())

    def action_value(self, logits, actions):
        each = self._each(lambda key, child: child.action_value(logits[key], actions[key]))
        return sum(each.values())


#: What gives actions, by name: one that chooses them by probabilities, one by their values.
OUTPUTS = {"softmax": MultiDiscreteOutput, "duelling": DuellingOutput}


def output(space: Any, width: int, kind: str = "softmax") -> nn.Module:
    """A module from vectors (..., width) to logits of this action space, or dict of spaces, that
    can also `sample` them, pick the likeliest (`greedy`) and compute `logprob`; `entropy`, if its
    kind is softmax, or `action_value`, if it is duelling. ValueError if the space is of no known
    kind.
    """
    if isinstance(space, dict) and space:
        return DictOutput(space, width, kind)
    if isinstance(space, spaces.MultiDiscrete):
        return OUTPUTS[kind](space, width)
    raise ValueError(
        f"no output is known for the action space {space!r}; there are MultiDiscrete and dicts of "
        f"it"
    )
