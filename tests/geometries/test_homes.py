"""Homes: the parts of their generator, statistics of homes, and the database of the package."""

import hashlib
import shutil

import matplotlib
import numpy as np
import pytest
import torch

from megastep import geodesics, geometries, geometry
from megastep.dotdict import dotdict
from megastep.engine import AGENT_RADIUS
from megastep.geodesics import PathGraph
from megastep.geometries import checks, databases, homes, mazes, memory_mazes
from megastep.geometries.homes import plan, portable_generator, regions
from megastep.geometries.homes.portable_generator import PortableGenerator
from scripts import check_homes, make_homes

matplotlib.use("Agg")


@pytest.fixture(scope="module")
def generated():
    """Generated homes."""
    return [homes.generate(seed) for seed in range(24)]


@pytest.fixture(scope="module")
def dense():
    """Homes of the highest density."""
    return [homes.generate(seed, density=plan.DENSEST) for seed in range(16)]


@pytest.fixture(scope="module")
def cluttered():
    """Homes of the highest density and clutter."""
    return [homes.generate(seed, density=plan.DENSEST, clutter=1) for seed in range(8)]


@pytest.fixture(scope="module")
def some_packaged():
    """One in a hundred homes of the package."""
    return [databases.home(index) for index in range(0, databases.COUNT, 100)]


@pytest.fixture(scope="module")
def packaged():
    """All homes of the package."""
    return [databases.home(index) for index in range(databases.COUNT)]


def test_numbers_equal_published_splitmix64():
    # the first outputs of the published generator from state 0
    states = [k * portable_generator.GOLDEN & portable_generator.MASK for k in (1, 2, 3)]
    outputs = [portable_generator.mixed(state) for state in states]
    assert outputs == [0xE220A8397B1DCDAF, 0x6E789E6AA1B965F4, 0x06C45D188009454F]


@pytest.mark.parametrize("seed", range(5))
def test_a_partition_covers_its_footprint_once(seed):
    generator = PortableGenerator(seed)
    for _ in range(60):
        rooms = plan.programme(7, generator)
        footprint = plan.footprint(sum(size for _, size in rooms), generator)
        if result := plan.partition(footprint, rooms, generator, plan.style(1)):
            placed, _ = result
            break
    assert sorted(room.kind for room in placed) == sorted(kind for kind, _ in rooms)
    assert sum(regions.area(room.region) for room in placed) == regions.area(footprint)
    pieces = [r for room in placed for r in room.region]
    for i, a in enumerate(pieces):
        assert any(
            f[0] <= a[0] and f[1] <= a[1] and f[2] >= a[2] and f[3] >= a[3] for f in footprint
        )
        for b in pieces[:i]:
            assert min(a[2], b[2]) <= max(a[0], b[0]) or min(a[3], b[3]) <= max(a[1], b[1])


@pytest.mark.parametrize(
    "kind, expected",
    [
        ("generated", "65709a02cce3fa38634c40e6a6bb61ce7489259b2acabb7ecd35ba4641da8c7e"),
        ("dense", "73cce915673d897f556de17fb21b454552cee0a5b927f5c00f0bdc15225f5f94"),
        ("cluttered", "17d1d72575a14c6a4922de7517f64f4c571b10fbc4dda425c2b3dd973ce4617b"),
    ],
)
def test_bytes_of_homes_are_unchanged(kind, expected, request):
    digest = hashlib.sha256()
    for g in request.getfixturevalue(kind):
        for values, dtype in (g.walls, "<f4"), (g.lights, "<f4"), (g.masks, "<i2"):
            digest.update(values.astype(dtype).tobytes())
    assert digest.hexdigest() == expected


@pytest.mark.parametrize(
    "kind",
    ["generated", "dense", "some_packaged", pytest.param("packaged", marks=pytest.mark.nightly)],
)
def test_homes_pass_the_checks(kind, request):
    plans = request.getfixturevalue(kind)
    assert [(g.id, error) for g in plans for error in check_homes.errors(g)] == []


@pytest.mark.nightly
@pytest.mark.parametrize("clutter, median", [(0, 190), (1, 195)])
def test_many_dense_homes_pass_the_checks(clutter, median):
    plans = [homes.generate(seed, density=3, clutter=clutter) for seed in range(10_000, 11_000)]
    assert [(g.id, e) for g in plans for e in check_homes.errors(g, bool(clutter))] == []
    assert median < np.median([len(g.walls) for g in plans]) < 215


