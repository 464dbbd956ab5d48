"""Lanes, lifecycles, spawns, and drawings of sensors."""

import hashlib
import math

import numpy as np
import pytest
import torch

from megastep import core, dotdict, engine, modules, scene, toys
from megastep.geometries import sample
from megastep.modules import spawning

RADIUS = engine.AGENT_RADIUS


def core_of(geometries, n_agents=1, n_envs=None, **settings):
    scenery = scene.scenery(geometries, n_agents=n_agents, n_envs=n_envs, device="cpu")
    return core.Core(scenery, res=8, **settings)


# ---- Lanes ----


def test_lane_of_agent_a_in_environment_e_is_e_times_n_agents_plus_a():
    values = torch.arange(24).view(3, 2, 4)
    lanes = modules.to_lanes(values)
    assert lanes.shape == (6, 4) and torch.equal(lanes[2 * 2 + 1], values[2, 1])
    flags = torch.arange(6)
    for shape in ((6,), (6, 1), (3, 2)):
        assert torch.equal(modules.to_agents(flags.view(shape), 2), flags.view(3, 2))
    assert torch.equal(modules.to_lanes(modules.to_agents(flags, 2)), flags)


# ---- Lifecycles ----


def flags_of(lifecycle, n_steps, terminal=lambda age: None):
    """reset, terminal and truncated of each lane: lists over a reset and some steps."""
    flags = [lifecycle(lifecycle.start_all())]
    for _ in range(n_steps):
        flags.append(lifecycle(lifecycle.start_ended(), terminal(lifecycle.ages + 1)))
    return [torch.stack(flag).T.tolist() for flag in zip(*(f.values() for f in flags))]


def test_limit_of_three_steps_truncates_at_the_third_and_then_resets():
    lifecycle = modules.Lifecycle(core_of([toys.box()], n_envs=2), 3)
    reset, terminal, truncated = flags_of(lifecycle, 5)
    assert reset == 2 * [[True, False, False, False, True, False]]
    assert truncated == 2 * [[False, False, False, True, False, False]]
    assert not any(map(any, terminal)) and lifecycle.ages.tolist() == [1, 1]


def test_terminal_precedes_truncated_and_is_ignored_at_resets():
    """With a limit of two steps, lane 0 is always terminal, lane 1 at age two, lane 2 never."""

    def deaths(age):
        return torch.stack([age[0] >= 0, age[1] == 2, age[2] < 0])

    lifecycle = modules.Lifecycle(core_of([toys.box()], n_envs=3), 2)
    flags = flags_of(lifecycle, 3, deaths)
    reset, terminal, truncated = (np.array(flag).astype(int).tolist() for flag in flags)
    assert reset == [[1, 0, 1, 0], [1, 0, 0, 1], [1, 0, 0, 1]]
    assert terminal == [[0, 1, 0, 1], [0, 0, 1, 0], [0, 0, 0, 0]]
    assert truncated == [[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 1, 0]]


def test_an_environment_may_write_limits():
    lifecycle = modules.Lifecycle(core_of([toys.box()], n_envs=3))
    lifecycle(lifecycle.start_all())
    lifecycle.limits.copy_(torch.tensor([1, 2, 9]))
    assert [lifecycle(lifecycle.start_ended()).truncated.tolist() for _ in range(2)] == [
        [True, False, False],
        [False, True, False],
    ]


def test_without_a_limit_episodes_do_not_end():
    lifecycle = modules.Lifecycle(core_of([toys.box()]))
    _, _, truncated = flags_of(lifecycle, 300)
    assert not any(map(any, truncated))


def test_random_lifespans_are_uniform_and_constant_within_an_episode():
    c = core_of([toys.box()], n_envs=3000)
    lifecycle = modules.Lifecycle(c, modules.RandomLifespans(c, 3, 5))
    lifecycle(lifecycle.start_all())
    first = lifecycle.limits.clone()
    counts = torch.bincount(first, minlength=6).tolist()
    assert not any(counts[:3]) and len(counts) == 6
    assert all(abs(count - 1000) < 130 for count in counts[3:])  # five standard deviations
    for age in range(1, 6):
        ended = lifecycle(lifecycle.start_ended()).truncated
        assert torch.equal(ended[first >= age], first[first >= age] == age)
        running = first > age
        assert torch.equal(lifecycle.limits[running], first[running])


def test_random_ages_are_uniform_below_the_limit():
    limits = torch.tensor([1, 4, modules.ENDLESS], dtype=torch.int32).repeat_interleave(3000)
    ages = modules.random_ages(limits, seed=1)
    assert torch.equal(modules.random_ages(limits, seed=1), ages)
    assert not torch.equal(modules.random_ages(limits, seed=2), ages)
    first, second, endless = ages.view(3, -1)
    assert not first.any() and not endless.any(), "without a limit there is no middle"
    counts = torch.bincount(second).tolist()
    assert len(counts) == 4 and all(abs(count - 750) < 120 for count in counts)
    largest = torch.full((3000,), modules.ENDLESS - 1, dtype=torch.int32)
    assert 0 <= modules.random_ages(largest, seed=1).min()


