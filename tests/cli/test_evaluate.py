"""Evaluation: first episodes with known returns, intervals checked by hand, and the script."""

import collections
import csv
import dataclasses
import itertools
import json
import shutil

import numpy as np
import pytest
import torch

from megastep import envs, spaces
from megastep.agents import console
from megastep.agents.cli import evaluate, record, train
from megastep.agents.errors import UserError
from megastep.agents.evaluation import playing, statistics, tables
from megastep.agents.runs import checkpoint, scores
from megastep.agents.selfplay.bots.random import RandomActions
from megastep.arrdict import arrdict
from megastep.geometries import files, sample
from tests.helpers import tiny
from tests.helpers.tiny import settings

TINY = [*tiny.TINY, *tiny.SHORT_EPISODES, "samples=1"]


class Counting:
    """Episodes of lane b last b + 1 steps; the reward is 1 in the first and 100 in later ones."""

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
def test_only_first_episodes_count(mortal):
    env = Counting(100, mortal)
    episodes = playing.first_episodes(env, RandomActions(env.action_space))
    assert episodes.returns.tolist() == episodes.lengths.tolist() == list(range(1, 101))
    assert bool(episodes.done.all())


def test_unfinished_episodes():
    env = Counting(100, False)
    episodes = playing.first_episodes(env, RandomActions(env.action_space), max_steps=64)
    assert int((~episodes.done).sum()) == 36 and float(episodes.returns.max()) == 64
    (row,) = statistics.summaries(episodes)
    assert row["unfinished"] == 36


class Teams(Counting):
    """Environments with a leader and two followers; the second follower does not learn.

    The metric at an episode's end is its length, plus 1000 from the second life on; elsewhere it is
    meaningless.
    """

    n_agents, roles = 3, ("leader", "follower", "follower")

    def reset(self):
        self.n_lanes = 3 * self.n_envs
        env = Counting(self.n_lanes, False)
        self.env, world = env, env.reset()
        return self.with_metrics(world)

    def step(self, decision):
        return self.with_metrics(self.env.step(decision))

    def with_metrics(self, world):
        ended = world.terminal | world.truncated
        learns = torch.arange(self.n_lanes) % 3 < 2
        life = 1000 * (self.env.lives - 1)
        metrics = arrdict(age=torch.where(ended, life + self.env.age, -1e9))
        return arrdict(world, learns=learns, metrics=metrics)


def test_summaries_by_role():
    env = Teams(20, False)
    episodes = playing.first_episodes(env, RandomActions(env.action_space))
    ages = torch.arange(1, 61)
    learners = ages % 3 > 0
    assert episodes.metrics.age[learners].tolist() == ages[learners].tolist()
    assert not episodes.lengths[~learners].any()
    every, leader, follower = statistics.summaries(episodes, env.roles)
    for row, lengths in ((every, ages[learners]), (leader, ages[::3]), (follower, ages[1::3])):
        mean = pytest.approx(lengths.float().mean())
        assert row["return"] == row["length"] == row["metrics"]["age"]["mean"] == mean
        assert row["metrics"]["age"]["lower"] == row["lower"] < row["return"] < row["upper"]
        assert row["lanes"] == len(lengths)
    assert (leader["role"], follower["role"]) == ("leader", "follower") and "role" not in every


def test_pairs_are_of_episodes_that_both_played():
    """The other's third episode is of an agent that was not there."""
    returns, envs = torch.tensor([[8.0, 8.0, 8.0], [5.0, 5.0, 0.0]]), torch.arange(3)
    own, other = (episodes_of(row, envs, metrics=arrdict()) for row in returns)
    other["learns"] = envs < 2
    (row,) = statistics.summaries(statistics.difference(own, other))
    assert (row["return"], row["upper"], row["lanes"]) == (3, 3, 2)


def test_nonfinite_metric_is_left_out_of_its_mean():
    """Of `laps`, a half has no number; of `falls`, no episode has one."""
    laps = torch.tensor([2.0, torch.nan, 4.0, torch.inf])
    metrics = arrdict(laps=laps, falls=laps * torch.nan)
    episodes = episodes_of(torch.ones(4), torch.arange(4), metrics=metrics)
    with pytest.warns(UserWarning, match="metrics.laps was not finite at the end of 2 of 4 episo"):
        (row,) = statistics.summaries(episodes)
    assert row["metrics"]["laps"]["mean"] == 3 and row["metrics"]["laps"]["lower"] >= 2
    assert row["metrics"]["falls"] == {"mean": None, "lower": None, "upper": None}


