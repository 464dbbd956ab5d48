"""Learners learn: small environments, each of which only a learner with one particular ability can
solve, in seconds.
"""

import pytest
import torch

from megastep import spaces
from megastep.agents.networks.policy import Policy
from megastep.arrdict import arrdict
from tests.helpers.learners import LEARNERS

B = 64


class Env:
    """Lanes whose episodes are at step `age`; subclasses define what is observed and paid, and when
    it ends.
    """

    n_shown, n_actions = 1, 4
    n_envs, n_agents, device = B, 1, torch.device("cpu")

    def __init__(self, seed=0):
        self.obs_space = spaces.MultiVector(1, self.n_shown)
        self.action_space = spaces.MultiDiscrete(1, self.n_actions)
        self.generator = torch.Generator().manual_seed(seed)
        self.age, self.over = torch.zeros(B, dtype=torch.int64), torch.zeros(B, dtype=torch.bool)

    def _world(self, reward, reset, terminal, truncated):
        self.over = terminal | truncated
        return arrdict(
            obs=self.show()[:, None],
            reward=reward,
            reset=reset,
            terminal=terminal,
            truncated=truncated,
        )

    def reset(self):
        return self._begin(torch.ones(B, dtype=torch.bool))

    def _begin(self, which):
        self.age[which] = 0
        self.begin(which)
        none = torch.zeros(B, dtype=torch.bool)
        return self._world(torch.zeros(B), which, none, none)

    def step(self, decision):
        new, action = self.over, decision.actions[:, 0]
        reward, terminal, truncated = (x.masked_fill(new, 0) for x in self.result(action))
        self.age += 1
        self._begin(new)
        return self._world(reward, new, terminal, truncated)

    def begin(self, which):
        pass

    def show(self):
        return torch.zeros(B, self.n_shown)


class Bandit(Env):
    """One action per episode; action 2 pays 1, the others a tenth of their number."""

    def result(self, action):
        over = torch.ones(B, dtype=torch.bool)
        return torch.tensor([0.0, 0.1, 1.0, 0.3])[action], over, ~over


class Corridor(Env):
    """Seven cells in a row, from the first to the last, which pays 1; action 0 goes back, action 1
    on. An episode is truncated after 40 steps.
    """

    n_shown = 7

    def begin(self, which):
        cell = getattr(self, "cell", torch.zeros(B, dtype=torch.int64))
        self.cell = cell.masked_fill(which, 0)

    def show(self):
        return torch.nn.functional.one_hot(self.cell, self.n_shown).float()

    def result(self, action):
        way = (action == 1).long() - (action == 0).long()
        self.cell = (self.cell + way).clamp(0, self.n_shown - 1)
        there = self.cell == self.n_shown - 1
        return there.float(), there, (self.age == 39) & ~there


class Cue(Env):
    """Shows one of four cues on an episode's first observation and then nothing; doing what it said
    pays 1 at age 5.
    """

    n_shown, lag = 4, 5

    def begin(self, which):
        new = torch.randint(self.n_actions, (B,), generator=self.generator)
        self.cue = torch.where(which, new, getattr(self, "cue", new))

    def show(self):
        return torch.nn.functional.one_hot(self.cue, 4).float() * (self.age == 0)[:, None]

    def result(self, action):
        due = self.age == self.lag
        return (due & (action == self.cue)).float(), due, torch.zeros_like(due)


class Clock(Env):
    """Shows nothing at all, ever. At age k the action PATTERN[k] pays 1, and an episode may be cut
    after any step.

    Only who starts counting anew with each episode can know k.
    """

    PATTERN = torch.tensor([2, 0, 3, 1, 1])

    def result(self, action):
        right = (action == self.PATTERN[self.age % len(self.PATTERN)]).float()
        cut = (torch.rand(B, generator=self.generator) < 0.25) | (self.age == len(self.PATTERN) - 1)
        return right, torch.zeros_like(cut), cut


class Wage(Env):
    """Pays 1 for every step, whatever one does; an episode ends after each with probability 1/8, in
    one way.
    """

    def __init__(self, ends):
        super().__init__()
        self.ends = ends

    def result(self, action):
        ended, none = (
            torch.rand(B, generator=self.generator) < 1 / 8,
            torch.zeros(B, dtype=torch.bool),
        )
        return torch.ones(B), *((ended, none) if self.ends == "terminal" else (none, ended))


