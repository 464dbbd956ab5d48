"""The lock of packages."""

import re
from pathlib import Path

import lock
import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[2]
BLOCKS = [
    block
    for name in lock.FILES
    for block in re.findall(r"^[a-z].*(?:\n .*)*", (ROOT / "requirements" / name).read_text(), re.M)
]
LOCKED = [Requirement(re.split(r" \\\n", block)[0]) for block in BLOCKS]


def in_project():
    """The requirements of pyproject.toml, with those of the extra `test` and what it includes."""
    tomllib = pytest.importorskip("tomllib", reason="Python 3.10 cannot read TOML")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras, wanted = project["optional-dependencies"], [*project["dependencies"]]
    names = ["test", "gymnasium"]
    for name in names:
        wanted += extras[name]
        names += [n for req in map(Requirement, extras[name]) for n in req.extras if n in extras]
    return [req for req in map(Requirement, wanted) if req.name != project["name"]]


# ---- requirements/ ----


def test_every_package_has_one_version_and_hashes():
    assert all(re.search(r"^    --hash=sha256:[0-9a-f]{64}", block, re.M) for block in BLOCKS)
    for version in ("3.10", "3.11", "3.12", "3.13"):
        environment = {"python_version": version, "python_full_version": f"{version}.1"}
        names = [req.name for req in LOCKED if not req.marker or req.marker.evaluate(environment)]
        assert len(names) == len({*names}) > 80


def test_lock_fits_pyproject_and_constraints():
    constraints = [*map(Requirement, (ROOT / "constraints.txt").read_text().split())]
    for wanted in in_project() + constraints:
        name = wanted.name.lower()
        versions = [str(req.specifier)[2:] for req in LOCKED if req.name == name]
        assert versions and all(map(wanted.specifier.contains, versions)), wanted
