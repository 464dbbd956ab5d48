"""Settings reach constructors as they were typed, in every command that makes an environment."""

import json

import numpy as np
import pytest

from megastep.agents.algorithms.ppo import PPO
from megastep.agents.cli import evaluate, record, train
from megastep.agents.runs import agent_file, checkpoint
from megastep.envs import Minimal
from megastep.geometries import sources
from tests.helpers import tiny

pytestmark = pytest.mark.usefixtures("here")
HERE = __name__
SEEN = []


class Yard(Minimal):
    """Takes what strangers take: also defaults that no checkpoint can keep."""

    def __init__(
        self,
        *args,
        heights=None,
        prices=None,
        cap: float = 1.0,
        limit: float = None,
        pick=max,
        table=np.zeros(2),  # noqa: B008
        **settings,
    ):
        SEEN.append(repr((heights, prices, cap)))
        assert (limit, pick, table.tolist()) == (None, max, [0.0, 0.0])
        super().__init__(*args, **settings)
        if prices:
            prices.clear()  # a stranger's constructor may use its arguments up


def boxes(n: int = 4, *, split: str, seed: int = 1, sizes=None):
    SEEN.append(repr(sizes))
    return sources.box(n, split=split, seed=seed)


class Scaled(PPO):
    def __init__(self, *args, scales=None, **settings):
        SEEN.append(repr(scales))
        super().__init__(*args, **settings)


OWN = [
    *(f"env={HERE}:Yard", f"geometry={HERE}:boxes", f"learner={HERE}:Scaled", *tiny.TINY[2:]),
    *("env.heights=[0.0,1,inf,'0']", "env.prices={0: 1.0, 2: nan}", "env.cap=inf"),
    *("geometry.sizes={0.5: [0.0]}", "learner.scales=[1e6,2.0]", "samples=32"),
]
PLAYED = {"([0.0, 1, inf, '0'], {0: 1.0, 2: nan}, inf)", "{0.5: [0.0]}"}
TRAINED = PLAYED | {"[1000000.0, 2.0]"}


def seen(main, *words):
    """Runs a command. Returns what constructors got."""
    SEEN.clear()
    assert main([*words]) == 0
    return {*SEEN}


def test_classes_of_ones_own_get_the_same_values_in_every_command(here):
    assert seen(train.main, *OWN, "folder=run") == TRAINED
    assert seen(train.main, "resume=run", "more_samples=32") == TRAINED
    assert seen(train.main, *tiny.TINY[2:], "init=run", "samples=32", "folder=next") == PLAYED
    assert seen(evaluate.main, "run=run", "episodes=4") == PLAYED
    assert seen(record.main, "run=run", "steps=1", "file=x.png") == PLAYED
    (table,) = here.glob("run/evaluations/*.json")
    json.loads(table.read_text(), parse_constant=pytest.fail)
    saved = checkpoint.load_latest("run/checkpoints")
    weights = {name: value.float() for name, value in saved.state["policy"].items()}
    agent_file.write(here / "a.safetensors", weights, saved.config, {"samples": 32})
    assert seen(evaluate.main, "run=a.safetensors", "episodes=4", "trust=true") == PLAYED


def test_files_and_sweeps_give_the_same_values(here):
    (here / "mine/experiment").mkdir(parents=True)
    (here / "mine/experiment/yard.yaml").write_text(
        """# @package _global_
        env: {heights: [0.0, 1, .inf, "0"], prices: {0: 1.0, 2: .nan}, cap: .inf}
        geometry: {sizes: {0.5: [0.0]}}
        learner: {scales: [1e6, 2.0]}
        """
    )
    words = ["--config-dir=mine", "experiment=yard", *OWN[:3], *tiny.TINY[2:], "samples=32"]
    assert seen(train.main, *words) == TRAINED
    varied = ["-m", "env.heights=[0.0,1,inf,'0'],[-inf]", "hydra.sweep.dir=sweep"]
    words = [word for word in OWN if not word.startswith("env.heights")]
    other = PLAYED | {"([-inf], {0: 1.0, 2: nan}, inf)"}
    assert seen(train.main, *words, *varied) == TRAINED | other


def test_keys_that_cannot_be_are_refused(capsys):
    assert train.main([*OWN, "env.prices={null: 1}"]) == 2
    assert "env.prices: Incompatible key type 'NoneType'" in capsys.readouterr().err
