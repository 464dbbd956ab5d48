"""Runs in environments of other people that fail."""

import json

import pytest

from megastep.agents.cli import evaluate, record, train
from megastep.agents.runs import json_lines
from megastep.envs.minimal import Minimal

pytest.importorskip("gymnasium")
pytestmark = pytest.mark.usefixtures("here")
WORDS = [
    *("env=gymnasium", "device=cpu", "env.n_envs=4", "agent.width=8"),
    *("learner.n_steps=8", "learner.n_minibatches=2", "logging.every=1", "logger=none"),
]


class Own(Minimal):
    """Fails in its 20th step, with an error that nothing in megastep expects."""

    count = 0

    def step(self, decision):
        self.count += 1
        if self.count == 20:
            raise KeyError("door")
        return super().step(decision)


def env_id(name):
    return f"env.id=tests.helpers.odd_envs:Odd{name}-v0"


@pytest.mark.parametrize("vectorization", ["sync", "async"])
def test_failed_environment_ends_the_run_with_all_saved(here, vectorization, capsys):
    words = [*WORDS, env_id("Crash"), "samples=9600", "folder=run", "seed=2", "learner.n_steps=32"]
    assert train.main([*words, f"env.vectorization={vectorization}"]) == 4
    (line,) = capsys.readouterr().err.splitlines()
    text = "OddCrash-v0: environment {} failed: OSError: simulator does not answer. Its traceback "
    assert any(text.format(i) in line for i in range(4))
    n_samples = json_lines.read(here / "run/metrics.jsonl")[-1]["samples"]
    assert f"All {n_samples} samples are saved. To continue: python train.py resume=run" in line
    trace = (here / "run/env_error.txt").read_text()
    assert trace.startswith("Traceback") and "odd_envs.py" in trace
    assert "hosting" not in trace and trace.endswith("OSError: simulator does not answer\n")
    if vectorization == "async":  # new episodes, which do not fail in the same step
        assert train.main(["resume=run", f"samples={n_samples + 128}"]) in (0, 4)
        assert json_lines.read(here / "run/metrics.jsonl")[-1]["samples"] > n_samples


def test_failure_before_training_leaves_the_traceback(here, capsys):
    assert train.main([*WORDS, env_id("CrashInReset"), "samples=64", "folder=run"]) == 4
    assert "OddCrashInReset-v0: environment 0 failed: KeyError: 'map'" in capsys.readouterr().err
    assert "odd_envs.py" in (here / "run/env_error.txt").read_text()


def test_own_class_that_fails(here, capsys):
    words = [f"env={__name__}:Own", "geometry=box", *WORDS[1:], "samples=640"]
    assert train.main([*words, "env.res=8", "folder=run"]) == 4
    text = capsys.readouterr().err
    assert ":Own failed: KeyError: 'door'. Its traceback is in" in text
    assert "saved. To continue: python train.py resume=run" in text
    assert "in step" in (here / "run/env_error.txt").read_text()


def test_environment_that_cannot_be_closed_is_a_warning(here, capsys):
    words = [*WORDS, env_id("CloseFails"), "samples=64", "folder=run", "env.vectorization=async"]
    assert train.main([*words, "finish.evaluate=true", "finish.episodes=4"]) == 0
    assert "warning: The environment could not be closed: " in capsys.readouterr().err
    assert len([*here.glob("run/evaluations/*.json")]) == 1


def test_evaluation_cuts_endless_episodes_off(here, capsys):
    assert train.main([*WORDS, env_id("Endless"), "samples=64", "folder=run"]) == 0
    assert evaluate.main(["run=run", "episodes=4", "max_steps=100", "baseline=false"]) == 0
    text = "warning: trained: 4 of 4 episodes had not ended after 100 steps and are counted as"
    assert text in capsys.readouterr().err
    (table,) = here.glob("run/evaluations/*.json")
    (row,) = json.loads(table.read_text())["rows"]
    assert (row["return"], row["length"], row["unfinished"]) == (100, 100, 4)


def test_failure_in_an_evaluation(here, capsys):
    assert train.main([*WORDS, env_id("Endless"), "samples=64", "folder=run"]) == 0
    words = ["env=gymnasium", env_id("Crash"), "episodes=16", "run=run"]
    assert evaluate.main(words) == 4
    assert "OSError: simulator does not answer. Its traceback" in capsys.readouterr().err
    assert (here / "run/env_error.txt").exists()


def test_odd_renderers_are_filmed(here):
    from matplotlib.image import imread

    words = ["env=gymnasium", env_id("BuildsRenderer"), "steps=2", "file=a.png", "device=cpu"]
    assert record.main(words) == 0
    image = (255 * imread(here / "a.png")[..., :3]).round()
    assert (image == 9).all(-1).sum() >= 64  # below a caption, at least the 8 x 8 pixels
