"""The lock of packages, and the Dockerfile that installs from it."""

import re
import subprocess
import sys
from pathlib import Path

import check_image
import lock
import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[2]
LINES = [
    line.split(maxsplit=1)
    for line in (ROOT / "Dockerfile").read_text().splitlines()
    if line and not line.startswith("#")
]
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


def test_lock_is_split_by_package():
    compiled = (
        "numpy==2.0 ; python_version < '3.11' \\\n    --hash=sha256:a\nnvidia-x==1 \\\n"
        "    --hash=sha256:b \\\n    --hash=sha256:c\nsetuptools==3 \\\n    --hash=sha256:d\n"
        "torch==2 \\\n    --hash=sha256:e\ntorchmetrics==1 \\\n    --hash=sha256:f\n"
    )
    contents = lock.split(compiled, {"numpy"})
    names = {file: re.findall(r"^([\w-]+)==", text, re.M) for file, text in contents.items()}
    assert names == {
        "build.txt": ["setuptools"],
        "torch.txt": ["nvidia-x", "torch"],
        "test.txt": ["torchmetrics"],
        "packages.txt": ["numpy"],
    }
    together = "".join(text.partition("\n")[2] for text in contents.values())
    assert sorted(together.splitlines()) == sorted(compiled.splitlines())


# ---- The Dockerfile ----


def test_image_installs_packages_by_hash_and_runs_without_root():
    names = [name for name, _ in LINES]
    args = dict(rest.split("=", 1) for name, rest in LINES if name == "ARG")
    for name, rest in LINES:
        for command in re.findall(r"pip install ([^&]+)", rest) if name == "RUN" else ():
            command = command.replace("${TORCH}", args["TORCH"])
            assert "--require-hashes" in command or command.split()[-1] == "/tmp/megastep"
    (user,) = (rest for name, rest in LINES if name == "USER")
    assert user != "root"
    assert names.index("USER") > max(i for i, n in enumerate(names) if n == "RUN")


def test_no_layer_of_the_image_holds_source_or_packages_of_tests():
    names = [name for name, _ in LINES]
    assert not {"COPY", "ADD", "VOLUME"} & {*names}
    text = (ROOT / "requirements" / "test.txt").read_text()
    only_tests = {*re.findall(r"^([\w-]+)==", text, re.M)}
    assert only_tests >= {*check_image.UNWANTED} and lock.OF_IMAGE not in only_tests
    assert not any("test.txt" in rest for _, rest in LINES)


@pytest.mark.nightly
def test_image_is_built_and_trains_for_any_user_without_a_network(tmp_path):
    """On a base image that is made here; the CPU's PyTorch is whichever pip finds."""
    if reason := check_image.problem():
        pytest.skip(reason)
    script = ROOT / "scripts" / "check_image.py"
    words = "--stand-in", "--torch=torch==2.13.0", f"--store={tmp_path}", "--samples=2e5"
    try:
        done = subprocess.run([sys.executable, script, *words], capture_output=True, text=True)
        assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    finally:
        removes = check_image.Builder(tmp_path).words("rmi", "--all", "--force")
        subprocess.run(removes, capture_output=True)
