"""Training against opponents from the command line."""

import re

import pytest
import torch

from megastep import capture, devices
from megastep.agents.cli import evaluate, train
from megastep.agents.export import agent
from megastep.agents.runs import agent_file, checkpoint, json_lines
from megastep.envs.pong import CELL
from tests.cli.test_duels import PONG, UPDATE
from tests.cli.test_train import configured
from tests.helpers import pages
from tests.helpers.games import Always
from tests.helpers.tiny import settings
from tests.helpers.weights import same

OPPOSED = [*PONG, "opponents.past=0.5", "opponents.bot=0.25", "opponents.snapshots=2"]
OPPOSED += ["opponents.every=2", "opponents.bot_class=tests.helpers.games:High", "env.limit=5"]
#: Samples of an update: two environments with two learning lanes, six with one.
OPPOSED_UPDATE = 10 * 16


def saved_snapshots(folder):
    return checkpoint.load_latest(folder / "checkpoints").state["opponents"]["snapshots"]


def test_commands_and_code_of_the_page_work(here, monkeypatch, capsys):
    text = (pages.ROOT / "docs" / "self-play.md").read_text()
    commands = pages.commands(text)
    assert {script for script, _ in commands} == set(pages.MAINS)
    for script, words in commands:
        if script == "evaluate.py":
            words = [re.sub("^against=(.*)", r"against=[\1]", word) for word in words]
        settings(*words, script=script.removesuffix(".py"))
    folder = train.run(configured("samples=1", tiny=PONG))
    walker, tracker = pages.code(text)
    (here / "tracker.py").write_text(tracker)
    capsys.readouterr()
    exec(walker, {})
    assert float(re.search(r"[0-9.]+", capsys.readouterr().out)[0]) > 0.9
    with pages.inside(here, monkeypatch):
        first = ["ratings=true", "against=tracker:Tracker,random", "episodes=40", "device=cpu"]
        assert evaluate.main([f"run={folder}", *first]) == 0
    ratings = (folder / "ratings.csv").read_text().splitlines()[-2:]
    tracker, random = (float(row.split(",")[-4]) for row in ratings)
    assert tracker > random + 5


def test_metrics_by_kind_of_opponent(here):
    folder = train.run(configured(f"samples={6 * OPPOSED_UPDATE}", tiny=OPPOSED))
    rows = json_lines.read(folder / "metrics.jsonl")
    assert [row["samples"] for row in rows] == [OPPOSED_UPDATE * (i + 1) for i in range(6)]
    parts = "left", "right", "now", "past", "bot"
    assert {f"episode/return/{name}" for name in parts} <= rows[-1].keys()
    assert evaluate.main([f"run={folder}", "against=bot", "episodes=4", "device=cpu"]) == 0
    (path,) = folder.glob("evaluations/*.md")
    assert "bot, as right" in path.read_text(), "the environment's own"


def test_one_role_learns_against_the_agent_of_a_run(here, capsys):
    first = train.run(configured(f"samples={UPDATE}", tiny=PONG))
    words = ["opponents.past=0", "opponents.bot=1", "opponents.role=right"]
    words += [f"opponents.bot_class={first}", f"samples={6 * OPPOSED_UPDATE}"]
    folder = train.run(configured(*words, tiny=OPPOSED))
    last = json_lines.read(folder / "metrics.jsonl")[-1]
    assert "episode/return/right" in last and "episode/return/left" not in last
    agent.write(str(folder), here / "sole.safetensors")
    told = agent_file.read(here / "sole.safetensors", None).config["train"]["opponents"]
    assert told["bot_class"] == first.name, "without folders of this machine"
    assert train.main([*OPPOSED, "samples=100", "opponents.bot_class=runs/none"]) == 2
    assert "(bots are bot, explorer, hunter, " in capsys.readouterr().err
    words = "opponents.role=right", f"opponents.bot_class={first}", "env.self_play=true"
    train.run(configured(*words, f"samples={UPDATE}", tiny=PONG))
    text = capsys.readouterr().err
    assert "bot_class plays in no environment" in text and "role has no effect without" in text


class Configured(Always):
    """Takes settings of the environment as arguments."""

    def __init__(self, points, limit=7, other=3):
        super().__init__()
        assert (points, limit, other) == (2, 5, 3)


