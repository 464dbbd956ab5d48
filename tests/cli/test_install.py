"""What `pip install .` gives, as a stranger has it: a wheel in a fresh environment, used from an
empty folder. Slow, for all that it needs is installed as well.
"""

import os
import pathlib
import re
import shutil
import subprocess
import sys
import zipfile

import pytest
import yaml

from tests.helpers import tiny

ROOT = pathlib.Path(__file__).parents[2]
NAME = "megastep_flatland"
#: Without a path to this checkout, which pip would take for an installed package.
ENVIRONMENT = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    others = shutil.ignore_patterns(".*", "runs", "sweeps", "build", "dist", "*.egg-info")
    source = shutil.copytree(ROOT, folder / "source", symlinks=True, ignore=others)
    pip = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", str(folder), str(source)]
    subprocess.run(pip, check=True, env=ENVIRONMENT)
    (path,) = folder.glob(f"{NAME}-*.whl")
    return path


@pytest.fixture(scope="module")
def programs(wheel, tmp_path_factory):
    """The folder of programs of an environment that has the wheel and what it needs alone."""
    folder = tmp_path_factory.mktemp("fresh")
    subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
    pip = [str(folder / "bin" / "python"), "-m", "pip", "install", "-q"]
    for what in ("torch==2.13.0", str(wheel)):
        constrained = [*pip, "-c", str(ROOT / "constraints.txt"), what]
        subprocess.run(constrained, check=True, env=ENVIRONMENT)
    return folder / "bin"


@pytest.mark.slow
def test_the_wheel_adds_two_import_names_with_configs_and_kernels_as_data(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0].split("-")[0] for name in names} == {"megastep", "agents", NAME}
    for folder, pattern, place in (
        ("configs", "*.yaml", "agents/configs"),
        ("megastep/kernels", "*.[ch]*", "megastep/kernels"),
        ("agents/kernels", "*.[ch]*", "agents/kernels"),
    ):
        files = {str(path.relative_to(ROOT / folder)) for path in (ROOT / folder).rglob(pattern)}
        assert {f"{place}/{file}" for file in files} <= set(names)


@pytest.mark.slow
def test_the_installed_command_trains_evaluates_and_films_in_an_empty_folder(programs, tmp_path):
    environment = ENVIRONMENT | {"MEGASTEP_CACHE": str(tmp_path / "cache")}
    (tmp_path / "empty").mkdir()

    def typed(*words, code=0):
        done = subprocess.run(
            [str(programs / words[0]), *words[1:]],
            cwd=tmp_path / "empty",
            text=True,
            capture_output=True,
            env=environment,
        )
        assert done.returncode == code, done.stderr
        return done.stdout + done.stderr

    assert "Traceback" not in typed("megastep", "train", *tiny.TINY, "samples=64", "folder=run")
    assert "trained" in typed("megastep", "evaluate", "run=run", "episodes=4")
    typed("megastep", "record", "run=latest", "steps=3")
    assert (tmp_path / "empty/run/video.mp4").exists()
    sweep = ["-m", "seed=1,2", "samples=64", "hydra.sweep.dir=mine"]
    assert "sweep.md" in typed("megastep", "train", *tiny.TINY, *sweep)
    told = typed("megastep", "train", "lr=1", code=2).splitlines()
    assert told[0] == "megastep train: 1 error in the configuration"
    assert told[1] == "  lr: no such key; did you mean learner.lr?"
    tree = yaml.safe_load(typed("megastep", "train", "--cfg", "job", "env=pong"))
    assert tree["env"]["name"] == "megastep.envs.pong:Pong"
    told = typed("megastep", "train", "hydra/launcher=joblib", "-m", code=2)
    assert "pip install 'megastep-flatland[sweep]'" in told
    versions = typed("megastep", "--version")
    assert re.match(r"megastep-flatland \d", versions)
    for name in ("train", "evaluate", "configs", "hydra_plugins"):
        assert "ModuleNotFoundError" in typed("python", "-c", f"import {name}", code=1)
    installed = typed("python", "-m", "pip", "list")
    assert "wandb" not in installed and "optuna" not in installed and "pytest" not in installed
