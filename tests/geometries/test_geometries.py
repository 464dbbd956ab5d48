"""Sources of geometries: toys, splits, files, and files that are broken or malicious."""

import io
import re
import zipfile

import numpy as np
import pytest
import torch

from megastep import core, geometries, modules, toys
from megastep.dotdict import dotdict
from megastep.geometries import files, sources
from megastep.geometry import mirror_image
from megastep.scene import scenery


def test_box():
    g = toys.box()
    assert g.walls.shape == (4, 2, 2) and g.walls.min() == 1 and g.walls.max() == 6
    assert (g.lights == [[3.5, 3.5]]).all() and g.res == 0.2
    assert g.masks.shape == (35, 35)
    assert (g.masks == 1).sum() == 23**2, "25 cells per side less the two that walls touch"
    assert g.masks[0, 0] == 0 and g.masks[17, 17] == 1 and g.masks[17, 5] == -1


def test_column():
    g = toys.column()
    assert g.walls.shape == (8, 2, 2)
    assert g.masks[17, 17] == 0 and g.masks[17, 10] == 1
    n_touched = (g.masks[14:21, 14:21] == -1).sum()
    assert n_touched == 40, "7 x 7 cells less the 3 x 3 inside the pillar"
    assert all(g.masks[tuple(ij)] == 1 for ij in geometries.indices(g.lights, g.masks.shape, g.res))


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: toys.box(0), "width=0 .*from 1 to 199"),
        (lambda: toys.box(500), "width=500 "),
        (lambda: toys.column(5, 5), "pillar=5 .*from 0.01 to 4 m"),
        (lambda: toys.box(np.nan), "width=nan"),
        (lambda: toys.box("5"), "width='5'"),
        (lambda: toys.column(pillar=None), "pillar=None"),
    ],
)
def test_toys_of_wrong_size_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_sample_is_determined_by_its_arguments():
    first = geometries.sample("bench", 5, seed=3)
    assert [g.id for g in first] == [g.id for g in geometries.sample("bench", 5, seed=3)]
    assert [g.id for g in first] != [g.id for g in geometries.sample("bench", 5, seed=4)]
    assert [g.id for g in geometries.sample("bench", 3, seed=3)] == [g.id for g in first[:3]]


@pytest.mark.parametrize("name, total, test", [("bench", 512, 51), ("homes", 5000, 500)])
def test_the_test_split_is_a_tenth(name, total, test):
    ids = {
        split: [g.id for g in geometries.sample(name, total, split)] for split in geometries.SPLITS
    }
    assert len(set(ids["all"])) == total and len(set(ids["test"])) == test
    assert not set(ids["training"]) & set(ids["test"])
    assert ids["test"][test : 2 * test] == ids["test"][:test], "repeated if n exceeds the split"


def rooms(n=4, split="training", seed=1, longest=9.0):
    """A source of one's own: n rooms, 5 m to `longest` wide."""
    widths = np.random.default_rng([seed, split == "test"]).uniform(5, longest, n)
    return [toys.box(width) for width in widths]


def test_a_mix_splits_each_part_with_one_seed():
    braided = {"source": "maze", "n": 3, "size": 4, "braid": 1}
    own = {"source": f"{__name__}:rooms", "n": 6, "longest": 6.0}
    parts = {"homes": 7, "bench": 60, "maze": 0, "braided": braided, "own": own}
    for split, n_bench in ("training", 60), ("test", 51), ("all", 60):
        n = 7 + n_bench + 3 + 6
        mix = geometries.sample("mixed", n, split, seed=5, parts=parts)
        assert [g.source for g in mix] == 7 * ["homes"] + n_bench * ["bench"] + 3 * [
            "braided"
        ] + 6 * ["own"]
        homes = geometries.sample("homes", 7, split, 5)
        bench = geometries.sample("bench", n_bench, split, 5)
        mazes = geometries.sample("maze", 3, split, 5, size=4, braid=1)
        for g, alone in zip(mix, [*homes, *bench, *mazes, *rooms(6, split, 5, 6.0)], strict=True):
            assert g.walls.tobytes() == alone.walls.tobytes() and "source" not in alone


