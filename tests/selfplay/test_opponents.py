"""Opponents: which lanes they control, that their transitions are not learned from, how snapshots
are refreshed and saved, how wins are counted, and that a policy learns against them.
"""

import copy
import itertools

import pytest
import torch
from torch.utils._pytree import tree_leaves

from megastep import contract, envs, spaces, toys
from megastep.agents.algorithms.ppo import PPO
from megastep.agents.networks.policy import Policy
from megastep.agents.runs.saver import Saver
from megastep.agents.selfplay.mixed_policy import rotating_teams, score_pairs
from megastep.agents.selfplay.opponents import Opponents
from megastep.agents.storage.rollout import SEQUENCES
from megastep.agents.training.budget import Budget
from megastep.agents.training.trainer import Trainer
from megastep.arrdict import arrdict
from megastep.dotdict import dotdict
from megastep.env_state import EnvState
from tests.helpers.games import Always, High, Matrix, Middle
from tests.helpers.logged import Rows
from tests.helpers.weights import copied, same


def policy_of(env, seed=1, width=8, **options):
    return Policy(env.obs_space, env.action_space, width=width, seed=seed, **options)


def make_opponents(n_envs=16, n_agents=2, env=None, policy=None, **options):
    env = env or Matrix(n_envs, n_agents)
    options = {**dict(past=0.5, bot=0.25, scripted=High(), snapshots=2, every=3), **options}
    return Opponents(env, policy or policy_of(env), **options)


# ---- Lanes and actions ----


@pytest.mark.parametrize("begins", [False, True])
def test_opponents_act_once_per_step(begins):
    """The same, whether they start before the actions are known or in the step."""
    env, other = make_opponents(), make_opponents()
    for one in (env, other):
        one.reset()
    actions = []
    for one in (env, other):
        step = one.env.step
        one.env.step = lambda given, step=step: actions.append(given["actions"]) or step(given)
    for _ in range(5):
        if begins:
            env.begin_step()
        for one in (env, other):
            one.step(arrdict(actions=torch.zeros(32, 1, dtype=torch.int64)))
        assert torch.equal(*actions[-2:])
    assert same(env.hidden_state["0"], other.hidden_state["0"]) and env.acting is None


def collected(device, has_streams, is_captured=False):
    """Returns the tensors of four rollouts against past selves and a bot, with new weights and a
    new snapshot after each.
    """
    env = envs.Deathmatch(
        37, [toys.box()], n_agents=3, device=device, limit=20, res=128, privileged=True
    )
    policy = policy_of(env, width=64, privileged_space=env.privileged_space, encoder="conv")
    policy = policy.to(device)
    opponents = Opponents(env, policy, env.bot(), past=0.5, bot=0.25, snapshots=3, every=1, seed=2)
    if not has_streams:
        opponents.mixed_policy.streams = []
    collector = PPO(policy, n_steps=8, n_minibatches=2).collector(opponents)
    collector.can_capture = is_captured
    tensors = []
    for n_updates in range(1, 5):
        rollout = collector()
        parts = [getattr(rollout, name) for name in (*SEQUENCES, "values", "state")]
        tensors += [leaf.clone() for leaf in tree_leaves(parts) if leaf is not None]
        with torch.no_grad():
            for weight in policy.parameters():
                weight.mul_(1.5)
        opponents.refresh_snapshots(policy, n_updates)
    assert (collector.graph is not None) == is_captured
    return tensors


@pytest.mark.cuda
@pytest.mark.parametrize("is_captured", [False, True])
def test_streams_of_opponents_change_no_bit(is_captured):
    """They act beside the policy, or one after the other: three times, as a race may go well."""
    expected = collected("cuda", False, is_captured)
    for _ in range(3):
        for tensor, other in zip(collected("cuda", True, is_captured), expected, strict=True):
            assert torch.equal(tensor, other)


def test_fractions_of_environments_and_learning_slots():
    env = make_opponents(n_envs=16, n_agents=2)
    assert {name: int(lanes.sum()) // 2 for name, lanes in env.matchups.items()} == dict(
        now=4, past=8, bot=4
    )
    learners = env.learners.view(16, 2)
    assert learners[:4].all() and (learners[4:].sum(1) == 1).all()
    for first in (4, 8, 12):  # two snapshots and the bot, four environments each
        assert learners[first : first + 4, 0].tolist() == [True, True, False, False]
    assert env.mixed_policy.lanes.tolist() == [9, 11, 12, 14, 17, 19, 20, 22, 25, 27, 28, 30]
    assert env.mixed_policy.sizes == [4, 4, 4]


