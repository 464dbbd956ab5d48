"""What environments are made of: lanes, lifecycles, spawns, and what sensors draw."""

import hashlib
import math

import numpy as np
import pytest
import torch

from megastep import core, dotdict, engine, modules, plotting, scene, toys
from megastep.arrdict import numpyify
from megastep.geometries import sample
from megastep.modules import spawning

RADIUS = engine.AGENT_RADIUS


def core_of(geometries, n_agents=1, n_envs=None, **settings):
    made = scene.scenery(geometries, n_agents=n_agents, n_envs=n_envs, device="cpu")
    return core.Core(made, res=8, **settings)


# ---- Lanes ----


def test_lane_e_a_plus_a_is_agent_a_of_environment_e():
    values = torch.arange(24).view(3, 2, 4)
    lanes = modules.to_lanes(values)
    assert lanes.shape == (6, 4) and torch.equal(lanes[2 * 2 + 1], values[2, 1])
    flags = torch.arange(6)
    for given in (flags, flags[:, None], flags.view(3, 2)):
        assert torch.equal(modules.to_agents(given, 2), flags.view(3, 2))
    assert torch.equal(modules.to_lanes(modules.to_agents(flags, 2)), flags)


# ---- Lifecycles ----


def lived(lifecycle, steps, terminal=lambda age: None):
    """Worlds' flags of a reset and some steps."""
    flags = [lifecycle(lifecycle.start_all())]
    for _ in range(steps):
        flags.append(lifecycle(lifecycle.start_ended(), terminal(lifecycle.ages + 1)))
    return [torch.stack(kind).T.tolist() for kind in zip(*(f.values() for f in flags))]


def test_an_episode_of_three_steps_is_truncated_at_the_third_and_the_next_step_begins_another():
    lifecycle = modules.Lifecycle(core_of([toys.box()], n_envs=2), 3)
    reset, terminal, truncated = lived(lifecycle, 5)
    assert reset == 2 * [[True, False, False, False, True, False]]
    assert truncated == 2 * [[False, False, False, True, False, False]]
    assert not any(map(any, terminal)) and lifecycle.ages.tolist() == [1, 1]


def test_terminal_wins_over_the_limit_and_is_masked_where_an_episode_begins():
    """With a limit of two steps, lane 0 dies whenever it may, lane 1 at the age of two, lane 2
    never.
    """

    def deaths(age):
        return torch.stack([age[0] >= 0, age[1] == 2, age[2] < 0])

    lifecycle = modules.Lifecycle(core_of([toys.box()], n_envs=3), 2)
    reset, terminal, truncated = lived(lifecycle, 3, deaths)
    yes, no = True, False
    assert reset == [[yes, no, yes, no], [yes, no, no, yes], [yes, no, no, yes]]
    assert terminal == [[no, yes, no, yes], [no, no, yes, no], [no, no, no, no]]
    assert truncated == [[no, no, no, no], [no, no, no, no], [no, no, yes, no]]


def test_limits_may_be_written_by_the_environment():
    lifecycle = modules.Lifecycle(core_of([toys.box()], n_envs=3))
    lifecycle(lifecycle.start_all())
    lifecycle.limits.copy_(torch.tensor([1, 2, 9]))
    assert [lifecycle(lifecycle.start_ended()).truncated.tolist() for _ in range(2)] == [
        [True, False, False],
        [False, True, False],
    ]


def test_without_a_limit_episodes_do_not_end():
    lifecycle = modules.Lifecycle(core_of([toys.box()]))
    _, _, truncated = lived(lifecycle, 300)
    assert not any(map(any, truncated))


def test_random_lifespans_cover_their_range_evenly_and_stay_until_the_next_episode():
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
        still = first > age
        assert torch.equal(lifecycle.limits[still], first[still])


