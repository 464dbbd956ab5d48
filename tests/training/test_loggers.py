"""Loggers: files that survive crashes, and failures that do not stop a run."""

import csv
import functools
import io
import json
import os
import pathlib
import subprocess
import sys
import types

import numpy as np
import pytest
from PIL import Image

from megastep.agents.errors import UserError
from megastep.agents.runs import json_lines
from megastep.agents.training.loggers import Loggers
from megastep.agents.training.loggers.csv import CSV
from megastep.agents.training.loggers.tensorboard import TensorBoard
from megastep.agents.training.loggers.wandb import Wandb
from megastep.agents.types import RunResult
from megastep.video import Mp4Writer
from tests.helpers import faults
from tests.helpers.processes import HUNG


def with_tensorboard(folder):
    return Loggers(folder, others={"tensorboard": lambda: TensorBoard(folder, 0)})


def test_files_and_tensorboard_hold_what_was_written(tmp_path):
    run_loggers = with_tensorboard(tmp_path)
    metrics = {"loss/value": 0.25, "episode/count": 3, "bad": float("nan"), "anneal": "never"}
    run_loggers.write(64, {**metrics, "perf/rate": 1e6})
    run_loggers.close()
    (row,) = json_lines.read(tmp_path / "metrics.jsonl")
    assert row == {"samples": 64, **metrics, "bad": None}
    assert json_lines.read(tmp_path / "perf.jsonl") == [{"samples": 64, "perf/rate": 1e6}]
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert [(e.step, e.value) for e in events.Scalars("loss/value")] == [(64, 0.25)]


def test_resumed_run_replaces_lines_after_its_checkpoint(tmp_path):
    run_loggers = Loggers(tmp_path)
    for step in (10, 20, 30):
        run_loggers.write(step, {"x": step})
    run_loggers.close()
    with open(tmp_path / "metrics.jsonl", "a") as file:
        file.write('{"samples": 40, "x"')  # a line cut short by a kill
    run_loggers = Loggers(tmp_path, step=20)
    run_loggers.write(30, {"x": -1})
    run_loggers.close()
    assert [row["x"] for row in json_lines.read(tmp_path / "metrics.jsonl")] == [10, 20, -1]


def test_tensorboard_has_the_points_of_the_lines_after_two_resumes(tmp_path, monkeypatch):
    from tensorboard.summary.writer import event_file_writer as files

    # files of one second are read in the order of a counter's text, in which 10 is before 9
    monkeypatch.setattr(files, "_global_uid", files.AtomicCounter(0))
    for first, saved, last in ((0, 0, 40), (3, 30, 60), (6, 60, 70)):
        others = {"tensorboard": lambda saved=saved: TensorBoard(tmp_path, saved)}
        run_loggers = Loggers(tmp_path, saved, others)
        for step in range(10 * first + 10, last + 1, 10):
            run_loggers.write(step, {"x": step + saved / 100, "perf/rate": 1.0})
        run_loggers.close()
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    rows = json_lines.read(tmp_path / "metrics.jsonl")
    assert [row["samples"] for row in rows] == [10, 20, 30, 40, 50, 60, 70]
    points = [(event.step, pytest.approx(event.value)) for event in events.Scalars("x")]
    assert [(row["samples"], row["x"]) for row in rows] == points
    assert [event.step for event in events.Scalars("perf/rate")] == [row["samples"] for row in rows]


def lines(n, **values):
    return "".join(json.dumps({"samples": i, **values}) + "\n" for i in range(n)).encode()


@pytest.mark.parametrize(
    "damage",
    [b"\xff\xfe{", b'{"samples": 2', b'{"sanples": 2}', b"[]", b"7", b'{"samples": null}', b"\0"],
)
def test_damaged_line_is_named_and_skipped(tmp_path, damage):
    path = tmp_path / "metrics.jsonl"
    parts = lines(5).split(b"\n")
    parts[2] = damage
    path.write_bytes(b"\n".join(parts))
    with pytest.warns(UserWarning, match="metrics.jsonl: line 3 .*skipped") as caught:
        assert [row["samples"] for row in json_lines.read(path)] == [0, 1, 3, 4]
    assert caught[0].filename == __file__, "the line that reads is the one that is shown"
    with pytest.warns(UserWarning, match="line 3"):
        run_loggers = Loggers(tmp_path, step=3)
    run_loggers.write(9, {})
    run_loggers.close()
    assert [row["samples"] for row in json_lines.read(path)] == [0, 1, 3, 9]


def test_run_resumes_after_damage_to_any_byte(tmp_path):
    path, intact = tmp_path / "metrics.jsonl", lines(4, x=0.5)
    for n in range(len(intact) - 1):
        path.write_bytes(intact[:n] + bytes([intact[n] ^ 0x80]) + intact[n + 1 :])
        with pytest.warns(UserWarning, match="damaged"):
            json_lines.truncate_after(path, 2)
        assert set(path.read_bytes().splitlines()) <= set(lines(3, x=0.5).splitlines())


