"""Settings reach constructors as they were typed, in every command that makes an environment."""

import json
import math
import pathlib

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from megastep.agents.algorithms.ppo import PPO
from megastep.agents.cli import evaluate, record, sweeps, train
from megastep.agents.cli.command import load
from megastep.agents.cli.compose import Composer
from megastep.agents.runs import agent_file, checkpoint, json_lines
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


# ---- Environments of Gymnasium ----


class Cap(gymnasium.Env):
    """Pays 3 for action 1, at most `cap`, where None is 1. Ends after ten steps."""

    observation_space = spaces.Box(0, 1, (1,), np.float32)
    action_space = spaces.Discrete(2)

    def __init__(self, cap=None, render_mode=None):
        self.cap = 1.0 if cap is None else cap

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return np.zeros(1, np.float32), {}

    def reward(self, action):
        return float(min(3.0 * action, self.cap))

    def step(self, action):
        self.t += 1
        return np.full(1, self.t / 10, np.float32), self.reward(action), False, self.t >= 10, {}


class Shop(Cap):
    """Pays the price of a product, 0 without one."""

    action_space = spaces.Discrete(3)

    def __init__(self, prices=None, render_mode=None):
        self.prices = prices or {}

    def reward(self, action):
        return float(self.prices.get(int(action), 0.0))


gymnasium.register("TypedCap-v0", Cap)
gymnasium.register("TypedShop-v0", Shop)
GYMNASIUM = [
    *("env=gymnasium", "device=cpu", "env.n_envs=8", "agent.width=8", "learner.n_steps=32"),
    *("learner.n_minibatches=2", "logging.every=1", "samples=256"),
]


@pytest.mark.parametrize(
    "words, by_chance",
    [
        (["env.id=TypedCap-v0", "env.kwargs.cap=inf"], 10 * 3 / 2),
        (["env.id=TypedShop-v0", "env.kwargs.prices={0: 1.0, 1: 5.0, 2: 2.0}"], 10 * 8 / 3),
    ],
)
def test_environments_of_gymnasium(here, words, by_chance):
    assert train.main([*GYMNASIUM, *words, "folder=run"]) == 0
    assert train.main(["resume=run", "more_samples=256"]) == 0
    assert evaluate.main(["run=run", "episodes=16"]) == 0
    returns = [row["episode/return"] for row in json_lines.read("run/metrics.jsonl")]
    (table,) = here.glob("run/evaluations/*.json")
    returns += [row["return"] for row in json.loads(table.read_text())["rows"]]
    assert len(returns) == 4 and returns == pytest.approx(4 * [by_chance], rel=0.25)


def test_swept_words_are_in_the_table_as_they_were_typed(here):
    (here / "zoo.py").write_text(f"from {HERE} import *")
    words = [*GYMNASIUM[:-1], "samples=256", "hydra.sweep.dir=mine", "-m"]
    assert train.main([*words, "env.id=zoo:TypedCap-v0,'zoo:TypedShop-v0'"]) == 0
    text = pathlib.Path("mine/sweep.csv").read_text()
    assert ",zoo:TypedCap-v0,done" in text and ",zoo:TypedShop-v0,done" in text
    assert "\\" not in text + pathlib.Path("mine/sweep.md").read_text()
    composer = Composer(load("train"))
    jobs, *_ = sweeps.jobs_of(composer, [*OWN[:-3], "learner.scales=1.0,1,inf,'1'"])
    scales = [composer.settings(job).learner.scales for job in jobs]
    assert repr(scales) == repr([1.0, 1, math.inf, "1"])