def test_agents_of_one_environment_are_one_sample():
    """Two agents with equal returns: half as many samples as episodes."""
    alike = torch.arange(100.0).repeat_interleave(2)
    envs = torch.arange(100).repeat_interleave(2)
    episodes = episodes_of(alike, envs, metrics=arrdict(laps=alike))
    (row,) = statistics.summaries(episodes)
    expected = statistics.interval(np.arange(100.0), np.arange(100))
    assert (row["return"], row["lower"], row["upper"]) == pytest.approx(expected)
    assert row["metrics"]["laps"]["lower"] == row["lower"] and row["lanes"] == 200
    in_one_home = arrdict(episodes, homes=torch.full((200,), 7))
    assert statistics.summaries(in_one_home)[0]["lower"] == row["lower"]


def test_metrics_average_over_finished_episodes():
    env = Teams(20, False)
    random = RandomActions(env.action_space)
    (row,) = statistics.summaries(playing.first_episodes(env, random, max_steps=10))
    assert row["unfinished"] == 40 - 7
    assert row["metrics"]["age"]["mean"] == (1 + 2 + 4 + 5 + 7 + 8 + 10) / 7
    (row,) = statistics.summaries(playing.first_episodes(env, random, max_steps=0))
    assert row["metrics"]["age"] == dict(mean=None, lower=None, upper=None)
    shown = tables.cells({"agent": "a", **row})
    assert shown["age"] == shown["age: 95 % interval"] == "none"


EXPLORER = [
    *("env=explorer", "env.n_envs=4", "env.patience=1", "env.res=4", "env.subsample=1"),
    *("agent.width=8", "learner.n_steps=8", "learner.n_minibatches=2", "device=cpu", "samples=1"),
]
MAZES = ["run=x", "geometry=maze", "geometry.n=4", "geometry.size=3"]


@pytest.fixture
def played(monkeypatch):
    """The environment and the episodes of each evaluation."""
    played, first_episodes = [], playing.first_episodes

    def spied(env, *args):
        played.append((env, first_episodes(env, *args)))
        return played[-1][1]

    monkeypatch.setattr(playing, "first_episodes", spied)
    return played


def episodes_of(returns, envs, **others):
    """Returns finished episodes of one step."""
    ones = torch.ones(len(returns))
    flags = dict(done=ones > 0, learns=ones > 0)
    return arrdict(returns=returns, lengths=ones, envs=envs, **flags, **others)


def lanes_of_homes(sizes, random):
    """Returns (returns of ``sizes[h]`` lanes in each home h, homes of the lanes)."""
    homes = np.repeat(np.arange(len(sizes)), sizes)
    return random.normal(np.arange(len(sizes))[homes], 1.0), homes


class Moving:
    """An Explorer that records the home in which each lane's first episode ends."""

    def __init__(self, *args, **settings):
        self.env = envs.Explorer(*args, res=1, subsample=1, patience=1, **settings)
        self.last = torch.full((self.env.n_envs,), -1)

    def __getattr__(self, name):
        return getattr(self.env, name)

    def step(self, decision):
        world, scenery = self.env.step(decision), self.env.core.scenery
        ended = (world.terminal | world.truncated) & (self.last < 0)
        self.last = torch.where(ended, scenery.layout.long(), self.last)
        return world


@pytest.mark.parametrize("resample", [False, True])
def test_homes_of_first_episodes(resample):
    env = Moving(10, sample("bench", 4), device="cpu", resample=resample)
    episodes = playing.first_episodes(env, RandomActions(env.action_space))
    assert bool(episodes.done.all())
    assert torch.equal(episodes.homes.long(), env.last)
    assert torch.equal(env.layout, torch.arange(10) % 4) != resample


def test_interval_weighs_homes_by_lanes():
    """One lane that earned 0 in one home, three that earned 4 in another. Of the resamples of two
    homes half hold both: (0 + 3 * 4) / 4 = 3, not the mean of the homes' means, 2.
    """
    mean, lower, upper = statistics.interval([0.0, 4.0, 4.0, 4.0], [0, 1, 1, 1], level=0.4)
    assert mean == lower == upper == 3