class Luck(Env):
    """Pays the same at every step of an episode, whatever one does: how much is drawn as it begins,
    and shown to nobody but a critic.
    """

    privileged_space = arrdict(luck=spaces.MultiVector(1, 1))

    def begin(self, which):
        new = torch.randn(B, generator=self.generator)
        self.luck = torch.where(which, new, getattr(self, "luck", new))

    def result(self, action):
        ended = self.age == 4
        return self.luck, ended, torch.zeros_like(ended)

    def _world(self, *flags):
        return arrdict(super()._world(*flags), privileged=dict(luck=self.luck.view(B, 1, 1)))


def learn(env, n_updates, policy=None, name="ppo", **how):
    """Trains a small policy and counts what happened in the last ten rollouts: (policy, rewards,
    ends, valid steps, tenths of the returns' variance that the critic explained, if it has one).
    """
    kind = LEARNERS[name]
    made, learner = kind.make(env, **how)
    if policy is None:
        policy = made
    else:
        learner = kind.made(policy, **{**kind.how, **how})
    collect, counts = learner.collector(env), torch.zeros(4)
    for i in range(n_updates):
        rollout = collect()
        explained = learner.update(rollout).get("loss/explained_variance", torch.tensor(0.0))
        if i >= n_updates - 10:
            happened = rollout.reward.sum(), rollout.terminal.sum(), (~rollout.reset).sum()
            counts += torch.stack([*happened, explained])
    return policy, *counts.tolist()


class Forgetless(Policy):
    """A policy whose memory leaks from one episode into the next."""

    def unroll(self, obs, reset, state):
        return super().unroll(obs, torch.zeros_like(reset), state)


@pytest.mark.parametrize("name", LEARNERS)
def test_the_arm_that_pays_is_found(name):
    _, rewards, ends, *_ = learn(Bandit(), 30, name=name)
    assert rewards / ends > 0.9


@pytest.mark.parametrize("name", LEARNERS)
def test_the_end_of_a_corridor_is_reached(name):
    """The shortest way takes 6 steps; whoever walks at random gets there in a third of episodes.
    R2D2 draws some actions by chance while it learns.
    """
    _, rewards, _, valid, _ = learn(Corridor(), 30, name=name, gamma=0.95)
    assert valid / rewards < (8 if name == "r2d2" else 7)


@pytest.mark.parametrize("name", LEARNERS)
def test_a_cue_is_remembered(name):
    """Guessing earns 1/4, and so does any policy without a memory."""
    _, rewards, ends, *_ = learn(Cue(), 60, name=name, lr=3e-3)
    assert rewards / ends > 0.9


@pytest.mark.parametrize(
    "core, least, most", [("gru", 0.9, 1), ("mingru", 0.9, 1), ("none", 0.1, 0.4)]
)
def test_every_recurrent_core_remembers_a_cue(core, least, most):
    env = Cue()
    policy = Policy(env.obs_space, env.action_space, width=32, core=core)
    _, rewards, ends, *_ = learn(env, 40, policy, lr=3e-3)
    assert least < rewards / ends <= most


def test_memory_starts_anew_with_every_episode():
    how, env = dict(n_updates=60, lr=1e-2, entropy_coef=0.03), Clock()
    _, rewards, _, valid, _ = learn(env, **how)
    assert rewards / valid > 0.9
    leaky = Forgetless(env.obs_space, env.action_space, width=32)
    _, rewards, _, valid, _ = learn(env, policy=leaky, **how)
    assert rewards / valid < 0.5  # nothing it sees tells it when an episode begins


@pytest.mark.parametrize(
    "ends, worth",
    [
        ("truncated", 1 / (1 - 0.9)),  # a time limit takes nothing away: 1 + .9 + .81 + ...
        ("terminal", 1 / (1 - 0.9 * 7 / 8)),
    ],
)  # a death does: 1 + .9 (7/8) + ...
def test_a_time_limit_is_not_a_death(ends, worth):
    env = Wage(ends)
    policy, *_ = learn(env, n_updates=60, gamma=0.9, lambda_=0.8)
    obs, reset = torch.zeros(12, 1, 1, 1), torch.zeros(12, 1, dtype=torch.bool)
    value = policy.value(policy.unroll(obs, reset, policy.initial(1)).features)[:, 0]
    torch.testing.assert_close(value, torch.full((12,), worth), rtol=0.1, atol=0)


@pytest.mark.parametrize("critic, least, most", [("asymmetric", 0.95, 1), ("plain", -0.1, 0.1)])
def test_what_only_the_critic_sees_explains_the_returns(critic, least, most):
    env = Luck()
    policy = Policy(env.obs_space, env.action_space, env.privileged_space, critic=critic, width=32)
    *_, tenths = learn(env, 60, policy)
    assert least < tenths / 10 <= most
