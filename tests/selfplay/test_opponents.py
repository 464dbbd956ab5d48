"""Opponents: who plays where, that nothing of theirs is learnt from, how the pool is renewed, saved
and counted, and that a policy learns against it.
"""

import pytest
import torch

from megastep import contract
from megastep.agents.algorithms.ppo import PPO
from megastep.agents.networks.policy import Policy
from megastep.agents.selfplay import duels
from megastep.agents.selfplay.opponents import Opponents
from megastep.agents.training import checkpoint
from megastep.agents.training.budget import Budget
from megastep.agents.training.saver import Saver
from megastep.agents.training.trainer import Trainer
from megastep.arrdict import arrdict
from tests.helpers.games import Always, High, Matrix, Middle


def policy_of(env, seed=1, width=8, **options):
    return Policy(env.obs_space, env.action_space, width=width, seed=seed, **options)


def opposed(n_envs=16, n_agents=2, env=None, policy=None, **options):
    env = env or Matrix(n_envs, n_agents)
    options = {**dict(past=0.5, bot=0.25, scripted=High(), snapshots=2, every=3), **options}
    return Opponents(env, policy or policy_of(env), **options)


def same(a, b):
    return all(torch.equal(a[name], b[name]) for name in a)


def copied(module):
    return {name: value.clone() for name, value in module.state_dict().items()}


# ---- Who plays where ----


def test_environments_are_shared_out_and_one_lane_learns_where_there_are_opponents():
    env = opposed(n_envs=16, n_agents=2)
    assert {name: int(lanes.sum()) // 2 for name, lanes in env.kinds.items()} == dict(
        now=4, past=8, bot=4
    )
    learners = env.learners.view(16, 2)
    assert learners[:4].all() and (learners[4:].sum(1) == 1).all()
    for first in (4, 8, 12):  # two snapshots and the bot, four environments each
        assert learners[first : first + 4, 0].tolist() == [True, True, False, False]
    assert env.lineup.lanes.tolist() == [9, 11, 12, 14, 17, 19, 20, 22, 25, 27, 28, 30]
    assert env.lineup.sizes == [4, 4, 4]


@pytest.mark.parametrize("n_agents", [2, 3, 5])
def test_an_environment_with_opponents_keeps_the_contract(n_agents):
    env = opposed(15, n_agents)
    worlds = contract.rollout(env, 20)
    for world in worlds:
        assert torch.equal(world.learns, env.learners)
    seats = env.learners.view(15, n_agents)[-env.n_opposed :].sum(0)
    assert seats.sum() == env.n_opposed and seats.max() - seats.min() <= 3


def test_opponents_act_at_their_lanes_whatever_a_decision_says_of_them():
    env = opposed(bot=1.0, past=0.0)
    env.reset()
    decision = arrdict(actions=torch.ones(32, 1, dtype=torch.int64))
    env.step(decision)
    assert torch.equal(env.env.played[-1].flatten() == 1, env.learners)
    assert (env.env.played[-1].flatten()[~env.learners] == 2).all()
    assert (decision.actions == 1).all(), "what was given stays as it was"


def test_a_snapshot_plays_as_the_policy_did_and_remembers_its_own_episodes():
    """Two snapshots that always choose 0 and 1, of which one sees only its lanes' observations."""
    env = opposed(past=1.0, bot=0.0)
    for choice, actor in enumerate(env.actors):
        actor.output.linear.weight.data.zero_()
        actor.output.linear.bias.data.copy_(
            torch.tensor([-50.0] * 3).index_fill(0, torch.tensor(choice), 50)
        )
    env.reset()
    for _ in range(3):
        env.step(arrdict(actions=torch.full((32, 1), 2)))
    played, theirs = env.env.played[-1], ~env.learners.view(16, 2)
    assert (played[:8][theirs[:8]] == 0).all() and (played[8:][theirs[8:]] == 1).all()
    assert env.memory["0"].cell.abs().sum() > 0
    assert len(env.memory["0"].cell) == 8


