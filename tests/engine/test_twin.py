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


def original_progress(walls, offsets, steps, position, step):
    """The free fraction of a step by the original's shortcuts; see the README beside the data."""
    start, along = walls[:, 0] - position, walls[:, 1] - walls[:, 0]
    height = twin.cross(start, along).abs() / along.norm(dim=-1)
    crossing = twin.cross(start, along) / twin.cross(step, along)
    place = twin.cross(start, step) / twin.cross(step, along)
    through = (crossing > 0) & (crossing < 1) & (place > 0) & (place < 1)
    final = ((step - start) * along).sum(-1) / along.square().sum(-1)
    left_over = twin.cross(start - step, along).abs() / along.norm(dim=-1)
    beside = (final > 0) & (final < 1) & (left_over < REACH)
    times = [
        torch.where(through, crossing * (1 - REACH / height), math.inf),
        torch.where(beside, (height - REACH) / (height - left_over), math.inf),
        *(twin.contact(position - end, step.expand_as(end), REACH) for end in walls.unbind(1)),
        twin.contact(offsets, steps, 2 * REACH),
    ]
    return (torch.cat(times) * twin.SHORTFALL).clamp(0, 1).min()


@pytest.mark.parametrize("case", random_scenery.CASES)
def test_excused_agents_are_those_that_the_original_misjudges(case):
    ours, settings, right, ws = golden_step(case)
    off = ((ours["progress"] - right["progress"]).abs() > 2e-3).nonzero().tolist()
    assert {(case, *place) for place in off} == {
        place for place in compare.MISJUDGED if place[0] == case
    }
    for e, w in enumerate(ws):
        steps = w["velocity"] / settings["fps"]
        for a, (position, step) in enumerate(zip(w["positions"], steps)):
            others = [b for b in range(len(steps)) if b != a]
            offsets, relative = position - w["positions"][others], step - steps[others]
            progress = original_progress(w["walls"], offsets, relative, position, step)
            assert abs(progress - right["progress"][e, a]) < 1e-4, (case, e, a)


# Rays by hand

NO_LINES = torch.zeros((0, 2, 2), dtype=torch.float64)
WALL_AT_3 = t([[3, -5], [3, 5]])


def raycast(lines, position=(1.0, 0.0), angle=0.0, res=3, fov=90.0):
    """The hits of one camera at `position`: fields of shape (R,)."""
    hits = twin.raycast(lines, t(position), twin.rays(t(angle), [0.0], res, fov))
    return {k: v[0, 0] for k, v in hits.items()}


def test_wall_two_metres_ahead():
    seen = raycast(WALL_AT_3)
    assert seen["indices"].tolist() == [0, 0, 0]
    assert seen["distances"][1] == 2
    # the outer of three pixels look 2/3 of tan(45 degrees) to the side
    assert seen["distances"][0] == pytest.approx(2 * math.hypot(1, 2 / 3), abs=EXACT)
    assert seen["locations"].tolist() == pytest.approx([0.5 + 4 / 30, 0.5, 0.5 - 4 / 30])
    assert seen["dots"].tolist() == pytest.approx(
        [2 / math.sqrt(13), 0, -2 / math.sqrt(13)], abs=1e-6
    )


def test_hidden_walls():
    walls = torch.cat([WALL_AT_3 + t([1, 0]), WALL_AT_3, WALL_AT_3 - t([4, 0])])
    assert raycast(walls)["indices"].tolist() == [1, 1, 1]


def test_rays_without_a_hit():
    wall, light, white, one = t([[9, 9], [9, 10]]), t([5, 5, 1]), t([1, 1, 1]), torch.tensor([1])
    seen = twin.render(NO_LINES, wall, light, white, one, t([1, 1]), t(180), res=2, fov=60)
    assert (seen["indices"] == -1).all() and (seen["distances"] == math.inf).all()
    assert (seen["screen"] == 0).all()
    assert seen["locations"].isnan().all() and seen["dots"].isnan().all()


def test_pixel_0_is_on_the_left():
    left = t([[2, 0.1], [2, 5]])
    assert raycast(left)["indices"].tolist() == [0, -1, -1]
    hits = twin.raycast(WALL_AT_3, t([1, 0]), twin.rays(t(-90), [0.0, 90.0], 1, 60))
    assert hits["indices"].tolist() == [[[-1], [0]]]


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


