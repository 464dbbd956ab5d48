"""Training against opponents as the command line does it."""

import pytest
import torch
from test_arena import PONG, UPDATE
from test_train import configured

from megastep import capture
from megastep.agents.cli import arena, evaluate, train
from megastep.agents.cli.compose import ConfigLoader
from megastep.agents.cli.settings import Evaluate, Record, Train
from megastep.agents.training import checkpoint, loggers
from megastep.engine import devices
from megastep.envs.pong.step import CELL
from tests.helpers import pages
from tests.helpers.games import Always

SHARES = ["opponents.past=0.5", "opponents.bot=0.25", "opponents.snapshots=2", "opponents.every=2"]
OPPOSED = [*PONG, *SHARES, "opponents.bot_class=tests.helpers.games:High", "env.limit=5"]
#: Samples of an update: two environments of two lanes that learn, six of one.
SMALLER = 10 * 16


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def actors(folder):
    return checkpoint.load_latest(folder / "checkpoints").state["opponents"]["actors"]


def same(a, b):
    return all(torch.equal(a[name], b[name]) for name in a)


def test_every_command_of_the_page_composes_and_its_policy_plays(here, monkeypatch):
    text = (pages.ROOT / "docs" / "self-play.md").read_text()
    typed = pages.commands(text)
    assert {script for script, _ in typed} == set(pages.MAINS)
    for script, words in typed:
        name = script.removesuffix(".py")
        kind = dict(train=Train, evaluate=Evaluate, record=Record)[name]
        if script == "evaluate.py":
            words = [arena.listed(word) if word.startswith("against=") else word for word in words]
        with ConfigLoader(name, kind) as loader:
            loader.tree(words)
    folder = train.run(configured("samples=1", tiny=PONG))
    (here / "tracker.py").write_text(pages.code(text)[0])
    with pages.inside(here, monkeypatch):
        against = "against=tracker:Tracker,random"
        assert evaluate.main([f"run={folder}", against, "episodes=40", "device=cpu"]) == 0
        first = ["ratings=true", "against=tracker:Tracker,random", "episodes=40", "device=cpu"]
        assert evaluate.main([f"run={folder}", *first]) == 0
    ratings = (folder / "ratings.csv").read_text().splitlines()[-2:]
    tracker, random = (float(row.split(",")[-4]) for row in ratings)
    assert tracker > random + 5


def test_a_run_against_opponents_tells_how_it_does_against_each(here):
    folder = train.run(configured(f"samples={6 * SMALLER}", tiny=OPPOSED))
    rows = loggers.read(folder / "metrics.jsonl")
    assert [row["samples"] for row in rows] == [SMALLER * (i + 1) for i in range(6)]
    assert {f"episode/return/{name}" for name in ("left", "right", "now", "past", "bot")} <= set(
        rows[0]
    )
    assert evaluate.main([f"run={folder}", "against=bot", "episodes=4", "device=cpu"]) == 0
    (path,) = folder.glob("evaluations/*.md")
    assert "tests.helpers.games:High" in path.read_text(), "bot is the one that the run has met"


class Told(Always):
    """Is told of the environment what it asks for."""

    def __init__(self, points, limit=7, other=3):
        super().__init__()
        assert (points, limit, other) == (2, 5, 3)


def test_a_scripted_policy_is_given_the_settings_that_it_takes(here):
    words = [f"samples={SMALLER}", "env.points=2", "opponents.bot_class=test_self_play:Told"]
    folder = train.run(configured(*words, tiny=OPPOSED))
    assert evaluate.main([f"run={folder}", "against=bot", "episodes=2", "device=cpu"]) == 0


def test_without_opponents_a_run_is_as_it_was(here):
    """No share: nothing in the checkpoint, in the metrics, and every lane is a sample."""
    folder = train.run(configured(f"samples={2 * UPDATE}", tiny=[*PONG, "env.limit=5"]))
    rows = loggers.read(folder / "metrics.jsonl")
    assert rows[-1]["samples"] == 2 * UPDATE and "episode/return/left" in rows[-1]
    ours = ("/now", "/past", "/bot")
    assert not any(name.endswith(ours) or name.startswith("episode/won") for name in rows[-1])
    assert "opponents" not in checkpoint.load_latest(folder / "checkpoints").state


def test_a_resumed_run_has_the_pool_it_had(here):
    folder = train.run(configured(f"samples={2 * SMALLER}", tiny=OPPOSED))
    saved = actors(folder)
    assert not same(saved["0"], saved["1"]), "the first was renewed after two updates"
    train.run(configured(f"resume={folder}", f"samples={3 * SMALLER}", tiny=[]))
    after = actors(folder)
    assert all(same(after[name], saved[name]) for name in saved)
    train.run(configured(f"resume={folder}", f"samples={4 * SMALLER}", tiny=[]))
    later = actors(folder)
    assert same(later["0"], saved["0"]) and not same(later["1"], saved["1"])


def test_a_run_from_the_weights_of_another_begins_with_them_as_past_selves(here):
    first = train.run(configured(f"samples={UPDATE}", tiny=PONG))
    second = train.run(configured(f"init={first}", f"samples={SMALLER}", tiny=OPPOSED))
    weights = checkpoint.load_latest(first / "checkpoints").state["policy"]
    assert all(same(actor, weights) for actor in actors(second).values())