def test_agents_of_one_environment_have_states_of_their_own():
    c = core_of([toys.box()], n_agents=2, n_envs=3)
    lifecycle = modules.Lifecycle(c, 7)
    lifecycle(lifecycle.start_all())
    lifecycle.ages.copy_(torch.arange(6))
    state = lifecycle.state(2)
    lifecycle.ages.zero_()
    assert state.age.tolist() == [4, 5] and state.limit.tolist() == [7, 7]


@pytest.mark.parametrize("limit", [0, -1, 2**31])
def test_a_limit_is_at_least_one_step(limit):
    with pytest.raises(ValueError, match=f"at least one step, but {limit} was given"):
        modules.Lifecycle(core_of([toys.box()]), limit)


# ---- Spawns ----


def clearance(point, walls):
    """Metres from a point to the nearest wall, by looking at every wall each half centimetre:
    another and slower way, good to 0.02 mm at 15 cm.
    """
    nearest = math.inf
    for start, end in walls.astype(float):
        along = np.linspace(start, end, 2 + int(200 * np.linalg.norm(end - start)))
        nearest = min(nearest, np.linalg.norm(along - point, axis=-1).min())
    return nearest


@pytest.mark.parametrize("n_agents", [1, 3])
def test_agents_spawn_in_rooms_five_centimetres_clear_of_every_wall(n_agents):
    homes = [*sample("bench", 2), *sample("homes", 2), toys.column()]
    c = core_of(homes, n_agents)
    spawner = modules.RandomSpawns(homes, c, n_spawns=30)
    for home, points in zip(homes, spawner.points.double().numpy(), strict=True):
        for x, y in points:
            assert clearance((x, y), home.walls) > RADIUS + 0.05 - 1e-4
            cell = len(home.masks) - 1 - int(y / home.res), int(x / home.res)
            assert home.masks[cell] > 0, "in a room"
    for _ in range(6):
        spawner(c.agent_full(True))
        for points, positions in zip(spawner.points, c.agents.positions):
            assert (points == positions[:, None]).all(-1).any(-1).all(), "at one of the points"


def nearest_pair(positions):
    """The least distance between two agents of one environment, positions (N, A, 2)."""
    apart = (positions[:, :, None] - positions[:, None]).norm(dim=-1)
    return float(apart[:, ~torch.eye(positions.shape[1], dtype=torch.bool)].min())


@pytest.mark.parametrize("width", [1, 5])
def test_agents_that_spawn_together_never_overlap(width):
    """In a room of a metre, too, where points drawn one by one would put many pairs on top of each
    other.
    """
    n = 2 if width == 1 else 8
    c = core_of([toys.box(width)], n, n_envs=64)
    spawner = modules.RandomSpawns([toys.box(width)], c)
    for _ in range(40):
        spawner(c.agent_full(True))
        assert nearest_pair(c.agents.positions) >= 2 * RADIUS + 0.05 - 1e-6
    assert len(c.agents.positions.flatten(0, 1).unique(dim=0)) > 10 * n, "and not always there"


def test_every_agent_has_points_all_over_a_room():
    c = core_of([toys.box()], 4, n_envs=1)
    points = modules.RandomSpawns([toys.box()], c).points[0].view(4, 32, 2)
    for share in points:
        assert np.ptp(share.numpy(), 0).min() > 3.5


def corner():
    """A room whose only cell is nearly all too near to its walls: 20 points of some 5,000 fit."""
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
def test_the_points_of_lone_agents_never_change(geometries, n_spawns, digest):
    """Episodes of a seed depend on them: they are those of the search that first found them, which
    compared every candidate with every wall.
    """
    spawner = modules.RandomSpawns(geometries, core_of(geometries), n_spawns)
    assert spawner.points.shape == (len(geometries), n_spawns, 2)
    assert hashlib.sha256(spawner.points.numpy().tobytes()).hexdigest()[:16] == digest


def test_a_room_with_less_space_gives_its_points_again():
    points = modules.RandomSpawns([corner()], core_of([corner()]), 64).points[0]
    assert len(points.unique(dim=0)) == 20 and points.shape == (64, 2)


