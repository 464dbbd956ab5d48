"""Where geometries come from: toys, splits, files, and files of strangers."""

import io
import subprocess
import sys
import zipfile

import numpy as np
import pytest

from megastep import geometries, toys
from megastep.dotdict import dotdict
from megastep.geometries import files


def test_the_box_is_the_one_of_the_documents():
    g = toys.box()
    assert g.walls.shape == (4, 2, 2) and g.walls.min() == 1 and g.walls.max() == 6
    assert (g.lights == [[3.5, 3.5]]).all() and g.res == 0.2
    assert (
        g.masks.shape == (35, 35) and (g.masks == 1).sum() == 23**2
    )  # 25 a side less the two the walls touch
    assert g.masks[0, 0] == 0 and g.masks[17, 17] == 1 and g.masks[17, 5] == -1


def test_the_column_is_a_pillar_in_a_box():
    g = toys.column()
    assert g.walls.shape == (8, 2, 2)
    assert g.masks[17, 17] == 0 and g.masks[17, 10] == 1
    assert (
        g.masks[14:21, 14:21] == -1
    ).sum() == 40  # a frame of two cells around the three in the pillar
    assert all(g.masks[tuple(ij)] == 1 for ij in geometries.indices(g.lights, g.masks.shape, g.res))


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: toys.box(0), "width=0 m is not allowed: take 1 to 199"),
        (lambda: toys.box(500), "width=500 m"),
        (lambda: toys.column(5, 5), "pillar=5 m does not fit a box 5 m wide"),
        (lambda: toys.box(np.nan), "width=nan"),
        (lambda: toys.box("5"), "width='5' m"),
        (lambda: toys.column(pillar=None), "pillar=None m"),
    ],
)
def test_toys_of_impossible_size_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_sample_gives_the_same_list_for_the_same_arguments():
    first = geometries.sample("bench", 5, seed=3)
    assert [g.id for g in first] == [g.id for g in geometries.sample("bench", 5, seed=3)]
    assert [g.id for g in first] != [g.id for g in geometries.sample("bench", 5, seed=4)]
    assert [g.id for g in geometries.sample("bench", 3, seed=3)] == [g.id for g in first[:3]]


@pytest.mark.parametrize("name, total, test", [("bench", 512, 51), ("homes", 5000, 500)])
def test_a_tenth_is_kept_for_testing(name, total, test):
    ids = {
        split: [g.id for g in geometries.sample(name, total, split)] for split in geometries.SPLITS
    }
    assert len(set(ids["all"])) == total and len(set(ids["test"])) == test
    assert not set(ids["training"]) & set(ids["test"])
    assert (
        ids["test"][test : 2 * test] == ids["test"][:test]
    )  # asked for more than there are: from the start again


def test_the_homes_for_testing_are_the_last_seeds():
    assert sorted(g.id for g in geometries.sample("homes", 500, "test")) == list(range(4500, 5000))


def test_options_reach_the_source():
    assert geometries.sample("box", 2, width=3)[1].walls.max() == 4
    assert len(geometries.sample("column", 3, pillar=2)) == 3


@pytest.mark.parametrize(
    "arguments, options, message",
    [
        (("hoems", 1), {}, "no geometry source 'hoems'; did you mean 'homes'"),
        (("homes", 1, "train"), {}, "no split 'train'; did you mean 'training'"),
        (("homes", 0), {}, "n=0 geometries"),
        (("homes", 1.5), {}, "n=1.5 geometries"),
        (("column", 1), {"pilar": 1}, "called 'pilar'; did you mean 'pillar'"),
        (("files", 1), {}, "needs its option path"),
        (("files", 1), {"path": None}, "needs its option path"),
        (("files", 1), {"path": "nowhere.npz"}, "no geometry file 'nowhere.npz'"),
    ],
)
def test_sample_names_what_it_does_not_know(arguments, options, message):
    with pytest.raises(ValueError, match=message):
        geometries.sample(*arguments, **options)


