"""Metrics: files that a crash cannot damage, and sinks that fail and do no harm."""

import json
import os
import pathlib
import subprocess
import sys
import types

import pytest

from megastep.agents.training import loggers
from megastep.agents.training.loggers import Loggers
from tests.helpers import faults


def test_files_hold_what_was_written(tmp_path):
    sinks = Loggers(tmp_path)
    found = {"loss/value": 0.25, "episode/count": 3, "bad": float("nan"), "anneal": "never"}
    sinks.write(64, found, {"perf/rate": 1e6})
    sinks.close()
    (row,) = loggers.read(tmp_path / "metrics.jsonl")
    assert row == {"samples": 64, **found, "bad": None}
    assert loggers.read(tmp_path / "perf.jsonl") == [{"samples": 64, "perf/rate": 1e6}]
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert [(e.step, e.value) for e in events.Scalars("loss/value")] == [(64, 0.25)]


def test_a_resumed_run_writes_again_what_came_after_its_checkpoint(tmp_path):
    sinks = Loggers(tmp_path)
    for step in (10, 20, 30):
        sinks.write(step, {"x": step}, {})
    sinks.close()
    with open(tmp_path / "metrics.jsonl", "a") as file:
        file.write('{"samples": 40, "x"')  # the line that a kill cut short
    sinks = Loggers(tmp_path, step=20)
    sinks.write(30, {"x": -1}, {})
    sinks.close()
    assert [row["x"] for row in loggers.read(tmp_path / "metrics.jsonl")] == [10, 20, -1]


def lines(n, **values):
    return "".join(json.dumps({"samples": i, **values}) + "\n" for i in range(n)).encode()


