"""Duels and ratings: of players with known chances, and of runs of Pong by the scripts."""

import csv
import json
import math
import re

import numpy as np
import pytest
import torch

from megastep import recording
from megastep.agents.cli import evaluate, record, train
from megastep.agents.evaluation import evaluate_run, playing, statistics
from megastep.agents.evaluation.statistics import interval
from megastep.agents.factory import make as factory
from megastep.agents.runs import checkpoint, scores
from megastep.agents.selfplay.mixed_policy import MixedPolicy
from megastep.arrdict import arrdict
from tests.cli.test_train import configured
from tests.helpers.games import Always, Matrix

# ---- Duels ----


def test_stronger_player_wins_from_every_slot():
    played = playing.first_duels(Matrix(64), Always(2), Always(0))
    assert (played.score == 1).all() and (played.lengths == 1).all()
    assert playing.first_duels(Matrix(64), Always(0), Always(2)).score.sum() == 0
    assert played.slots.tolist() == [0] * 32 + [1] * 32


@pytest.mark.parametrize("words", ["against=bot", "ratings=true"])
def test_one_agent_alone_is_refused_before_homes_are_made(words, monkeypatch, capsys):
    homes, made = factory.homes, []
    monkeypatch.setattr(factory, "homes", lambda *how: made.append(how[1].name) or homes(*how))
    assert evaluate.main(["run=explorer_anywhere", "geometry=suite", "device=cpu", words]) == 2
    assert "at least two agents, and Explorer has one" in capsys.readouterr().err
    assert len(made) == 1 and made[0].endswith(":box")


@pytest.mark.parametrize("mortal", [False, True])
def test_win_share_matches_independent_count(mortal):
    """Each player chooses its own number with probability 1/2, else any of three."""
    env = Matrix(2000, mortal=mortal)
    played = playing.first_duels(env, Always(2, chance=0.5), Always(0, chance=0.5))
    # the first step with different numbers decides
    actions = torch.stack(env.played)  # (T, E, 2)
    first = (actions[:, :, 0] != actions[:, :, 1]).int().argmax(0)
    decisive = actions[first, torch.arange(2000)]
    mine = decisive.gather(1, played.slots[:, None])[:, 0]
    assert torch.equal(played.score, (mine == decisive.amax(1)).float())
    assert torch.equal(played.lengths, first + 1.0)
    # by hand: the probabilities of 0, 1 and 2, for either player
    me, other = np.array([1, 1, 4]) / 6, np.array([4, 1, 1]) / 6
    win, lose = (
        sum(a[i] * b[j] for i in range(3) for j in range(i)) for a, b in ((me, other), (other, me))
    )
    mean, lower, upper = interval(played.score.numpy())
    assert lower < win / (win + lose) < upper and upper - lower < 0.04
    (row,) = statistics.summaries(played)
    assert row["won"] == mean and row["wins"] + row["losses"] == row["duels"] == 2000


def test_only_first_duel_counts():
    class Turning(Always):
        """Wins the first duel and loses all others."""

        def __call__(self, world, state, *rest):
            decision, state = super().__call__(world, state, *rest)
            self.action = 0
            return decision, state

    played = playing.first_duels(Matrix(4), Turning(2), Always(1), max_steps=200)
    assert (played.score == 1).all() and (played.lengths == 1).all()


def test_first_death_loses():
    """Four agents; those below the highest number die."""
    env = Matrix(16, 4, mortal=True)
    assert (playing.first_duels(env, Always(2), Always(1)).score == 1).all()
    assert (playing.first_duels(env, Always(1), Always(2)).score == 0).all()
    played = playing.first_duels(env, Always(2), Always(1))
    assert played.slots.bincount().tolist() == [4, 4, 4, 4]


def test_teams_duel_where_agents_have_roles():
    env = Matrix(8, 3, roles=("prey", "hunter", "hunter"))
    played = playing.first_duels(env, Always(2), Always(0))
    assert (played.score == 1).all() and played.slots.tolist() == [0] * 4 + [1] * 4
    assert env.played[0].tolist() == [[2, 0, 0]] * 4 + [[0, 2, 2]] * 4


def test_intervals_are_over_homes():
    env = Matrix(8)
    env.layout = torch.arange(4, dtype=torch.int32).repeat(2)
    played = playing.first_duels(env, Always(2), Always(0))
    assert played.homes.tolist() == [0, 1, 2, 3, 0, 1, 2, 3]
    # each home was played in from both slots
    pairs = set(zip(played.homes.tolist(), played.slots.tolist(), strict=True))
    assert len(pairs) == 8
    assert statistics.summaries(played)[0]["homes"] == 4
    score = torch.tensor([1.0, 0, 0, 0, 1, 0, 0, 0])
    (row,) = statistics.summaries(arrdict(played, score=score))
    assert (row["won"], row["lower"], row["upper"]) == interval(score.numpy(), played.homes.numpy())