def test_a_part_may_have_a_seed_of_its_own():
    parts = {"homes": 5, "others": {"source": "homes", "n": 5, "seed": 2}}
    mix = geometries.sample("mixed", 10, "test", seed=1, parts=parts)
    drawn = [g.id for seed in (1, 2) for g in geometries.sample("homes", 5, "test", seed)]
    assert [g.id for g in mix] == drawn and len(set(drawn)) > 5
    parts["others"]["seed"] = -1
    with pytest.raises(ValueError, match="others: seed: -1 is out of range"):
        geometries.sample("mixed", 10, parts=parts)


def test_training_draws_a_part_as_often_as_its_weight_says():
    parts = {"homes": 3, "bench": {"n": 4, "weight": 2}}
    plain = geometries.sample("mixed", 7, parts={"homes": 3, "bench": 4})
    mix = geometries.sample("mixed", 11, parts=parts)
    assert [(g.source, g.id) for g in mix] == [
        (g.source, g.id) for g in [*plain[:3], *plain[3:], *plain[3:]]
    ]
    homes = scenery(mix, 1, n_envs=11)
    assert homes.layouts.n_layouts == 11, "drawing layouts evenly draws them by weight"
    for split in "test", "all":
        assert len(sources.mixed(None, split, parts=parts)) == 7


def test_training_draws_mirror_images_of_a_part_as_well():
    parts = {"homes": 3, "bench": {"n": 4, "mirror": True, "weight": 2}}
    mix = geometries.sample("mixed", 19, parts=parts)
    plain = geometries.sample("bench", 4)
    swapped = [mirror_image(g) for g in plain]
    for g, expected in zip(mix[3:], 2 * [*plain, *swapped], strict=True):
        assert g.source == "bench" and g.walls.tobytes() == expected.walls.tobytes()
    for split in "test", "all":
        assert len(sources.mixed(None, split, parts=parts)) == 7
    as_dict = mirror_image(dict(plain[0], walls=plain[0].walls.tolist()))  # as of a source
    assert as_dict.walls.tobytes() == swapped[0].walls.tobytes()
    small = dotdict(plain[0], masks=plain[0].masks[:, :20])
    with pytest.raises(ValueError, match="no mirror image: a wall or light is at x = "):
        mirror_image(small)


def test_an_agent_sees_a_mirror_image_from_right_to_left():
    homes, random = geometries.sample("bench", 16), np.random.default_rng(0)
    cells = [random.choice(np.argwhere(g.masks > 0)) for g in homes]
    places = [geometries.centers(ij, g.masks.shape, g.res) for ij, g in zip(cells, homes)]
    positions, angles = np.stack(places), random.uniform(-180, 180, 16).astype(np.float32)
    widths = np.array([g.masks.shape[1] * g.res for g in homes], np.float32)

    def depth(homes, x, angles):
        c = core.Core(scenery(homes, 1, n_envs=16), res=256)
        poses = np.stack([x, positions[:, 1]], -1)
        c.agents.positions[:, 0] = torch.from_numpy(poses)
        c.agents.angles[:, 0] = torch.from_numpy(angles)
        return modules.Depth(c)()[:, 0, 0, 0].numpy()

    seen = depth(homes, positions[:, 0], angles)
    swapped = depth([mirror_image(g) for g in homes], widths - positions[:, 0], 180 - angles)
    assert seen.std() > 0.1
    differs = np.abs(seen - swapped[:, ::-1]) > 1e-3
    assert differs.mean() < 0.005, "rays at the very edge of a wall may miss it on one side"


def test_fewer_of_a_mix_are_spread_over_its_parts_and_more_are_repeated():
    parts = {"homes": 6, "bench": 2}
    mix = geometries.sample("mixed", 8, parts=parts)
    four, twenty = (geometries.sample("mixed", n, parts=parts) for n in (4, 20))
    assert [g.id for g in four] == [mix[i].id for i in (0, 2, 4, 6)]
    assert [g.id for g in twenty] == [mix[i % 8].id for i in range(20)]
    assert twenty[8] is twenty[0], "the same objects, so that no home gets two layouts"