def test_counter_generator_draws_where_masked_and_repeats_by_seed():
    first, second, other = (modules.CounterGenerator(3, seed, "cpu") for seed in (1, 1, 2))
    everywhere = torch.ones(3, dtype=torch.bool)
    before = first(everywhere).clone()
    assert before.shape == (3, 4) and before.min() >= 0 and before.max() < 1
    after = first(torch.tensor([True, False, True])).clone()
    changed = (after != before).any(1)
    assert changed.tolist() == [True, False, True]
    assert torch.equal(second(everywhere), before) and not torch.equal(other(everywhere), before)


# ---- Spawns ----


def clearance(point, walls):
    """Metres from a point to the nearest wall, by sampling every wall each half centimetre. The
    error is below 0.02 mm at 15 cm.
    """
    nearest = math.inf
    for start, end in walls.astype(float):
        along = np.linspace(start, end, 2 + int(200 * np.linalg.norm(end - start)))
        nearest = min(nearest, np.linalg.norm(along - point, axis=-1).min())
    return nearest


@pytest.mark.parametrize("n_agents", [1, 3])
def test_spawns_lie_in_rooms_5_cm_clear_of_walls(n_agents):
    homes = [*sample("bench", 2), *sample("homes", 2), toys.column()]
    c = core_of(homes, n_agents)
    spawner = modules.RandomSpawns(homes, c, n_spawns=30)
    for home, points in zip(homes, spawner.points.double().numpy(), strict=True):
        for x, y in points:
            assert clearance((x, y), home.walls) > RADIUS + 0.05 - 1e-4
            cell = len(home.masks) - 1 - int(y / home.res), int(x / home.res)
            assert home.masks[cell] > 0
    for _ in range(6):
        spawner(c.agent_full(True))
        for points, positions in zip(spawner.points, c.agents.positions):
            assert (points == positions[:, None]).all(-1).any(-1).all()


def nearest_pair(positions):
    """The smallest distance between two agents of one environment, positions (N, A, 2)."""
    distances = (positions[:, :, None] - positions[:, None]).norm(dim=-1)
    return float(distances[:, ~torch.eye(positions.shape[1], dtype=torch.bool)].min())


@pytest.mark.parametrize("width", [1, 5])
def test_agents_that_spawn_together_never_overlap(width):
    """A room of one metre is a hard case: independent points would often overlap."""
    n = 2 if width == 1 else 8
    c = core_of([toys.box(width)], n, n_envs=64)
    spawner = modules.RandomSpawns([toys.box(width)], c)
    for _ in range(40):
        spawner(c.agent_full(True))
        assert nearest_pair(c.agents.positions) >= 2 * RADIUS + 0.05 - 1e-6
    assert len(c.agents.positions.flatten(0, 1).unique(dim=0)) > 10 * n, "always the same points"


def corner():
    """A room of one cell, nearly all of it too close to walls: 20 points of about 5,000 fit."""
    g = toys.box(1)
    g.masks[g.masks > 0] = 0
    g.masks[-6, 5] = 1
    return dotdict.dotdict(g, walls=(g.walls + 0.03).astype(np.float32))


@pytest.mark.parametrize(
    "geometries, n_spawns, digest",
    [
        ([toys.box(), *sample("bench", 4), *sample("homes", 4)], 128, "1768d8a8ce0457af"),
        ([corner()], 64, "82e12166db51bb19"),
    ],
)
def test_spawn_points_of_single_agents_are_unchanged(geometries, n_spawns, digest):
    """Episodes depend on these points, so their bytes must not change between versions."""
    spawner = modules.RandomSpawns(geometries, core_of(geometries), n_spawns)
    assert spawner.points.shape == (len(geometries), n_spawns, 2)
    assert hashlib.sha256(spawner.points.numpy().tobytes()).hexdigest()[:16] == digest


@pytest.mark.parametrize(
    "n_agents, message", [(1, "no point .*0.16 m"), (9, "no room for 9 agents .*0.26 m")]
)
def test_a_geometry_without_space_is_refused(n_agents, message):
    g = toys.box(1)
    if n_agents == 1:
        g["walls"] = np.concatenate([g.walls, [[[x, 1], [x, 2]] for x in np.arange(1.1, 2, 0.1)]])
    c = core_of([toys.box(1)], n_agents)
    with pytest.raises(ValueError, match=f"geometry 0 .*{message}"):
        modules.RandomSpawns([g], c)