def test_rows_by_role():
    """Of three agents, the second and the third are hunters; whoever plays a hunter loses."""
    played = arrdict(
        score=torch.tensor([1.0, 1, 0.5, 0, 0, 0]),
        lengths=torch.tensor([2.0, 4, 6, 8, 10, 12]),
        slots=torch.tensor([0, 0, 1, 1, 2, 2]),
        homes=torch.tensor([0, 1, 0, 1, 0, 1]),
    )
    every, prey, hunter = statistics.summaries(played, ("prey", "hunter", "hunter"))
    assert (prey["role"], hunter["role"]) == ("prey", "hunter") and "role" not in every
    assert (every["duels"], prey["duels"], hunter["duels"]) == (6, 2, 4)
    assert (every["won"], prey["won"], hunter["won"]) == (2.5 / 6, 1, 0.125)
    assert (hunter["length"], hunter["homes"], hunter["draws"]) == (9, 2, 1)
    expected = interval([0.5, 0, 0, 0], [0, 1, 0, 1])
    assert (hunter["won"], hunter["lower"], hunter["upper"]) == expected


# ---- Mixed policies ----


class Echo:
    """Acts as it observes; its hidden state is the first observation."""

    def initial(self, n_lanes, device=None):
        return arrdict(first=torch.zeros(n_lanes, 1))

    def __call__(self, world, state, sample=True, generator=None):
        first = torch.where(world["reset"][:, None], world["obs"], state.first)
        return arrdict(actions=world["obs"].long() + self.more), arrdict(first=first)


@pytest.mark.parametrize("split", [[[0, 1, 2, 3], [4, 5]], [[5, 0, 3], [4], [1, 2]]])
def test_mixed_policy_lanes_and_hidden_states(split):
    players = [Echo() for _ in split]
    for i, player in enumerate(players):
        player.more = 100 * i
    lineup = MixedPolicy(players, [torch.tensor(lanes) for lanes in split])
    state = lineup.initial(6, "cpu")
    expected = [10 * lane + 100 * i for i, lanes in enumerate(split) for lane in lanes]
    order = [lane for lanes in split for lane in lanes]
    for step, reset in ((0, True), (1, False)):
        obs = 10 * torch.arange(6.0)[:, None] + step
        world = arrdict(obs=obs, reset=torch.full((6,), reset), privileged=None)
        decision, state = lineup(world, state)
        action_of = dict(zip(order, expected, strict=True))
        assert decision.actions[:, 0].tolist() == [action_of[lane] + step for lane in range(6)]
    for i, lanes in enumerate(split):
        assert state[str(i)].first[:, 0].tolist() == [10 * lane for lane in lanes]


# ---- Ratings ----


def test_ratings_match_the_model():
    """Each wins 73 % against the next, e to 1: by the model that is 25 / 6 times 2**.5 apart."""
    random = np.random.default_rng(1)
    strength, gap = [2, 0, 1, 3], 25 / 6 * 2**0.5
    scores = {
        (i, j): (random.random(300) < 1 / (1 + math.exp(strength[j] - strength[i]))).astype(float)
        for i in range(4)
        for j in range(i)
    }
    means = [mean for mean, _ in evaluate_run.rate(4, scores)]
    assert sorted(range(4), key=means.__getitem__) == [1, 2, 0, 3]
    assert np.diff(np.sort(means)) == pytest.approx([gap] * 3, abs=1)  # a standard deviation


# ---- The scripts ----

