"""Rollouts and the collectors that fill them. Every number of the environment encodes its lane,
time and key.
"""

import pytest
import torch

from megastep import contract, envs, geometries, spaces
from megastep.agents.networks.policy import Policy
from megastep.agents.storage.collector import Collector, collect, initial_actor_state
from megastep.agents.storage.rollout import Rollout, without_last
from megastep.arrdict import arrdict, clone
from megastep.dotdict import leaves
from tests.helpers import web

B, T = 6, 5


class LabelledEnv:
    """Every number is 100 * lane + time plus a fraction per key. Episodes of lane b end at times
    divisible by b + 2.
    """

    obs_space = arrdict(
        eye=spaces.MultiImage(1, 1, 1, 2), rest=arrdict(imu=spaces.MultiVector(1, 3))
    )
    action_space = arrdict(move=spaces.MultiDiscrete(1, 7), fire=spaces.MultiDiscrete(1, 2))

    device = "cpu"

    def __init__(self):
        self.time = 0
        self.actions = []
        self.obs = None

    def reset(self):
        return self._world(torch.ones(B, dtype=torch.bool))

    def step(self, decision):
        self.actions.append(decision.actions)
        self.time += 1
        return self._world(self.ends(self.time - 1))

    def ends(self, time):
        return torch.tensor([time > 0 and time % (b + 2) == 0 for b in range(B)])

    def label(self, time):
        return 100.0 * torch.arange(B) + time

    def _world(self, reset):
        label, ended = self.label(self.time), self.ends(self.time) & ~reset
        if self.obs is None:
            self.obs = arrdict(
                eye=torch.zeros(B, 1, 1, 1, 2), rest=arrdict(imu=torch.zeros(B, 1, 3))
            )
        # the same memory every time, like the engine
        self.obs.eye[:] = label.view(B, 1, 1, 1, 1)
        self.obs.rest.imu[:] = label.view(B, 1, 1) + 0.5
        odd = torch.arange(B) % 2 == 1
        return arrdict(
            obs=self.obs,
            reset=reset,
            reward=label + 0.25,
            terminal=ended & odd,
            truncated=ended & ~odd,
        )


def collected(n_rollouts=1, env=None, values=True):
    """Collects some rollouts. Returns env, policy, the last rollout and the actor state."""
    env = env or LabelledEnv()
    policy = Policy(env.obs_space, env.action_space, width=16)
    state = policy.initial(B)
    env_spaces = env.obs_space, env.action_space
    rollout = Rollout(T, B, *env_spaces, state, values=values)
    actor_state = initial_actor_state(env, policy, rollout)
    for _ in range(n_rollouts):
        actor_state = collect(env, policy, rollout, actor_state)
    return env, policy, rollout, actor_state


@pytest.mark.parametrize("n_rollouts", [1, 3])
def test_rows_line_up_with_env(n_rollouts):
    env, _, rollout, _ = collected(n_rollouts)
    first = (n_rollouts - 1) * T
    for row in range(T + 1):
        time = first + row
        assert torch.equal(rollout.obs.eye[row, :, 0, 0, 0, 1].float(), env.label(time))
        assert torch.equal(rollout.obs.rest.imu[row, :, 0, 2].float(), env.label(time) + 0.5)
        assert torch.equal(
            rollout.starts[row], env.ends(time - 1) if time else torch.ones(B, dtype=torch.bool)
        )
    for row in range(T):
        time = first + row
        assert torch.equal(rollout.reward[row], env.label(time + 1) + 0.25)
        assert torch.equal(rollout.reset[row], env.ends(time))
        ended = env.ends(time + 1) & ~env.ends(time)
        assert torch.equal(rollout.terminal[row] | rollout.truncated[row], ended)
        assert not rollout.terminal[row, ::2].any() and not rollout.truncated[row, 1::2].any()
        assert torch.equal(rollout.actions.move[row], env.actions[time].move)
        assert torch.equal(rollout.actions.fire[row], env.actions[time].fire)


def test_actions_are_stored_as_they_were_chosen():
    """An environment may change the actions that it is given, for example to clip them."""

    class Changes(LabelledEnv):
        def step(self, decision):
            self.actions.append(decision.actions.clone())
            world = super().step(decision)
            self.actions.pop()
            for leaf in leaves(decision.actions):
                leaf.fill_(0)
            return world

    env, _, rollout, _ = collected(env=Changes())
    assert rollout.actions.move.any()
    for t, actions in enumerate(env.actions):
        assert torch.equal(rollout.actions.move[t], actions.move)
        assert torch.equal(rollout.actions.fire[t], actions.fire)


@pytest.mark.parametrize("name", [*web.ENVS, "minimal"])
def test_environments_of_megastep_leave_actions_as_they_are(name):
    """Their actions are stored after the step, with what came of them."""
    if name == "minimal":
        env = envs.Minimal(3, geometries.sample("homes", 3, seed=7), device="cpu")
    else:
        env = web.made(name)
    assert type(env).__module__.startswith("megastep.envs.")
    env.reset()
    generator = torch.Generator().manual_seed(0)
    for _ in range(3):
        actions = contract.random_actions(env, generator)
        before = clone(actions)
        env.step(arrdict(actions=actions))
        assert contract.same(actions, before)


def test_logprobs_and_values_match_unroll():
    _, policy, rollout, actor_state = collected(n_rollouts=2)
    out = policy.unroll(rollout.obs, rollout.starts, rollout.state)
    close = dict(rtol=1e-4, atol=1e-4)  # sums of numbers up to 500 in another order
    torch.testing.assert_close(rollout.values, policy.value(out.features), **close)
    logprobs = policy.output.logprob(out.logits[:-1], rollout.actions)
    torch.testing.assert_close(rollout.logprobs, logprobs, **close)
    last = policy.unroll(rollout.obs[-1:], rollout.starts[-1:], actor_state.state)
    torch.testing.assert_close(rollout.values[-1:], policy.value(last.features), **close)