def test_geometries_survive_a_file(tmp_path):
    path = tmp_path / "some.npz"
    made = [
        toys.box(),
        dotdict(toys.column(), id=7, goal=np.array([1.0, 2.0])),
        *geometries.sample("homes", 2),
    ]
    files.save(path, made)
    for before, after in zip(made, files.load(path), strict=True):
        assert before.keys() == after.keys()
        for key in before:
            assert np.array_equal(before[key], after[key]), key
    assert [p.name for p in tmp_path.iterdir()] == ["some.npz"]
    assert geometries.sample("files", 3, "all", path=path)[0].id in (
        0,
        7,
        *[g.id for g in made[2:]],
    )


def test_a_file_of_one_geometry_serves_every_split(tmp_path):
    files.save(tmp_path / "one.npz", [toys.box()])
    for split in geometries.SPLITS:
        assert len(geometries.sample("files", 2, split, path=tmp_path / "one.npz")) == 2


def test_a_changed_file_is_read_again(tmp_path):
    path = tmp_path / "one.npz"
    files.save(path, [toys.box(5)])
    assert geometries.sample("files", 1, path=path)[0].walls.max() == 6
    files.save(path, [toys.box(8)])
    assert geometries.sample("files", 1, path=path)[0].walls.max() == 9


def test_save_leaves_the_old_file_when_it_refuses(tmp_path):
    path = tmp_path / "one.npz"
    files.save(path, [toys.box()])
    with pytest.raises(ValueError, match="Geometry 1 cannot be saved: has no 'res'"):
        broken = toys.box()
        del broken["res"]
        files.save(path, [toys.box(), broken])
    with pytest.raises(ValueError, match="0 geometries cannot be saved"):
        files.save(path, [])
    assert len(files.load(path)) == 1 and len(list(tmp_path.iterdir())) == 1


def npy(values, **kwargs):
    buffer = io.BytesIO()
    np.save(buffer, values, **kwargs)
    return buffer.getvalue()


def header(text):
    """The start of an array file with this text for its description."""
    text = text.encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


def written(path, **changes):
    """An archive of one box at `path` with some entries replaced (bytes), added, or left out
    (None).
    """
    entries = {f"0/{key}.npy": npy(value) for key, value in toys.box().items()}
    entries.update(
        {f"0/{key}.npy" if "/" not in key else key: value for key, value in changes.items()}
    )
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, value in entries.items():
            if value is not None:
                archive.writestr(name, value)
    return path


BAD = {
    "geometry 0: has no 'masks'": {"masks": None},
    "geometry 0: 'walls' holds a number that is not finite": {
        "walls": npy(np.full((3, 2, 2), np.nan))
    },
    "geometry 0: 'walls' reaches up to 1e\\+30 m, and the limit is 200": {
        "walls": npy(np.full((3, 2, 2), 1e30))
    },
    "geometry 0: 'walls' reaches down to -1 m": {"walls": npy(np.full((3, 2, 2), -1.0))},
    "geometry 0: has no room": {"masks": npy(np.zeros((5, 5), int))},
    "'walls' cannot be read: is a pickled object, which is never loaded": {
        "walls": npy(np.array([{}], object), allow_pickle=True)
    },
    "'walls' cannot be read: is of dtype <U3": {"walls": npy(np.array(["abc"]))},
    r"'walls' cannot be read: claims shape \(10{11}, 2, 2\) of float32 but holds 32 bytes": {
        "walls": header("{'descr': '<f4', 'fortran_order': False, 'shape': (100000000000, 2, 2)}")
        + bytes(32)
    },
    "'walls' cannot be read: claims shape": {"walls": npy(toys.box().walls)[:-4]},
    "'walls' cannot be read: .*magic": {"walls": b"<html>not an array</html>"},
    "'lights' cannot be read": {"lights": header("[" * 900)},
    "'res' cannot be read": {"res": header("-" * 900 + "1")},
    "'id' cannot be read: Header info length": {"id": header(" " * 5000)},
    "holds '../../escaped.npy', and only": {"../../escaped.npy": npy(np.ones(3))},
    "holds 'readme/x.txt', and only": {"readme/x.txt": b"hello"},
    "numbers its geometries with a gap: 1 is missing": {"2/walls.npy": npy(np.ones(3))},
    "holds '0/masks.npy' of 300,000,000 bytes, and the limit is": {"masks": bytes(300_000_000)},
}