HIGH = "tests.helpers.games:High"
PONG = [
    *("env=pong", "env.self_play=true", "env.n_envs=8", "agent.width=8"),
    *("agent.core=none", "learner.n_steps=16", "learner.n_minibatches=2", "device=cpu"),
    "logging.every=1",
]
UPDATE = 16 * 16


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A folder with runs a and b in self-play (a with snapshots), pixels and minimal."""
    base = tmp_path_factory.mktemp("runs")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(base)
        four = [f"samples={4 * UPDATE}", "checkpoints.snapshots=2", "folder=a"]
        train.run(configured(*four, tiny=PONG))
        train.run(configured(f"samples={UPDATE}", "folder=b", "seed=2", tiny=PONG))
        wider = [f"samples={UPDATE}", "folder=pixels", "env.pixels=true"]
        train.run(configured(*wider, tiny=PONG))
        train.run(configured("samples=1", "folder=minimal"))
    return base


@pytest.fixture
def here(trained, monkeypatch):
    monkeypatch.chdir(trained)
    return trained


def test_snapshots_are_spread_over_the_budget(here):
    names = {path.name for path in (here / "a" / "snapshots").iterdir()}
    assert names == {f"step_{2 * UPDATE}", f"step_{4 * UPDATE}"}
    assert not (here / "b" / "snapshots").exists()
    last = checkpoint.load_latest(here / "a" / "snapshots").state
    assert set(last) == {"policy"}
    weights = checkpoint.load_latest(here / "a" / "checkpoints").state["policy"]
    assert all(torch.equal(weights[name], last["policy"][name]) for name in weights)


def test_evaluate_against(here, capsys):
    names = f"a/snapshots/step_{2 * UPDATE},b,random,bot,{HIGH}"
    assert evaluate.main(["run=a", f"against={names}", "episodes=20", "device=cpu"]) == 0
    (path,) = (here / "a" / "evaluations").glob("duels-*.json")
    result = json.loads(path.read_text())
    overall = [row for row in result["rows"] if "role" not in row]
    runs = [f"a, {2 * UPDATE:,} samples", f"b, {UPDATE:,} samples"]
    assert [row["against"] for row in overall] == [*runs, "random", "bot", HIGH]
    for i, row in enumerate(overall):
        assert row["duels"] == row["wins"] + row["draws"] + row["losses"] == 20
        assert row["lower"] <= row["won"] <= row["upper"] and row["homes"] is None
        left, right = result["rows"][3 * i + 1 : 3 * i + 3]
        assert (left["role"], right["role"]) == ("left", "right")
        assert left["duels"] == right["duels"] == 10
        assert row["won"] == pytest.approx((left["won"] + right["won"]) / 2)
    text = path.with_suffix(".md").read_text()
    assert "95 % interval" in text and "95 % interval" in capsys.readouterr().out
    assert "random, as left" in text and "in pong: 20 duels, seed 1" in text
    row = result["rows"][0]
    expected = dict(score=row["won"], evaluated=row["won"], lower=row["lower"])
    assert expected.items() <= scores.outcome(path).items()
    assert scores.outcome(here / "a")["evaluated"] is None, "a duel's table has no return"


def test_evaluate_ratings(here, capsys):
    words = "ratings=true", "against=random", "episodes=8", "device=cpu"
    assert evaluate.main(["run=a", *words]) == 0
    with open(here / "a" / "ratings.csv") as file:
        rows = list(csv.DictReader(file))
    names = [f"{n * UPDATE:,} samples" for n in (2, 4)]
    assert [row["player"] for row in rows] == [*names, "random"]
    assert [row["samples"] for row in rows] == [str(2 * UPDATE), str(4 * UPDATE), ""]
    assert all(row["duels"] == "16" for row in rows)
    assert "rating" in capsys.readouterr().out


def test_record_against(here, capsys, monkeypatch):
    drawn = []

    def film(players, place, *rest, **look):
        drawn.extend((player.env, player.policy) for player in players)
        return place

    words = "run=a", "steps=2", "file=c.png", "device=cpu"
    assert record.main([*words, "against=b"]) == 0
    assert (here / "c.png").exists()
    monkeypatch.setattr(recording, "film_all", film)
    assert record.main([*words, f"against={HIGH}"]) == 0
    ((env, lineup),) = drawn
    assert env.n_envs == 1 and lineup.sizes == [1, 1] and lineup.lanes.tolist() == [0, 1]
    assert type(lineup.policies[1]).__name__ == "High"
    assert "the other is tests.helpers.games:High" in capsys.readouterr().out


@pytest.mark.parametrize(
    "name, sentence",
    [
        ("pixels", "was trained in another environment: obs was MultiImage.* and is MultiVector"),
        ("minimal", "was trained in minimal and .* in pong"),
        ("tests.helpers.games:Hihg", "tests.helpers.games has no Hihg; did you mean High"),
        ("tests.helpers.games:Matrix", "tests.helpers.games:Matrix cannot play in Pong"),
        ("test_duels:Elsewhere", "cannot play in Pong.*its actions are not those of MultiDiscrete"),
        ("nowhere", "nowhere is neither a run folder nor a pretrained agent"),
    ],
)
def test_opponent_errors(here, capsys, name, sentence):
    assert evaluate.main(["run=a", f"against={name}", "device=cpu"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(sentence, line)


class Elsewhere(Always):
    def __init__(self):
        super().__init__(3)


MATRIX = ["env=tests.helpers.games:Matrix", "env.n_envs=4", *PONG[3:], "samples=1", "folder=run"]


def test_duel_homes_and_slots(tmp_path, monkeypatch):
    """Three agents learn, two duel. Of 40 duels, each of 7 homes gets two from each slot."""
    monkeypatch.chdir(tmp_path)
    train.run(configured("env.n_agents=3", "geometry=homes", "geometry.n=7", tiny=MATRIX))
    played, real = [], playing.first_duels

    def play(env, *rest, **options):
        played.append((env, real(env, *rest, **options)))
        return played[-1][1]

    monkeypatch.setattr(playing, "first_duels", play)
    words = f"against={HIGH}", "episodes=40", "device=cpu"
    assert evaluate.main(["run=run", *words]) == 0
    ((env, result),) = played
    assert (env.n_envs, env.n_agents) == (28, 2)
    counts = torch.stack([result.homes, result.slots.int()], 1).unique(dim=0, return_counts=True)[1]
    assert counts.tolist() == [2] * 14
    (path,) = (tmp_path / "run" / "evaluations").glob("*.json")
    table = json.loads(path.read_text())
    assert table["rows"][0]["homes"] == 7
    assert "matrix: 28 duels in 7 homes, geometry=homes, split=test, seed 1" in table["title"]
