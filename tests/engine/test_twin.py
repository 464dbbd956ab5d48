"""The twin against outputs of the original engine and against hand calculation; comparing with it
finds errors.
"""

import math

import pytest
import torch

from tests.helpers import compare, random_scenery, twin

torch.set_num_threads(1)
EXACT = 1e-12  # float64 and a handful of operations
REACH = twin.INFLATION * twin.RADIUS
MOVING = "walls", "positions", "angles", "velocity", "angvelocity"


def t(*values):
    return torch.tensor(values, dtype=torch.float64)


def stacked(dicts, *names):
    return {k: torch.stack([d[k] for d in dicts]) for k in names or dicts[0]}


# Golden


def placed(w):
    return torch.cat([twin.agent_lines(w["model"], w["positions"], w["angles"]), w["walls"]])


def golden_light(w, baked):
    """Light of static texels from the golden data, and of agents' texels from the twin."""
    n_own = int(w["widths"][: len(w["positions"]) * len(w["model"])].sum())
    points = twin.texel_positions(placed(w), w["widths"])[:n_own]
    return torch.cat([twin.light_at(points, w["walls"], w["lights"]), baked[n_own:].double()])


@pytest.mark.parametrize("case", random_scenery.CASES)
def test_twin_rays_match_the_original(case):
    envs, settings, right = random_scenery.golden(case)
    seen = []
    for e, baked in enumerate(right["baked_vals"].split(envs.texels().tolist())):
        w = envs.one(e)
        hits = twin.raycast(
            placed(w),
            w["positions"],
            twin.rays(w["angles"], [0.0], settings["res"], settings["fov"]),
        )
        hits["screen"] = twin.shade(hits, w["textures"], w["widths"], golden_light(w, baked))
        seen.append({k: v[:, 0] for k, v in hits.items()})
    lines = torch.cat([placed(envs.one(e)) for e in range(envs.n_envs)])
    errors = compare.check_golden(case, dict(stacked(seen), lines=lines))
    assert {"indices", "distances", "screen, mean on walls"} <= set(errors)


@pytest.mark.parametrize("case", random_scenery.CASES)
def test_twin_light_matches_the_original(case):
    envs, _, right = random_scenery.golden(case)
    errors = []
    for e, baked in enumerate(right["baked_vals"].split(envs.texels().tolist())):
        w = envs.one(e)
        n_own = int(w["widths"][: envs.n_agents * 8].sum())
        points = twin.texel_positions(placed(w), w["widths"])[
            n_own::11
        ]  # all of them take a quarter of a minute
        errors.append((twin.light_at(points, w["walls"], w["lights"]) - baked[n_own::11]).abs())
    errors = torch.cat(errors)
    assert (errors <= 2e-3).double().mean() >= 0.995
    assert errors.max() < 1e-5  # what is true today, of every texel


def golden_step(case):
    envs, settings, right = random_scenery.golden(case)
    ws = [envs.one(e) for e in range(envs.n_envs)]
    return (
        stacked([twin.physics(*(w[k] for k in MOVING), fps=settings["fps"]) for w in ws]),
        settings,
        right,
        ws,
    )


@pytest.mark.parametrize("case", random_scenery.CASES)
def test_twin_physics_matches_the_original(case):
    compare.check_golden(case, golden_step(case)[0])


# Rays by hand

NO_LINES = torch.zeros((0, 2, 2), dtype=torch.float64)
WALL_AT_3 = t([[3, -5], [3, 5]])


def raycast(lines, position=(1.0, 0.0), angle=0.0, res=3, fov=90.0):
    """The hits of one camera at `position`: fields of shape (R,)."""
    hits = twin.raycast(lines, t(position), twin.rays(t(angle), [0.0], res, fov))
    return {k: v[0, 0] for k, v in hits.items()}


@pytest.mark.parametrize("angle", [0, 30])
def test_near_limit_is_a_circle(angle):
    closer, further = (t([[x, -5], [x, 5]]) for x in (0.9 * twin.RADIUS, 1.1 * twin.RADIUS))
    seen = raycast(torch.cat([closer, further]), (0, 0), angle, fov=1)
    assert seen["indices"].tolist() == 3 * [0 if math.cos(math.radians(angle)) < 0.9 else 1]


def test_first_of_equal_lines_is_hit():
    assert raycast(torch.cat([WALL_AT_3 + t([1, 0]), WALL_AT_3, WALL_AT_3]))[
        "indices"
    ].tolist() == [1, 1, 1]


