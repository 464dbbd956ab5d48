"""MinAtar: equal to the original, which draws our random numbers, in every observation, reward and
end.
"""

import logging

import numpy as np
import pytest
import torch
from torch.utils._pytree import tree_leaves as leaves

import megastep
from megastep import envs
from megastep.agents.cli import train
from megastep.arrdict import arrdict
from megastep.envs.minatar import ACTIONS
from tests.helpers.pong_twins import philox

every_game = pytest.mark.parametrize("game", ACTIONS)


class OurDraws:
    """Takes the place of the original's NumPy generator: an environment's draws, in order."""

    def __init__(self, lane, seed):
        self.lane, self.seed, self.n_drawn = lane, seed, 0

    def word(self):
        self.n_drawn += 1
        return philox(self.lane, self.n_drawn - 1, self.seed)[0]

    def rand(self, size=None):
        draws = [(self.word() + 0.5) / 2**32 for _ in range(size or 1)]
        return draws[0] if size is None else np.array(draws)

    def randint(self, low, high=None, size=None):
        low, high = (0, low) if high is None else (low, high)
        draws = [low + (self.word() * (high - low) >> 32) for _ in range(size or 1)]
        return draws[0] if size is None else np.array(draws)


def imported(name):
    """Returns a module of the original, which warns that it cannot draw."""
    logging.disable(logging.WARNING)
    try:
        return pytest.importorskip(name)
    finally:
        logging.disable(logging.NOTSET)


def state_of(env):
    return [leaf for leaf in (env.games, env.lists, env.images) if leaf is not None]


def best_of(env, plans):
    """Returns the first actions (N, 1) of the plans (K, T, N, 1) that earn most and survive."""
    before, scores = [leaf.clone() for leaf in state_of(env)], []
    for plan in plans:
        score, alive = torch.zeros(env.n_envs), torch.ones(env.n_envs)
        for actions in plan:
            world = env.step(arrdict(actions=actions))
            score += alive * (world.reward - 100.0 * world.terminal)
            alive *= ~(world.terminal | world.truncated)
        if world.obs.shape[2] == 10:  # divers on board, so that six are brought up in Seaquest
            score += alive * world.obs[:, 0, 8].flatten(1).sum(1)
        scores.append(score)
        for leaf, old in zip(state_of(env), before):
            leaf.copy_(old)
    best = torch.stack(scores).argmax(0)
    return plans[best, 0, torch.arange(env.n_envs)]


def play(game, n_envs, n_episodes, seed, n_plans=0, **settings):
    """Compares n_episodes in each lane. Lanes act at random; with plans, odd lanes take the best of
    some random plans of 21 steps and of those to repeat an action. Returns how many episodes and
    steps were compared, and the best return.
    """
    ours = envs.MinAtar(n_envs, id=game, seed=seed, device="cpu", **settings)
    words = dict(sticky_action_prob=settings.get("sticky", 0.1))
    words |= dict(difficulty_ramping=settings.get("ramping", True))
    original = imported("minatar.environment")
    theirs = [original.Environment(game, **words) for _ in range(n_envs)]
    numbers = theirs[0].minimal_action_set()
    for e, env in enumerate(theirs):
        env.random = env.env.random = OurDraws(e, seed)
    random = torch.Generator().manual_seed(seed)
    is_careful = torch.arange(n_envs)[:, None] % 2 == 1
    always = torch.arange(len(numbers)).view(-1, 1, 1, 1).expand(-1, 7, n_envs, 1)
    has_ended, returns = np.ones(n_envs, bool), np.zeros(n_envs)
    n_ended, n_steps, best = np.zeros(n_envs, int), 0, 0
    world = ours.reset()
    actions = ours.no_actions
    while n_ended.min() < n_episodes:
        rewards, dones = np.zeros(n_envs), np.zeros(n_envs, bool)
        for e, env in enumerate(theirs):
            if has_ended[e]:
                env.reset()
            else:
                rewards[e], dones[e] = env.act(numbers[int(actions[e])])
        states = np.stack([env.state() for env in theirs])
        assert np.array_equal(world.obs[:, 0].permute(0, 2, 3, 1).numpy(), states)
        assert np.array_equal(world.reward.numpy(), rewards)
        assert np.array_equal(world.terminal.numpy(), dones)
        assert np.array_equal(world.reset.numpy(), has_ended)
        n_steps += int((~has_ended).sum())
        returns = np.where(has_ended, 0, returns + rewards)
        best = max(best, returns.max())
        has_ended = (world.terminal | world.truncated).numpy()
        n_ended += has_ended
        plans = torch.randint(len(numbers), (n_plans or 1, 7, n_envs, 1), generator=random)
        actions = plans[0, 0]
        if n_plans:
            plans = torch.cat([plans, always]).repeat_interleave(3, 1)
            actions = torch.where(is_careful, best_of(ours, plans), actions)
        world = ours.step(arrdict(actions=actions))
    return int(n_ended.sum()), n_steps, int(best)