@pytest.mark.parametrize("sizes", [(1, 5, 2), (3, 3, 3), (1, 1, 7, 2)])
def test_interval_matches_exhaustive_bootstrap(sizes):
    values, homes = lanes_of_homes(sizes, np.random.default_rng(3))
    tries = []
    for resample in itertools.product(range(len(sizes)), repeat=len(sizes)):
        drawn = [value for home in resample for value in values[homes == home]]
        tries.append(sum(drawn) / len(drawn))
    interval = statistics.interval(values, homes, level=0.8, n_resamples=200_000)
    assert interval == pytest.approx((values.mean(), *np.quantile(tries, [0.1, 0.9])), abs=0.02)


def configured(**changes):
    words = ["run=latest", "episodes=6", "device=cpu"]
    return dataclasses.replace(settings(*words, script="evaluate"), **changes)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """The folder of a run."""
    with pytest.MonkeyPatch.context() as patch:
        base = tmp_path_factory.mktemp("trained")
        patch.chdir(base)
        return base / train.run(settings(*TINY))


def test_evaluate_prints_and_writes_a_table(trained, capsys):
    written = evaluate.run(configured(run=str(trained)))
    assert written == trained / "evaluations" / "box-test-32.json"
    result = json.loads(written.read_text())
    first, second = result["rows"]
    assert (first["agent"], second["agent"]) == ("trained", "random")
    assert (first["lanes"], first["homes"], first["return"]) == (6, 1, 0)
    assert 5 <= first["length"] <= 9
    assert result["checkpoint"].endswith("step_32") and result["evaluation"]["split"] == "test"
    title = "minimal: 6 episodes in 1 home, geometry=box, split=test, after 32 samples (step_32)"
    for text in (capsys.readouterr().out, written.with_suffix(".md").read_text()):
        assert "95 % interval" in text and "random" in text and f"{title}, seed 1" in text
    row = dict(evaluated=0.0, lower=0.0, upper=0.0)
    assert scores.outcome(written) == dict(score=0.0, **row)
    assert row.items() <= scores.outcome(trained).items()


def test_evaluate_shows_how_many_episodes_have_ended(trained, monkeypatch, capsys):
    monkeypatch.setattr(console, "LINE_EVERY", 0)
    words = [f"run={trained}", "episodes=4", "baseline=none", "max_steps=9", "device=cpu"]
    assert evaluate.main(words) == 0
    assert capsys.readouterr().out.startswith("0 of 4 episodes\n")


def test_evaluate_is_reproducible(trained):
    shutil.rmtree(trained / "evaluations", ignore_errors=True)  # of other tests

    def lengths(**changes):
        written = evaluate.run(configured(run=str(trained), **changes))
        return [row["length"] for row in json.loads(written.read_text())["rows"]]

    words = ["run=x", "geometry=bench", "geometry.n=3"]
    bench = settings(*words, script="evaluate").geometry
    assert lengths() == lengths() != lengths(seed=2)
    path = str(trained / "checkpoints" / "step_32")
    written = evaluate.run(configured(run=path, geometry=bench, baseline=False, greedy=True))
    result = json.loads(written.read_text())
    assert [(row["agent"], row["homes"]) for row in result["rows"]] == [("trained, greedy", 3)]
    evaluate.run(configured(run=str(trained), split="training", baseline=False))
    names = {path.name for path in (trained / "evaluations").iterdir()}
    tables = "box-test-32", "box-training-32", "bench-test-32-greedy"
    assert names == {f"{name}.{kind}" for name in tables for kind in ("json", "md", "csv")}


def test_evaluate_in_homes_from_a_file(trained, tmp_path):
    files.save(tmp_path / "plans.npz", sample("homes", 3))
    words = ["run=x", "geometry=files", f"geometry.path={tmp_path / 'plans.npz'}"]
    plans = settings(*words, script="evaluate").geometry
    written = evaluate.run(
        configured(run=str(trained), geometry=plans, split="all", baseline=False)
    )
    assert written.name == "files-plans-all-32.json"
    result = json.loads(written.read_text())
    assert "in 3 homes, geometry=files (plans.npz), split=all, " in result["title"]
    assert result["rows"][0]["homes"] == 3