def test_what_opponents_see_is_what_was_there_before_the_environment_went_on():
    class Buffer(Matrix):
        """Observations are one buffer, written anew by every step."""

        def _world(self, *flags):
            world = super()._world(*flags)
            self.buffer = getattr(self, "buffer", world.obs.clone())
            self.buffer.copy_(world.obs + len(self.played))
            return arrdict(world, obs=self.buffer)

    class Seeing(Always):
        seen = []

        def __call__(self, world, *rest):
            self.seen.append(world.obs.clone())
            return super().__call__(world, *rest)

    env = opposed(env=Buffer(4), bot=1.0, past=0.0)
    env.lineup.policies[0] = Seeing()
    env.reset()
    env.env.buffer.fill_(-1)
    env.step(arrdict(actions=torch.zeros(8, 1, dtype=torch.int64)))
    assert (Seeing.seen[0] >= 0).all()


@pytest.mark.parametrize(
    "options, sentence",
    [
        (dict(n_agents=1), "two agents or more, and Matrix has one"),
        (dict(past=0.7, bot=0.4), "opponents.past=0.7 and opponents.bot=0.4 are shares"),
        (dict(past=0.5, snapshots=9), "are 8, one for each of so many snapshots and not for 9"),
        (dict(bot=0.01), "opponents.bot=0.01 of 16 environments are none"),
        (dict(past=1.5), "past: 1.5 is out of range: allowed is from 0 to 1"),
        (dict(snapshots=0), "snapshots: 0 is out of range"),
    ],
)
def test_what_cannot_be_is_one_sentence(options, sentence):
    with pytest.raises(ValueError, match=sentence):
        opposed(**options)


# ---- Learning ----


def trainer_of(folder, env, samples, seed=1, **options):
    policy = policy_of(env, seed)
    if options:
        env = Opponents(env, policy, seed=seed, **options)
    learner = PPO(policy, n_steps=4, n_minibatches=2, lr=1e-2, seed=seed)
    rows = []

    class Rows:
        @staticmethod
        def write(samples, metrics, perf):
            rows.append({"samples": samples, **metrics})

    saver = Saver(folder, {})
    opponents = env if options else None
    run = Trainer(env, policy, learner, Rows, saver, Budget(samples), opponents=opponents)
    run.rows = rows
    return run


class Rigged(Matrix):
    """Pays the lanes of `mask` as `Matrix` does, and the others anything; `shows` them as those
    that learn.
    """

    mask, other, shows = None, 0.0, False

    def scored(self, reward):
        return torch.where(self.mask, reward, self.other * (1 + torch.arange(len(reward))))

    def _world(self, *flags):
        world = super()._world(*flags)
        return arrdict(world, learns=self.mask) if self.shows else world


@pytest.mark.parametrize("other", [0.0, 7.0, -1e6])
def test_an_update_is_the_same_bits_whatever_opponents_are_paid(tmp_path, other):
    weights = []
    for pay in (1.0, other):
        env = Rigged(16)
        run = trainer_of(tmp_path, env, 0, past=0.5, bot=0.25, scripted=High(), snapshots=2)
        env.mask, env.other = run.env.learners, pay
        for _ in range(3):
            run.rollout = run.collect()
            run.update()
        weights.append(copied(run.policy))
    assert same(*weights)
    assert not same(weights[0], copied(policy_of(env)))


@pytest.mark.parametrize("shows", [True, False])
def test_lanes_that_a_world_masks_teach_nothing(shows):
    """An environment may have opponents of its own; without its `learns` they are learnt from."""
    weights = []
    for pay in (1.0, 1e6):
        env = Rigged(16)
        env.mask, env.other, env.shows = torch.arange(32) % 4 > 0, pay, shows
        learner = PPO(policy_of(env), n_steps=4, n_minibatches=2)
        learner.update(learner.collector(env)())
        weights.append(copied(learner.policy))
    assert same(*weights) == shows


def test_only_lanes_that_learn_are_stored_and_counted(tmp_path):
    run = trainer_of(
        tmp_path, Matrix(16), 3 * 4 * 20, past=0.5, bot=0.25, scripted=High(), snapshots=2
    )
    run.train()
    assert run.rollout.n_lanes == 2 * 4 + 12 and run.samples == 3 * 4 * 20
    stored = run.rollout.learners.nonzero()[:, 0]
    place = run.rollout.obs[0, :, 0].argmax(1)
    assert torch.equal(place, stored % 2)
    played = torch.stack(run.env.env.played[-4:]).flatten(1)
    assert torch.equal(run.rollout.actions[:, :, 0], played[:, stored])