@every_game
def test_equals_the_original(game):
    play(game, n_envs=24, n_episodes=1, seed=3, limit=200)


def test_equals_the_original_without_sticky_actions_and_ramping(game="asterix"):
    play(game, n_envs=8, n_episodes=1, seed=5, limit=300, sticky=0, ramping=False)


def test_freeway_ends_by_itself():
    assert play("freeway", n_envs=1, n_episodes=1, seed=2) == (1, 2501, 0)


def test_breakout_in_any_state_equals_the_original():
    """Few games come to where a ball is between bricks."""
    n, random, original = 400, np.random.default_rng(1), imported("minatar.environment")
    ours = envs.MinAtar(n, sticky=0, device="cpu")
    ours.reset()
    theirs = [original.Environment("breakout", sticky_action_prob=0) for _ in range(n)]
    for e, env in enumerate(theirs):
        env.reset()
        game = env.env
        game.ball_x, game.ball_y, game.ball_dir = random.integers((10, 5, 4))
        game.brick_map[1:4] = bricks = random.integers(2, size=(3, 10))
        bits = int((bricks.flatten() << np.arange(30)).sum())
        ball = game.ball_x, game.ball_y, game.last_x, game.last_y, game.ball_dir
        ours.games[4:, e] = torch.tensor([*ball, game.pos, 0, bits])
    alive = np.ones(n, bool)
    for _ in range(12):
        actions = random.integers(3, size=(n, 1))
        world = ours.step(arrdict(actions=torch.from_numpy(actions)))
        for e in alive.nonzero()[0]:
            reward, done = theirs[e].act([0, 1, 3][actions[e, 0]])
            assert (float(world.reward[e]), bool(world.terminal[e])) == (reward, done)
            assert np.array_equal(world.obs[e, 0].permute(1, 2, 0).numpy(), theirs[e].state())
        alive &= ~world.terminal.numpy()
    assert alive.sum() > 20


def test_seaquest_with_things_that_are_equal_equals_the_original():
    """The original removes the first of equal things from lists that it walks backwards."""
    n, random, original = 400, np.random.default_rng(1), imported("minatar.environment")
    ours = envs.MinAtar(n, id="seaquest", sticky=0, seed=1, device="cpu")
    ours.reset()
    theirs = [original.Environment("seaquest", sticky_action_prob=0) for _ in range(n)]
    # first rows of `lists`, things, and numbers of a thing
    lists = dict(f_bullets=(0, 4, 3), divers=(4, 3, 4), e_bullets=(8, 8, 3))
    lists |= dict(e_fish=(40, 16, 4), e_subs=(72, 16, 5))
    for e, env in enumerate(theirs):
        env.random = env.env.random = OurDraws(e, 1)
        env.reset()
        game, is_near = env.env, e % 2  # to the surface
        game.sub_x, game.sub_y, game.surface = 8 if is_near else 5, 1 if is_near else 8, False
        game.diver_count, game.move_speed, game.ramp_index = random.integers((0, 2, 0), (7, 5, 2))
        state = game.sub_x, game.sub_y, game.diver_count, 0, game.move_speed, game.ramp_index
        ours.games[[4, 5, 8, 9, 14, 15], e] = torch.tensor(state, dtype=torch.int32)
        for k, (name, (first, size, width)) in enumerate(lists.items()):
            things = random.integers(0, (4, 2, 2, 3, 11), (size, 5)) + (3, 2, 0, 0, 0)
            things[:, width:] = 0
            fields = things[:, :width].tolist()
            setattr(game, name, [[x, y, bool(right), *more] for x, y, right, *more in fields])
            packed = 2 + things @ (1, 16, 1 << 8, 1 << 12, 1 << 16)
            ours.lists[first : first + size, e] = torch.from_numpy(packed).int()
            ours.games[16 + k, e] = size
    for _ in range(12):
        actions = random.integers(5, size=(n, 1))
        world = ours.step(arrdict(actions=torch.from_numpy(actions)))
        for e, env in enumerate(theirs):
            if not env.env.terminal:
                reward, done = env.act(actions[e, 0])
                assert (float(world.reward[e]), bool(world.terminal[e])) == (reward, done)
                assert np.array_equal(world.obs[e, 0].permute(1, 2, 0).numpy(), env.state())
    assert sum(not env.env.terminal for env in theirs) > 20