@pytest.mark.parametrize(
    "parts, message",
    [
        ({"hoems": 3}, "'hoems' is not a source; did you mean homes?"),
        ({"a": {"source": "nowhere:rooms", "n": 3}}, "nowhere:rooms cannot be imported"),
        (
            {"a": {"source": "megastep.toys:box", "n": 3}},
            "unexpected keyword argument 'n'; it takes width, and a source n, split and seed",
        ),
        ({"homes": 0, "maze": 0}, "its counts sum to 0"),
        ({}, "its counts sum to 0"),
        ({"homes": -1}, "homes: n: -1 is out of range: allowed is at least 1"),
        ({"homes": True}, "homes: n: expected an integer, got True"),
        ({"bench": {"weight": 0}}, "bench: weight: 0 is out of range: allowed is at least 1"),
        ({"bench": {"mirror": 2}}, "bench: mirror: expected true or false, got 2"),
        ({"a": {"source": "mixed"}}, "'mixed' is not a source; there are bench"),
        (
            {"a": {"source": "homes", "outr": True}},
            "a: homes: got an unexpected keyword argument 'outr'",
        ),
        ({"files": 3}, "files: missing a required"),
        ({"maze": {"n": 3, "braid": 4}}, "maze: braid: 4 is out of range: allowed is at most 1"),
    ],
)
def test_a_mix_of_wrong_parts_is_refused(parts, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        geometries.sample("mixed", 4, parts=parts)


@pytest.mark.parametrize(
    "arguments, options, message",
    [
        (("hoems", 1), {}, "geometry source 'hoems'.*mean homes"),
        (("homes", 1, "train"), {}, "split 'train'.*mean training"),
        (("homes", 0), {}, "n=0 "),
        (("homes", 1.5), {}, "n=1.5 "),
        (("column", 1), {"pilar": 1}, "option .*'pilar'.*mean pillar"),
        (("files", 1), {}, "files.*path="),
        (("files", 1), {"path": None}, "files.*path="),
        (("files", 1), {"path": "nowhere.npz"}, "no geometry file 'nowhere.npz'"),
    ],
)
def test_sample_names_a_wrong_argument(arguments, options, message):
    with pytest.raises(ValueError, match=message):
        geometries.sample(*arguments, **options)


def test_save_and_load(tmp_path):
    path = tmp_path / "some.npz"
    column = dotdict(toys.column(), id=7, goal=np.array([1.0, 2.0]))
    saved = [toys.box(), column, *geometries.sample("homes", 2)]
    files.save(path, saved)
    for before, after in zip(saved, files.load(path), strict=True):
        assert before.keys() == after.keys()
        for key in before:
            assert np.array_equal(before[key], after[key]), key
    assert [p.name for p in tmp_path.iterdir()] == ["some.npz"]
    (g,) = geometries.sample("files", 1, "all", path=path)
    assert g.id in [g.id for g in saved]


def test_a_changed_file_is_loaded_again(tmp_path):
    path = tmp_path / "one.npz"
    files.save(path, [toys.box(5)])
    assert geometries.sample("files", 1, path=path)[0].walls.max() == 6
    files.save(path, [toys.box(8)])
    assert geometries.sample("files", 1, path=path)[0].walls.max() == 9


def test_a_refused_save_leaves_the_old_file(tmp_path):
    path = tmp_path / "one.npz"
    files.save(path, [toys.box()])
    with pytest.raises(ValueError, match="Geometry 1 .*no 'res'"):
        broken = toys.box()
        del broken["res"]
        files.save(path, [toys.box(), broken])
    with pytest.raises(ValueError, match="0 geometries: allowed are 1 to"):
        files.save(path, [])
    assert len(files.load(path)) == 1 and len(list(tmp_path.iterdir())) == 1


def npy(values, **kwargs):
    buffer = io.BytesIO()
    np.save(buffer, values, **kwargs)
    return buffer.getvalue()


def header(text):
    """The start of an array file whose header is this text."""
    text = text.encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


def write_box(path, **changes):
    """Writes an archive of one box with some entries replaced or added (bytes) or left out (None).
    Returns the path.
    """
    entries = {f"0/{key}.npy": npy(value) for key, value in toys.box().items()}
    for key, value in changes.items():
        entries[key if "/" in key else f"0/{key}.npy"] = value
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, value in entries.items():
            if value is not None:
                archive.writestr(name, value)
    return path


BAD = {
    "geometry 0: has no 'masks'": {"masks": None},
    "geometry 0: 'walls' holds a NaN": {"walls": npy(np.full((3, 2, 2), np.nan))},
    "geometry 0: 'walls' reaches up to 1e\\+30 m, .*200": {"walls": npy(np.full((3, 2, 2), 1e30))},
    "geometry 0: 'walls' .*-1 m": {"walls": npy(np.full((3, 2, 2), -1.0))},
    "geometry 0: has no room": {"masks": npy(np.zeros((5, 5), int))},
    "'walls' cannot be read: Object arrays cannot be loaded": {
        "walls": npy(np.array([{}], object), allow_pickle=True)
    },
    "'walls' cannot be read: .*dtype <U3": {"walls": npy(np.array(["abc"]))},
    "'walls' cannot be read": {
        "walls": header("{'descr': '<f4', 'fortran_order': False, 'shape': (100000000000, 2, 2)}")
        + bytes(32)
    },
    "'walls' cannot be read: .*(data|EOF)": {"walls": npy(toys.box().walls)[:-4]},
    "'walls' cannot be read: .*magic": {"walls": b"<html>not an array</html>"},
    "'res' cannot be read": {"res": header("-" * 900 + "1")},
    "holds '../../escaped.npy', .*only": {"../../escaped.npy": npy(np.ones(3))},
    "holds 'readme/x.txt', .*only": {"readme/x.txt": b"hello"},
    "numbers? .*1 is missing": {"2/walls.npy": npy(np.ones(3))},
    "its arrays have 101,00.,... bytes, but the limit": {"masks": bytes(101_000_000)},
}


@pytest.mark.parametrize("message", BAD)
def test_a_bad_file_is_refused_in_one_sentence(tmp_path, message):
    path = write_box(tmp_path / "bad.npz", **BAD[message])
    with pytest.raises(ValueError, match=message) as caught:
        files.load(path)
    text = str(caught.value)
    assert text.startswith(f"Geometry file {str(path)!r}") and "\n" not in text
    assert [p.name for p in tmp_path.iterdir()] == ["bad.npz"]
    assert not (tmp_path.parents[1] / "escaped.npy").exists()


def test_more_texels_than_a_home_can_have_are_refused(tmp_path):
    walls = np.tile(np.array([[[1, 1], [199, 199]]], np.float32), (30_000, 1, 1))
    path = write_box(tmp_path / "long.npz", walls=npy(walls))
    assert path.stat().st_size < 70_000
    with pytest.raises(ValueError, match="has 8,400,[0-9]+ m of walls, .* limits are 20,000"):
        files.load(path)
    wide = [dotdict(toys.box(190.0), res=10.0, masks=np.ones((2, 2), np.int16))] * 6_000
    with pytest.raises(ValueError, match="the file 4,000,[0-9]+ m up to here"):
        files.save(path, wide)


@pytest.mark.parametrize(
    "content, message",
    [
        (b"", "no zip file, or is cut short"),
        (b"hello" * 100, "no zip file"),
        (b"PK\5\6" + bytes(18), "0 geometries"),
    ],
)
def test_a_file_that_is_no_archive_is_refused(tmp_path, content, message):
    (tmp_path / "bad.npz").write_bytes(content)
    with pytest.raises(ValueError, match=message):
        files.load(tmp_path / "bad.npz")


def test_a_file_cut_anywhere_is_refused(tmp_path):
    whole = write_box(tmp_path / "whole.npz").read_bytes()
    for size in range(0, len(whole), 97):
        (tmp_path / "cut.npz").write_bytes(whole[:size])
        with pytest.raises(ValueError, match="cut.npz"):
            files.load(tmp_path / "cut.npz")


def test_too_many_geometries_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "MAX_GEOMETRIES", 2)
    path = write_box(tmp_path / "many.npz", **{f"{i}/id.npy": npy(i) for i in range(1, 3)})
    with pytest.raises(ValueError, match="3 geometries: allowed are 1 to 2"):
        files.load(path)
    with pytest.raises(ValueError, match="3 geometries: allowed are 1 to 2"):
        files.save(path, 3 * [toys.box()])
