"""Help, errors and spent budgets are reported before PyTorch is imported."""

import inspect
import json
import os
import pathlib
import subprocess
import sys

import pytest
from pydantic import ValidationError

from megastep.agents.errors import ConfigErrors, UserError
from megastep.agents.factory import components
from megastep.agents.factory.check import as_tree
from megastep.agents.launch import again
from megastep.agents.runs import checkpoint
from megastep.imports import import_object
from megastep.settings import arguments_of, sentence, settings_class
from tests.helpers.tiny import TINY, settings

ROOT = pathlib.Path(__file__).parents[2]


@pytest.fixture
def stopped(here):
    """Saves a run of 64 samples in 2.5 seconds, with these words and then other settings. Returns
    its folder's name.
    """

    def stop(*words, **changes):
        state = dict(samples=64, updates=2, seconds=2.5)
        config = {"train": as_tree(settings(*TINY, *words)) | changes, "spaces": {}}
        checkpoint.save("run/checkpoints", 64, state, config)
        return "run"

    return stop


# ---- Arguments of built-in components ----


def sentences(kind, name, value):
    """Returns what is wrong with a value of one setting."""
    fields = kind.__pydantic_fields__
    try:
        kind(**{name: value})
    except ValidationError as error:
        return [
            sentence(line, fields[name], line["input"])
            for line in error.errors()
            if line["loc"][0] == name
        ]
    return []


def test_cached_arguments_have_the_same_errors():
    values = (None, True, -1, 0, 2.5, 10**30, 1e30, float("nan"), "word", "no:thing", [], {"x": 1})
    n_sentences = 0
    for (group, name), arguments in components.built_in().items():
        cached = settings_class(*arguments)
        imported = settings_class(*arguments_of(import_object(name), **components.ARGUMENTS[group]))
        assert cached.__pydantic_fields__.keys() == imported.__pydantic_fields__.keys()
        for field in cached.__pydantic_fields__:
            for value in values:
                expected = sentences(imported, field, value)
                assert sentences(cached, field, value) == expected, (name, field, value)
                n_sentences += len(expected)
    assert n_sentences > 1000


def test_environments_that_take_geometries_are_cached():
    for group, name in components.built_in():
        if group == "env":
            taken = inspect.signature(import_object(name)).parameters
            assert components.takes_geometries(name) == ("geometries" in taken), name
    assert components.takes_geometries("megastep.envs.explorer:Explorer")
    assert not components.takes_geometries("tests.cli.test_exact_resume:Steered")


def test_arguments_are_read_again_after_a_change(tmp_path, monkeypatch):
    monkeypatch.setenv("MEGASTEP_CACHE", str(tmp_path))
    read = []
    monkeypatch.setattr(components, "read", lambda: read.append(1) or ({}, set(), {}))
    monkeypatch.setattr(components.package, "CONFIGS", tmp_path / "agents/configs")
    source = tmp_path / "agents/module.py"
    source.parent.mkdir()
    for text, n_reads in (("x = 1", 1), ("x = 1", 1), ("x = 2", 2), ("x = 1", 2)):
        source.write_text(text)
        assert components.cached.__wrapped__().arguments == {} and len(read) == n_reads


HEAVY = ("torch", "numpy", "scipy", "matplotlib", "rich", "tensorboard", "loky")
CODE = """
import json, sys
from megastep.agents.cli import entry
for script, code, words in json.loads(sys.argv[1]):
    sys.argv[1:] = words
    assert entry.run_command(script) == code, words
print([name for name in json.loads(sys.argv[0]) if name in sys.modules], file=sys.__stderr__)
""".replace("sys.argv[0]", repr(json.dumps(HEAVY)))


def test_errors_need_no_pytorch(stopped):
    components.built_in()  # so that it is in the cache
    stopped("samples=64")
    os.mkdir("full")
    pathlib.Path("full/file").touch()
    wrong = ["env=explorr", "learner.lrr=1", "env.n_envs=0", "agent.core=lstmm", "device=gpu"]
    calls = [
        ("train", 0, ["--help"]),
        ("train", 0, ["--version"]),
        ("train", 2, ["learnr.lr=1"]),
        ("train", 2, ["env=nonsense"]),
        ("train", 2, wrong),
        ("train", 2, ["learner=r2d2", "learner.replay.capacity=0"]),
        ("train", 2, ["geometry=files", "geometry.path=nope"]),
        ("train", 2, ["env=pong", "geometry=box"]),
        ("train", 2, ["-m", "seed=1,2", "learner.lr=-1"]),
        ("train", 2, ["hydra.searchpath=ppo", "--info", "searchpath"]),
        ("train", 2, ["resume=run"]),
        ("train", 2, ["resume=nope"]),
        ("train", 2, ["folder=full"]),
        ("evaluate", 0, ["--help"]),
        ("evaluate", 2, []),
        ("evaluate", 2, ["run=nope"]),
        ("record", 2, ["run=nope", "env=pong"]),
    ]
    command = [sys.executable, "-c", CODE, json.dumps(calls)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.run(command, env=environment, text=True, capture_output=True)
    assert process.returncode == 0, process.stderr
    assert process.stderr.splitlines()[-1] == "[]", "modules that errors do not need"
    assert "Traceback" not in process.stderr and process.stdout.count("most common words") == 2


# ---- Budgets of resumed runs ----


@pytest.mark.parametrize(
    "budget, words, key, text",
    [
        (
            ["samples=64"],
            [],
            "samples",
            "already trained for 64 of 64 samples; to continue, give more_samples",
        ),
        (["samples=64"], ["more_seconds=9"], "samples", "already trained for 64 of 64 samples"),
        (["samples=64"], ["samples=9"], "samples", "already trained for 64 of 9 samples"),
        (
            ["seconds=2"],
            [],
            "seconds",
            "trained for 2.5 of 2.0 seconds; to continue, give more_sec",
        ),
        ([], ["more_seconds=9", "seconds=99"], "more_seconds", "seconds= is the total"),
        ([], ["more_samples=0"], "more_samples", "out of range"),
        ([], ["more_samples=x"], "more_samples", "expected an integer, got 'x'"),
        ([], ["seconds=x"], "seconds", "expected a number, got 'x'"),
    ],
)
def test_budgets_that_are_refused(stopped, budget, words, key, text):
    with pytest.raises(ConfigErrors) as error:
        settings(f"resume={stopped(*budget)}", *words)
    ((error_key, error_text),) = error.value.errors
    assert error_key == key and text in error_text


def test_more_comes_on_top(stopped):
    run = stopped("samples=64", "seconds=2")
    cfg = settings(f"resume={run}", "more_samples=1e3", "more_seconds=60")
    cfg = again.with_more(cfg)
    assert (cfg.samples, cfg.seconds) == (1064, 62.5)
    assert cfg.more_samples is cfg.more_seconds is None


def test_more_needs_a_run():
    with pytest.raises(ConfigErrors, match="more_seconds: .* give resume=RUN, or seconds="):
        settings("more_seconds=60")


def test_snapshot_cannot_be_resumed(stopped):
    stopped()
    config = {"train": as_tree(settings(*TINY)), "spaces": {}}
    snapshot = checkpoint.save("run/snapshots", 32, {"policy": {}}, config)
    with pytest.raises(UserError, match=f"is a snapshot, .* init={snapshot} starts"):
        settings(f"resume={snapshot}")