def test_metrics_of_each_part_of_a_mix(here, played, capsys):
    """Of six episodes in three homes each, those in homes 1 and 4 are in a maze."""
    house = "{source: megastep.geometries.sources:bench, n: 1}"
    words = ["geometry=mixed", f"geometry.parts={{homes: 1, maze: 1, house: {house}}}"]
    written = evaluate.run(configured(run=str(train.run(settings(*EXPLORER, *words))), episodes=6))
    assert written.name.startswith("mixed-test-")
    rows = json.loads(written.read_text())["rows"]
    sources = [None, "homes", "maze", "house"]
    assert [(row["agent"], row.get("source")) for row in rows] == [
        (agent, source) for agent in ("trained", "random") for source in sources
    ]
    every, _, maze, house = rows[:4]
    assert (every["lanes"], maze["lanes"], maze["homes"]) == (6, 2, 1)
    (_, episodes), _ = played
    for row, lanes in (maze, [1, 4]), (house, [2, 5]):
        assert row["return"] == pytest.approx(episodes.returns[lanes].mean().item())
        for name, values in episodes.metrics.items():
            assert row["metrics"][name]["mean"] == pytest.approx(values[lanes].mean().item())
    assert "trained, in maze" in capsys.readouterr().out


# ---- The suite ----


@pytest.fixture
def explorer(here):
    """A run of an explorer."""
    return train.run(settings(*EXPLORER, "geometry=box"))


def test_suite_evaluates_each_source_by_itself(explorer, capsys):
    parts = "{dense: {source: homes, n: 3, density: 1.5}, maze: {n: 2, size: 3}, box: 1}"
    words = ["run=x", "geometry=suite", f"geometry.parts={parts}"]
    suite = settings(*words, script="evaluate").geometry
    written = evaluate.run(configured(run=str(explorer), geometry=suite, episodes=6))
    assert written.name.startswith("suite-test-")
    result = json.loads(written.read_text())
    assert "explorer: 6 episodes in each source in 6 homes, geometry=suite" in result["title"]
    rows = [row for row in result["rows"] if row["agent"] == "trained"]
    assert rows == result["rows"][:3] and len(result["rows"]) == 6
    assert [row["source"] for row in rows] == ["dense", "maze", "box"]
    assert [(row["lanes"], row["homes"]) for row in rows] == [(6, 3), (6, 2), (6, 1)]
    assert "trained, in dense" in capsys.readouterr().out
    alone = settings("run=x", "geometry=maze", "geometry.n=2", "geometry.size=3", script="evaluate")
    alone = evaluate.run(configured(run=str(explorer), geometry=alone.geometry, episodes=6))
    alone = json.loads(alone.read_text())["rows"][0]
    assert alone.items() <= rows[1].items(), "as in an evaluation of that source alone"


@pytest.mark.parametrize("geometry", ["suite", "maze"])
def test_a_geometry_that_the_environment_does_not_take_is_refused(here, geometry):
    pong = ["env=pong", "env.n_envs=4", "learner.n_steps=8", "agent.width=8"]
    run = train.run(settings(*pong, "learner.n_minibatches=2", "device=cpu", "samples=1"))
    typed = settings("run=x", f"geometry={geometry}", script="evaluate").geometry
    message = f"pong takes no floor plans, so it cannot be played in geometry={geometry}"
    with pytest.raises(UserError, match=message):
        evaluate.run(configured(run=str(run), geometry=typed))
    with pytest.raises(UserError, match=message):
        words = f"run={run}", f"geometry={geometry}", "steps=2", "device=cpu"
        record.run(settings(*words, script="record"))
    assert not (run / "evaluations").exists() and not (run / "video.mp4").exists()


def test_evaluate_keeps_lanes_in_one_home(here, played):
    """Ten lanes in four homes: rounded up to three in each."""
    homes = ["geometry=bench", "geometry.n=4", "env.resample=true"]
    run = train.run(settings(*EXPLORER, *homes))
    evaluate.run(configured(run=str(run), split="all", episodes=10, baseline=False))
    ((env, episodes),) = played
    assert episodes.homes.tolist() == [0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3]
    assert torch.equal(env.core.scenery.layout, episodes.homes)


class Homeless(envs.Minimal):
    """Does not tell which home an environment is in."""

    layout = None


def test_environment_without_a_layout_is_warned_of(here, capsys):
    train.run(settings("env=test_evaluate:Homeless", *TINY[1:], "folder=run"))
    homes = settings("run=x", "geometry=homes", "geometry.n=3", script="evaluate").geometry
    written = evaluate.run(configured(run="run", geometry=homes, baseline=False))
    result = json.loads(written.read_text())
    assert result["rows"][0]["homes"] is None
    assert result["title"].startswith("homeless: 6 episodes, geometry=homes, split=test, ")
    assert "Homeless has no `layout`" in capsys.readouterr().err
    evaluate.run(configured(run="run", baseline=False))
    assert "layout" not in capsys.readouterr().err, "the box is one home"