@pytest.mark.parametrize("message", BAD)
def test_a_bad_file_is_refused_in_one_sentence(tmp_path, message):
    path = written(tmp_path / "bad.npz", **BAD[message])
    with pytest.raises(ValueError, match=message) as caught:
        files.load(path)
    assert str(caught.value).startswith(f"Geometry file {str(path)!r}") and "\n" not in str(
        caught.value
    )
    assert [p.name for p in tmp_path.iterdir()] == ["bad.npz"] and not (
        tmp_path.parents[1] / "escaped.npy"
    ).exists()


def test_an_encrypted_array_is_refused_in_one_sentence(tmp_path):
    path = written(tmp_path / "locked.npz")
    content = bytearray(path.read_bytes())
    content[content.index(b"PK\1\2") + 8] |= 1  # the first entry's flags in the table of contents
    path.write_bytes(content)
    with pytest.raises(ValueError, match=f"^Geometry file '{path}', .*: is encrypted.$"):
        files.load(path)


@pytest.mark.parametrize(
    "content, message",
    [
        (b"", "is not an .npz file, or it is cut short"),
        (b"hello" * 100, "is not an .npz file"),
        (b"PK\5\6" + bytes(8) + b"\xff" * 4 + bytes(6), "lists more arrays than"),
        (b"PK\5\6" + bytes(18), "holds no geometry"),
    ],
)
def test_what_is_no_archive_is_refused(tmp_path, content, message):
    (tmp_path / "bad.npz").write_bytes(content)
    with pytest.raises(ValueError, match=message):
        files.load(tmp_path / "bad.npz")


def test_a_file_cut_anywhere_is_refused(tmp_path):
    whole = written(tmp_path / "whole.npz").read_bytes()
    for size in range(0, len(whole), 97):
        (tmp_path / "cut.npz").write_bytes(whole[:size])
        with pytest.raises(ValueError, match="cut.npz"):
            files.load(tmp_path / "cut.npz")


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_flipped_bits_give_a_geometry_or_one_sentence(tmp_path):
    whole = written(tmp_path / "whole.npz").read_bytes()
    random, refused = np.random.default_rng(0), 0
    for _ in range(400):
        broken = bytearray(whole)
        for at in random.integers(len(whole), size=3):
            broken[at] ^= 1 << random.integers(8)
        (tmp_path / "broken.npz").write_bytes(broken)
        try:
            files.load(tmp_path / "broken.npz")
        except ValueError as error:
            refused += "broken.npz" in str(error)
    assert refused > 200


def test_a_bomb_costs_little_memory_and_time(tmp_path):
    path = written(
        tmp_path / "bomb.npz", **{f"{i}/masks.npy": bytes(30 << 20) for i in range(1, 12)}
    )
    script = (
        "import re, sys, time; from megastep.geometries import files; start = time.time()\n"
        "try: files.load(sys.argv[1])\nexcept ValueError as error: print(error)\n"
        # anew with each program, unlike ru_maxrss
        "peak = re.search(r'VmHWM:\\s+(\\d+)', open('/proc/self/status').read())\n"
        "print(time.time() - start, int(peak[1])/1024)"
    )
    run = subprocess.run(
        [sys.executable, "-c", script, str(path)], capture_output=True, text=True, check=True
    )
    message, measured = run.stdout.strip().split("\n")
    seconds, megabytes = map(float, measured.split())
    assert "unpacks to 346" in message and seconds < 5 and megabytes < 500


def test_too_many_geometries_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "MAX_GEOMETRIES", 2)
    path = written(tmp_path / "many.npz", **{f"{i}/id.npy": npy(i) for i in range(1, 3)})
    with pytest.raises(ValueError, match="holds 3 geometries, and the limit is 2"):
        files.load(path)
    with pytest.raises(ValueError, match="3 geometries cannot be saved: take 1 to 2"):
        files.save(path, 3 * [toys.box()])