@pytest.mark.parametrize(
    "option",
    [{"density": x} for x in (0.9, 3.1, float("nan"), "dense")] + [{"clutter": 1.1}],
    ids=str,
)
def test_another_density_or_clutter_is_refused(option):
    (name,) = option
    with pytest.raises(ValueError, match=name):
        geometries.sample("homes", 2, **option)


# ---- Dense homes ----


def door_widths(g):
    return np.linalg.norm(g.doors[:, 1] - g.doors[:, 0], axis=-1)


def test_density_widens_homes_up_to_those_of_the_benchmarks(generated, dense):
    """Median walls: 66 of real homes, 204 of `bench`."""
    half = [homes.generate(seed, density=2) for seed in range(10)]
    medians = [np.median([len(g.walls) for g in plans]) for plans in (generated, half, dense)]
    assert 55 < medians[0] < 90 < medians[1] < 180 < medians[2] < 240
    widths, narrow = (np.concatenate([door_widths(g) for g in p]) for p in (generated, dense))
    assert narrow.min() == pytest.approx(0.6) and narrow.mean() < widths.mean() - 0.03
    n_open, n_dense = (np.mean([len(g.openings) for g in plans]) for plans in (generated, dense))
    assert n_dense < 0.6 * n_open


def test_no_room_has_cells_inside_furniture(dense):
    for g in dense:
        distance = checks.clearance(g)
        labels, _ = geometry.components(distance > checks.FINE / 2)
        fine = np.maximum(g.masks, 0).repeat(4, 0).repeat(4, 1)
        assert len(np.unique(labels[(fine > 0) & (labels > 0)])) == 1, g.id
        assert (labels[fine > 0] > 0).mean() > 0.99, "a cell that no wall touches is free"


@pytest.mark.parametrize(
    "source, generate, options",
    [
        ("homes", homes.generate, dict(density=1.5, clutter=0.5)),
        ("maze", mazes.generate, dict(size=4, braid=0.5)),
        ("memory_maze", memory_mazes.generate, dict(size=11)),
    ],
)
def test_what_a_source_generates_is_the_same_from_the_cache(
    source, generate, options, monkeypatch, tmp_path
):
    """As in two processes and in one."""
    monkeypatch.setenv("MEGASTEP_CACHE", str(tmp_path / "cache"))
    drawn = []
    for each in 2, 100:
        monkeypatch.setattr(databases, "SEEDS_EACH", each)
        drawn.append(geometries.sample(source, 5, "test", **options))
        with monkeypatch.context() as patch:
            patch.delattr(databases, "functools")  # which only generating needs
            drawn.append(geometries.sample(source, 5, "test", **options))
        shutil.rmtree(tmp_path / "cache")
    for plans in drawn:
        assert [g.id for g in plans] == [g.id for g in geometries.sample("homes", 5, "test")]
        for g in plans:
            expected = generate(g.id, **options)
            assert all(np.array_equal(g[key], expected[key]) for key in g)
            assert set(databases.PARTS[:3]) < set(g)


# ---- Cluttered homes ----


def test_cluttered_homes_pass_the_checks(cluttered):
    """An agent reaches every point to spawn at."""
    some = [*cluttered, *(homes.generate(seed, clutter=1) for seed in range(4))]
    assert [(g.id, error) for g in some for error in check_homes.errors(g, True)] == []


def test_a_third_of_the_ways_in_cluttered_homes_are_narrow(dense, cluttered):
    """A body 41 cm wide can walk two thirds of those of an agent, and one 23 cm wide all."""
    for plans, (least, most) in ((dense, (0, 0.1)), (cluttered, (0.2, 0.45))):
        assert blocked(plans, 0.01) < 0.01 and least <= blocked(plans, 0.1) < most


def blocked(plans, wider):
    """Returns the fraction of pairs of points, 1 to 15 m apart, between which a body that is wider
    than an agent by so many metres on each side finds no path.
    """
    ways, cpu, n = [], torch.device("cpu"), geodesics.MAX_GOALS
    for i, home in enumerate(plans):
        graph = PathGraph([home], AGENT_RADIUS, cpu)
        points = geodesics.draw_points(graph, 3 * n, [np.random.default_rng(i)])
        pairs = geodesics.largest_part(graph, points, n, n)
        lengths = graph.lengths(*pairs)
        wide = PathGraph([home], AGENT_RADIUS + wider, cpu).lengths(*pairs)
        ways.append(wide[(lengths >= 1) & (lengths <= 15)])
    return torch.cat(ways).isinf().float().mean()