def test_evaluate_refuses_another_environment(trained, tmp_path):
    loaded = checkpoint.load_latest(trained / "checkpoints")
    loaded.config["train"]["env"]["res"] = 16
    checkpoint.save(tmp_path / "checkpoints", 32, loaded.state, loaded.config)
    with pytest.raises(UserError, match=r"obs was MultiImage\(.*W=8\) and is MultiImage\(.*W=16\)"):
        evaluate.run(configured(run=str(tmp_path)))


# ---- Single episodes ----


def test_episodes_are_written_one_by_one(explorer):
    """The rows' means are those of the table, and each home has as many."""
    homes = settings(*MAZES, script="evaluate").geometry
    bots = ["random", "explorer"]
    written = evaluate.run(configured(run=str(explorer), geometry=homes, baseline=bots))
    result = json.loads(written.read_text())
    with open(written.with_suffix(".csv"), newline="") as file:
        rows = [*csv.DictReader(file)]
    assert [row["agent"] for row in result["rows"]] == ["trained", *bots]
    for row in result["rows"]:
        own = [each for each in rows if each["agent"] == row["agent"]]
        assert row["lanes"] == len(own) == 8  # six, rounded up to as many in each of four homes
        assert collections.Counter(each["home"] for each in own) == dict.fromkeys("0123", 2)
        for name, mean in {
            "return": row["return"],
            "length": row["length"],
            "coverage": row["metrics"]["coverage"]["mean"],
        }.items():
            assert np.mean([float(each[name]) for each in own]) == pytest.approx(mean)
        assert {each["ended"] for each in own} <= {"terminal", "truncated"}
        spots = {(each["start_x"], each["start_y"], each["start_angle"]) for each in own}
        assert len(spots) == 8
    columns = result["episodes"]
    assert columns["return"] == [float(row["return"]) for row in rows]
    assert columns["source"] == ["maze"] * 24 if "source" in columns else True


def test_evaluations_are_paired(explorer):
    """Everybody starts from the same places, the random row is the same beside any agent, and the
    interval of a difference is that of the pairs, by home.
    """
    words = [*EXPLORER, "geometry=box", "seed=2", "learner.lr=0.01", "folder=other/run"]
    others = [str(explorer), str(train.run(settings(*words)))]
    homes = settings(*MAZES, script="evaluate").geometry
    found = []
    for run, other in (others, others[::-1]):
        baseline = ["explorer", other, "random"]
        written = evaluate.run(configured(run=run, geometry=homes, baseline=baseline))
        found.append(json.loads(written.read_text()))
    first, second = (result["episodes"] for result in found)
    starts = np.array([first[key] for key in ("home", "start_x", "start_y", "start_angle")])
    starts = starts.reshape(4, 4, 8)
    assert (starts == starts[:, :1]).all() and len(np.unique(starts[1, 0])) == 8
    assert found[0]["rows"][3] == found[1]["rows"][3], "the random row"
    assert first["return"][:8] == second["return"][16:24] != first["return"][16:24]
    returns = np.array(first["return"]).reshape(4, 8)
    row = found[0]["differences"][2]
    assert row["agent"] == "trained - random"
    expected = statistics.interval(returns[0] - returns[3], starts[0, 0])
    assert (row["return"], row["lower"], row["upper"]) == pytest.approx(expected)
    assert "trained - random" in written.with_suffix(".md").read_text()


def test_rows_of_different_runs_have_different_names(explorer):
    names = [str(shutil.copytree(explorer, name)) for name in ("a/run", "b/run")]
    written = evaluate.run(configured(run=names[0], baseline=[*names, "random"]))
    agents = [row["agent"] for row in json.loads(written.read_text())["rows"]]
    assert agents == ["trained", *(f"run, 32 samples ({name})" for name in names), "random"]


def test_a_name_of_nobody_names_the_bots(explorer):
    for name, sentence in {
        "explorerr": r"neither a run folder .*\(bots are bot, explorer, hunter, mapper, ",
        "bot": "Explorer has no bot of its own; name one, such as explorer, hunter, mapper, ",
    }.items():
        with pytest.raises(UserError, match=sentence):
            evaluate.run(configured(run=str(explorer), baseline=[name]))
