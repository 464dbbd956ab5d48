"""The settings of resumed runs: loggers, budgets."""

import pathlib
import subprocess
import sys

import pytest

from megastep.agents.errors import ConfigErrors, UserError
from megastep.agents.factory.check import as_tree
from megastep.agents.launch import again
from megastep.agents.runs import checkpoint
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


CODE = """
import sys
from megastep.agents.cli import entry
for words, code in ((["--help"], 0), (["--version"], 0), (["env"], 2)):
    assert entry.run_command("train", words) == code, words
assert "torch" not in sys.modules
"""


def test_help_and_words_that_cannot_be_read_need_no_pytorch():
    subprocess.run([sys.executable, "-c", CODE], cwd=ROOT, check=True, timeout=300)


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
        (["samples=64"], ["samples=9"], "samples", "already trained for 64 of 9 samples"),
        (
            ["seconds=2"],
            [],
            "seconds",
            "trained for 2.5 of 2.0 seconds; to continue, give more_sec",
        ),
        ([], ["more_seconds=9", "seconds=99"], "more_seconds", "seconds= is the total"),
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