def test_snapshots_can_be_started_from_but_not_gone_on_from(here, capsys):
    folder = train.run(configured(f"samples={2 * UPDATE}", "snapshots=1", tiny=PONG))
    snapshot = folder / "snapshots" / f"step_{2 * UPDATE}"
    train.run(configured(f"init={snapshot}", f"samples={UPDATE}", tiny=PONG))
    assert train.main([f"resume={snapshot}", "samples=1e6"]) == 2
    assert "is a snapshot, the weights alone; init=" in capsys.readouterr().err


def test_snapshots_of_a_run_that_goes_on_are_spaced_over_its_new_budget(here):
    """Half of seven updates is over when the second part begins, after four."""
    folder = train.run(configured(f"samples={4 * UPDATE}", "snapshots=2", tiny=PONG))
    train.run(configured(f"resume={folder}", f"samples={7 * UPDATE}", tiny=[]))
    names = {path.name for path in (folder / "snapshots").iterdir()}
    assert names == {f"step_{n * UPDATE}" for n in (2, 4, 7)}


class Elsewhere(Always):
    """Made for an environment that shows something else."""

    def __call__(self, world, state, sample=True, generator=None):
        return super().__call__(world, state, world["obs"]["rgb"])


@pytest.mark.parametrize(
    "words, sentence",
    [
        (["env.self_play=false"], "two agents or more, and Pong has one"),
        (["opponents.past=0.9"], "opponents.past=0.9 and opponents.bot=0.25 are shares"),
        (["opponents.snapshots=5"], "one for each of so many snapshots and not for 5"),
        (["opponents.snapshots=0"], "opponents.snapshots: 0 is out of range"),
        (["opponents.bot_class=tests.helpers.games:Hihg"], "did you mean High?"),
        (["opponents.bot_class=test_self_play:Elsewhere"], "Elsewhere cannot play in Pong"),
        (["samples=null", "snapshots=8"], "snapshots: they are spaced over the budget"),
    ],
)
def test_what_cannot_be_is_one_sentence_and_leaves_nothing(here, capsys, words, sentence):
    assert train.main([*OPPOSED, "samples=100", *words]) == 2
    assert sentence in capsys.readouterr().err
    assert not list(here.glob("runs/*/"))


def test_a_pool_larger_than_the_memory_says_how_many_fit(here, capsys, monkeypatch):
    folder = train.run(configured(f"samples={SMALLER}", tiny=OPPOSED))
    each = sum(weight.nbytes for weight in actors(folder)["0"].values())
    monkeypatch.setattr(devices, "free_memory", lambda device: 3.3 * each)
    assert train.main([*OPPOSED, "samples=100", "opponents.snapshots=4"]) == 2
    error = capsys.readouterr().err
    assert "4 snapshots need" in error and "are free on cpu: at most 3 fit" in error


def test_snapshots_act_as_they_are_and_on_a_gpu_in_graphs(here, monkeypatch, device):
    """On a GPU from the second rollout on, each on a stream of its own."""
    made, real = [], train.make_trainer

    def make_trainer(*arguments):
        made.append(real(*arguments))
        return made[-1]

    monkeypatch.setattr(train, "make_trainer", make_trainer)
    tiny = [word for word in OPPOSED if not word.startswith(("device", "agent.core", "env."))]
    tiny += ["env.self_play=true", "env.n_envs=64", f"device={device}"]
    folder = train.run(configured(f"samples={12 * 8 * SMALLER}", tiny=tiny))
    ((trainer, _),) = made
    if device == "cuda":
        assert isinstance(trainer.collect.graph, capture.Graph) and trainer.learner.cuda_graph.graph
    assert trainer.nonfinite_value is None and trainer.updates == 12
    rows = loggers.read(folder / "metrics.jsonl")
    for name in ("return/past", "return/bot", "won/past", "won/bot"):
        assert any(f"episode/{name}" in row for row in rows)
    played = []
    for _ in range(2):
        trainer.rollout = trainer.collect()
        played.append((trainer.rollout.actions.clone(), trainer.env.memory["0"].cell.clone()))
    assert not torch.equal(played[0][0], played[1][0]), "the random stream goes on"
    assert not torch.equal(played[0][1], played[1][1]), "snapshots remember"
    # now one snapshot that only moves up and one that only moves down, written in place
    for up, actor in zip((50.0, -50.0), trainer.opponents.actors, strict=True):
        actor.output.linear.weight.data.zero_()
        actor.output.linear.bias.data.copy_(torch.tensor([-90.0, up, -up]))
    for _ in range(4):
        trainer.collect()
    tops = trainer.env.env.games[6:8].T  # of the left and the right paddle
    theirs = ~trainer.env.learners.view(-1, 2)
    for first, is_up in ((16, True), (32, False)):
        found = tops[first : first + 16][theirs[first : first + 16]]
        middle = 13 * CELL
        assert ((found < middle) == is_up).float().mean() > 0.8