def test_degenerate_lines_are_invisible():
    assert raycast(t([[2, 0], [3, 0]], [[2, 0], [2, 0]]))["indices"].tolist() == [-1, -1, -1]


def test_agents_see_others_but_not_themselves():
    lines = twin.agent_lines(random_scenery.OCTAGON.double(), t([1, 1], [3, 1]), t(0, 45))
    seen = twin.raycast(lines, t([1, 1], [3, 1]), twin.rays(t(0, 180), [0.0], 1, 60))
    assert seen["indices"].flatten().tolist() == [
        13,
        2,
    ]  # turned by 45 degrees, the other shows a cut corner
    assert seen["distances"].flatten().tolist() == pytest.approx(
        [2 - 0.1125 / math.sqrt(2), 2 - 0.075]
    )


# Light by hand


@pytest.mark.parametrize(
    "wall, light, level, why",
    [
        ([[9, 9], [9, 8]], [2, 0, 1], 0.1 + 2 / 4, "two metres away"),
        ([[9, 9], [9, 8]], [0.5, 0, 0.2], 0.1 + 2 * 0.2, "closer than a metre counts as a metre"),
        ([[9, 9], [9, 8]], [0, 1, 5], 1, "never above 1"),
        ([[1, -1], [1, 1]], [2, 0, 1], 0.1, "behind a wall"),
        ([[3, -1], [3, 1]], [2, 0, 1], 0.1 + 2 / 4, "the wall is behind the light"),
        ([[-1, -1], [-1, 1]], [2, 0, 1], 0.1 + 2 / 4, "the wall is behind the texel"),
        ([[0, -1], [0, 1]], [2, 0, 1], 0.1 + 2 / 4, "the texel's own wall"),
        ([[1, 0], [1, 0]], [2, 0, 1], 0.1 + 2 / 4, "a point throws no shadow"),
    ],
)
def test_light_at_the_origin(wall, light, level, why):
    assert twin.light_at(t([0, 0]), t(wall), t(light)).item() == pytest.approx(level, abs=EXACT), (
        why
    )


# Physics by hand


def move(walls, positions, velocity, fps=1.0, angles=None, angvelocity=None):
    blank = torch.zeros(len(positions), dtype=torch.float64)
    walls = t(*walls) if walls else NO_LINES
    return twin.physics(
        walls,
        t(*positions),
        blank if angles is None else t(*angles),
        t(*velocity),
        blank if angvelocity is None else t(*angvelocity),
        fps=fps,
    )


@pytest.mark.parametrize("end", [[3, 0], [5, 0]], ids=["point", "wall met head-on"])
def test_disc_stops_at_points_and_ends_of_walls(end):
    assert move([[[3, 0], end]], [[0, 0]], [[4, 0]])["progress"].item() == pytest.approx(
        0.99 * (3 - REACH) / 4, abs=EXACT
    )


@pytest.mark.parametrize("aside, free", [(1.001, True), (0.999, False)])
def test_disc_passes_the_end_of_a_wall(aside, free):
    after = move([[[3, aside * REACH], [3, 4]]], [[0, 0]], [[4, 0]])
    assert (after["progress"].item() == 1) == free
    assert (after["velocity"][0].tolist() == [4, 0]) == free


@pytest.mark.parametrize(
    "velocity, progress", [([1, 0], 0), ([-1, 0], 1), ([0, 1], 1), ([0, 0], 1)]
)
def test_overlapping_disc_moves_anywhere_but_in(velocity, progress):
    assert move([[[0.05, -9], [0.05, 9]]], [[0, 0]], [velocity])["progress"].item() == progress


def test_two_discs_meet_halfway():
    after = move([], [[0, 0], [4, 0], [0, 5]], [[4, 0], [-4, 0], [1, 0]])
    meeting = 0.99 * (4 - 2 * REACH) / 8
    assert after["progress"].tolist() == pytest.approx([meeting, meeting, 1], abs=EXACT)


@pytest.mark.parametrize("velocity, progress", [([1, 0], 0), ([-1, 0], 1), ([0, 1], 1)])
def test_overlapping_discs(velocity, progress):
    assert move([], [[0, 0], [0.1, 0]], [velocity, [0, 0]])["progress"].tolist() == [
        progress,
        progress,
    ]


# Random environments, and comparing