def test_texels_are_filtered():
    values, width, start = t([9], [0], [1], [9]), torch.tensor(2), torch.tensor(1)
    for location, value in ((0, 0), (0.25, 0), (0.5, 0.5), (0.6, 0.7), (0.75, 1), (1, 1)):
        assert twin.filtered(values, width, start, t(location)).item() == pytest.approx(
            value, abs=EXACT
        )


def test_slanted_walls_are_darker():
    hits = dict(
        indices=torch.tensor([0, 0, -1]), locations=t(0.5, 0.5, math.nan), dots=t(0, -0.5, math.nan)
    )
    screen = twin.shade(hits, t([1, 0.5, 0.2]), torch.tensor([1]), t(0.8))
    assert screen.flatten().tolist() == pytest.approx([0.8, 0.4, 0.16, 0.6, 0.3, 0.12, 0, 0, 0])


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


def test_texel_positions():
    points = twin.texel_positions(t([[0, 0], [4, 0]], [[1, 1], [1, 2]]), torch.tensor([2, 1]))
    assert points.tolist() == [[1, 0], [3, 0], [1, 1.5]]


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


def test_disc_stops_short_of_a_wall():
    after = move([[[6, 1], [6, 6]]], [[3, 3]], [[1000, 0]], fps=10)  # the example of the tutorial
    assert after["progress"].item() == pytest.approx(0.99 * (3 - REACH) / 100, abs=EXACT)
    assert after["positions"][0].tolist() == pytest.approx([5.8649, 3.0], abs=1e-4)
    assert after["velocity"].tolist() == [[0, 0]]


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


def test_wall_just_out_of_reach():
    assert move([[[3, -1], [3, 1]]], [[0, 0]], [[2.999 - REACH, 0]])["progress"].item() == 1
    assert move([[[3, -1], [3, 1]]], [[0, 0]], [[3.001 - REACH, 0]])["progress"].item() < 0.99


@pytest.mark.parametrize(
    "velocity, progress", [([1, 0], 0), ([-1, 0], 1), ([0, 1], 1), ([0, 0], 1)]
)
def test_overlapping_disc_moves_anywhere_but_in(velocity, progress):
    assert move([[[0.05, -9], [0.05, 9]]], [[0, 0]], [velocity])["progress"].item() == progress


def test_two_discs_meet_halfway():
    after = move([], [[0, 0], [4, 0], [0, 5]], [[4, 0], [-4, 0], [1, 0]])
    meeting = 0.99 * (4 - 2 * REACH) / 8
    assert after["progress"].tolist() == pytest.approx([meeting, meeting, 1], abs=EXACT)


def test_disc_at_rest_shares_progress():
    after = move([], [[0, 0], [2, 0]], [[4, 0], [0, 0]], angvelocity=[0, 90])
    assert after["progress"].tolist() == pytest.approx(2 * [0.99 * (2 - 2 * REACH) / 4], abs=EXACT)
    assert after["angvelocity"].tolist() == [0, 0]
    assert after["angles"][1] == pytest.approx(90 * after["progress"][1].item())


@pytest.mark.parametrize("velocity, progress", [([1, 0], 0), ([-1, 0], 1), ([0, 1], 1)])
def test_overlapping_discs(velocity, progress):
    assert move([], [[0, 0], [0.1, 0]], [velocity, [0, 0]])["progress"].tolist() == [
        progress,
        progress,
    ]


@pytest.mark.parametrize(
    "before, speed, after",
    [(179, 2, -179), (-179, -2, 179), (179, 1, -180), (0, 725, 5), (-180, -1e-15, -180)],
)
def test_angles_wrap(before, speed, after):
    step = move([], [[0, 0]], [[0, 0]], angles=[before], angvelocity=[speed])
    assert step["angles"].item() == pytest.approx(after, abs=EXACT)


# Random environments, and comparing

HARD = dict(
    n_envs=2, n_agents=3, n_walls=12, degenerate=random_scenery.EVERYTHING, res=48, fov=100.0
)


def rounded(envs, res, fov, cameras=(0.0,)):
    """Render, step and light by the twin in float32: an engine that is correct but rounds."""
    renders, steps, lights = [], [], []
    for e in range(envs.n_envs):
        w = envs.one(e, torch.float32)
        steps.append(twin.physics(*(w.pop(k) if k.endswith("velocity") else w[k] for k in MOVING)))
        renders.append(twin.render(**w, res=res, fov=fov, cameras=cameras))
        lights.append(renders[-1]["light"])
    return (
        stacked(renders, "indices", "locations", "dots", "distances", "screen"),
        stacked(steps),
        torch.cat(lights),
    )


