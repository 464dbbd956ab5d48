"""All built-in learners, as tests of learning and of the contract go through them: one line each.

A learner that is added here is held to both.
"""

import dataclasses
from typing import Any

from megastep.agents.algorithms.ppo import PPO
from megastep.agents.algorithms.r2d2 import R2D2
from megastep.agents.algorithms.vtrace import VTrace
from megastep.agents.networks.policy import Policy
from megastep.agents.storage.replay import ReplaySettings


@dataclasses.dataclass(frozen=True)
class Kind:
    """A learner's class, its settings in small environments, and those of the policy it takes."""

    made: type
    how: dict[str, Any]
    agent: dict[str, Any] = dataclasses.field(default_factory=dict)

    def make(self, env, width=32, seed=1, **how):
        """(policy, learner)."""
        spaces_of = env.obs_space, env.action_space, getattr(env, "privileged_space", None)
        policy = Policy(*spaces_of, width=width, seed=seed, bf16=False, **self.agent)
        policy = policy.to(env.device)
        if self.made is R2D2 and "n_minibatches" in how:
            how["gradient_steps"] = how.pop("n_minibatches")
        return policy, self.made(policy, seed=seed, **{**self.how, **how})


_HOW = dict(n_steps=16, lr=5e-3, n_minibatches=4)
_REPLAY = ReplaySettings(capacity=2**14, burn_in=2, ratio=0.5, alpha=0.5)

_OFTEN = ReplaySettings(capacity=2**14, burn_in=1, ratio=2.0, alpha=0.9)
_R2D2 = dict(n_steps=16, lr=3e-3, gradient_steps=8, target_period=20, return_steps=3)
_R2D2 |= dict(epsilon_spread=3.0, replay=_OFTEN)  # in a corridor chance has to find the way first

LEARNERS = {
    "ppo": Kind(PPO, dict(_HOW, n_epochs=2)),
    "vtrace": Kind(VTrace, _HOW),
    "vtrace-ahead": Kind(VTrace, dict(_HOW, lag=1)),
    "vtrace-replay": Kind(VTrace, dict(_HOW, buffer="replay", replay=_REPLAY)),
    "r2d2": Kind(R2D2, _R2D2, dict(output="duelling")),
}
