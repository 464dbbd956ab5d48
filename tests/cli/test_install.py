"""The package as a user installs it: the wheel's contents; the wheel in a virtual environment with
the dependencies of this one; and, nightly, in one that downloads them and the OpenAI Agents SDK.
"""

import importlib.metadata
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from pathlib import Path

import pytest

from tests.helpers import tiny

ROOT = Path(__file__).parents[2]
DISTRIBUTION = "megastep_flatland"
#: Without PYTHONPATH, through which pip and Python would find this checkout.
ENVIRONMENT = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
#: Source folders with files that the wheel must contain, and where it has them.
PACKAGE_DATA = {
    "configs": ("megastep/agents/configs", {".yaml"}),
    "agents": ("megastep/agents", {".py", ".typed", ".h", ".cu", ".cpp", ".safetensors", ".md"}),
    "megastep": ("megastep", {".py", ".typed", ".h", ".cu", ".cpp", ".npz", ".json", ".sha256"}),
}


def has_setuptools():
    try:
        return int(importlib.metadata.version("setuptools").partition(".")[0]) > 70
    except importlib.metadata.PackageNotFoundError:
        return False


def build_wheel(source, folder):
    """Builds the wheel of a source folder with pip. Returns its path."""
    command = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", folder, source]
    if has_setuptools():  # no need to install another one
        command.append("--no-build-isolation")
    subprocess.run(list(map(str, command)), check=True, env=ENVIRONMENT, cwd=folder)
    (wheel,) = folder.glob(f"{DISTRIBUTION}-*.whl")
    return wheel


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A copy of this checkout without what git ignores, for setuptools to write into."""
    folder = tmp_path_factory.mktemp("source") / "megastep"
    listing = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    try:
        listed = subprocess.run(listing, cwd=ROOT, capture_output=True, text=True, check=True)
        names = listed.stdout.splitlines()
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("needs a git checkout, to copy the files that belong to the project")
    for name in names:
        if os.path.lexists(ROOT / name):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name, follow_symlinks=False)
    for suffix in ("safetensors", "md"):  # an agent, also where none was committed yet
        (folder / f"agents/pretrained/test_agent.{suffix}").write_text("not read")
    return folder


@pytest.fixture(scope="module")
def wheel(source, tmp_path_factory):
    return build_wheel(source, tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """The interpreter of a virtual environment with the wheel, and this one's packages below."""
    folder = tmp_path_factory.mktemp("installed")
    python = folder / "bin" / "python"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder)], check=True)
    command = [sys.executable, "-m", "pip", "--python", str(python), "install", "-q", "--no-index"]
    subprocess.run([*command, "--no-deps", str(wheel)], check=True, env=ENVIRONMENT, cwd=folder)
    (packages,) = folder.glob("lib/*/site-packages")
    # such a path is searched last, and .pth files in it, as that of this checkout, are not read
    (packages / "dependencies.pth").write_text(sysconfig.get_path("purelib"))
    return python


@pytest.fixture(scope="module")
def python(wheel, tmp_path_factory):
    """The interpreter of a virtual environment with the wheel and openai-agents, nothing else."""
    folder = tmp_path_factory.mktemp("fresh")
    subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
    python = folder / "bin" / "python"
    constraints = str(ROOT / "constraints.txt")
    for requirements in (["torch==2.13.0"], [str(wheel), "openai-agents"]):
        command = [str(python), "-m", "pip", "install", "-q", "-c", constraints, *requirements]
        subprocess.run(command, check=True, env=ENVIRONMENT, cwd=folder)
    return python


def run(command, folder, returncode=0, **environment):
    """Runs a command in a folder. Returns its stdout and stderr together."""
    completed = subprocess.run(
        list(map(str, command)),
        cwd=folder,
        text=True,
        capture_output=True,
        env=ENVIRONMENT | environment,
    )
    assert completed.returncode == returncode, completed.stderr
    return completed.stdout + completed.stderr


def names_in(wheel):
    return set(zipfile.ZipFile(wheel).namelist())


# ---- The wheel ----


@pytest.mark.slow
def test_wheel_has_one_import_name(wheel):
    top_level = {name.split("/")[0] for name in names_in(wheel)}
    assert {name for name in top_level if not name.endswith(".dist-info")} == {"megastep"}


@pytest.mark.slow
def test_wheel_contains_sources_kernels_configs_and_data(wheel, source):
    for folder, (packaged, suffixes) in PACKAGE_DATA.items():
        paths = [path for path in (source / folder).rglob("*") if path.suffix in suffixes]
        expected = {f"{packaged}/{path.relative_to(source / folder)}" for path in paths}
        assert expected and not expected - names_in(wheel)


@pytest.mark.slow
def test_sdist_builds_the_same_wheel(wheel, source, tmp_path):
    pytest.importorskip("setuptools")
    code = f"import setuptools.build_meta as backend; backend.build_sdist({str(tmp_path)!r})"
    run([sys.executable, "-c", code], source)
    (sdist,) = tmp_path.glob(f"{DISTRIBUTION}-*.tar.gz")
    with tarfile.open(sdist) as archive:
        archive.extractall(tmp_path / "unpacked")  # our own; older Pythons have no filter
    (unpacked,) = (tmp_path / "unpacked").iterdir()
    assert not (unpacked / "tests").exists()
    assert names_in(build_wheel(unpacked, tmp_path)) == names_in(wheel)


# ---- Installed ----


def commands(python, folder):
    """Returns a function that runs the command `megastep` in a folder, and returns its output."""
    folder.mkdir()

    def megastep(*arguments, returncode=0):
        command = [python.with_name("megastep"), *arguments]
        return run(command, folder, returncode)

    return megastep


@pytest.mark.slow
def test_installed_command_trains_evaluates_and_records(installed, tmp_path):
    megastep = commands(installed, tmp_path / "empty")
    finish = ["finish.evaluate=true", "finish.episodes=4", "finish.record=true", "finish.steps=3"]
    output = megastep("train", *tiny.TINY, "samples=64", "folder=run", *finish)
    assert "trained" in output and "Traceback" not in output
    assert (tmp_path / "empty/run/video.mp4").exists()
    assert re.match(r"megastep-flatland \d", megastep("--version"))


@pytest.mark.nightly
def test_installed_beside_openai_agents(python, tmp_path):
    """`agents` is OpenAI's and `megastep.agents` is ours, in one process."""
    code = """
import agents
import megastep.agents.algorithms.ppo
import megastep.agents
print(agents.Agent.__module__, agents.__file__, megastep.agents.__file__)
"""
    module, openai_file, our_file = run([python, "-c", code], tmp_path).split()
    assert module.split(".")[0] == "agents"
    assert Path(openai_file).parts[-2:] == ("agents", "__init__.py")
    assert Path(our_file).parts[-3:] == ("megastep", "agents", "__init__.py")
    files = run([python, "-m", "pip", "show", "-f", "openai-agents"], tmp_path)
    assert "agents/agent.py" in files


@pytest.mark.nightly
def test_sweeps_without_the_extra_packages(python, tmp_path):
    megastep = commands(python, tmp_path / "empty")
    sweep = ["-m", "seed=1,2", "samples=64", "hydra.sweep.dir=mine"]
    assert "sweep.md" in megastep("train", *tiny.TINY, *sweep)
    error = megastep("train", "hydra/launcher=joblib", "-m", returncode=2)
    assert "pip install 'megastep-flatland[sweep]'" in error
