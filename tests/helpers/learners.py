"""All built-in learners with settings for small environments. Add a new learner to `LEARNERS`, and
the tests of learning and of the contract run for it, too.
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
    """A learner for tests.

    Args:
        learner: its class.
        settings: its settings in small environments.
        agent: settings of its policy.
    """

    learner: type
    settings: dict[str, Any]
    agent: dict[str, Any] = dataclasses.field(default_factory=dict)

    def make_policy(self, env, width=32, seed=1):
        env_spaces = env.obs_space, env.action_space, getattr(env, "privileged_space", None)
        policy = Policy(*env_spaces, width=width, seed=seed, bf16=False, **self.agent)
        return policy.to(env.device)

    def make(self, env, width=32, seed=1, policy=None, **settings):
        """Returns (policy, learner). `n_minibatches` also sets R2D2's gradient_steps."""
        policy = policy or self.make_policy(env, width, seed)
        if self.learner is R2D2 and "n_minibatches" in settings:
            settings["gradient_steps"] = settings.pop("n_minibatches")
        return policy, self.learner(policy, seed=seed, **{**self.settings, **settings})


_PPO = dict(n_steps=16, lr=5e-3, gamma=0.99, n_minibatches=4, n_epochs=2)
_VTRACE = dict(n_steps=16, lr=5e-3, gamma=0.99, n_minibatches=4, advantage_floor=0.3)
_VTRACE_REPLAY = ReplaySettings(capacity=2**14, burn_in=2, ratio=0.5, alpha=0.5)
_R2D2 = dict(
    n_steps=16,
    lr=3e-3,
    gamma=0.99,
    gradient_steps=8,
    target_period=20,
    return_steps=3,
    epsilon_spread=3.0,  # many random actions, which have to find the end of the corridor
    replay=ReplaySettings(capacity=2**14, burn_in=1, ratio=2.0, alpha=0.9),
)

LEARNERS = {
    "ppo": Kind(PPO, _PPO),
    "vtrace": Kind(VTrace, _VTRACE),
    "vtrace-replay": Kind(VTrace, dict(_VTRACE, buffer="replay", replay=_VTRACE_REPLAY)),
    "r2d2": Kind(R2D2, _R2D2, dict(output="duelling")),
}
