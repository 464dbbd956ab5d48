"""The lock of packages, and the Dockerfile that installs from it."""

import re
from pathlib import Path

import check_dockerfile
import lock
import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[2]
LINES = check_dockerfile.instructions((ROOT / "Dockerfile").read_text())
BLOCKS = [
    block
    for name in lock.FILES
    for block in re.findall(r"^[a-z].*(?:\n .*)*", (ROOT / "requirements" / name).read_text(), re.M)
]
LOCKED = [Requirement(re.split(r" \\\n", block)[0]) for block in BLOCKS]


def in_project():
    """The requirements of pyproject.toml, those of the extras included."""
    tomllib = pytest.importorskip("tomllib", reason="Python 3.10 cannot read TOML")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"].values()
    wanted = [*project["dependencies"], *(text for extra in extras for text in extra)]
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
    contents = lock.split(compiled)
    names = {file: re.findall(r"^([\w-]+)==", text, re.M) for file, text in contents.items()}
    assert names == {
        "build.txt": ["setuptools"],
        "torch.txt": ["nvidia-x", "torch"],
        "packages.txt": ["numpy", "torchmetrics"],
    }
    together = "".join(text.partition("\n")[2] for text in contents.values())
    assert sorted(together.splitlines()) == sorted(compiled.splitlines())


def test_make_builds_sources_with_locked_packages_only():
    """A build in isolation would fetch its requirements without hashes."""
    makefile = (ROOT / "Makefile").read_text()
    commands = [one for one in re.findall(r"pip install ([^&;\n]+)", makefile) if "-r " in one]
    assert [re.findall(r"requirements/(\w+)", one) for one in commands] == [["build"], ["packages"]]
    assert all("--require-hashes --no-build-isolation" in one for one in commands[1:])
    (own,) = re.findall(r"pip install (.* -e .*)", makefile)
    assert "--no-build-isolation" in own


# ---- The Dockerfile ----


def test_base_image_is_an_exact_tag_of_a_locked_python():
    (base,) = (rest for name, rest in LINES if name == "ARG" and rest.startswith("BASE="))
    minor = re.fullmatch(r"BASE=python:3\.(1[0-3])\.\d+-slim-\w+", base)
    assert minor, base


def test_image_installs_packages_by_hash_and_runs_without_root():
    names = [name for name, _ in LINES]
    args = dict(rest.split("=", 1) for name, rest in LINES if name == "ARG")
    for name, rest in LINES:
        for command in re.findall(r"pip install ([^&]+)", rest) if name == "RUN" else ():
            command = command.replace("${TORCH}", args["TORCH"])
            assert "--require-hashes" in command or command.split()[-1] == "."
    (user,) = (rest for name, rest in LINES if name == "USER")
    assert user != "root"
    assert names.index("USER") > max(i for i, n in enumerate(names) if n == "RUN")
    assert ["VOLUME", '["/megastep/runs", "/cache"]'] in LINES


def test_instructions_are_followed(tmp_path, monkeypatch):
    """Without a root of its own: what each command would have been given."""
    calls = []
    image = check_dockerfile.Image(tmp_path, {"TORCH": "mine"})
    monkeypatch.setattr(
        image, "run", lambda words: calls.append((words[-1], dict(image.args), image.user))
    )
    text = (
        '# a comment\nARG TORCH="default"\nENV A=1 B="two words"\nWORKDIR /source\n'
        'RUN first \\\n && second\nUSER somebody\nRUN third\nCMD ["train"]\n'
    )
    for name, rest in check_dockerfile.instructions(text):
        image.follow(name, rest)
    assert calls == [
        ("first   && second", {"TORCH": "mine"}, "root"),
        ("third", {"TORCH": "mine"}, "somebody"),
    ]
    assert image.env["B"] == "two words" and image.folder == "/source"
    assert (tmp_path / "source").is_dir() and image.command == {"CMD": ["train"]}
    with pytest.raises(SystemExit, match="HEALTHCHECK"):
        image.follow("HEALTHCHECK", "CMD true")