def test_bot_gets_the_settings_its_constructor_takes(here):
    words = "env.points=2", "opponents.bot_class=test_self_play:Configured"
    folder = train.run(configured(f"samples={OPPOSED_UPDATE}", *words, tiny=OPPOSED))
    assert evaluate.main([f"run={folder}", "against=bot", "episodes=2", "device=cpu"]) == 0


def test_init_weights_are_the_first_snapshots(here):
    first = train.run(configured(f"samples={UPDATE}", tiny=PONG))
    second = train.run(configured(f"init={first}", f"samples={OPPOSED_UPDATE}", tiny=OPPOSED))
    weights = checkpoint.load_latest(first / "checkpoints").state["policy"]
    assert all(same(snapshot, weights) for snapshot in saved_snapshots(second).values())


class NeedsRgb(Always):
    """Needs an observation that Pong does not have."""

    def __call__(self, world, state, sample=True, generator=None):
        return super().__call__(world, state, world["obs"]["rgb"])


@pytest.mark.parametrize(
    "words, message",
    [
        (["env.self_play=false"], "at least two agents; Pong has one"),
        (["opponents.past=0.9"], "opponents.past=0.9 and opponents.bot=0.25"),
        (["opponents.snapshots=5"], "opponents.snapshots=5"),
        (["opponents.bot_class=test_self_play:NeedsRgb"], "test_self_play:NeedsRgb"),
        (["samples=null", "checkpoints.snapshots=8"], "snapshots: "),
    ],
)
def test_bad_settings_are_named_and_leave_no_folder(here, capsys, words, message):
    assert train.main([*OPPOSED, "samples=100", *words]) == 2
    assert message in capsys.readouterr().err
    assert not list(here.glob("runs/*/"))


def test_snapshots_that_do_not_fit_say_how_many_would(here, capsys, monkeypatch):
    folder = train.run(configured(f"samples={OPPOSED_UPDATE}", tiny=OPPOSED))
    n_bytes = sum(weight.nbytes for weight in saved_snapshots(folder)["0"].values())
    monkeypatch.setattr(devices, "free_memory", lambda device: 3.3 * n_bytes)
    assert train.main([*OPPOSED, "samples=100", "opponents.snapshots=4"]) == 2
    error = capsys.readouterr().err
    assert "4 snapshots" in error and "at most 3 fit" in error


def test_snapshots_act_with_their_current_weights(here, trainers, device):
    """On a GPU in CUDA graphs from the second rollout on, each on a stream of its own."""
    tiny = [word for word in OPPOSED if not word.startswith(("device", "agent.core", "env."))]
    tiny += ["env.self_play=true", "env.n_envs=64", f"device={device}"]
    folder = train.run(configured(f"samples={12 * 8 * OPPOSED_UPDATE}", tiny=tiny))
    (trainer,) = trainers
    if device == "cuda":
        trainer.collect()  # the graphs of training are gone
        assert isinstance(trainer.collect.graph, capture.Graph)
    assert trainer.nonfinite_guard.value is None and trainer.updates == 12
    rows = json_lines.read(folder / "metrics.jsonl")
    for name in ("return/past", "return/bot", "won/past", "won/bot"):
        assert any(f"episode/{name}" in row for row in rows)
    played = []
    for _ in range(2):
        trainer.rollout = trainer.collect()
        played.append((trainer.rollout.actions.clone(), trainer.env.hidden_state["0"].cell.clone()))
    assert not torch.equal(played[0][0], played[1][0]), "the generator advances"
    assert not torch.equal(played[0][1], played[1][1]), "the hidden state advances"
    # change the weights in place: the first snapshot only moves up, the second only down
    for up, snapshot in zip((50.0, -50.0), trainer.episodes.opponents.snapshots, strict=True):
        snapshot.output.linear.weight.data.zero_()
        snapshot.output.linear.bias.data.copy_(torch.tensor([-90.0, up, -up]))
    for _ in range(4):
        trainer.collect()
    tops = trainer.env.env.games[6:8].T  # of the left and the right paddle
    is_opponent = ~trainer.env.learners.view(-1, 2)
    for first, is_up in ((16, True), (32, False)):
        opponent_tops = tops[first : first + 16][is_opponent[first : first + 16]]
        middle = 13 * CELL
        assert ((opponent_tops < middle) == is_up).float().mean() > 0.8