def test_without_opponents_nothing_is_left_out():
    env = Matrix(4)
    rollout = PPO(policy_of(env)).collector(env).rollout
    assert rollout.learners is None and rollout.n_lanes == 8
    world = env.reset()
    assert rollout.select_lanes(world) is world and rollout.scatter_actions(world.obs) is world.obs


def test_a_bad_number_is_named_by_the_lane_of_its_environment(tmp_path):
    env = Rigged(16)
    run = trainer_of(tmp_path, env, 0, past=0.0, bot=1.0, scripted=High())
    lane = int(run.env.learners.nonzero()[-1, 0])
    env.mask = torch.ones(32, dtype=torch.bool)
    env.scored = lambda reward: reward.index_fill(0, torch.tensor(lane), torch.nan)
    run.rollout = run.collect()
    run.update()
    with pytest.warns(UserWarning, match=f"reward of lane {lane} was nan"):
        run.check_numbers()


@pytest.mark.parametrize(
    "options",
    [dict(past=1.0, snapshots=2, every=10), dict(bot=1.0, scripted=Middle())],
)
def test_a_policy_learns_to_beat_its_opponents(tmp_path, options):
    """Who always beats what it was until lately ends at the highest number."""
    run = trainer_of(tmp_path, Matrix(32), 120 * 4 * 32, **options)
    run.train()
    assert (run.rollout.actions == 2).float().mean() > 0.95
    (kind,) = run.env.kinds
    won = [row[f"episode/won/{kind}"] for row in run.rows if f"episode/won/{kind}" in row]
    assert won[0] < 0.9 and max(won) > 0.95


# ---- The pool ----


def test_a_refresh_renews_the_oldest_snapshot_in_place():
    env = Matrix(16)
    policy = policy_of(env)
    pool = opposed(env=env, policy=policy, every=3)
    first, places = (
        copied(policy),
        [[p.data_ptr() for p in actor.parameters()] for actor in pool.actors],
    )
    pool.reset()
    pool.step(arrdict(actions=torch.zeros(32, 1, dtype=torch.int64)))
    kept = []
    for updates in range(1, 10):
        with torch.no_grad():
            for weight in policy.parameters():
                weight.add_(0.01)
        pool.refresh(policy, updates)
        if updates % 3 == 0:
            kept.append(copied(policy))
        newest = [kept[i] if i >= 0 else first for i in (len(kept) - 2, len(kept) - 1)]
        expected = newest if len(kept) % 2 == 0 else newest[::-1]
        for actor, weights in zip(pool.actors, expected, strict=True):
            assert same(actor.state_dict(), weights), updates
    assert places == [[p.data_ptr() for p in actor.parameters()] for actor in pool.actors]


def test_a_renewed_snapshot_forgets_its_episodes_and_others_do_not():
    env = Matrix(16)
    policy = policy_of(env)
    pool = opposed(env=env, policy=policy, every=1)
    pool.reset()
    pool.step(arrdict(actions=torch.zeros(32, 1, dtype=torch.int64)))
    pool.refresh(policy, 1)
    assert not pool.memory["0"].cell.any() and pool.memory["1"].cell.any()


def test_an_actor_is_the_policy_without_what_learns():
    env = Matrix(4)
    policy = policy_of(env, critic="asymmetric")
    actor = policy.actor()
    assert actor.critic is None and not any(p.requires_grad for p in actor.parameters())
    assert all(p.requires_grad for p in policy.parameters()) and policy.critic is not None
    world, generator = env.reset(), torch.Generator()
    ours, theirs = (
        each(world, each.initial(8), generator=generator.manual_seed(1))[0]
        for each in (policy, actor)
    )
    assert torch.equal(ours.logits, theirs.logits) and torch.equal(ours.actions, theirs.actions)


