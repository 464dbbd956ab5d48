"""Evaluation: first episodes counted on worlds whose returns are known, intervals checked on paper,
and the script.
"""

import dataclasses
import json

import numpy as np
import pytest
import torch

from agents import evaluation
from agents.cli import evaluate, train
from agents.cli.compose import ConfigLoader
from agents.cli.settings import Evaluate, Train, UserError, build
from megastep import spaces
from megastep.arrdict import arrdict

TINY = [
    "env=minimal",
    "geometry=box",
    "agent=small",
    "env.n_envs=4",
    "env.res=8",
    "env.shortest=5",
    "env.longest=9",
    "learner.n_steps=8",
    "learner.n_minibatches=2",
    "agent.width=8",
    "device=cpu",
    "samples=1",
]


class Counting:
    """Lane b lives b + 1 steps, again and again; a step pays 1 in the first life and 100 later."""

    n_agents, device = 1, torch.device("cpu")
    action_space = spaces.MultiDiscrete(1, 7)

    def __init__(self, n_envs, mortal):
        self.n_envs, self.mortal = n_envs, mortal

    def reset(self):
        self.age, self.lives = torch.zeros(self.n_envs), torch.zeros(self.n_envs)
        self.ended = torch.zeros(self.n_envs, dtype=torch.bool)
        return self.world(~self.ended, torch.zeros(self.n_envs))

    def step(self, decision):
        assert decision.actions.shape == (self.n_envs, 1)
        reset, reward = self.ended, torch.where(self.lives > 0, 100.0, 1.0)
        self.age = torch.where(reset, 0.0, self.age + 1)
        self.ended = (self.age == torch.arange(self.n_envs) + 1) & ~reset
        self.lives += self.ended
        return self.world(reset, torch.where(reset, 0.0, reward))

    def world(self, reset, reward):
        never = torch.zeros_like(reset)
        terminal, truncated = (self.ended, never) if self.mortal else (never, self.ended)
        return arrdict(
            obs=self.age, reward=reward, reset=reset, terminal=terminal, truncated=truncated
        )


@pytest.mark.parametrize("mortal", [False, True])
def test_only_the_first_episode_of_a_lane_counts(mortal):
    env = Counting(100, mortal)
    episodes = evaluation.first_episodes(env, evaluation.RandomActions(env.action_space))
    assert episodes.returns.tolist() == episodes.lengths.tolist() == list(range(1, 101))
    assert bool(episodes.done.all())


def test_an_episode_that_does_not_end_is_reported_as_it_stands():
    env = Counting(100, False)
    episodes = evaluation.first_episodes(
        env, evaluation.RandomActions(env.action_space), max_steps=64
    )
    assert int((~episodes.done).sum()) == 36 and float(episodes.returns.max()) == 64
    assert evaluation.summary(episodes, range(100))["unfinished"] == 36


def test_random_actions_are_spread_evenly_over_every_action():
    space = {"move": spaces.MultiDiscrete(2, 7), "fire": spaces.MultiDiscrete(1, 2)}
    policy = evaluation.RandomActions(arrdict(space))
    decision, _ = policy(
        None, policy.initial(10_000, "cpu"), generator=torch.Generator().manual_seed(1)
    )
    assert decision.actions.move.shape == (10_000, 2) and decision.actions.fire.shape == (10_000, 1)
    shares = torch.bincount(decision.actions.move.flatten(), minlength=7) / 20_000
    assert shares.sub(1 / 7).abs().max() < 0.015  # six standard errors


def test_the_mean_is_exact_and_the_interval_holds_it():
    values = np.random.default_rng(1).normal(5, 2, 400)
    mean, low, high = evaluation.interval(values, np.arange(400))
    assert mean == pytest.approx(values.mean())
    # 2 / sqrt(400) = 0.1 is the standard error; the interval is 1.96 of it to each side, within the
    # bootstrap's noise
    assert mean - low == pytest.approx(0.196, abs=0.03) and high - mean == pytest.approx(
        0.196, abs=0.03
    )


def test_lanes_of_one_home_count_as_one_draw():
    homes = np.random.default_rng(1).normal(0, 1, 50)
    alone = evaluation.interval(homes, np.arange(50))
    again = evaluation.interval(np.repeat(homes, 20), np.repeat(np.arange(50), 20))
    assert again == pytest.approx(alone)


def test_in_one_home_lanes_are_drawn():
    mean, low, high = evaluation.interval([0.0, 1.0] * 200, np.zeros(400))
    assert mean == 0.5 and high - low == pytest.approx(4 * 0.5 / 20, rel=0.15)


def configured(**changes):
    with ConfigLoader("evaluate", Evaluate) as door:
        return dataclasses.replace(
            build(Evaluate, door.tree(["run=latest", "lanes=6", "device=cpu"])), **changes
        )


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run folder, and the folder it was trained from."""
    with ConfigLoader("train", Train) as door, pytest.MonkeyPatch.context() as patch:
        base = tmp_path_factory.mktemp("trained")
        patch.chdir(base)
        return base / train.run(build(Train, door.tree(TINY)))


def test_the_table_is_printed_and_written(trained, capsys):
    assert evaluate.run(configured(run=str(trained))) == trained
    result = json.loads((trained / "evaluation.json").read_text())
    first, second = result["rows"]
    assert (first["agent"], second["agent"]) == ("trained", "random")
    assert (
        first["lanes"] == 6
        and first["homes"] == 1
        and first["return"] == 0
        and 5 <= first["length"] <= 9
    )
    assert result["checkpoint"].endswith("step_32") and result["evaluation"]["split"] == "test"
    for text in (capsys.readouterr().out, (trained / "evaluation.md").read_text()):
        assert (
            "95 % interval" in text
            and "random" in text
            and "minimal in the test homes of box" in text
        )


def test_it_is_reproducible_and_other_homes_can_be_chosen(trained):
    def lengths(**changes):
        evaluate.run(configured(run=str(trained), **changes))
        return [
            row["length"] for row in json.loads((trained / "evaluation.json").read_text())["rows"]
        ]

    with ConfigLoader("evaluate", Evaluate) as door:
        bench = build(Evaluate, door.tree(["run=x", "geometry=bench", "geometry.n=3"])).geometry
    assert lengths() == lengths() != lengths(seed=2)
    evaluate.run(
        configured(
            run=str(trained / "checkpoints" / "step_32"),
            geometry=bench,
            baseline=False,
            greedy=True,
        )
    )
    result = json.loads((trained / "evaluation.json").read_text())
    assert [(row["agent"], row["homes"]) for row in result["rows"]] == [("trained, greedy", 3)]
    assert "bench" in result["title"]


def test_a_checkpoint_of_another_environment_is_refused_with_both_shapes(trained, tmp_path):
    from agents import checkpoint

    loaded = checkpoint.load(trained / "checkpoints")
    loaded.config["train"]["env"]["res"] = 16
    checkpoint.save(tmp_path / "checkpoints", 32, loaded.state, loaded.config)
    with pytest.raises(UserError, match=r"obs was MultiImage\(.*W=8\) and is MultiImage\(.*W=16\)"):
        evaluate.run(configured(run=str(tmp_path)))


def test_a_folder_that_is_no_run_is_refused(tmp_path, capsys):
    assert evaluate.main([f"run={tmp_path}"]) == 2
    assert "is no run" in capsys.readouterr().err
    assert evaluate.main([]) == 2
    assert "run:" in capsys.readouterr().err
