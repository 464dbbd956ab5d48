"""Homes: the generator's parts, what homes are like, and the database of ready ones."""

import hashlib
import math
import shutil
import time

import matplotlib
import numpy as np
import pytest

from megastep import geometry
from megastep.dotdict import dotdict
from megastep.geometries import homes
from megastep.geometries.homes import (
    database,
    openings,
    partition,
    plan,
    portable_generator,
    regions,
)
from scripts import check_homes, make_homes, show_homes

matplotlib.use("Agg")

COMB = np.array([[[1, y], [4, y]] for y in np.arange(1.2, 4.3, 0.2)], np.float32)
L_SHAPE = [(0, 0, 400, 600), (400, 0, 700, 250)]  # centimetres


@pytest.fixture(scope="module")
def made():
    """Sixty homes fresh from the portable_generator."""
    return [homes.generate(seed) for seed in range(60)]


@pytest.fixture(scope="module")
def ready():
    """All the homes that come with the package."""
    return [database.home(index) for index in range(database.COUNT)]


def test_random_numbers_are_those_of_splitmix64():
    # The first outputs of the published generator from state 0, which is `mixed` of multiples of
    # its increment.
    outputs = [
        portable_generator.mixed(k * portable_generator.GOLDEN & portable_generator.MASK)
        for k in (1, 2, 3)
    ]
    assert outputs == [0xE220A8397B1DCDAF, 0x6E789E6AA1B965F4, 0x06C45D188009454F]


def test_random_numbers_differ_between_seeds_and_not_between_runs():
    assert portable_generator.PortableGenerator(5).bits() == 0x4000795F8E33B2A8
    assert (
        len({portable_generator.PortableGenerator(seed).bits() for seed in range(-100, 1000)})
        == 1100
    )


def test_exp_is_the_exponential():
    for x in np.linspace(-19, 19, 77):
        assert portable_generator.exp(float(x)) == pytest.approx(math.exp(x), rel=1e-11)


def test_random_numbers_have_the_moments_they_claim():
    stream, n = portable_generator.PortableGenerator(1), 20_000
    uniform, normal = (
        np.array([draw() for _ in range(n)]) for draw in (stream.uniform, stream.normal)
    )
    error = 4 / np.sqrt(n)  # four standard errors
    assert abs(uniform.mean() - 0.5) < error * 12**-0.5 and 0 <= uniform.min() and uniform.max() < 1
    assert abs(normal.mean()) < error and abs(normal.var() - 1) < error * 2**0.5
    picks = np.bincount([stream.pick([1, 0, 3]) for _ in range(n)], minlength=3) / n
    assert picks[1] == 0 and abs(picks[2] - 0.75) < error * 0.433
    assert {stream.between(2, 4) for _ in range(100)} == {2, 3, 4}


def test_regions_of_an_l():
    assert regions.area(L_SHAPE) == 400 * 600 + 300 * 250
    assert regions.bounds(L_SHAPE) == (0, 0, 700, 600)
    assert regions.narrowest(L_SHAPE) == 250
    assert regions.widest(L_SHAPE) == (0, 0, 400, 600)
    assert regions.corners(L_SHAPE, 0) == {
        400: 1
    }  # beyond x = 400 there is less: outdoors is above the line
    assert regions.corners(L_SHAPE, 1) == {250: 1}
    lower, upper = regions.cut(L_SHAPE, 1, 300)
    assert lower == [(0, 0, 400, 300), (400, 0, 700, 250)] and upper == [(0, 300, 400, 600)]
    assert regions.connected(L_SHAPE, 250) and not regions.connected(L_SHAPE, 255)
    for axis in (0, 1):
        for share in (0.1, 0.5, 0.77):
            at = regions.position(regions.bands(L_SHAPE, axis), int(share * regions.area(L_SHAPE)))
            below = regions.area(regions.cut(L_SHAPE, axis, at)[0]) / regions.area(L_SHAPE)
            assert at % regions.LATTICE == 0 and abs(below - share) < 0.01


