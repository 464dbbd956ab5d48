"""Metrics: files that a crash cannot damage, and sinks that fail and do no harm."""

import builtins
import json
import pathlib
import subprocess
import sys
import types

import pytest

from agents import metrics
from agents.metrics import Metrics


def test_files_hold_what_was_written(tmp_path):
    sinks = Metrics(tmp_path)
    found = {"loss/value": 0.25, "episode/count": 3, "bad": float("nan"), "anneal": "never"}
    sinks.write(64, found, {"perf/rate": 1e6})
    sinks.close()
    (row,) = metrics.read(tmp_path / "metrics.jsonl")
    assert row == {"samples": 64, **found, "bad": None}
    assert metrics.read(tmp_path / "perf.jsonl") == [{"samples": 64, "perf/rate": 1e6}]
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert [(e.step, e.value) for e in events.Scalars("loss/value")] == [(64, 0.25)]


def test_a_resumed_run_writes_again_what_came_after_its_checkpoint(tmp_path):
    sinks = Metrics(tmp_path)
    for step in (10, 20, 30):
        sinks.write(step, {"x": step}, {})
    sinks.close()
    with open(tmp_path / "metrics.jsonl", "a") as file:
        file.write('{"samples": 40, "x"')  # the line that a kill cut short
    sinks = Metrics(tmp_path, step=20)
    sinks.write(30, {"x": -1}, {})
    sinks.close()
    assert [row["x"] for row in metrics.read(tmp_path / "metrics.jsonl")] == [10, 20, -1]


def without(monkeypatch, package):
    """As if the package were not installed."""
    real = builtins.__import__

    def refuse(name, *args, **kwargs):
        if name.split(".")[0] == package:
            raise ImportError(f"No module named {name!r}")
        return real(name, *args, **kwargs)

    for name in [
        n
        for n in sys.modules
        if n.split(".")[0] == package or n.startswith("torch.utils.tensorboard")
    ]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(builtins, "__import__", refuse)
    monkeypatch.setattr("importlib.import_module", lambda name, package=None: refuse(name))


@pytest.mark.parametrize("package", ["tensorboard", "wandb"])
def test_a_package_that_is_missing_is_named_with_the_line_that_installs_it(
    tmp_path, monkeypatch, package
):
    without(monkeypatch, package)
    with pytest.warns(UserWarning, match=f"pip install {package}"):
        sinks = Metrics(tmp_path, wandb=WANDB if package == "wandb" else None)
    sinks.write(1, {"x": 1}, {})
    sinks.close()
    assert metrics.read(tmp_path / "metrics.jsonl") == [{"samples": 1, "x": 1}]


def fake_wandb(monkeypatch, key="key", init=None, log=None):
    """A stand-in for the package, to fail where it is told to."""
    logged = []
    room = types.SimpleNamespace
    run = room(log=log or (lambda values, step: logged.append((step, values))), finish=lambda: None)
    module = room(
        login=lambda prompt: key is not None, Settings=dict, init=init or (lambda **_: run)
    )
    monkeypatch.setitem(sys.modules, "wandb", module)
    return logged


def failing(*_, **__):
    raise ConnectionError("the network is unreachable\nand more lines")


WANDB = dict(project="p", mode="online", name="n", config={})


def test_wandb_gets_what_the_files_get(tmp_path, monkeypatch):
    logged = fake_wandb(monkeypatch)
    sinks = Metrics(tmp_path, wandb=WANDB)
    sinks.write(5, {"a": 1}, {"b": 2})
    assert logged == [(5, {"samples": 5, "a": 1, "b": 2})]


@pytest.mark.parametrize(
    "fault, sentence",
    [
        (dict(key=None), "no key"),
        (dict(init=failing), "did not start .the network is unreachable.$"),
        (
            dict(log=failing),
            "Wandb failed and is left out from here on .the network is unreachable.$",
        ),
    ],
)
def test_wandb_failing_is_one_warning_and_the_run_goes_on(tmp_path, monkeypatch, fault, sentence):
    fake_wandb(monkeypatch, **fault)
    with pytest.warns(UserWarning, match=sentence) as caught:
        sinks = Metrics(tmp_path, wandb=WANDB)
        for step in range(3):
            sinks.write(step, {"x": step}, {})
        sinks.close()
    assert len(caught) == 1
    assert len(metrics.read(tmp_path / "metrics.jsonl")) == 3


def test_a_full_disk_is_one_warning(tmp_path):
    sinks = Metrics(tmp_path)
    sinks.metrics.file.close()
    sinks.metrics.file = open("/dev/full", "a")
    with pytest.warns(
        UserWarning, match="metrics.jsonl cannot be written .*No space left.*the run goes on"
    ) as caught:
        sinks.write(1, {"x": 1}, {"y": 2})
        sinks.write(2, {"x": 1}, {"y": 2})
    assert len(caught) == 1 and len(metrics.read(tmp_path / "perf.jsonl")) == 2


def test_the_curves_are_a_picture_of_the_files(tmp_path):
    from matplotlib.image import imread

    rows = [{"samples": n, "episode/return": n, "loss/value": None} for n in range(3)]
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    (tmp_path / "perf.jsonl").write_text("")
    metrics.curves(tmp_path)
    assert imread(tmp_path / "curves.png").shape[1] > 500


@pytest.mark.slow
def test_the_real_wandb_keeps_an_offline_run(tmp_path):
    script = f"""
from agents.metrics import Metrics
wandb = dict(project="p", mode="offline", name="n", config=dict(a=1))
sinks = Metrics({str(tmp_path)!r}, wandb=wandb)
sinks.write(1, dict(x=1), dict(y=2))
sinks.close()"""
    done = subprocess.run(
        [sys.executable, "-W", "always::UserWarning", "-c", script],
        text=True,
        timeout=120,
        stderr=subprocess.PIPE,
        cwd=pathlib.Path(__file__).parents[1],
    )
    assert done.returncode == 0 and "left out" not in done.stderr, done.stderr
    assert [
        path.stat().st_size > 1000 for path in tmp_path.glob("wandb/offline-run-*/*.wandb")
    ] == [True]