def test_full_disk_on_resume_leaves_the_file(tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_bytes(lines(1000))
    with faults.full_disk(5000), pytest.raises(UserError, match="File too large"):
        Loggers(tmp_path, step=900)
    assert path.read_bytes() == lines(1000)
    assert [p.name for p in tmp_path.iterdir()] == ["metrics.jsonl"]


# ---- progress.csv ----


def table(folder):
    with open(folder / "progress.csv", newline="") as file:
        return list(csv.reader(file))


def test_csv_has_a_column_per_metric_from_its_first_report_on(tmp_path):
    logger = CSV(tmp_path, 0)
    for step, values in (8, {"lr": 0.5}), (16, {"anneal": 'a,"b"'}), (24, {"lr": 0.1}):
        logger.write(step, values)
    logger.close()
    assert table(tmp_path) == [
        ["samples", "lr", "anneal"],
        ["8", "0.5", ""],
        ["16", "", 'a,"b"'],
        ["24", "0.1", ""],
    ]


@pytest.mark.parametrize("cut", [1, 4, 7])
def test_csv_of_a_resumed_run_has_no_row_after_its_checkpoint(tmp_path, cut):
    logger = CSV(tmp_path, 0)
    for step in 10, 20, 30:
        logger.write(step, {"x": step})
    path = tmp_path / "progress.csv"
    path.write_bytes(path.read_bytes() + b"31,31\n"[:-cut])  # a kill cut the last row short
    logger = CSV(tmp_path, 20)
    logger.write(30, {"x": -1})
    logger.write(40, {"x": 4, "y": 5})
    rows = [["10", "10", ""], ["20", "20", ""], ["30", "-1", ""], ["40", "4", "5"]]
    assert table(tmp_path) == [["samples", "x", "y"], *rows]


# ---- Weights & Biases ----


def test_wandb_that_is_not_installed_is_named_with_the_cure(tmp_path, monkeypatch):
    faults.not_installed(monkeypatch, "wandb")
    with pytest.warns(UserWarning, match="logger=wandb skipped: .*pip install wandb$"):
        run_loggers = with_wandb(tmp_path)
    run_loggers.write(1, {"x": 1})
    run_loggers.close()
    assert json_lines.read(tmp_path / "metrics.jsonl") == [{"samples": 1, "x": 1}]


def fake_wandb(monkeypatch, key="key", init=None, log=None):
    """Replaces the package by one that logs to a list, or fails as `init` and `log` do."""
    logged = []
    namespace = types.SimpleNamespace
    log = log or (lambda values, step: logged.append((step, values)))
    run = namespace(log=log, finish=lambda: None, summary={})

    def started(**options):
        module.options.append(options)
        run.id = options["id"] or f"id{len(module.options)}"
        return run

    module = namespace(login=lambda prompt: key is not None, Settings=dict, init=init or started)
    module.Video = lambda path, format: ("video", path, format)
    module.Table = lambda columns, data: ("table", columns, data)
    module.run = run
    module.options = []
    monkeypatch.setitem(sys.modules, "wandb", module)
    return logged


def failing(*_, **__):
    raise ConnectionError("the network is unreachable\nand more lines")


def with_wandb(folder, step=0):
    make = functools.partial(Wandb, folder, run_name="n", config={}, project="p")
    return Loggers(folder, step, {"wandb": make})


def test_resumed_run_continues_its_wandb_run(tmp_path, monkeypatch):
    fake_wandb(monkeypatch)
    for name, step in (("a", 0), ("b", 0), ("a", 5), ("a", 9)):
        (tmp_path / name).mkdir(exist_ok=True)
        with_wandb(tmp_path / name, step).close()
    started = sys.modules["wandb"].options
    assert [options["id"] for options in started] == [None, None, "id1", "id1"]
    assert [options["resume"] for options in started] == ["allow"] * 4
    assert {options["job_type"] for options in started} == {"train"}
    assert started[0]["config"].keys() == {"commit"}


RESULT = RunResult({"score": 3.5}, None, [{"agent": "trained", "return": "3.5"}])


def test_wandb_has_the_result_of_a_run(tmp_path, monkeypatch):
    logged = fake_wandb(monkeypatch)
    run_loggers = with_wandb(tmp_path, 5)
    run_loggers.finish(5, RESULT._replace(film=tmp_path / "video.mp4"))
    run_loggers.close()
    film = "video", str(tmp_path / "video.mp4"), "mp4"
    table = "table", ["agent", "return"], [["trained", "3.5"]]
    assert logged == [(5, {"samples": 5, "film": film, "evaluation": table})]
    assert sys.modules["wandb"].run.summary == {"final/score": 3.5}


def test_tensorboard_has_the_result_of_a_run(tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
    from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

    config = {"seed": 1, "learner": {"lr": 0.1, "names": [1, 2]}, "desync": False, "seconds": None}
    film = tmp_path / "video.mp4"
    writer = Mp4Writer(10)
    for number in range(8):
        writer.add(np.full((720, 640, 3), 30 * number, np.uint8))
    film.write_bytes(writer.close())
    made = []

    def make():
        made.append(TensorBoard(tmp_path, 5, config))
        return made[-1]

    run_loggers = Loggers(tmp_path, 5, {"tensorboard": make, "csv": lambda: CSV(tmp_path, 5)})
    run_loggers.finish(5, RESULT._replace(film=film))
    assert [*run_loggers.others] == ["tensorboard"], "a table has no use for it"
    run_loggers.close()
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert [(e.step, e.value) for e in events.Scalars("final/score")] == [(5, 3.5)]
    (text,) = events.Tensors("evaluation/text_summary")
    assert b"| trained" in text.tensor_proto.string_val[0]
    (image,) = events.Images("film")
    assert (image.height, image.width) == (360, 320)
    with Image.open(io.BytesIO(image.encoded_image_string)) as gif:
        assert gif.n_frames == 8 and gif.size == (320, 360)
    data = events.summary_metadata["_hparams_/session_start_info"].plugin_data.content
    values = HParamsPluginData.FromString(data).session_start_info.hparams
    kinds = {name: value.WhichOneof("kind") for name, value in values.items()}
    assert kinds == {
        "seed": "number_value",
        "learner.lr": "number_value",
        "learner.names": "string_value",
        "desync": "string_value",
    }


@pytest.mark.parametrize(
    "fault, message",
    [
        (dict(key=None), "no key"),
        (dict(init=failing), "did not start.*the network is unreachable"),
        (dict(log=failing), "logger=wandb failed.*the network is unreachable"),
    ],
)
def test_wandb_failure_is_one_warning(tmp_path, monkeypatch, fault, message):
    fake_wandb(monkeypatch, **fault)
    with pytest.warns(UserWarning, match=message) as warnings:
        run_loggers = with_wandb(tmp_path)
        for step in range(3):
            run_loggers.write(step, {"x": step})
        run_loggers.close()
    assert len(warnings) == 1
    assert len(json_lines.read(tmp_path / "metrics.jsonl")) == 3


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_full_disk_is_one_warning_per_file_and_loses_no_line(tmp_path):
    run_loggers = with_tensorboard(tmp_path)
    run_loggers.write(1, {"x": 1, "perf/y": 2})
    size = (tmp_path / "metrics.jsonl").stat().st_size
    with pytest.warns(UserWarning, match="File too large") as warnings:
        with faults.full_disk(size + 5):  # space for part of a line
            run_loggers.write(2, {"x": 1, "perf/y": 2})
            run_loggers.write(3, {"x": 1, "perf/y": 2})
    names = sorted(str(w.message).split(" ")[0].rpartition("/")[2] for w in warnings)
    if "logger=tensorboard" in names:  # its thread may hit the full disk, too
        names.remove("logger=tensorboard")
    assert names == ["metrics.jsonl", "perf.jsonl"]
    run_loggers.write(4, {"x": 1, "perf/y": 2})
    run_loggers.close()
    for name in ("metrics.jsonl", "perf.jsonl"):
        assert [row["samples"] for row in json_lines.read(tmp_path / name)] == [1, 2, 3, 4]


def logged_with_real_wandb(folder, mode, **environment):
    """Writes one report in a process of its own. Returns the warnings."""
    script = f"""
import pathlib
from megastep.agents.training.loggers import Loggers, wandb
from megastep.agents.types import RunResult
from megastep.video import Mp4Writer
import numpy as np
wandb.TIMEOUT = 2
folder = pathlib.Path({str(folder)!r})
make = lambda: wandb.Wandb(folder, "n", dict(a=1), "p", {mode!r})
run_loggers = Loggers(folder, others=dict(wandb=make))
run_loggers.write(1, dict(x=1))
film = Mp4Writer(10)
film.add(np.zeros((64, 64, 3), np.uint8))
(folder / "film.mp4").write_bytes(film.close())
run_loggers.finish(2, RunResult(dict(score=1.0), folder / "film.mp4", [dict(agent="trained")]))
run_loggers.close()"""
    process = subprocess.run(
        [sys.executable, "-W", "always::UserWarning", "-c", script],
        text=True,
        timeout=HUNG,
        stderr=subprocess.PIPE,
        cwd=pathlib.Path(__file__).parents[2],
        env={**os.environ, "HOME": str(folder), **environment},
    )
    assert process.returncode == 0 and "Traceback" not in process.stderr, process.stderr
    assert json_lines.read(folder / "metrics.jsonl") == [{"samples": 1, "x": 1}]
    return [line for line in process.stderr.splitlines() if "UserWarning" in line]


@pytest.mark.slow
def test_real_wandb_writes_an_offline_run(tmp_path):
    assert not logged_with_real_wandb(tmp_path, "offline")
    (path,) = tmp_path.glob("wandb/offline-run-*/*.wandb")
    assert path.stat().st_size > 1000
    (film,) = tmp_path.glob("wandb/offline-run-*/files/media/videos/film_*.mp4")
    assert film.stat().st_size > 500
    assert [*tmp_path.glob("wandb/offline-run-*/files/media/table/evaluation_*.json")]