@pytest.mark.parametrize("seed", range(20))
def test_a_partition_covers_its_footprint_once(seed):
    stream = portable_generator.PortableGenerator(seed)
    for _ in range(60):
        rooms = plan.programme(7, stream)
        footprint = plan.footprint(sum(size for _, size in rooms), stream)
        try:
            laid, _ = partition.partition(footprint, rooms, stream)
            break
        except partition.Failure:
            pass
    assert sorted(room.kind for room in laid) == sorted(kind for kind, _ in rooms)
    assert sum(regions.area(room.region) for room in laid) == regions.area(footprint)
    pieces = [r for room in laid for r in room.region]
    for i, a in enumerate(pieces):
        assert any(
            f[0] <= a[0] and f[1] <= a[1] and f[2] >= a[2] and f[3] >= a[3] for f in footprint
        )
        for b in pieces[:i]:
            assert min(a[2], b[2]) <= max(a[0], b[0]) or min(a[3], b[3]) <= max(a[1], b[1])


def test_contacts_are_the_walls_between_rooms():
    rooms = [
        partition.Room("living", [(0, 0, 400, 600)]),
        partition.Room("bath", [(400, 0, 700, 250)]),
        partition.Room("bedroom", [(400, 250, 700, 600)]),
    ]
    assert openings.contacts(rooms) == [
        (0, 400, 0, 250, 0, 1),
        (0, 400, 250, 600, 0, 2),
        (1, 250, 400, 700, 1, 2),
    ]


def test_a_home_depends_on_its_seed_alone():
    alone = homes.generate(7)
    homes.generate(3)
    again = homes.generate(7)
    assert alone.keys() == again.keys() and all(
        np.array_equal(alone[key], again[key]) for key in alone
    )


def test_homes_are_the_same_bytes_on_any_machine(made):
    digest = hashlib.sha256()
    for g in made:
        for values, dtype in (g.walls, "<f4"), (g.lights, "<f4"), (g.masks, "<i2"):
            digest.update(values.astype(dtype).tobytes())
    assert digest.hexdigest() == "e5d40bf46ffaf368ed89de69fd7c6b18c8665457b7d8df80dcca074e81a5a926"


def test_the_ready_homes_are_the_generated_ones(made):
    for g in [*made[::6], homes.generate(4999)]:
        stored = database.home(g.id)
        for key, value in stored.items():
            assert np.array_equal(value, g[key]), (g.id, key)
            assert getattr(value, "dtype", None) == getattr(g[key], "dtype", None)


def test_every_fresh_home_passes_the_checks(made):
    assert [(g.id, error) for g in made for error in check_homes.errors(g)] == []


def test_ready_homes_pass_the_checks(ready):
    assert [(g.id, error) for g in ready[::50] for error in check_homes.errors(g)] == []


@pytest.mark.slow
def test_all_ready_homes_pass_the_checks(ready):
    assert [(g.id, error) for g in ready for error in check_homes.errors(g)] == []


def open_envelope(g):
    i, j = np.argwhere(g.masks > 0)[0]
    g["masks"] = g.masks.copy()
    g.masks[:i, j] = 0


def shut(g, width):
    """Narrows everything to `width` in the middle of a 3 m wide, 6 m long room."""
    return np.array(
        [[[1.0, 4.0], [2.5 - width / 2, 4.0]], [[2.5 + width / 2, 4.0], [4.0, 4.0]]], np.float32
    )


def room(walls=None):
    """A plain room, 3 m by 6 m, as a home with two rooms that its walls may part."""
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


def test_the_checks_know_a_passage_from_a_wall():
    assert check_homes.errors(room()) == [] and check_homes.errors(room(shut(room(), 0.6))) == []
    assert check_homes.errors(room(shut(room(), 0.4))) == [
        "a disc as wide as the least gap cannot reach every room"
    ]
    assert check_homes.errors(room(shut(room(), 0.1)))[0] == "an agent cannot reach every room"