class NaNEnv(LabelledEnv):
    """Lane 4, whose episode lasts from time 7 to time 12, observes NaN at time 9."""

    def _world(self, reset):
        world = super()._world(reset)
        if self.time == 9:
            world.obs.eye[4] = torch.nan
        return world


def test_nonfinite_hidden_state_is_cleared():
    env, policy, rollout, actor_state = collected(n_rollouts=2, env=NaNEnv())
    assert rollout.values[4:, 4].isnan().all() and rollout.values[:4].isfinite().all()
    assert rollout.values[:, :4].isfinite().all()
    collect(env, policy, rollout, actor_state)
    assert not rollout.state.cell[4].any() and rollout.state.cell[3].any()
    assert rollout.values.isfinite().all() and rollout.logprobs.isfinite().all()


def test_collector_continues_between_rollouts():
    env = LabelledEnv()
    policy = Policy(env.obs_space, env.action_space, width=16)
    rollout = Rollout(T, B, env.obs_space, env.action_space, policy.initial(B))
    collector = Collector(env, policy, rollout)
    addresses = [leaf.data_ptr() for leaf in leaves(rollout.state)]
    for _ in range(3):
        collector()
    _, _, expected, _ = collected(n_rollouts=3)
    assert torch.equal(rollout.values, expected.values) and collector.graph is None
    assert torch.equal(rollout.state.cell, expected.state.cell)
    assert [leaf.data_ptr() for leaf in leaves(rollout.state)] == addresses


@pytest.mark.parametrize("values", [True, False])
def test_sequences_select_lanes(values):
    env = MetricsEnv()
    _, _, rollout, _ = collected(n_rollouts=2, env=env, values=values)
    rollout.logprobs[:] = torch.arange(T)[:, None] + 100.0 * torch.arange(B)
    rollout.state.cell[:] = torch.arange(B)[:, None].float()
    rows = torch.tensor([4, 1, 2])
    batch = rollout.sequences(rows)
    for i, b in enumerate(rows.tolist()):
        lane = 100.0 * b + T + torch.arange(T + 1)
        assert torch.equal(batch.obs.eye[:, i, 0, 0, 0, 0], lane)
        assert torch.equal(batch.obs.rest.imu[:, i, 0, 0], lane + 0.5)
        assert torch.equal(batch.logprobs[:, i], 100.0 * b + torch.arange(T))
        assert torch.equal(batch.actions.move[:, i], rollout.actions.move[:, b])
        assert torch.equal(batch.reward[:, i], lane[1:] + 0.25)
        for name in ("starts", "learns", "terminal", "truncated"):
            assert torch.equal(batch[name][:, i], getattr(rollout, name)[:, b])
        assert (batch.state.cell[i] == b).all()
    acted = without_last(batch.obs)
    assert torch.equal(acted.eye, batch.obs.eye[:T]) and without_last(None) is None


def test_policy_without_critic_or_logprobs():
    """A decision does not need log-probabilities, either."""

    class NoLogprobs(Policy):
        def forward(self, *arguments):
            decision, state = super().forward(*arguments)
            return arrdict(actions=decision.actions), state

    stored = []
    for kind, critic in (Policy, "plain"), (NoLogprobs, None):
        env = LabelledEnv()
        policy = kind(env.obs_space, env.action_space, width=16, critic=critic)
        state = policy.initial(B)
        rollout = Rollout(T, B, env.obs_space, env.action_space, state, values=False)
        collect(env, policy, rollout, initial_actor_state(env, policy, rollout))
        assert rollout.values is None and "value" not in rollout.floats()
        stored.append(rollout)
    assert torch.equal(stored[0].actions.move, stored[1].actions.move)
    assert stored[0].logprobs.all() and not stored[1].logprobs.any()


class MetricsEnv(LabelledEnv):
    """Lane b learns at times divisible by b + 1. Two metrics encode lane and time."""

    def _world(self, reset):
        world, label = super()._world(reset), self.label(self.time)
        metrics = arrdict(laps=label, falls=label + 0.5)
        return arrdict(world, learns=self.learns(self.time), metrics=metrics)

    def learns(self, time):
        return torch.tensor([time % (b + 1) == 0 for b in range(B)])


@pytest.mark.parametrize("n_rollouts", [1, 3])
def test_learns_and_metrics_line_up_with_env(n_rollouts):
    env, _, rollout, _ = collected(n_rollouts, env=MetricsEnv())
    first = (n_rollouts - 1) * T
    for row in range(T + 1):
        assert torch.equal(rollout.learns[row], env.learns(first + row))
    for row in range(T):
        assert torch.equal(rollout.metrics.laps[row], env.label(first + row + 1))
        assert torch.equal(rollout.metrics.falls[row], env.label(first + row + 1) + 0.5)


def test_lanes_that_are_not_stored_act_with_0():
    learners = torch.tensor([True, False, True, False])
    args = LabelledEnv.obs_space, LabelledEnv.action_space, arrdict()
    rollout = Rollout(1, 2, *args, learners=learners)
    assert rollout.lane_indices.tolist() == [0, 2]
    flat, nested = torch.tensor([5, 7]), torch.tensor([[1.5, 2.5], [3.5, 4.5]])
    actions = rollout.scatter_actions(arrdict(flat=flat, nested=nested))
    assert actions.flat.tolist() == [5, 0, 7, 0] and actions.flat.dtype == torch.int64
    assert actions.nested.tolist() == [[1.5, 2.5], [0, 0], [3.5, 4.5], [0, 0]]
