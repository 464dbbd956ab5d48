"""No agent ever passes a wall or gets stuck: half a million agent steps that try to, ten million in
the nightly tests, a hundred million on a GPU.
"""

import math
from fractions import Fraction
from itertools import product

import numpy as np
import pytest
import torch

from megastep import core, engine, scene
from megastep.dotdict import dotdict
from megastep.modules import MomentumMovement
from tests.helpers import random_scenery, wall_courses, wall_crossings, walls
from tests.helpers.wall_courses import BODY, COURSES, RADIUS, make_course
from tests.helpers.wall_crossings import crossed

STEPS = 10**7  # agent steps on all courses together
STEPS_PER_COURSE = -(-STEPS // len(COURSES))
# minimum fraction of steps that a wall or an agent stops, else the test is too easy; 0.65 is
# typical
STOPPED = 0.5
# minimum number of layouts in whose acute corners agents must get
ACUTE = dict(wedges=10, slivers=8, spokes=4, zigzags=4, crossing=8, fragments=8)


def alone(*ends, n_envs=1, fps=10.0):
    """A Core with one agent per environment, and walls (W, 2, 2) without a room."""
    g = dotdict(walls=np.float32(ends), lights=np.zeros((0, 2)))
    return core.Core(scene.scenery([g], 1, n_envs, device=torch.device("cpu")), res=1, fps=fps)


def check(total, n_steps):
    """Asserts that a run was long and hard enough, and that no agent passed a wall, sank in or
    stuck.
    """
    assert total["steps"] >= n_steps and total["collisions"] >= STOPPED * total["steps"], total
    failures = {key: total[key] for key in ("crossings", "sunk", "stuck")}
    assert not any(failures.values()), f"{failures} in {total['steps']:,} steps: " + "; ".join(
        total["descriptions"][:3]
    )


# ---- The tests ----


@pytest.mark.parametrize("name", COURSES)
def test_no_agent_passes_a_wall(name):
    check(walls.run(name, STEPS_PER_COURSE // 20, 256), STEPS_PER_COURSE // 20)


@pytest.mark.nightly
@pytest.mark.parametrize("name", COURSES)
def test_no_agent_passes_a_wall_or_gets_stuck_in_many_steps(name):
    total = walls.run(name, STEPS_PER_COURSE, 2048)
    check(total, STEPS_PER_COURSE)
    assert total["tried"] > 10_000 and total["held"] < 0.1 * total["tried"]
    reached = sum(n > 0 for n in total["cornered"])
    assert reached >= ACUTE.get(name, 0), (
        f"agents reached the acute corners of {reached} layouts only"
    )


@pytest.mark.cuda
@pytest.mark.parametrize("name", COURSES)
def test_no_agent_passes_a_wall_on_a_gpu(name):
    check(
        walls.run(name, 10 * STEPS_PER_COURSE, 2**20, "cuda", seed=1, tries=256),
        10 * STEPS_PER_COURSE,
    )


def test_courses_cover_rates_and_accelerations():
    fps, accel = zip(*walls.SETTINGS)
    assert STEPS_PER_COURSE * len(COURSES) >= 10**7
    assert (min(fps), max(fps), min(accel), max(accel)) == (1, 200, 1, 100)
    assert all(setting in walls.SETTINGS for setting in product((1, 200), (1, 100)))
    momentum = MomentumMovement(alone([(1, 1), (2, 1)], fps=1.0))
    assert momentum.moves.max(0).values[0] == walls.ACCEL and momentum.damping == walls.DECAY


def test_disc_touching_a_slanted_wall_is_stopped():
    c = alone([(2.3560333251953125, 2.9257616996765137), (5.024743556976318, 0.9436310529708862)])
    c.agents.positions[:] = torch.tensor([3.7575743198394775, 2.0170488357543945])
    c.agents.velocity[:] = torch.tensor([-4.205398082733154, -9.07274055480957])
    assert engine.physics(c.scenery, c.agents).progress.item() < 1e-3


def test_agent_does_not_slip_through_along_a_wall():
    c = alone([(6, 1), (6, 6)], fps=1.0)
    c.agents.positions[:] = torch.tensor([5.999889850616455, 4.891547679901123])
    c.agents.velocity[:] = torch.tensor([0.004166539758443832, -40.0])
    assert engine.physics(c.scenery, c.agents).progress.item() == 0


def test_disc_that_rounding_puts_at_a_walls_end_is_stopped():
    """Along the wall, its centre is within 1e-6 m of the end. It moves back along the wall and
    closer.
    """
    c = alone([(2.0, 10.595815658569336), (4.6668243408203125, 2.0)], fps=1.0)
    c.agents.positions[:] = torch.tensor([4.6665940284729, 1.999928593635559])
    c.agents.velocity[:] = torch.tensor([-11.850244522094727, 38.204341888427734])
    assert engine.physics(c.scenery, c.agents).progress.item() == 0


@pytest.mark.parametrize("side", [1, -1])
def test_tiny_steps_do_not_sink_into_a_wall(side):
    """Far from the origin, rounding makes a short step along a slanted wall one along an axis."""
    along = torch.tensor([math.cos(0.5), math.sin(0.5)])
    c = alone([(30, 30), (30 + 8 * along[0], 30 + 8 * along[1])], n_envs=64, fps=200.0)
    normal = side * torch.tensor([-along[1], along[0]])
    c.agents.positions[:] = 30 + 4 * along + 1.001 * BODY * normal
    # metres per step; float32 resolves 1.9e-6 m there
    way = torch.linspace(1e-6, 2e-5, 32)[:, None]
    # along the wall either way, and very slightly away from it
    velocity = 200 * torch.cat([way * (0.01 * normal + sign * along) for sign in (1, -1)])
    for _ in range(2000):
        c.agents.velocity[:, 0] = velocity
        engine.physics(c.scenery, c.agents)
    assert ((c.agents.positions[:, 0] - 30) @ normal).min().item() > RADIUS


# ---- These tests can fail ----


def without_walls(scenery, agents, *rest):
    """Physics without walls."""
    agents.positions += agents.velocity / agents.fps
    return engine.Physics(torch.ones_like(agents.angles))


def without_motion(scenery, agents, *rest):
    """Physics in which no agent moves."""
    return engine.Physics(torch.zeros_like(agents.angles))


def test_finds_agents_that_pass_walls(monkeypatch):
    monkeypatch.setattr(engine, "physics", without_walls)
    total = walls.run("box", 20_000, 512)
    assert total["crossings"] > 0.05 * total["steps"] and "box at 1 fps" in total["descriptions"][0]


def test_finds_agents_that_are_stuck(monkeypatch):
    monkeypatch.setattr(engine, "physics", without_motion)
    total = walls.run("box", 10_000, 256)
    assert total["stuck"] > 0.3 * total["tried"]
    assert total["held"] + total["stuck"] == total["tried"] > 0


def brute(p, q, a, b):
    """True if the closed segments pq and ab meet, computed in exact fractions."""
    p, q, a, b = ([Fraction(x) for x in point] for point in (p, q, a, b))
    d, e, g = ((y[0] - x[0], y[1] - x[1]) for x, y in ((p, q), (a, b), (p, a)))
    area = d[0] * e[1] - d[1] * e[0]
    if area:
        s, t = (g[0] * e[1] - g[1] * e[0]) / area, (g[0] * d[1] - g[1] * d[0]) / area
        return 0 <= s <= 1 and 0 <= t <= 1
    way = d if any(d) else e
    if g[0] * way[1] - g[1] * way[0]:
        return False
    if not any(way):
        return p == a
    place = lambda point: point[0] * way[0] + point[1] * way[1]  # noqa: E731
    one, other = sorted(map(place, (p, q))), sorted(map(place, (a, b)))
    return one[0] <= other[1] and other[0] <= one[1]


@pytest.mark.parametrize("dense", [False, True], ids=["sparse", "dense"])
def test_crossings_match_exact_fractions(dense):
    """On a grid of 4 x 4 points, segments touch, are collinear and shrink to points; others are
    random.
    """
    random = random_scenery.CounterGenerator(0)
    grid = random.pick(range(4), 3000, 4, 2)
    fine = random.uniform(0, 4, 1000, 4, 2).float().double()
    cases = torch.cat(
        [grid, fine, fine * torch.tensor([1e-3, 1.0]) + torch.tensor([190.0, 0.0])]
    ).float()
    p, q, a, b = cases.unbind(1)
    right = torch.tensor([brute(*case) for case in cases.tolist()])
    mine = crossed(p[None, :, None], q[None, :, None], torch.stack([a, b], 1)[:, None], dense)[
        0, :, 0
    ]
    assert torch.equal(mine, right) and 500 < right.sum() < 4500


def test_padding_walls_are_never_crossed():
    course = make_course("remote")
    filling = course.walls.isnan().all((-1, -2))
    assert filling.any() and torch.equal(filling.sum(1), len(filling[0]) - course.counts)
    everywhere = 200 * torch.rand(
        (50, len(course.walls), 2, 1, 2), generator=torch.Generator().manual_seed(0)
    )
    nothing = torch.where(filling[..., None, None], course.walls, math.nan)
    for dense in (False, True):
        assert not crossed(everywhere[:, :, 0], everywhere[:, :, 1], nothing, dense).any()


def test_chunk_size_changes_nothing(monkeypatch):
    course, random = make_course("crossing"), torch.Generator().manual_seed(0)
    before, after = (
        1 + 8 * torch.rand((40, len(course.walls), 3, 2), generator=random) for _ in range(2)
    )
    whole = crossed(before, after, course.walls)
    monkeypatch.setitem(wall_crossings.MAX_PAIRS, "cpu", 1)
    assert torch.equal(crossed(before, after, course.walls), whole) and whole.any()
    assert not whole.all()


def test_spots_touch_overlap_and_are_clear():
    for name in COURSES:
        course = make_course(name)
        for layout in range(len(course.walls)):
            mine = course.walls[layout, : course.counts[layout]].double()
            gap = wall_courses.clearances(course.spots[layout].double(), mine).amin(1)
            touching = (gap - RADIUS).abs() < 2e-4
            assert (
                gap.min() > wall_courses.MIN_GAP and (gap < RADIUS - 1e-3).any() and touching.any()
            ), name
            assert torch.equal(course.clear[layout], gap > BODY) and course.clear[layout].any(), (
                name
            )


@pytest.mark.parametrize(
    "shape, position, held",
    [
        (wall_courses.slit(0.1, 20.0), (1.5, 0.05), True),
        (wall_courses.slit(0.3, 0.0), (1.5, 0.1), False),
        (wall_courses.wedge(2.0, 0.0), (5.9, 0.0), False),
        (wall_courses.wedge(90.0, 0.0), (0.1, 0.0), False),
        (
            wall_courses.path([(-0.1, -0.1), (0.1, -0.1), (0.0, 0.1), (-0.1, -0.1)]),
            (0.0, 0.0),
            True,
        ),
    ],
    ids=["slit", "wide slit", "wedge", "corner", "cell"],
)
def test_held_by_geometry(shape, position, held):
    if shape.shape[0] == 2 and held:
        position = wall_courses.turned([position], 20.0)[0]
    at = torch.tensor(position, dtype=torch.float64)
    assert walls.held_by_geometry(at, at.new_zeros((0, 2)), torch.as_tensor(shape)) == held