@pytest.mark.parametrize(
    "error, change",
    [
        ("a wall is not finite", lambda g: g.walls.__setitem__((0, 1), g.walls[0, 0])),
        ("two walls are the same", lambda g: g.walls.__setitem__(1, g.walls[0, ::-1])),
        ("coordinates start at", lambda g: g.walls.__iadd__(0.2)),
        (
            "it is too large",
            lambda g: g.update(walls=np.concatenate([g.walls, g.walls + np.float32(40)])),
        ),
        (
            "it is too large",
            lambda g: g.update(
                walls=np.concatenate([g.walls + np.float32(i / 999) for i in range(101)])
            ),
        ),
        ("a room has too few cells", lambda g: g.masks.__setitem__(g.masks == 1, 2)),
        ("the envelope is open", open_envelope),
        (
            "a room has no point to spawn at",
            lambda g: g.update(walls=np.concatenate([g.walls, COMB])),
        ),
        ("a light is not in its room", lambda g: g.update(lights=g.lights[::-1])),
        ("a light is in a wall", lambda g: g.lights.__setitem__((0, 0), 1.04)),
    ],
)
def test_the_checks_see(error, change):
    g = room()
    change(g)
    assert any(error in found for found in check_homes.errors(g)), check_homes.errors(g)


def test_components_are_those_of_a_flood_fill():
    free = np.random.default_rng(0).random((40, 50)) < 0.6
    labels, count = check_homes.components(free)
    flooded = np.where(free, np.arange(1, free.size + 1).reshape(free.shape), 0)
    for _ in range(free.size):
        far = np.pad(flooded, 1)
        spread = (
            np.max([flooded, far[:-2, 1:-1], far[2:, 1:-1], far[1:-1, :-2], far[1:-1, 2:]], 0)
            * free
        )
        if (spread == flooded).all():
            break
        flooded = spread
    pairs = set(zip(labels[free], flooded[free]))
    assert len(pairs) == count == len(set(labels[free])) == len(set(flooded[free]))
    assert ((labels > 0) == free).all()


def test_rooms_are_where_the_generator_says(made):
    for g in made:
        assert g.masks.max() == len(g.rooms) == len(g.lights) == len(g.areas)
        assert set(plan.CORE[: len(g.rooms)]) <= set(g.rooms)
        cells = np.bincount(g.masks[g.masks > 0])[1:] * g.res**2
        assert (
            cells <= np.array(g.areas) + 0.05 * np.sqrt(g.areas) * 4
        ).all()  # walls take cells that are partly floor
        assert all(0.6 <= width <= 0.95 for width in g.doors)


def test_no_outer_face_without_the_rest_changing(made):
    for g in made[:5]:
        inner, stored = homes.generate(g.id, outer=False), database.home(g.id, outer=False)
        whole = database.home(g.id)
        assert len(inner.walls) == len(g.walls) - g.n_outer == len(stored.walls)
        for other in inner, stored:
            assert (other.walls == whole.walls[: -g.n_outer]).all() and (
                other.masks == whole.masks
            ).all()
            assert other.n_outer == 0 and (other.lights == whole.lights).all()


def test_some_corners_are_slanted(ready):
    slanted = [g for g in ready if (g.walls[:, 0] != g.walls[:, 1]).all(-1).any()]
    assert 0.05 < len(slanted) / len(ready) < 0.12
    lines = slanted[0].walls
    spans = np.abs(lines[:, 1] - lines[:, 0])
    diagonal = spans[(spans > 0).all(-1)]
    assert len(diagonal) == 2 and np.allclose(diagonal[:, 0], diagonal[:, 1])
    a, b = lines[(spans > 0).all(-1)]
    normal = (b[1] - b[0])[::-1] * [1, -1] / np.linalg.norm(b[1] - b[0])
    assert (
        abs(abs((a[0] - b[0]) @ normal) - np.array([0.20, 0.24, 0.30])).min() < 0.011
    )  # the envelope's thickness, to 1 cm


def test_ready_homes_are_like_real_ones(ready):
    lengths = [np.linalg.norm(g.walls[:, 1] - g.walls[:, 0], axis=-1).sum() for g in ready]
    values = {
        "walls": [len(g.walls) for g in ready],
        "wall length, m": lengths,
        "long side, m": [np.ptp(g.walls, axis=(0, 1)).max() for g in ready],
        "rooms": [g.masks.max() for g in ready],
    }
    bands = [band for band in make_homes.BANDS if band[0] in values]
    assert len(bands) == 7
    assert make_homes.outside(values, bands) == []


