"""The scripts in processes of their own: exit codes, signals, closed pipes. Few tests, as a process
costs seconds.
"""

import json
import os
import pathlib
import signal
import subprocess
import sys
import time

import pytest

ROOT = pathlib.Path(__file__).parents[1]
TINY = [
    "env=minimal",
    "geometry=box",
    "preset=cpu",
    "env.n_envs=4",
    "env.res=8",
    "learner.n_steps=8",
    "learner.n_minibatches=2",
    "agent.width=8",
    "device=cpu",
]


def start(script, *arguments, cwd, **environment):
    return subprocess.Popen(
        [sys.executable, str(ROOT / f"{script}.py"), *arguments],
        cwd=cwd,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={**os.environ, **environment},
    )


def finished(script, *arguments, cwd, **environment):
    """(exit code, stdout, stderr)"""
    process = start(script, *arguments, cwd=cwd, **environment)
    out, err = process.communicate(timeout=120)
    return process.returncode, out, err


def test_a_typo_is_exit_code_2_and_leaves_nothing(tmp_path):
    code, out, err = finished("train", "env=explorr", "learner.lrr=1", "env.n_envs=0", cwd=tmp_path)
    assert code == 2 and out == ""
    assert err.splitlines() == [
        "train.py: 3 errors in the configuration",
        "  env: 'explorr' is unknown; did you mean explorer?",
        "  learner.lrr: no such key; did you mean learner.lr?",
        "  env.n_envs: 0 is out of range: allowed is from 1 to 67,108,864",
    ]
    assert not any(tmp_path.iterdir())


def test_a_gpu_that_is_not_there_and_a_compiler_that_is_not_there_are_one_sentence(tmp_path):
    code, _, err = finished("train", *TINY, "device=cuda", cwd=tmp_path, CUDA_VISIBLE_DEVICES="")
    assert code == 2 and "device=cpu" in err and len(err.splitlines()) == 1
    code, _, err = finished(
        "train",
        *TINY,
        cwd=tmp_path,
        CXX="/nonexistent",
        XDG_CACHE_HOME=str(tmp_path / "cache"),
        MEGASTEP_CACHE=str(tmp_path / "cache"),
    )
    assert code == 2 and "compiler" in err and len(err.splitlines()) == 1
    assert not any(tmp_path.glob("runs/*"))


@pytest.mark.parametrize("number, code", [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_saves_and_says_how_to_go_on(tmp_path, number, code):
    process = start("train", *TINY, "folder=run", cwd=tmp_path)
    deadline = time.monotonic() + 60
    while (
        not (tmp_path / "run" / "metrics.jsonl").exists()
        or not (tmp_path / "run" / "metrics.jsonl").stat().st_size
    ):
        assert time.monotonic() < deadline and process.poll() is None, process.communicate()
        time.sleep(0.05)
    process.send_signal(number)
    _, err = process.communicate(timeout=60)
    assert process.returncode == code
    assert "python train.py resume=run" in err and "Traceback" not in err
    (saved,) = (tmp_path / "run" / "checkpoints").iterdir()
    assert json.loads((saved / "manifest.json").read_text())["step"] > 0


def test_a_reader_that_leaves_does_not_stop_the_run(tmp_path):
    overrides = [*TINY, "samples=64", "folder=run", "finish.evaluate=true", "finish.lanes=4"]
    command = f"{sys.executable} {ROOT / 'train.py'} {' '.join(overrides)}"
    done = subprocess.run(
        ["bash", "-c", f"{{ {command}; echo code $? >&2; }} | true"],
        cwd=tmp_path,
        text=True,
        stderr=subprocess.PIPE,
        timeout=120,
        env={**os.environ, "TERM": "dumb"},
    )
    assert done.stderr.splitlines() == ["code 0"]
    assert list((tmp_path / "run" / "evaluations").glob("box-test-*.json"))