def test_a_team_learns_and_opponents_play_the_other():
    """Two hiders and a seeker: in half of the environments either learns."""
    env = make_opponents(env=Matrix(16, 3, roles=("hider", "hider", "seeker")))
    hiders, seeker = [True, True, False], [False, False, True]
    learners = env.learners.view(16, 3).tolist()
    assert learners == [[True] * 3] * 4 + [hiders, hiders, seeker, seeker] * 3
    assert env.mixed_policy.sizes == [6, 6, 6]
    env.reset()
    env.step(arrdict(actions=torch.ones(48, 1, dtype=torch.int64)))
    played = env.env.played[-1]
    assert (played[env.learners.view(16, 3)] == 1).all()
    assert (played[12:14, 2] == 2).all() and (played[14:, :2] == 2).all(), "the bot"
    # the bot's 2 beats a 1 in each of its two pairs
    assert env.pairs[:, -4:].tolist() == [[0.0] * 4, [2.0] * 4]
    one = make_opponents(env=Matrix(16, 3, roles=("hider", "hider", "seeker")), role="seeker")
    assert one.learners.view(16, 3).tolist() == [[True] * 3] * 4 + [seeker] * 12
    with pytest.raises(ValueError, match="role=hunter is none of .'hider', 'seeker'"):
        make_opponents(env=Matrix(16, 3, roles=("hider", "hider", "seeker")), role="hunter")


@pytest.mark.parametrize("n_agents", [2, 3, 5])
def test_opponents_satisfy_the_contract(n_agents):
    env = make_opponents(15, n_agents)
    worlds = contract.rollout(env, 20)
    for world in worlds:
        assert torch.equal(world.learns, env.learners)
    counts = env.learners.view(15, n_agents)[-env.n_opposed :].sum(0)  # by slot
    assert counts.sum() == env.n_opposed and counts.max() - counts.min() <= 3


def test_snapshots_act_in_their_own_lanes_with_their_own_hidden_state():
    """Of two snapshots, one always chooses 0 and the other always 1."""
    env = make_opponents(past=1.0, bot=0.0)
    for choice, snapshot in enumerate(env.snapshots):
        snapshot.output.linear.weight.data.zero_()
        snapshot.output.linear.bias.data.copy_(
            torch.tensor([-50.0] * 3).index_fill(0, torch.tensor(choice), 50)
        )
    env.reset()
    for _ in range(3):
        env.step(arrdict(actions=torch.full((32, 1), 2)))
    played, theirs = env.env.played[-1], ~env.learners.view(16, 2)
    assert (played[:8][theirs[:8]] == 0).all() and (played[8:][theirs[8:]] == 1).all()
    assert env.hidden_state["0"].cell.abs().sum() > 0
    assert len(env.hidden_state["0"].cell) == 8


def test_opponents_have_their_own_actions_in_each_part_of_a_dict():
    class Parts(Matrix):
        action_space = dotdict(
            of=dotdict(number=Matrix.action_space, push=spaces.MultiContinuous(1, 2))
        )

        def step(self, decision):
            self.pushes = decision.actions.of.push
            return super().step(arrdict(actions=decision.actions.of.number))

    env = make_opponents(env=Parts(8), past=1.0, bot=0.0)
    env.reset()
    parts = arrdict(number=torch.full((16, 1), 2), push=torch.full((16, 1, 2), 0.5))
    env.step(arrdict(actions=arrdict(of=parts)))
    assert ((env.env.pushes == 0.5).all((1, 2)) == env.learners).all()
    assert (env.env.played[-1].flatten()[env.learners] == 2).all()


def test_opponents_act_on_a_copy_of_observations():
    class Buffer(Matrix):
        """Observations are one buffer that every step overwrites."""

        def _world(self, *flags):
            world = super()._world(*flags)
            self.buffer = getattr(self, "buffer", world.obs.clone())
            self.buffer.copy_(world.obs + len(self.played))
            return arrdict(world, obs=self.buffer)

    class Recorder(Always):
        observations = []

        def __call__(self, world, *rest):
            self.observations.append(world.obs.clone())
            return super().__call__(world, *rest)

    env = make_opponents(env=Buffer(4), bot=1.0, past=0.0)
    env.mixed_policy.policies[0] = Recorder()
    env.reset()
    env.env.buffer.fill_(-1)
    env.step(arrdict(actions=torch.zeros(8, 1, dtype=torch.int64)))
    assert (Recorder.observations[0] >= 0).all()