@pytest.mark.slow
@pytest.mark.parametrize("game", ["asterix", "seaquest", "space_invaders"])
def test_equals_the_original_when_played_well(game):
    play(game, n_envs=4, n_episodes=1, seed=3, n_plans=2, limit=400)


@pytest.mark.nightly
@every_game
def test_equals_the_original_for_a_thousand_episodes(game):
    print(game, *play(game, n_envs=1000, n_episodes=1, seed=7, n_plans=2))


@pytest.mark.nightly
def test_an_agent_trained_here_earns_the_same_in_the_original(here):
    words = ["experiment=minatar", "device=cpu", "agent.encoder=linear", "agent.width=32"]
    assert train.main([*words, "samples=200000", "seconds=null", "folder=run"]) == 0
    run, n = megastep.load("run"), 128
    (row,) = run.evaluate(episodes=1024, baseline="none")
    policy = run.policy
    original = imported("minatar.gym")
    theirs = [original.BaseEnv("breakout", use_minimal_action_set=True) for _ in range(n)]
    state, generator = policy.initial(n), torch.Generator().manual_seed(1)
    obs = np.stack([env.reset(seed=e)[0] for e, env in enumerate(theirs)])
    returns, totals, has_ended = [[] for _ in theirs], np.zeros(n), np.ones(n, bool)
    while min(map(len, returns)) < 4:
        images = torch.from_numpy(obs).permute(0, 3, 1, 2)[:, None].byte()
        world = arrdict(obs=images, reset=torch.from_numpy(has_ended))
        decision, state = policy(world, state, generator=generator)
        steps = [env.step(int(a)) for env, a in zip(theirs, decision.actions[:, 0])]
        totals += [step[1] for step in steps]
        has_ended = np.array([step[2] for step in steps])
        obs = np.stack([step[0] for step in steps])
        for e in has_ended.nonzero()[0]:
            returns[e].append(totals[e])
            totals[e], obs[e] = 0, theirs[e].reset()[0]
    their_returns = np.array([lane[:4] for lane in returns]).flatten()
    error = np.hypot(
        their_returns.std() / len(their_returns) ** 0.5, (row["upper"] - row["lower"]) / 4
    )
    assert row["return"] > 2 and abs(their_returns.mean() - row["return"]) < 4 * error


@pytest.mark.cuda
@every_game
def test_gpu_has_the_bits_of_the_cpu(game):
    worlds = []
    actions = torch.randint(3, (400, 300, 1), generator=torch.Generator().manual_seed(1))
    for device in "cpu", "cuda":
        env = envs.MinAtar(300, id=game, device=device)
        env.reset()
        worlds.append([env.step(arrdict(actions=a.to(device))).clone() for a in actions])
        worlds[-1].append(arrdict(dict(enumerate(state_of(env)))))
    for ours, theirs in zip(*worlds, strict=True):
        assert all((a == b.cpu()).all() for a, b in zip(leaves(ours), leaves(theirs), strict=True))


@pytest.mark.parametrize("version, n_actions", [("v0", 6), ("v1", 4)])
def test_registered_ids(version, n_actions):
    """With the same seed, both do the same where their actions mean the same."""
    env = envs.MinAtar(2, id=f"MinAtar/SpaceInvaders-{version}", device="cpu")
    twin = envs.MinAtar(2, id="space_invaders", device="cpu")
    assert env.action_space.n_actions == n_actions
    env.reset()
    twin.reset()
    for move in "ArrowLeft", " ", "ArrowRight", " ":
        world, other = (
            one.step(arrdict(actions=torch.full((2, 1), one.controls[move]))) for one in (env, twin)
        )
        assert torch.equal(world.obs, other.obs)


def test_an_unknown_id_names_the_nearest():
    with pytest.raises(ValueError, match="near are .*MinAtar/Breakout-v1"):
        envs.MinAtar(2, id="MinAtar/Breakout-v2", device="cpu")


@every_game
@pytest.mark.parametrize("value", [-(2**31), -1, 2**31 - 1])
def test_what_is_written_into_games_ends_no_process(game, value, device):
    env = envs.MinAtar(2, id=game, device=device)
    env.reset()
    for leaf in (env.games, env.lists):
        for row in range(0 if leaf is None else len(leaf)):
            leaf[row] = value
            env.step(arrdict(actions=torch.full((2, 1), 1, device=device)))


@every_game
def test_picture(game, tmp_path):
    env = envs.MinAtar(1, id=game, device="cpu")
    env.reset()
    env.display().savefig(tmp_path / "board.png")
    assert (tmp_path / "board.png").stat().st_size > 2000