@pytest.mark.parametrize(
    "n_agents, message",
    [
        (1, "no point in a room that is 0.16 m from every wall"),
        (9, "no room for 9 agents at once, 0.26 m apart"),
    ],
)
def test_a_geometry_without_space_is_named(n_agents, message):
    g = toys.box(1)
    if n_agents == 1:
        g["walls"] = np.concatenate([g.walls, [[[x, 1], [x, 2]] for x in np.arange(1.1, 2, 0.1)]])
    c = core_of([toys.box(1)], n_agents)
    with pytest.raises(ValueError, match=f"geometry 0 has {message}"):
        modules.RandomSpawns([g], c)


def test_every_agent_needs_a_point():
    with pytest.raises(ValueError, match="for each of the 3 agents, but 2 was given"):
        modules.RandomSpawns([toys.box()], core_of([toys.box()], 3), n_spawns=2)


def cached_points(folder):
    return sorted(folder.glob("spawn-points-*"))


def test_the_points_of_many_layouts_are_found_once_and_cached(tmp_path, monkeypatch):
    monkeypatch.setenv("MEGASTEP_CACHE", str(tmp_path))
    homes = sample("bench", 40)
    c = core_of(homes)
    found = modules.RandomSpawns(homes, c).points
    alone = [modules.RandomSpawns([g], core_of([g])).points for g in homes[:1]]
    assert torch.equal(found[:1], alone[0])
    (path,) = cached_points(tmp_path)

    with monkeypatch.context() as patch:  # nothing is searched for again
        patch.setattr(spawning, "spawn_points", None)
        assert torch.equal(modules.RandomSpawns(homes, c).points, found)

    body = path.read_bytes()
    path.write_bytes(body[:100] + bytes([body[100] ^ 1]) + body[101:])
    assert torch.equal(modules.RandomSpawns(homes, c).points, found)
    assert path.read_bytes() == body


def test_other_homes_seeds_and_numbers_have_points_of_their_own(tmp_path, monkeypatch):
    monkeypatch.setenv("MEGASTEP_CACHE", str(tmp_path))
    homes = sample("bench", 40)
    c = core_of(homes)
    others = [*homes[:-1], homes[0]]
    found = [
        modules.RandomSpawns(homes, c).points,
        modules.RandomSpawns(homes, c, seed=2).points,
        modules.RandomSpawns(others, c).points,
        modules.RandomSpawns(homes, c, 64).points,
    ]
    assert len(cached_points(tmp_path)) == 4
    assert not any(torch.equal(found[0][:, :64], points[:, :64]) for points in found[1:3])


def test_only_the_newest_points_stay_in_the_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("MEGASTEP_CACHE", str(tmp_path))
    monkeypatch.setattr(spawning, "MAX_FILES", 2)
    homes = sample("bench", 32)
    c = core_of(homes)
    left = []
    for seed in range(4):
        modules.RandomSpawns(homes, c, seed=seed)
        left.append({path.name for path in cached_points(tmp_path)})
    assert [len(names) for names in left] == [1, 2, 2, 2]
    assert not left[1] & left[3] and len(left[2] & left[3]) == 1


# ---- Sensors ----


def test_sensors_draw_their_own_states():
    c = core_of([toys.box()], n_agents=2)
    c.agents.positions[:] = 3.0
    c.agents.angvelocity[:] = torch.tensor([[180.0, 0.0]])
    for sensor, name in ((modules.RGB(c), "rgb"), (modules.Depth(c), "depth")):
        axes = sensor.plot_state(numpyify(sensor.state(0)))
        assert [ax.get_title("left") for ax in axes[0]] == [f"{name} 0", f"{name} 1"]
        assert np.asarray(axes[0, 1].images[0].get_array()).shape[:2] == (1, 8)
    imu = modules.IMU(c)
    bars = imu.plot_state(numpyify(imu.state(0))).patches
    assert [bar.get_height() for bar in bars] == [0.5, 0, 0, 0, 0, 0]
    plotting.rasterise(bars[0].figure)
