"""What every geometry must satisfy, and the command that checks files of them."""

import numpy as np
import pytest

from megastep import geometries, geometry, toys
from megastep.agents.cli import entry
from megastep.dotdict import dotdict
from megastep.geometries import checks, files

KINDS = (
    *(("homes", {}), ("homes", {"density": 3.0}), ("homes", {"outer": False})),
    *(("bench", {}), ("maze", {"size": 5}), ("memory_maze", {}), ("box", {}), ("column", {})),
    ("quadrant", {}),
)


@pytest.mark.parametrize("name, options", KINDS, ids=str)
def test_every_source_passes(name, options):
    plans = geometries.sample(name, 6, "test", **options)
    plans = [g for g in plans if (name, g.id) != ("bench", 463)]  # one whose furniture crosses
    assert [(g.id, error) for g in plans for error in checks.errors(g)] == []


SQUARE = np.array([[1, 1], [6, 1], [6, 6], [1, 6]], np.float32)


def plan(*walls, lights=((2, 2),), open_side=False):
    """A room of 5 m x 5 m with further walls, ((x, y), (x, y)) each, or without its left side."""
    sides = np.stack([SQUARE, np.roll(SQUARE, -1, 0)], 1)[: 3 if open_side else 4]
    lines = np.concatenate([sides, np.reshape(walls, (-1, 2, 2))]).astype(np.float32)
    masks = geometry.masks(lines, [SQUARE])
    return dotdict(id=0, walls=lines, lights=np.array(lights, float), masks=masks, res=0.2)


@pytest.mark.parametrize(
    "error, walls, changes",
    [
        (None, [((2, 3), (4, 3)), ((3, 3), (3, 4)), ((3, 4), (4, 4))], {}),
        ("cross or overlap", [((2, 3), (4, 3)), ((3, 2), (3, 4))], {}),
        ("cross or overlap", [((2, 3), (4, 3)), ((5, 3), (3, 3))], {}),
        ("cross or overlap", [((2, 2), (4, 4)), ((3, 3), (5, 5))], {}),
        (None, [((2, 2), (4, 4)), ((2, 2.1), (4, 4.1))], {}),
        ("the same", [((2, 3), (4, 3)), ((4, 3), (2, 3))], {}),
        ("no length", [((2, 3), (2, 3))], {}),
        ("envelope is open", [], {"open_side": True}),
        ("cannot reach every point", [((3, 1), (3, 6))], {}),
        ("a light is outdoors", [], {"lights": [(2, 2), (6.5, 2)]}),
        ("'lights' holds a NaN", [], {"lights": [(2, np.nan)]}),
    ],
)
def test_errors(error, walls, changes):
    sentences = checks.errors(plan(*walls, **changes))
    assert bool(sentences) == bool(error) and (not error or error in sentences[0]), sentences


def test_check_prints_what_is_wrong_in_a_file(tmp_path, capsys):
    path = tmp_path / "plans.npz"
    files.save(path, [toys.box(), *geometries.sample("homes", 2)])
    assert entry.run_command("check", [f"path={path}"]) == 0
    assert capsys.readouterr().out.startswith("3 geometries, ")
    files.save(path, [toys.box(), plan(((2, 3), (4, 3)), ((3, 2), (3, 4)))])
    assert entry.run_command("check", [f"path={path}"]) == 2
    out, err = capsys.readouterr()
    assert out.startswith("geometry 1 (id 0): two walls cross") and "1 of 2 geometries" in err
    assert entry.run_command("check", [f"path={tmp_path / 'none.npz'}"]) == 2
    assert "There is no geometry file" in capsys.readouterr().err
    assert entry.run_command("check", ["seed=1"]) == 2
