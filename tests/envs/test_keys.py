"""Keys: every episode can be solved, and its rules by hand."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from megastep import envs, toys
from megastep.arrdict import arrdict
from megastep.envs.keys.episodes import (
    OPEN,
    Areas,
    _doors,
    _lock_ways_around,
    episodes,
)
from megastep.geometries import sample
from megastep.modules.kinds import REACH
from tests.helpers import keys_twin
from tests.helpers.outputs import Poison

N_COLOURS = 3


def solve(g, areas, start, keys, goal, doors):
    """Walks to all that can be reached, picks up all keys, opens all doors that it can, until
    nothing changes. Returns (whether the goal was reached, doors opened, doors that were open or
    needed no key when the goal was reached first).
    """
    has, opened = set(), set()
    n_before_goal = None
    while True:
        reached = {int(areas.at(start[None])[0])}
        while True:
            more = {
                b
                for k, sides in enumerate(areas.sides.tolist())
                for a, b in (sides, sides[::-1])
                if a in reached and b and (doors[k] == OPEN or k in opened)
            }
            if more <= reached:
                break
            reached |= more
        if n_before_goal is None and int(areas.at(goal[None])[0]) in reached:
            n_before_goal = len(opened)
        for colour in np.flatnonzero(np.isfinite(keys[:, 0])):
            if int(areas.at(keys[None, colour])[0]) in reached:
                has.add(int(colour))
        ready = [
            k
            for k, sides in enumerate(areas.sides.tolist())
            if doors[k] in has and k not in opened and reached & set(sides)
        ]
        if not ready:
            return n_before_goal, len(opened)
        opened.add(ready[0])


def check_episodes(n_homes, n, n_colours=N_COLOURS, **options):
    """Solves n episodes of each home. Returns how many have each number of doors."""
    homes = sample("homes", n_homes, **options)
    drawn = episodes(homes, n, n_colours, seed=1)
    counts = np.zeros(n_colours + 1, int)
    for d, g in enumerate(homes):
        areas = Areas(g)
        for m in range(n):
            start, keys, goal, doors = (part[d, m] for part in drawn)
            n_before_goal, n_opened = solve(g, areas, start, keys, goal, doors)
            n_shut = int(np.isfinite(keys[:, 0]).sum())
            used = doors[(doors >= 0) & (doors < n_colours)]
            assert len(set(used.tolist())) == len(used) == n_shut >= 1, "a door of each colour"
            assert n_opened == n_shut and n_before_goal, (g.id, m)
            counts[n_shut] += 1
    return counts


def test_every_episode_can_be_solved_and_needs_a_door():
    counts = check_episodes(6, 12)
    assert counts[N_COLOURS] > 40


def test_no_way_leads_around_a_door_through_areas_too_small_for_points():
    """Areas 1 and 2 have a door between them; 3, 4 and 5 are too small, and lead around it."""
    sides = np.array([(1, 2), (1, 3), (3, 4), (4, 2), (5, 1), (1, 1), (0, 2)])
    areas = SimpleNamespace(labels=np.arange(6)[None], sides=sides)
    random = np.random.default_rng(1)
    zones, opened, states = _doors(areas, [0], N_COLOURS, random)
    assert zones[1] != zones[2] and len(opened) == 1
    assert 0 <= states[0] < N_COLOURS
    assert states[1:].tolist() == [OPEN, OPEN, N_COLOURS, OPEN, OPEN, OPEN]


def test_homes_without_doors_are_refused():
    words = "no doorway between two of its parts.*Keys needs homes with doors"
    with pytest.raises(ValueError, match=words):
        envs.Keys(1, [toys.box()], device="cpu")


def make_env(device="cpu", n_envs=5, **settings):
    homes = sample("homes", 2)
    return envs.Keys(n_envs, homes, device=device, res=8, subsample=1, **settings)


def still(env):
    return arrdict(actions=torch.zeros((env.n_envs, 1), dtype=torch.long, device=env.device))


def visit(env, positions):
    """Puts each agent at a point (N, 2), at rest, and takes a step."""
    env.core.agents.positions[:, 0] = positions
    env.core.agents.velocity.zero_()
    return env.step(still(env))


def test_keys_open_doors_of_their_colours_and_the_goal_ends_the_episode(device):
    env = make_env(device, n_envs=5, key_reward=0.25, door_reward=0.5, privileged=True)
    world = env.reset()
    keys, doors, goal = (env.objects[name] for name in ("key", "door", "goal"))
    assert not world.obs["keys"].any() and (env.core.agents.positions[:, 0] != 0).all()
    n_keys = keys.visible.sum(1)
    lanes = torch.arange(5, device=device)
    for colour in range(3):
        is_there = keys.visible[:, colour].clone()
        door = (doors.colours == colour).int().argmax(1)
        before = visit(env, doors.positions[lanes, door])
        assert not before.reward.any(), "a door stays shut without its key"
        world = visit(env, keys.positions[:, colour].clone())
        assert torch.equal(world.reward > 0, is_there)
        assert torch.equal(world.obs["keys"][:, 0, colour] == 1, is_there)
        world = visit(env, doors.positions[lanes, door])
        torch.testing.assert_close(world.reward, 0.5 * is_there)
        assert torch.equal(doors.open[lanes, door], is_there) and not world.obs["keys"].any()
        assert not visit(env, doors.positions[lanes, door]).reward.any(), "it is open"
    world = visit(env, goal.positions[:, 0].clone())
    assert (world.reward == 1).all() and world.terminal.all() and not world.truncated.any()
    assert (world.metrics.success == 1).all() and not world.metrics.wasted.any()
    assert torch.equal(world.metrics.doors, n_keys.float())
    world = env.step(still(env))
    assert world.reset.all() and not world.reward.any() and not doors.open.any()


def test_cached_episodes_are_those_that_were_drawn(tmp_path, monkeypatch):
    monkeypatch.setenv("MEGASTEP_CACHE", str(tmp_path))
    homes = sample("homes", 32)
    made, read = (episodes(homes, 2, N_COLOURS, 3) for _ in range(2))
    for one, other in zip(made, read, strict=True):
        np.testing.assert_array_equal(one, other, strict=True)
    assert len([*tmp_path.glob("keys-*")]) == 1


@pytest.mark.parametrize("seed", [1, 2])
def test_step_matches_twin(seed, device, monkeypatch):
    """Agents are put on keys, doors and goals at random, and beside them."""
    env = make_env(device, n_envs=40, seed=seed, limit=12, key_reward=0.25, door_reward=0.5)
    names = "opened", "n_draws", "ages", "ended"
    tables = {name: table.cpu() for name, table in env.tables.items()}
    agents, objects = env.core.agents, env.objects.all
    random = np.random.default_rng(seed)
    env.reset()
    n_opened = n_won = 0
    for _ in range(60):
        lanes = torch.arange(40)
        k = torch.as_tensor(random.integers(objects.positions.shape[1], size=40))
        offset = torch.as_tensor(random.choice([0, 0, 0.1, 0.2, 0.5], (40, 1)), dtype=torch.float32)
        agents.positions[:, 0] = (objects.positions.cpu()[lanes, k] + offset).to(env.device)
        state = {name: getattr(env, name).cpu().clone() for name in names}
        things = {name: getattr(objects, name).cpu().clone() for name in keys_twin.THINGS}
        expected, positions, things, state = keys_twin.keys_step(
            *(agents.positions[:, 0].cpu(), agents.radius, things, env.layout.cpu(), tables, state),
            **(env.weights.values | {"seed": env.seed, "reach": REACH, "limit": env.limit}),
        )
        poison = Poison(torch.empty)
        with monkeypatch.context() as patch:
            patch.setattr(torch, "empty", poison.allocate)
            out = env._judge()
        poison.check(**{name: out[name] for name in ("reward", "metrics", "keys_obs")})
        for name, value in expected.items():
            given = out[name].cpu()
            given = given.T if name == "metrics" else given.reshape(value.shape)
            assert torch.equal(given.float(), value.float()), name
        for name in names:
            assert torch.equal(getattr(env, name).cpu(), state[name]), name
        for name, value in things.items():
            assert torch.equal(getattr(objects, name).cpu(), value), name
        assert torch.equal(agents.positions[:, 0].cpu(), positions)
        n_opened += int(expected["metrics"][:, 1].sum())
        n_won += int(expected["terminal"].sum())
    assert n_opened > 5 and n_won > 20


@pytest.mark.parametrize("zones, expected", [((-1, 0, 1), 2), ((-1, 1, 1), 0), ((-1, -1, 1), 0)])
def test_doorways_between_zones_are_locked(zones, expected):
    """Those that no door can shut, and no others."""
    areas, states = SimpleNamespace(sides=torch.tensor([(1, 2), (0, 1)])), [0, 0]
    _lock_ways_around(areas, {}, zones, 2, states)
    assert states == [expected, 0]
