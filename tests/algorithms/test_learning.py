"""Learning tests: small environments, each solvable in seconds by a learner with one particular
ability only.
"""

import pytest
import torch

from megastep import spaces
from megastep.agents.networks.policy import Policy
from megastep.arrdict import arrdict
from tests.helpers.learners import LEARNERS

B = 64


class Env:
    """Base of the environments. `age` (B,) is the step of each lane's episode. Subclasses define
    observations in `show`, and (reward, terminal, truncated) in `result`.
    """

    obs_dim, n_actions = 1, 4
    n_envs, device = B, torch.device("cpu")

    def __init__(self, seed=0):
        self.obs_space = spaces.MultiVector(1, self.obs_dim)
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
        return torch.zeros(B, self.obs_dim)


class Bandit(Env):
    """One action per episode; action 2 has reward 1, the others less."""

    def result(self, action):
        over = torch.ones(B, dtype=torch.bool)
        return torch.tensor([0.0, 0.1, 1.0, 0.3])[action], over, ~over


class Corridor(Env):
    """Seven cells in a row; the last one has reward 1. Action 0 goes back, action 1 forward. An
    episode is truncated after 40 steps.
    """

    obs_dim = 7

    def begin(self, which):
        cell = getattr(self, "cell", torch.zeros(B, dtype=torch.int64))
        self.cell = cell.masked_fill(which, 0)

    def show(self):
        return torch.nn.functional.one_hot(self.cell, self.obs_dim).float()

    def result(self, action):
        way = (action == 1).long() - (action == 0).long()
        self.cell = (self.cell + way).clamp(0, self.obs_dim - 1)
        there = self.cell == self.obs_dim - 1
        return there.float(), there, (self.age == 39) & ~there


class Cue(Env):
    """Shows one of four cues in an episode's first observation only. The action of the same number
    has reward 1 at age 5.
    """

    obs_dim, lag = 4, 5

    def begin(self, which):
        new = torch.randint(self.n_actions, (B,), generator=self.generator)
        self.cue = torch.where(which, new, getattr(self, "cue", new))

    def show(self):
        return torch.nn.functional.one_hot(self.cue, 4).float() * (self.age == 0)[:, None]

    def result(self, action):
        due = self.age == self.lag
        return (due & (action == self.cue)).float(), due, torch.zeros_like(due)


class Reach(Env):
    """Shows two numbers from -1 to 1. The reward of an action is 1 minus its squared distance from
    them, in its own scale, and 0 or less for one that does not know them.
    """

    obs_dim = 2

    def __init__(self, seed=0):
        super().__init__(seed)
        self.action_space = spaces.MultiContinuous(1, 2, low=(0.0, -1.0), high=(100.0, 1.0))

    def begin(self, which):
        new = 2 * torch.rand(B, 2, generator=self.generator) - 1
        self.goal = torch.where(which[:, None], new, getattr(self, "goal", new))

    def show(self):
        return self.goal

    def result(self, action):
        scaled = torch.stack([action[:, 0] / 50 - 1, action[:, 1]], 1)
        ended = self.age == 3
        return 1 - 2 * (scaled - self.goal).square().sum(1), ended, torch.zeros_like(ended)


class Clock(Env):
    """Shows nothing. At age k the action PATTERN[k] has reward 1, and an episode may be truncated
    after any step. Only a policy that counts from the start of each episode knows k.
    """

    PATTERN = torch.tensor([2, 0, 3, 1, 1])

    def result(self, action):
        right = (action == self.PATTERN[self.age % len(self.PATTERN)]).float()
        cut = (torch.rand(B, generator=self.generator) < 0.25) | (self.age == len(self.PATTERN) - 1)
        return right, torch.zeros_like(cut), cut


class Wage(Env):
    """Reward 1 in every step, whatever the action. An episode ends after each step with probability
    1/8, always the same way.
    """

    def __init__(self, ends):
        super().__init__()
        self.ends = ends

    def result(self, action):
        ended = torch.rand(B, generator=self.generator) < 1 / 8
        none = torch.zeros_like(ended)
        return torch.ones(B), *((ended, none) if self.ends == "terminal" else (none, ended))


