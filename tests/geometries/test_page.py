"""docs/geometries.md: its code runs, its source keeps the contract, its commands work."""

import numpy as np
import pytest

from megastep import geometry
from tests.helpers import pages

TEXT = (pages.ROOT / "docs" / "geometries.md").read_text()


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with the page's file, which is the current one."""
    (tmp_path / "my_rooms.py").write_text(pages.code(TEXT)[0])
    with pages.inside(tmp_path, monkeypatch):
        yield tmp_path


def test_source_keeps_the_contract(folder):
    from my_rooms import sample

    assert len(sample(3)) == 3
    first, again, other, test = (
        [room.walls for room in sample(20, *options)]
        for options in (("training", 1), ("training", 1), ("training", 2), ("test", 1))
    )
    assert np.array_equal(first, again)
    assert not any(np.array_equal(a, b) for a, b in zip(first, other))
    assert not any(np.array_equal(a, b) for a in first for b in test)
    for room in sample(20, longest=5.0):
        geometry.validate_geometry(room)
        assert np.ptp(room.walls[..., 0]) < 5


def test_code_of_the_page_runs(folder):
    variables = {}
    for block in pages.code(TEXT)[1:]:
        exec(compile(block, "geometries.md", "exec"), variables)
    assert (folder / "room.png").stat().st_size > 1000
    plans, rooms = variables["plans"], variables["sample"](100)
    assert all(np.allclose(a.walls, b.walls) for a, b in zip(plans, rooms, strict=True))


def test_commands_of_the_page_work(folder, monkeypatch, capsys):
    assert pages.type_all(TEXT, folder, monkeypatch) == ["train.py", *pages.MAINS]
    assert "in 64 homes, geometry=my_rooms:sample, split=test" in capsys.readouterr().out
    assert (folder / "rooms.png").exists()
