"""The example that turns HouseExpo's floor plans into a file."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from megastep.geometries import files

sys.path.insert(0, str(Path(__file__).parents[2] / "scripts" / "examples"))
import import_houseexpo

# Two rooms of 4 m x 3 m, side by side, and a door of 1 m in the wall between them, 0.2 m thick.
OUTLINE = (
    *((0, 0), (4, 0), (4, 1), (4.2, 1), (4.2, 0), (8.2, 0)),
    *((8.2, 3), (4.2, 3), (4.2, 2), (4, 2), (4, 3), (0, 3)),
)
PLAN = dict(
    id="two",
    verts=[[x - 20, y + 7] for x, y in OUTLINE],
    room_category={"Kitchen": [[-20, 7, -16, 10]], "Bedroom": [[-15.8, 7, -11.8, 10]]},
)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "two.json").write_text(json.dumps(PLAN))
    return tmp_path


def test_walls_rooms_and_lights(folder, capsys):
    assert import_houseexpo.main([str(folder), str(folder / "homes.npz")]) == 0
    assert "1 homes" in capsys.readouterr().out
    (home,) = files.load(folder / "homes.npz")
    assert len(home.walls) == len(OUTLINE)
    np.testing.assert_allclose(home.walls.reshape(-1, 2).min(0), 1)
    lengths = np.linalg.norm(home.walls[:, 0] - home.walls[:, 1], axis=1)
    assert lengths.sum() == pytest.approx(2 * (14 - 1) + 2 * 0.2)  # rooms without door, its sides
    np.testing.assert_allclose(home.lights, [[3, 2.5], [7.2, 2.5]])
    area = (home.masks > 0).sum() * home.res**2
    assert 15 < area < 24.2  # cells that a wall touches are no room


def test_files_that_are_no_plans_are_named(folder, capsys):
    nan = dict(PLAN, verts=[[float("nan"), 0], [1, 0], [1, 1]])
    bad = dict(text="{", nothing="{}", words='{"verts": "abc"}', nan=json.dumps(nan))
    for name, text in bad.items():
        (folder / f"{name}.json").write_text(text)
    assert import_houseexpo.main([str(folder), str(folder / "homes.npz")]) == 0
    out = capsys.readouterr().out
    assert all(f"{name}.json is left out" in out for name in bad) and "1 homes" in out


def test_file_that_cannot_be_written(folder, capsys):
    assert import_houseexpo.main([str(folder), str(folder / "none" / "homes.npz")]) == 2
    assert "cannot be written" in capsys.readouterr().err


def test_folder_without_plans(tmp_path, capsys):
    assert import_houseexpo.main([str(tmp_path), str(tmp_path / "homes.npz")]) == 2
    assert "has no floor plan" in capsys.readouterr().err and not [*tmp_path.iterdir()]
