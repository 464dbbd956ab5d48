"""Import paths: which module `games:MyEnv` names."""

import importlib
import sys

import pytest

from megastep.imports import import_object


@pytest.fixture
def folders(tmp_path, monkeypatch):
    """(the current folder, a folder of installed packages), both empty."""
    here, installed = tmp_path / "here", tmp_path / "site-packages"
    here.mkdir(), installed.mkdir()
    monkeypatch.chdir(here)
    monkeypatch.setattr(sys, "path", [*sys.path, str(installed)])
    importlib.invalidate_caches()
    yield here, installed
    sys.modules.pop("games", None)


def test_own_module_comes_before_an_installed_one(folders):
    for folder in folders:
        (folder / "games.py").write_text(f"class MyEnv:\n    folder = {folder.name!r}\n")
    assert import_object("games:MyEnv").folder == "here"


def test_own_module_shadows_nothing_of_python(folders, monkeypatch):
    here, _ = folders
    monkeypatch.delitem(sys.modules, "colorsys", raising=False)
    (here / "colorsys.py").write_text("raise RuntimeError\n")
    (here / "games.py").write_text("import colorsys\n\nclass MyEnv:\n    module = colorsys\n")
    assert import_object("games:MyEnv").module.rgb_to_hsv(1, 1, 1) == (0, 0, 1)