def test_fresh_homes_are_like_real_ones(made):
    medians = [
        band for band in make_homes.BANDS if band[1] == 50
    ]  # sixty homes have no 95 % quantile to speak of
    assert make_homes.outside(make_homes.statistics(made), medians) == []


@pytest.mark.slow
def test_a_thousand_homes_are_like_real_ones_and_quickly_made():
    start = time.process_time()
    made = [homes.generate(seed) for seed in range(10_000, 11_000)]
    assert time.process_time() - start < 20  # seconds: 20 ms a home on one core
    assert make_homes.outside(make_homes.statistics(made), make_homes.BANDS) == []


def test_the_bands_are_there_to_be_missed(made):
    small = make_homes.statistics([g for g in made if len(g.rooms) < 6])
    assert any(
        missed.startswith("rooms: the 50 % quantile")
        for missed in make_homes.outside(small, make_homes.BANDS)
    )


def test_no_two_homes_are_the_same(ready):
    assert len({make_homes.fingerprint(g) for g in ready[:1000] + ready[4500:]}) == 1500


@pytest.mark.slow
def test_training_and_test_share_no_home(ready):
    assert len({make_homes.fingerprint(g) for g in ready}) == 5000


def test_a_turned_home_has_the_same_fingerprint(made):
    g, other = made[0], made[1]
    turned = dotdict(
        g, walls=g.walls[::-1, ::-1, ::-1] * np.float32([-1, 1]) + np.float32([20.05, 3.1])
    )
    assert (
        make_homes.fingerprint(turned) == make_homes.fingerprint(g) != make_homes.fingerprint(other)
    )
    assert (
        make_homes.similarity([g, turned, other])[:2].min() > 0.8
    )  # cells are 30 cm and it moved by 5


def test_few_homes_are_nearly_the_same(ready):
    nearest = make_homes.similarity(ready[:400])
    assert np.median(nearest) <= 0.60 and (nearest > 0.9).mean() <= 0.005


@pytest.mark.slow
def test_few_of_a_thousand_homes_are_nearly_the_same(ready):
    nearest = make_homes.similarity(ready[4000:])
    assert np.median(nearest) <= 0.60 and (nearest > 0.9).mean() <= 0.005


def test_a_damaged_database_is_named(tmp_path):
    for name in ("homes.npz", "homes.sha256"):
        shutil.copy(database.PATH.with_name(name), tmp_path / name)
    path = tmp_path / "homes.npz"
    assert (database.home(3, path=path).walls == database.home(3).walls).all()
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    database._arrays.cache_clear()
    with pytest.raises(ValueError, match="homes.npz' are damaged .*; install megastep again"):
        database.home(4, path=path)
    path.with_suffix(".sha256").unlink()
    with pytest.raises(ValueError, match="homes.npz' cannot be read"):
        database.home(5, path=path)


def test_a_written_database_reads_back(tmp_path, made):
    path = tmp_path / "homes.npz"
    digest = make_homes.write(made[:3], path)
    assert path.with_suffix(".sha256").read_text() == f"{digest}  homes.npz\n"
    assert (
        hashlib.sha256(path.read_bytes()).hexdigest() == digest == make_homes.write(made[:3], path)
    )
    for index, g in enumerate(made[:3]):
        stored = database.home(index, path=path)
        assert all(np.array_equal(stored[key], g[key]) for key in stored)


def test_make_homes_prints_what_homes_are_like(monkeypatch, capsys):
    monkeypatch.setattr(make_homes, "BANDS", [("rooms", 50, 7, 10)])
    make_homes.main(["--count", "20", "--dry"])
    printed = capsys.readouterr().out
    assert (
        "20 homes" in printed and "20 different plans" in printed and "all checks passed" in printed
    )


def test_show_homes_draws_every_home():
    figure = show_homes.sheet(range(3))
    assert [ax.get_title()[:7] for ax in figure.axes] == ["home 0:", "home 1:", "home 2:", "", ""]
    assert len(figure.axes[1].collections[0].get_segments()) == len(homes.generate(1).walls)
    matplotlib.pyplot.close(figure)