@pytest.mark.parametrize(
    "options, message",
    [
        (dict(n_agents=1), "at least two agents; Matrix has one"),
        (dict(past=0.7, bot=0.4), "opponents.past=0.7 and opponents.bot=0.4"),
        (dict(past=0.5, snapshots=9), "is 8 environments.*opponents.snapshots=9"),
        (dict(bot=0.01), "opponents.bot=0.01 of 16 environments is none.*env.n_envs"),
        (dict(past=0.0, bot=0.0), "so their sum must be above 0"),
        (dict(scripted=None), "opponents.bot=0.25 needs a bot that plays: pass scripted="),
        (dict(past=1.5), "past: 1.5"),
        (dict(snapshots=0), "snapshots: 0"),
    ],
)
def test_bad_settings_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        make_opponents(**options)


# ---- Learning ----


def trainer_of(folder, env, samples, seed=1, **options):
    policy = policy_of(env, seed)
    if options:
        env = Opponents(env, policy, seed=seed, **options)
    learner = PPO(policy, n_steps=4, n_minibatches=2, lr=1e-2, seed=seed)
    rows, saver = Rows(), Saver(folder, {})
    trainer = Trainer(env, policy, learner, Budget(samples), saver=saver, callbacks=[rows])
    trainer.rows = rows
    return trainer


class Rigged(Matrix):
    """Rewards the lanes of `mask` as `Matrix` does, and the others by `other`. With `shows`, worlds
    have `mask` as `learns`.
    """

    mask, other, shows = None, 0.0, False

    def scored(self, reward):
        return torch.where(self.mask, reward, self.other * (1 + torch.arange(len(reward))))

    def _world(self, *flags):
        world = super()._world(*flags)
        return arrdict(world, learns=self.mask) if self.shows else world


@pytest.mark.parametrize("other", [0.0, 7.0, -1e6])
def test_update_does_not_depend_on_opponents_rewards(tmp_path, other):
    weights = []
    for reward in (1.0, other):
        env = Rigged(16)
        run = trainer_of(tmp_path, env, 0, past=0.5, bot=0.25, scripted=High(), snapshots=2)
        env.mask, env.other = run.env.learners, reward
        for _ in range(3):
            run.update()
        weights.append(copied(run.policy))
    assert same(*weights)
    assert not same(weights[0], copied(policy_of(env)))


@pytest.mark.parametrize("shows", [True, False])
def test_lanes_with_learns_false_are_not_learned_from(shows):
    """An environment may have opponents of its own, and say so by `learns`."""
    weights = []
    for reward in (1.0, 1e6):
        env = Rigged(16)
        env.mask, env.other, env.shows = torch.arange(32) % 4 > 0, reward, shows
        learner = PPO(policy_of(env), n_steps=4, n_minibatches=2)
        learner.update(learner.collector(env)())
        weights.append(copied(learner.policy))
    assert same(*weights) == shows


@pytest.mark.parametrize(
    "options",
    [
        dict(bot=1.0, scripted=Middle()),
        pytest.param(dict(past=1.0, snapshots=2, every=10), marks=pytest.mark.nightly),
    ],
)
def test_policy_learns_to_beat_its_opponents(tmp_path, options):
    """A policy that beats its own past ends at the highest number."""
    run = trainer_of(tmp_path, Matrix(32), 120 * 4 * 32, **options)
    run.train()
    assert (run.rollout.actions == 2).float().mean() > 0.95
    (kind,) = run.env.matchups
    key = f"episode/won/{kind}"
    won = [row[key] for row in run.rows if key in row]
    assert won[0] < 0.9 and max(won) > 0.95


# ---- Snapshots ----


def test_refresh_replaces_the_oldest_snapshot_in_place():
    env = Matrix(16)
    policy = policy_of(env)
    pool = make_opponents(env=env, policy=policy, every=3)

    def addresses():
        return [[p.data_ptr() for p in snapshot.parameters()] for snapshot in pool.snapshots]

    first, first_addresses = copied(policy), addresses()
    pool.reset()
    pool.step(arrdict(actions=torch.zeros(32, 1, dtype=torch.int64)))
    refreshed = []
    for updates in range(1, 10):
        with torch.no_grad():
            for weight in policy.parameters():
                weight.add_(0.01)
        pool.refresh_snapshots(policy, updates)
        if updates % 3 == 0:
            refreshed.append(copied(policy))
        last_two = [*[first] * 2, *refreshed][-2:]
        expected = last_two if len(refreshed) % 2 == 0 else last_two[::-1]
        for snapshot, weights in zip(pool.snapshots, expected, strict=True):
            assert same(snapshot.state_dict(), weights), updates
    assert addresses() == first_addresses


# ---- Wins ----


def slow_score_pairs(terminal, returns, own):
    """`score_pairs`, pair by pair."""
    won, decided = [], []
    for is_terminal, total, ours in zip(terminal.tolist(), returns.tolist(), own.tolist()):
        scores, slots = [], range(len(ours))
        for me, i in itertools.product(slots, slots):
            if not ours[me] or ours[i] or not (is_terminal[i] or is_terminal[me]):
                continue
            if is_terminal[i] and is_terminal[me]:
                scores.append(0.5 if total[i] == total[me] else float(total[me] > total[i]))
            else:
                scores.append(float(is_terminal[i]))
        won.append(sum(scores))
        decided.append(len(scores))
    return won, decided