class Luck(Env):
    """A random reward that stays the same during an episode, whatever the action. Only the critic
    sees it.
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


def learn(env, n_updates, policy=None, name="ppo", **settings):
    """Trains a small policy. Returns it and four sums over the last ten rollouts: rewards, terminal
    ends, valid steps, and the critic's explained variance.
    """
    kind = LEARNERS[name]
    if policy is None:
        policy, learner = kind.make(env, **settings)
    else:
        learner = kind.learner(policy, **{**kind.settings, **settings})
    collect, counts = learner.collector(env), torch.zeros(4)
    for i in range(n_updates):
        rollout = collect()
        explained = learner.update(rollout).get("loss/explained_variance", torch.tensor(0.0))
        if i >= n_updates - 10:
            sums = rollout.reward.sum(), rollout.terminal.sum(), (~rollout.reset).sum()
            counts += torch.stack([*sums, explained])
    return policy, *counts.tolist()


#: The fast tests have one learner, the slow ones all.
ONE_OR_ALL = [
    name if name == "ppo" else pytest.param(name, marks=pytest.mark.slow) for name in LEARNERS
]


class NeverResets(Policy):
    """A policy whose hidden state leaks from one episode into the next."""

    def _features(self, obs, reset, state, lanes=None):
        return super()._features(obs, torch.zeros_like(reset), state, lanes)


@pytest.mark.parametrize("name", LEARNERS)
def test_learns_bandit(name):
    _, rewards, ends, *_ = learn(Bandit(), 30, name=name)
    assert rewards / ends > 0.9


@pytest.mark.parametrize(
    "name",
    [pytest.param("ppo", marks=pytest.mark.nightly), pytest.param("r2d2", marks=pytest.mark.slow)],
)
def test_learns_corridor(name):
    """The shortest way takes 6 steps. A random policy arrives in a third of the episodes. R2D2
    takes some random actions while it learns.
    """
    _, rewards, _, valid, _ = learn(Corridor(), 30, name=name, gamma=0.95)
    assert valid / rewards < (8 if name == "r2d2" else 7)


@pytest.mark.parametrize("name", ONE_OR_ALL)
def test_remembers_cue(name):
    """A policy without a hidden state earns 1/4. Of R2D2's actions 14 % are random, and three in
    four of these are wrong, so that it earns 0.9 at best.
    """
    _, rewards, ends, *_ = learn(Cue(), 60, name=name, lr=3e-3)
    assert rewards / ends > (0.85 if name == "r2d2" else 0.9)


@pytest.mark.parametrize(
    "name, continuous",
    [
        ("ppo", "gaussian"),
        ("ppo", "beta"),
        pytest.param("vtrace", "beta", marks=pytest.mark.nightly),
        pytest.param("vtrace-replay", "gaussian", marks=pytest.mark.nightly),
    ],
)
def test_learns_to_reach(name, continuous):
    env = Reach()
    policy = Policy(env.obs_space, env.action_space, width=32, continuous=continuous)
    n_updates, lr = (40, 1e-2) if name == "ppo" else (140, 3e-3)
    _, rewards, _, valid, _ = learn(env, n_updates, policy, name, lr=lr, entropy_coef=1e-3)
    assert rewards / valid > 0.8


@pytest.mark.nightly
@pytest.mark.parametrize(
    "core, min_return, max_return", [("gru", 0.9, 1), ("mingru", 0.9, 1), ("none", 0.1, 0.4)]
)
def test_recurrent_cores_remember_cue(core, min_return, max_return):
    env = Cue()
    policy = Policy(env.obs_space, env.action_space, width=32, core=core)
    _, rewards, ends, *_ = learn(env, 40, policy, lr=3e-3)
    assert min_return < rewards / ends <= max_return


@pytest.mark.nightly
def test_hidden_state_is_reset_with_episode():
    env, settings = Clock(), dict(n_updates=60, lr=1e-2, entropy_coef=0.03)
    _, rewards, _, valid, _ = learn(env, **settings)
    assert rewards / valid > 0.9
    leaky = NeverResets(env.obs_space, env.action_space, width=32)
    _, rewards, _, valid, _ = learn(env, policy=leaky, **settings)
    assert rewards / valid < 0.5  # no observation shows when an episode begins


@pytest.mark.slow
@pytest.mark.parametrize(
    "ends, expected",
    [
        ("truncated", 1 / (1 - 0.9)),  # 1 + .9 + .81 + ...
        ("terminal", 1 / (1 - 0.9 * 7 / 8)),  # 1 + .9 (7/8) + ...
    ],
)
def test_truncated_bootstraps_and_terminal_does_not(ends, expected):
    env = Wage(ends)
    policy, *_ = learn(env, n_updates=60, gamma=0.9, lambda_=0.8)
    obs, reset = torch.zeros(12, 1, 1, 1), torch.zeros(12, 1, dtype=torch.bool)
    value = policy.value(policy.unroll(obs, reset, policy.initial(1)).features)[:, 0]
    torch.testing.assert_close(value, torch.full((12,), expected), rtol=0.1, atol=0)


@pytest.mark.slow
@pytest.mark.parametrize(
    "critic, min_explained, max_explained", [("asymmetric", 0.95, 1), ("plain", -0.1, 0.1)]
)
def test_asymmetric_critic_explains_returns(critic, min_explained, max_explained):
    env = Luck()
    policy = Policy(env.obs_space, env.action_space, env.privileged_space, critic=critic, width=32)
    *_, explained = learn(env, 60, policy)
    assert min_explained < explained / 10 <= max_explained