def cached_points(folder):
    return sorted(folder.glob("spawn-points-*"))


def test_points_of_many_layouts_are_cached(tmp_path, monkeypatch):
    monkeypatch.setenv("MEGASTEP_CACHE", str(tmp_path))
    homes = sample("bench", 40)
    c = core_of(homes)
    points = modules.RandomSpawns(homes, c).points
    points_of_first = modules.RandomSpawns(homes[:1], core_of(homes[:1])).points
    assert torch.equal(points[:1], points_of_first)
    (path,) = cached_points(tmp_path)

    with monkeypatch.context() as patch:
        patch.setattr(spawning, "spawn_points", None)  # a second search would fail
        assert torch.equal(modules.RandomSpawns(homes, c).points, points)

    body = path.read_bytes()
    path.write_bytes(body[:100] + bytes([body[100] ^ 1]) + body[101:])
    assert torch.equal(modules.RandomSpawns(homes, c).points, points)
    assert path.read_bytes() == body


# ---- Sensors ----


# ---- Wrong numbers of lanes ----


@pytest.mark.parametrize(
    "wrong",
    [
        torch.zeros(3, dtype=torch.bool),
        torch.zeros(1, dtype=torch.bool),  # would broadcast
        torch.zeros((4, 4), dtype=torch.bool),
        torch.zeros(4, dtype=torch.int64),
        torch.zeros(4, dtype=torch.bool, device="meta"),
        "text",
    ],
    ids=["too few", "one", "square", "integers", "another device", "words"],
)
def test_wrong_masks_are_named(wrong):
    c = core.Core(scene.scenery([toys.box()], 1, 4, device="cpu"))
    lifecycle, right = modules.Lifecycle(c, 9), torch.zeros(4, dtype=torch.bool)
    spawner = modules.RandomSpawns([toys.box()], c)
    calls = [
        ("reset", lambda: lifecycle(wrong)),
        ("terminal", lambda: lifecycle(right, wrong)),
        ("(mask|reset)", lambda: spawner(wrong)),
        ("mask", lambda: modules.CounterGenerator(4, 1, "cpu")(wrong)),
    ]
    for name, call in calls:
        with pytest.raises((TypeError, ValueError), match=f"^{name} must be .* was given"):
            call()
    assert not lifecycle.ages.any(), "a refused step is not counted"


def test_wrong_continuous_actions_are_named():
    move = modules.SimpleMovement(core_of([toys.box()]), control="continuous")
    right = torch.zeros((move.core.n_envs, 1, 3))
    wrongs = right[1:], right.mT, right.double(), right.long(), right[..., 0], None
    for wrong in (*wrongs, right.to("meta")):
        with pytest.raises((TypeError, ValueError), match="^actions must be .*, 3 for each .* was"):
            move(dict(actions=wrong))
    for shape in (right.shape, (-1, 3)):
        move(dict(actions=right.view(shape)))


def test_imu_is_in_fractions_of_a_turn_per_second_and_of_10_m_s():
    c = core_of([toys.box()])
    c.agents.angles.fill_(90.0)
    c.agents.angvelocity.fill_(90.0)
    c.agents.velocity.copy_(torch.tensor([-1.0, 5.0]))
    assert torch.allclose(modules.IMU(c)(), torch.tensor([0.25, 0.5, 0.1]), rtol=0, atol=1e-6)


def test_continuous_actions_are_fractions_of_the_speeds():
    """10 m/s and 180 degrees/s for a tenth of a second; the agent faces +y."""
    c = core_of([toys.box()])
    c.agents.positions[:], c.agents.angles[:] = 3.0, 90.0
    move = modules.SimpleMovement(c, control="continuous")
    move(dict(actions=torch.tensor([[[0.5, -0.25, 5.0]]])))
    expected = torch.tensor([[[3.25, 3.5]]])
    torch.testing.assert_close(c.agents.positions, expected)
    torch.testing.assert_close(c.agents.angles, torch.tensor([[108.0]]))


@pytest.mark.parametrize(
    "make, name",
    [
        (modules.Lifecycle, "limit"),
        (modules.RandomLifespans, "longest"),
        (modules.SimpleMovement, "speed"),
        (modules.MomentumMovement, "accel"),
        (modules.MomentumMovement, "control"),
        (modules.Depth, "subsample"),
        (lambda c, **options: modules.RandomSpawns([toys.box()], c, **options), "seed"),
    ],
    ids=lambda value: getattr(value, "__name__", value),
)
def test_wrong_settings_of_modules_are_named(make, name):
    for wrong in ("text", math.nan, [1]):
        with pytest.raises(ValueError, match=f"^{name} must be .* was given"):
            make(core_of([toys.box()]), **{name: wrong})