def test_a_resumed_run_has_the_same_pool_and_goes_on_as_it_would_have(tmp_path):
    options = dict(past=0.5, bot=0.25, scripted=High(), snapshots=2, every=2)
    first = trainer_of(tmp_path, Matrix(16), 5 * 4 * 20, **options)
    first.train()
    again = trainer_of(tmp_path, Matrix(16), 9 * 4 * 20, seed=2, **options)
    again.load_state_dict(checkpoint.load_latest(tmp_path).state)
    for ours, theirs in zip(again.opponents.actors, first.opponents.actors, strict=True):
        assert same(ours.state_dict(), theirs.state_dict())
    # the environment starts anew: in the first run as well
    first.collect = first.learner.collector(first.env)
    for run in (first, again):
        for _ in range(4):
            run.rollout = run.collect()
            run.update()
    assert same(first.policy.state_dict(), again.policy.state_dict())
    for ours, theirs in zip(again.opponents.actors, first.opponents.actors, strict=True):
        assert same(ours.state_dict(), theirs.state_dict())
    assert first.opponents.take() == again.opponents.take()


# ---- Who has won ----


def counted(terminal, returns, seat):
    """`duels.pairs`, pair by pair."""
    won, decided = [], []
    for ends, earned, me in zip(terminal.tolist(), returns.tolist(), seat[:, 0].tolist()):
        scores = []
        for i in range(len(ends)):
            if i == me or not (ends[i] or ends[me]):
                continue
            if ends[i] and ends[me]:
                scores.append(0.5 if earned[i] == earned[me] else float(earned[me] > earned[i]))
            else:
                scores.append(float(ends[i]))
        won.append(sum(scores))
        decided.append(len(scores))
    return won, decided


@pytest.mark.parametrize("n_agents", [2, 3, 6])
def test_pairs_are_won_by_who_survives_and_else_by_who_earned_more(n_agents):
    torch.manual_seed(1)
    terminal = torch.rand(500, n_agents) < 0.4
    returns = torch.randint(-2, 3, (500, n_agents)).float()
    seat = torch.randint(n_agents, (500, 1))
    won, decided = duels.pairs(terminal, returns, seat)
    assert (won.tolist(), decided.tolist()) == counted(terminal, returns, seat)


@pytest.mark.parametrize("mortal", [False, True])
def test_the_share_won_is_told_by_kind_of_opponent(mortal):
    env = opposed(16, mortal and 3 or 2, env=Matrix(16, 3 if mortal else 2, mortal), bot=0.25)
    for actor in env.actors:
        actor.output.linear.weight.data.zero_()
        actor.output.linear.bias.data.copy_(torch.tensor([0.0, 99, 0]))
    env.reset()
    lanes = len(env.learners)
    for action in (1, 2, 2, 2):  # every second step is the reset after an end
        env.step(arrdict(actions=torch.full((lanes, 1), action)))
    found = env.take()
    # against snapshots that choose 1: a 1 decides nothing, a 2 wins; the highest never loses, and
    # equal ones decide nothing
    assert found["episode/won/past"] == 1.0
    assert found["episode/won/bot"] == 0.0 and env.take() == {}


def test_only_what_an_episode_paid_decides_it():
    """Two games are lost by a point and the third is won by one: on the whole the return is -1."""
    env = opposed(4, bot=1.0, past=0.0, scripted=Middle())
    env.reset()
    for action in (0, 0, 0, 0, 2):  # every second step is the reset after an end
        env.step(arrdict(actions=torch.full((8, 1), action)))
    assert env.take() == {"episode/won/bot": pytest.approx(1 / 3)}


def test_roles_and_kinds_of_opponents_have_means_of_their_own(tmp_path):
    env = Matrix(16, roles=("left", "right"))
    run = trainer_of(tmp_path, env, 4 * 4 * 20, past=0.5, bot=0.25, scripted=High(), snapshots=2)
    run.train()
    row = run.rows[0]
    for name in ("left", "right", "now", "past", "bot"):
        assert row[f"episode/paid/{name}"] == row[f"episode/return/{name}"]
    assert row["episode/return/bot"] == -1, "nobody beats the highest number"
    assert row["episode/return/now"] == pytest.approx(0, abs=1e-9)