@pytest.mark.parametrize(
    "seed, origin, camera",
    [
        (1, 1.0, dict(res=48, fov=100.0)),
        (2, 190.0, dict(res=65, fov=170.0)),
        (3, 1.0, dict(res=1, fov=20.0, cameras=(0.0, 120.0, 240.0))),
    ],
)
def test_rounding_errors_are_tolerated(seed, origin, camera):
    envs = random_scenery.random_environments(seed, **{**HARD, "origin": origin})
    render, step, light = rounded(envs, **camera)
    compare.check_render(render, envs, **camera)
    compare.check_physics(step, envs)
    compare.check_baked(light, envs, static_only=False)


def hidden(render):
    """Every hit is attributed to the next line."""
    return dict(render, indices=render["indices"] + (render["indices"] >= 0).int())


MISTAKES = {
    "indices": hidden,
    "indices of misses": lambda r: dict(r, indices=torch.full_like(r["indices"], -1)),
    "locations": lambda r: dict(r, locations=1 - r["locations"]),
    "locations unwritten": lambda r: dict(r, locations=r["locations"] * math.nan),
    "dots": lambda r: dict(r, dots=-r["dots"]),
    "distances": lambda r: dict(
        r, distances=r["distances"] + 0.001 * (r["indices"] == r["indices"].max())
    ),
    "screen": lambda r: dict(r, screen=r["screen"].flip(-1)),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_errors_in_rendering_are_named(mistake):
    envs = random_scenery.random_environments(4, **HARD)
    render = rounded(envs, 48, 100.0)[0]
    with pytest.raises(
        AssertionError, match=rf"{mistake.split()[0]} at env \d+, agent \d+, camera 0, ray \d+"
    ):
        compare.check_render(MISTAKES[mistake](render), envs, res=48, fov=100.0)


@pytest.mark.parametrize("field", ["progress", "positions", "angles", "velocity", "angvelocity"])
def test_errors_in_physics_are_named(field):
    envs = random_scenery.random_environments(5, **HARD)
    step = rounded(envs, 48, 100.0)[1]
    step[field][:, 1] -= 0.01
    with pytest.raises(AssertionError, match=rf"{field} at env \d+, agent 1"):
        compare.check_physics(step, envs)


def test_error_in_one_texel_is_named():
    envs = random_scenery.random_environments(6, **HARD)
    light = rounded(envs, 48, 100.0)[2]
    light[-7] += 0.01
    with pytest.raises(AssertionError, match="baked at env 1, texel"):
        compare.check_baked(light, envs)


def test_errors_against_golden_data_are_named():
    case = "home_4_near"
    step = golden_step(case)[0]
    with pytest.raises(AssertionError, match="home_4_near: progress: .* at most"):
        compare.check_golden(case, dict(step, progress=step["progress"] * 0.99))


def test_random_environments_are_seeded():
    same, again, other = (random_scenery.random_environments(seed, **HARD) for seed in (7, 7, 8))
    assert torch.equal(same.lines, again.lines) and torch.equal(same.velocity, again.velocity)
    assert not torch.equal(same.angles, other.angles)
    assert int(same.line_widths.sum()) == len(same.lines) == len(same.texture_widths)
    assert int(same.texels().sum()) == len(same.textures)
    assert int(same.light_widths.sum()) == len(same.lights)


def test_random_environments_have_degenerate_cases():
    envs = random_scenery.random_environments(9, **HARD)
    for e in range(envs.n_envs):
        w = envs.one(e)
        walls, lengths = w["walls"], (w["walls"][:, 1] - w["walls"][:, 0]).norm(dim=-1)
        assert (lengths == 0).sum() == 3 and (lengths > 100).sum() == 2
        assert ((lengths > 0) & (lengths < 0.011)).sum() >= 6
        assert len(walls.unique(dim=0)) <= len(walls) - 4  # duplicates
        assert (w["positions"][0] - w["positions"][1]).norm() < 2 * twin.RADIUS
        gaps = (walls[:, 0] - w["positions"][0]).abs() - REACH
        assert (gaps.abs() < 5e-6).any(-1).sum() >= 2  # touching: five ulps of 8 m