def test_rewinding_keeps_the_bytes_up_to_the_step(tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_bytes(lines(9, rate=0.1, none=None))
    loggers.rewind(path, 4)
    assert path.read_bytes() == lines(5, rate=0.1, none=None)
    assert [p.name for p in tmp_path.iterdir()] == ["metrics.jsonl"]


def test_a_file_that_needs_no_rewinding_is_left_alone(tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_bytes(lines(5))
    inode = path.stat().st_ino
    loggers.rewind(path, 4)
    assert path.stat().st_ino == inode and path.read_bytes() == lines(5)
    loggers.rewind(tmp_path / "absent.jsonl", 4)


@pytest.mark.parametrize(
    "damage",
    [b"\xff\xfe{", b'{"samples": 2', b'{"sanples": 2}', b"[]", b"7", b'{"samples": null}', b"\0"],
)
def test_a_damaged_line_is_named_and_skipped(tmp_path, damage):
    path = tmp_path / "metrics.jsonl"
    parts = lines(5).split(b"\n")
    parts[2] = damage
    path.write_bytes(b"\n".join(parts))
    with pytest.warns(UserWarning, match="metrics.jsonl: line 3 is damaged and is skipped"):
        assert [row["samples"] for row in loggers.read(path)] == [0, 1, 3, 4]
    with pytest.warns(UserWarning, match="line 3"):
        sinks = Loggers(tmp_path, step=3)
    sinks.write(9, {}, {})
    sinks.close()
    assert [row["samples"] for row in loggers.read(path)] == [0, 1, 3, 9], "and named only once"


@pytest.mark.filterwarnings("error")
def test_a_last_line_cut_short_is_nothing_to_worry_about(tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_bytes(lines(3)[:-5])
    assert [row["samples"] for row in loggers.read(path)] == [0, 1]
    path.write_bytes(lines(3)[:-1])  # only its end is missing
    sinks = Loggers(tmp_path, step=9)
    sinks.write(9, {}, {})
    sinks.close()
    assert [row["samples"] for row in loggers.read(path)] == [0, 1, 2, 9]


def test_whichever_byte_is_lost_a_run_can_be_resumed(tmp_path):
    path, whole = tmp_path / "metrics.jsonl", lines(4, x=0.5)
    for n in range(len(whole) - 1):
        path.write_bytes(whole[:n] + bytes([whole[n] ^ 0x80]) + whole[n + 1 :])
        with pytest.warns(UserWarning, match="damaged"):
            loggers.rewind(path, 2)
        assert set(path.read_bytes().splitlines()) <= set(lines(3, x=0.5).splitlines())


def test_a_disk_that_is_full_while_a_file_is_rewound_leaves_the_file(tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_bytes(lines(1000))
    with faults.full_disk(5000), pytest.raises(loggers.LoggerError, match="File too large"):
        Loggers(tmp_path, step=900)
    assert path.read_bytes() == lines(1000)
    assert [p.name for p in tmp_path.iterdir()] == ["metrics.jsonl"]


def test_a_process_killed_while_it_rewinds_leaves_the_old_file_or_the_new(tmp_path, monkeypatch):
    path = tmp_path / "metrics.jsonl"
    path.write_bytes(lines(9))

    def killed(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", killed)
    with pytest.raises(KeyboardInterrupt):
        loggers.rewind(path, 4)
    assert path.read_bytes() == lines(9)


TENSORBOARD = ("torch.utils.tensorboard", "tensorboard")


@pytest.mark.parametrize("package, modules", [("tensorboard", TENSORBOARD), ("wandb", ("wandb",))])
def test_a_package_that_is_missing_is_named_with_the_line_that_installs_it(
    tmp_path, monkeypatch, package, modules
):
    faults.not_installed(monkeypatch, *modules)
    with pytest.warns(UserWarning, match=f"pip install {package}"):
        sinks = Loggers(tmp_path, wandb=WANDB if package == "wandb" else None)
    sinks.write(1, {"x": 1}, {})
    sinks.close()
    assert loggers.read(tmp_path / "metrics.jsonl") == [{"samples": 1, "x": 1}]


def test_without_matplotlib_the_curves_are_named(tmp_path, monkeypatch):
    faults.not_installed(monkeypatch, "matplotlib", "matplotlib.figure")
    with pytest.warns(UserWarning, match="curves.png left out.*pip install matplotlib"):
        loggers.curves(tmp_path)


def fake_wandb(monkeypatch, key="key", init=None, log=None):
    """A stand-in for the package, to fail where it is told to."""
    logged = []
    room = types.SimpleNamespace
    run = room(log=log or (lambda values, step: logged.append((step, values))), finish=lambda: None)

    def started(**options):
        module.options.append(options)
        run.id = options["id"] or f"id{len(module.options)}"
        return run

    module = room(login=lambda prompt: key is not None, Settings=dict, init=init or started)
    module.options = []
    monkeypatch.setitem(sys.modules, "wandb", module)
    return logged


def failing(*_, **__):
    raise ConnectionError("the network is unreachable\nand more lines")


WANDB = dict(project="p", mode="online", name="n", config={})


def test_wandb_gets_what_the_files_get(tmp_path, monkeypatch):
    logged = fake_wandb(monkeypatch)
    sinks = Loggers(tmp_path, wandb=WANDB)
    sinks.write(5, {"a": 1}, {"b": 2})
    assert logged == [(5, {"samples": 5, "a": 1, "b": 2})]


def test_a_run_that_goes_on_is_the_same_run_of_wandb_and_a_new_one_is_another(
    tmp_path, monkeypatch
):
    fake_wandb(monkeypatch)
    for folder, step in ((tmp_path / "a", 0), (tmp_path / "b", 0), (tmp_path / "a", 5)):
        folder.mkdir(exist_ok=True)
        Loggers(folder, step, WANDB).close()
    started = sys.modules["wandb"].options
    assert [options["id"] for options in started] == [None, None, "id1"]
    assert [options["resume"] for options in started] == ["allow"] * 3


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
        sinks = Loggers(tmp_path, wandb=WANDB)
        for step in range(3):
            sinks.write(step, {"x": step}, {})
        sinks.close()
    assert len(caught) == 1
    assert len(loggers.read(tmp_path / "metrics.jsonl")) == 3


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_full_disk_is_one_warning_for_each_file_and_loses_no_line_once_there_is_room(tmp_path):
    sinks = Loggers(tmp_path)
    sinks.write(1, {"x": 1}, {"y": 2})
    size = (tmp_path / "metrics.jsonl").stat().st_size
    with pytest.warns(UserWarning, match="File too large.*the run goes on") as caught:
        with faults.full_disk(size + 5):  # room for a part of a line
            sinks.write(2, {"x": 1}, {"y": 2})
            sinks.write(3, {"x": 1}, {"y": 2})
    named = sorted(str(w.message).split(" ")[0].rpartition("/")[2] for w in caught)
    if "TensorBoard" in named:  # its thread may meet the full disk, too
        named.remove("TensorBoard")
    assert named == ["metrics.jsonl", "perf.jsonl"]
    sinks.write(4, {"x": 1}, {"y": 2})
    sinks.close()
    for name in ("metrics.jsonl", "perf.jsonl"):
        assert [row["samples"] for row in loggers.read(tmp_path / name)] == [1, 2, 3, 4]


def test_the_curves_are_an_image_of_the_files(tmp_path):
    from matplotlib.image import imread

    rows = [{"samples": n, "episode/return": n, "loss/value": None} for n in range(3)]
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    (tmp_path / "perf.jsonl").write_text("")
    loggers.curves(tmp_path)
    assert imread(tmp_path / "curves.png").shape[1] > 500


@pytest.mark.slow
def test_the_real_wandb_keeps_an_offline_run(tmp_path):
    script = f"""
from megastep.agents.training.loggers import Loggers
wandb = dict(project="p", mode="offline", name="n", config=dict(a=1))
sinks = Loggers({str(tmp_path)!r}, wandb=wandb)
sinks.write(1, dict(x=1), dict(y=2))
sinks.close()"""
    done = subprocess.run(
        [sys.executable, "-W", "always::UserWarning", "-c", script],
        text=True,
        timeout=120,
        stderr=subprocess.PIPE,
        cwd=pathlib.Path(__file__).parents[2],
    )
    assert done.returncode == 0 and "left out" not in done.stderr, done.stderr
    assert [
        path.stat().st_size > 1000 for path in tmp_path.glob("wandb/offline-run-*/*.wandb")
    ] == [True]