def test_packaged_homes_equal_generated_ones(generated):
    for g in [*generated[::6], homes.generate(4999)]:
        stored = databases.home(g.id)
        for key, value in stored.items():
            assert np.array_equal(value, g[key]), (g.id, key)
            assert getattr(value, "dtype", None) == getattr(g[key], "dtype", None)


def bottleneck(width):
    """Walls that leave a gap of `width` in the middle of `room()`."""
    return np.array(
        [[[1.0, 4.0], [2.5 - width / 2, 4.0]], [[2.5 + width / 2, 4.0], [4.0, 4.0]]], np.float32
    )


def room(walls=None):
    """A home of 3 m x 6 m with two rooms, which further walls may separate."""
    corners = np.array([[1, 1], [4, 1], [4, 7], [1, 7]], np.float32)
    outline = np.stack([corners, np.roll(corners, -1, 0)], 1)
    lines = outline if walls is None else np.concatenate([outline, walls])
    halves = [np.array([[1, a], [4, a], [4, b], [1, b]]) for a, b in ((1, 4), (4, 7))]
    return dotdict(
        id=0,
        walls=lines,
        lights=np.array([[2.5, 2.5], [2.5, 5.5]], np.float32),
        masks=geometry.masks(lines, halves),
        res=0.2,
        n_outer=1,
    )


def test_checks_find_narrow_passages():
    assert check_homes.errors(room()) == check_homes.errors(room(bottleneck(0.6))) == []
    (error,) = check_homes.errors(room(bottleneck(0.4)))
    assert "narrowest gap" in error and "every room" in error
    first, *_ = check_homes.errors(room(bottleneck(0.1)))
    assert "agent" in first and "every room" in first


def test_masks_agree_with_rooms_and_areas(generated):
    for g in generated:
        assert g.masks.max() == len(g.rooms) == len(g.lights) == len(g.areas)
        assert set(plan.CORE[: len(g.rooms)]) <= set(g.rooms)
        cells = np.bincount(g.masks[g.masks > 0])[1:] * g.res**2
        # walls take cells that are partly floor
        assert (cells <= np.array(g.areas) + 0.05 * np.sqrt(g.areas) * 4).all()
        assert ((door_widths(g) > 0.599) & (door_widths(g) < 0.951)).all()


def test_statistics_of_generated_homes(generated):
    medians = [band for band in make_homes.BANDS if band[1] == 50]  # these are few for a 95 %
    assert make_homes.outside(make_homes.statistics(generated), medians) == []


@pytest.mark.nightly
def test_training_and_test_share_no_home(packaged):
    assert len({make_homes.fingerprint(g) for g in packaged}) == 5000


def test_a_turned_home_has_the_same_fingerprint(generated):
    g, other = generated[:2]
    walls = g.walls[::-1, ::-1, ::-1] * np.float32([-1, 1]) + np.float32([20.05, 3.1])
    turned = dotdict(g, walls=walls)
    assert make_homes.fingerprint(turned) == make_homes.fingerprint(g)
    assert make_homes.fingerprint(turned) != make_homes.fingerprint(other)


def test_a_written_database_can_be_read_and_a_damaged_one_is_named(
    tmp_path, generated, monkeypatch
):
    path, plans = tmp_path / "homes.npz", generated[:3]
    content = databases.pack(plans)
    assert databases.pack(plans) == content, "equal homes give equal bytes"
    path.write_bytes(content)
    stored = databases.read(path, 3, "")
    for index, g in enumerate(plans):
        home = stored.home(index, g.id)
        assert all(np.array_equal(home[key], g[key]) for key in home)
    monkeypatch.setattr(databases, "PATH", path)
    for k in range(1, 8):
        path.write_bytes(
            content[: k * len(content) // 9] + b"??" + content[k * len(content) // 9 + 2 :]
        )
        databases._packaged.cache_clear()
        databases.home.cache_clear()
        with pytest.raises(ValueError, match="homes.npz' cannot be read .*install megastep again"):
            databases.home(4)
    databases._packaged.cache_clear()
