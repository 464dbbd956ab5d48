"""The measures of hide and seek: which floor is closed, and what bots and runs make of it."""

import hide_and_seek
import numpy as np
import pytest
import torch
from hide_and_seek import Shelters, are_closed_in, floor_of, measure

from megastep import envs
from megastep.agents.cli import train
from megastep.agents.selfplay.bots.random import RandomActions
from megastep.agents.selfplay.bots.walker import Hunter, Runner
from megastep.core import AGENT_RADIUS
from megastep.geometries import sample

ROOMS = sample("quadrant", 8, split="test")
INSIDE, OUTSIDE = np.array([[1.0, 1.0], [0.3, 0.3]]), np.array([[3.0, 3.0]])


def turned(points, degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return points @ np.array([[c, s], [-s, c]])


def is_closed(gap, degrees=0.0, bodies=(), hiders=INSIDE, seekers=OUTSIDE):
    """A room of 4 x 4 m, turned, whose corner of 2 x 2 m has an opening at x = 2, y = 1."""
    low, high = 1 - gap / 2, 1 + gap / 2
    corners = [(0, 0), (4, 0), (4, 4), (0, 4), (0, 0)]
    walls = [*zip(corners, corners[1:]), ((2, 0), (2, low)), ((2, high), (2, 2)), ((2, 2), (0, 2))]
    bodies = np.array(bodies, float).reshape(-1, 5)
    bodies[:, :2], bodies[:, 2] = turned(bodies[:, :2], degrees), bodies[:, 2] + degrees
    walls, hiders, seekers = (turned(np.array(x, float), degrees) for x in (walls, hiders, seekers))
    return are_closed_in(floor_of(walls, bodies, AGENT_RADIUS), hiders, seekers)


@pytest.mark.parametrize("degrees", [0.0, 17.0, 45.0])
def test_an_opening_is_one_if_an_agent_fits_through(degrees):
    width = 2 * AGENT_RADIUS
    assert not is_closed(width + 0.001, degrees) and not is_closed(0.5, degrees)
    assert is_closed(width - 0.04, degrees) and is_closed(0.0, degrees)


@pytest.mark.parametrize(
    "bodies, expected",
    [
        ([(2.0, 1.0, 0, 0.3, 0.3)], True),  # a box in the opening
        ([(2.25, 1.0, 30, 0.25, 0.2)], True),  # before it, too near to get past
        ([(2.6, 1.0, 0, 0.3, 0.3)], False),  # 30 cm away
        ([(2.0, 1.25, 0, 0.3, 0.1)], False),  # beside: half of the opening is left
        ([(2.0, 1.0, 90, 0.6, 0.1)], True),  # an elongated box along it
        ([(2.0, 1.0, 0, 0.6, 0.1)], True),  # across it: 17 cm are left on either side
        ([(2.0, 1.0, 0, 0.6, 0.03)], False),  # a thin one: 24 cm are
    ],
)
def test_boxes_close_openings(bodies, expected):
    assert is_closed(0.55, 0.0, bodies) == is_closed(0.55, 30.0, bodies) == expected


def test_all_hiders_must_be_out_of_reach():
    boxed = [(2.0, 1.0, 0, 0.3, 0.3)]
    assert not is_closed(0.5, bodies=boxed, hiders=[*INSIDE, (3.0, 1.0)])
    assert not is_closed(0.5, bodies=boxed, seekers=[*OUTSIDE, (0.5, 1.5)])
    assert is_closed(0.5, bodies=boxed, hiders=[(1.0, 1.0), (2 - AGENT_RADIUS, 1.7)])  # at a wall


def test_shelters_of_an_environment():
    """Of two rooms, hiders have closed one by a box, and then lock it; a seeker comes by a ramp."""
    room = next(room for room in ROOMS if len(room.doors) == 1)
    env = envs.HideAndSeek(2, [room], device="cpu")
    env.reset()
    agents, objects, door = env.core.agents, env.objects, torch.tensor(room.doors[0])
    objects.all.visible[:] = False
    corners = torch.tensor([[6.7, 1.3], [6.3, 1.3], [1.5, 6.5], [1.9, 6.5]])  # two inside
    agents.positions[:] = corners
    objects["box"].visible[0, 0] = objects["ramp"].visible[0, 0] = True
    objects["box"].positions[0, 0] = door.mean(0)
    objects["box"].angles[0, 0] = 0.0
    objects["ramp"].positions[0, 0] = torch.tensor([2.5, 2.5])
    shelters, everywhere = Shelters(env), np.ones(2, bool)
    shelters.look(everywhere, shelters.closed)
    assert shelters.closed.tolist() == [True, False] and not shelters.locked_in.any()
    objects["box"].lock(torch.tensor([[True, False], [False, False]]), 0)
    objects["ramp"].lock(torch.tensor([[True], [False]]), 0)
    shelters.look(everywhere, shelters.closed)
    assert shelters.locked_in.tolist() == shelters.ramp_lock.tolist() == [True, False]
    shelters.watch()
    objects.all.elevated[:, 2] = 5
    shelters.watch()
    assert not shelters.enters.any(), "outside"
    agents.positions[:, 2] = corners[1] + 0.3
    shelters.watch()
    assert shelters.enters.tolist() == [True, False]


def test_bots_hide_and_seek():
    """A hunter sees more than random actions do, and a runner is seen less than they are."""
    env = envs.HideAndSeek(16, ROOMS, device="cpu", res=64, subsample=1, limit=150, prep=50)
    hunter, runner, still = Hunter(env), Runner(env), RandomActions(env.action_space)
    pairs = (still, still), (still, hunter), (runner, hunter)
    nobody, hunted, runs = (measure(env, *pair)["hidden"].mean() for pair in pairs)
    assert hunted < nobody - 0.2 and runs > hunted + 0.15, (nobody, hunted, runs)


@pytest.mark.slow
def test_a_table_of_runs_and_bots(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = ["env=hideandseek", "env.n_envs=4", "env.res=64", "env.limit=40", "geometry.n=4"]
    words += ["agent.width=8", "learner.n_steps=8", "samples=1", "device=cpu", "folder=run"]
    assert train.main(words) == 0
    capsys.readouterr()
    players = ["--hiders", "run", "runner", "--seekers", "untrained", "hunter"]
    words = [*players, "--episodes", "4", "--device", "cpu"]
    for frozen in (False, True):
        hide_and_seek.main(words + ["--frozen"] * frozen)
        first, _, _, *rows = capsys.readouterr().out.splitlines()
        assert first == "4 episodes in 4 unseen rooms" and len(rows) == 4
        for row in rows:
            hidden, seen, moved, *_ = (float(cell.split()[0]) for cell in row.split("|")[3:7])
            assert hidden + seen == pytest.approx(1, abs=2e-3)
            assert moved == 0 or not frozen
    with pytest.raises(SystemExit, match="2"):
        hide_and_seek.main(["--hiders", "memory_9", "--seekers", "random", "--device", "cpu"])
    assert "which is not hide and seek" in capsys.readouterr().err
