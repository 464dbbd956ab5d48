"""Profiles: a trace and a table of some updates, which change nothing that a run logs or learns."""

import gzip
import json
import re
from pathlib import Path

import pytest
import torch

from megastep.agents.cli import train
from megastep.agents.training.profiler import N_SKIPPED
from tests.helpers import tiny

pytestmark = pytest.mark.usefixtures("here")
DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]
WORDS = [*tiny.TINY, *tiny.SHORT_EPISODES, f"samples={12 * tiny.UPDATE}", "logging.every=2"]


def table_of(folder):
    """Returns the first line of a profile, and how often each operation was called."""
    head, *lines = Path(folder, "profile.txt").read_text().splitlines()
    rows = [re.split(r"  +", line.strip()) for line in lines]
    return head, {row[0]: int(row[-1]) for row in rows if len(row) > 5 and row[-1].isdigit()}


def events_of(folder):
    return json.loads(gzip.decompress(Path(folder, "profile.json.gz").read_bytes()))["traceEvents"]


@pytest.mark.parametrize("learner", ["ppo", pytest.param("vtrace", marks=pytest.mark.nightly)])
@pytest.mark.parametrize("device", DEVICES)
def test_profiled_run_has_a_trace_a_table_and_the_same_metrics(device, learner, capsys):
    words = [*WORDS, f"device={device}", f"learner={learner}"]
    assert train.main([*words, "folder=run", "logging.profile=4"]) == 0
    output = capsys.readouterr()
    assert "Profile: run/profile.txt" in output.out and not output.err
    assert train.main([*words, "folder=plain"]) == 0
    metrics = [Path(run, "metrics.jsonl").read_bytes() for run in ("run", "plain")]
    assert metrics[0] == metrics[1] and not list(Path("plain").glob("profile*"))
    head, numbers = table_of("run")
    assert head.startswith(f"Updates {N_SKIPPED + 1} to {N_SKIPPED + 4} on {device}")
    assert [numbers[phase] for phase in ("collect", "update")] == [4, 4]
    assert 1 <= numbers["rest"] <= 4  # a GPU's row has the updates after which a kernel ran
    ranges = [event for event in events_of("run") if event.get("cat") == "user_annotation"]
    names = [event["name"] for event in ranges]
    assert [names.count(phase) for phase in ("collect", "update", "rest")] == [4, 4, 4]
    if device == "cuda":
        kernels = {event["name"] for event in events_of("run") if event.get("cat") == "kernel"}
        assert any("render" in name or "raster" in name for name in kernels), "of the graph"


def test_profile_that_cannot_be_made_ends_no_run(monkeypatch, capsys):
    def fail(*_):
        raise RuntimeError("CUPTI is in use\nby another")

    monkeypatch.setattr(torch.profiler.profile, "start", fail)
    assert train.main([*WORDS, "folder=run", "logging.profile=4"]) == 0
    output = capsys.readouterr()
    assert output.err == "warning: The profile could not be made: CUPTI is in use\n"
    assert "Profile" not in output.out and not Path("run/profile.txt").exists()