@pytest.mark.parametrize("n_agents", [2, 3, 6])
def test_pairs_are_won_by_survival_and_else_by_return(n_agents):
    torch.manual_seed(1)
    terminal = torch.rand(500, n_agents) < 0.4
    returns = torch.randint(-2, 3, (500, n_agents)).float()
    for own in (torch.rand(500, n_agents) < 0.5, rotating_teams(500, torch.arange(n_agents))):
        won, decided = score_pairs(terminal, returns, own)
        assert (won.tolist(), decided.tolist()) == slow_score_pairs(terminal, returns, own)


@pytest.mark.parametrize("roles", ["ab", "abcde", "abaab"])
def test_pairs_of_a_gpu_are_those_of_the_cpu(roles, to_gpu):
    torch.manual_seed(1)
    n_agents, of_roles = len(roles), Matrix(600, len(roles), roles=[*roles])
    envs = [make_opponents(env=of_roles, past=0.0, bot=0.9) for _ in range(2)]
    for name in ("returns", "pairs", "own"):
        setattr(envs[1], name, to_gpu(getattr(envs[1], name)))
    for _ in range(5):
        terminal = torch.rand(600 * n_agents) < 0.3
        truncated = ~terminal & (torch.rand(600 * n_agents) < 0.2)
        reward = torch.randint(-2, 3, (600 * n_agents,)).float()
        for env, to in zip(envs, (torch.Tensor.cpu, to_gpu), strict=True):
            parts = dict(reward=reward, terminal=terminal, truncated=truncated)
            env._count_pairs({key: to(leaf) for key, leaf in parts.items()})
    on_cpu, on_gpu = envs
    assert on_cpu.pairs.any()
    torch.testing.assert_close(on_gpu.pairs.cpu(), on_cpu.pairs)
    assert torch.equal(on_gpu.returns.cpu(), on_cpu.returns)


@pytest.mark.parametrize("mortal", [False, True])
def test_win_rates_by_kind_of_opponent(mortal):
    env = make_opponents(env=Matrix(16, 3 if mortal else 2, mortal), bot=0.25)
    for snapshot in env.snapshots:
        snapshot.output.linear.weight.data.zero_()
        snapshot.output.linear.bias.data.copy_(torch.tensor([0.0, 99, 0]))
    env.reset()
    lanes = len(env.learners)
    for action in (1, 2, 2, 2):  # every second step is the reset after an end
        env.step(arrdict(actions=torch.full((lanes, 1), action)))
    win_rates = env.pop_win_rates()
    # snapshots choose 1: against them a 1 decides nothing and a 2 wins. The bot chooses 2: against
    # it a 1 loses and a 2 decides nothing.
    assert win_rates["episode/won/past"] == 1.0
    assert win_rates["episode/won/bot"] == 0.0 and env.pop_win_rates() == {}


def test_reset_forgets_the_returns_of_unfinished_episodes():
    """The learning agents earn 9 or more in a step that ends nothing, and lose after a reset."""
    env = make_opponents(env=Rigged(4), bot=1.0, past=0.0, scripted=Middle())
    for other, action in ((9.0, 1), (0.0, 0)):
        env.env.mask, env.env.other = ~env.learners, other
        env.reset()
        env.step(arrdict(actions=torch.full((8, 1), action)))
    assert env.pop_win_rates() == {"episode/won/bot": 0.0}


def test_state_is_whole():
    """A copy goes on with the same snapshots, memories, scores and random numbers."""
    env, other = (make_opponents(16, past=0.5, bot=0.25) for _ in range(2))
    other.reset()
    env.reset()
    for action in (1, 1, 2):  # the second step is the reset after an end
        env.step(arrdict(actions=torch.full((32, 1), action)))
    other.load_state_dict(copy.deepcopy(env.state_dict()))
    EnvState(other.env).load_state_dict(copy.deepcopy(EnvState(env.env).state_dict()))
    for _ in range(3):
        worlds = [one.step(arrdict(actions=torch.ones(32, 1, dtype=int))) for one in (env, other)]
        assert torch.equal(*(world.reward for world in worlds))
    won = env.pop_win_rates()
    assert "episode/won/bot" in won and other.pop_win_rates() == won
    assert same(other.snapshots[1].state_dict(), env.snapshots[1].state_dict())
    with pytest.raises(ValueError, match="have 2 snapshots, these have 3"):
        make_opponents(snapshots=3).load_state_dict(env.state_dict())
