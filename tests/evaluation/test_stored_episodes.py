"""Episodes of an evaluation, filmed as they were: worst=, episode=, home=."""

import csv
import json
import os
import shutil

import pytest
import torch

from megastep import moments
from megastep.agents.cli import evaluate, record, train
from megastep.agents.evaluation import playing, replay
from megastep.agents.evaluation.eval_env import EvalEnv
from megastep.agents.runs import restore
from tests.helpers import tiny
from tests.helpers.tiny import settings

WORDS = [*tiny.TINY, *tiny.SHORT_EPISODES, "samples=1"]


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("evaluated"))
        folder = train.run(settings(*WORDS, "geometry=homes", "env.res=16")).absolute()
        words = [f"run={folder}", "episodes=24", "device=cpu"]
        assert evaluate.main(words) == 0
        return folder


def rows_of(folder):
    (path,) = (folder / "evaluations").glob("*.csv")
    rows = list(csv.DictReader(path.read_text().splitlines()))
    return [row for row in rows if row["agent"] == "trained"]


@pytest.fixture
def returns(monkeypatch):
    """Returns the returns that a film shows, a list of each player's in each frame."""
    shown, original = [], moments._returns
    monkeypatch.setattr(moments, "_returns", lambda r: shown.append(float(r[0])) or original(r))
    return shown


def test_worst_episodes_are_filmed_as_they_were(evaluated, tmp_path, returns, capsys):
    path = tmp_path / "worst.mp4"
    words = [f"run={evaluated}", "worst=2", "dpi=30", "device=cpu", f"file={path}"]
    assert record.main(words) == 0
    worst = sorted(rows_of(evaluated), key=lambda row: float(row["return"]))[:2]
    lengths = [int(row["length"]) for row in worst]
    assert len(returns) == sum(lengths) + 2, "a frame per step, and the first of each"
    import av

    with av.open(str(path)) as video:
        assert len([*video.decode(video=0)]) == max(lengths) + 1
    said = capsys.readouterr().out
    for row in worst:  # the frames of both alternate until one is at the end
        assert f"episode {row['episode']}, home {row['home']}: return" in said
    short = min(lengths) + 1
    first = [returns[::2][:short], returns[1::2][:short]]
    rest = returns[2 * short :]
    shown = [[*one, *(rest if n + 1 > short else [])] for one, n in zip(first, lengths)]
    last = [one[-1] for one in shown]
    assert last == [float(row["return"]) for row in worst], "bit by bit"


def test_episode_of_a_number_and_worst_of_a_home(evaluated, tmp_path, returns, capsys):
    row = rows_of(evaluated)[7]
    words = [f"run={evaluated}", "device=cpu", "dpi=30", f"file={tmp_path / 'a.png'}"]
    assert record.main([*words, "episode=7"]) == 0
    assert returns[-1] == float(row["return"]) and len(returns) == int(row["length"]) + 1
    assert record.main([*words, "worst=1", f"home={row['home']}"]) == 0
    assert f"home {row['home']}: return" in capsys.readouterr().out


@pytest.mark.parametrize(
    "words, text",
    [
        (["worst=1", "home=400000"], "has no episode in home 400000: it has 24 homes, 0 to"),
        (["episode=24"], "has no episode 24: they are 0 to 23"),
        (["worst=1", "geometry=box"], "geometry: cannot be combined with worst"),
        (["worst=1", "episode=1"], "episode: cannot be combined with worst"),
    ],
)
def test_episode_that_is_none(evaluated, here, capsys, words, text):
    assert record.main([f"run={evaluated}", "device=cpu", *words]) == 2
    assert text in capsys.readouterr().err and not os.listdir()


def test_no_evaluation_yet(evaluated, tmp_path, capsys):
    copy = shutil.copytree(evaluated, tmp_path / "copy")
    shutil.rmtree(copy / "evaluations")
    assert record.main([f"run={copy}", "worst=1", "device=cpu"]) == 2
    error = capsys.readouterr().err
    assert "has no evaluation yet with episodes to film; first " in error
    assert "evaluate" in error.splitlines()[-1] and not [*copy.glob("video*")]


def test_another_episode_is_refused(evaluated, tmp_path, capsys):
    copy = shutil.copytree(evaluated, tmp_path / "copy")
    (path,) = (copy / "evaluations").glob("*.json")
    table = json.loads(path.read_text())
    table["episodes"]["return"][0] += 1
    path.write_text(json.dumps(table))
    words = [f"run={copy}", "episode=0", "dpi=30", "device=cpu"]
    assert record.main(words) == 2
    assert "its return is" in capsys.readouterr().err and not [*copy.glob("video*")]
    path.write_text("{")
    assert record.main(words) == 2
    assert "cannot be used: " in capsys.readouterr().err


def test_an_episode_of_several_ranks_is_the_same_again(evaluated, device="cpu"):
    loaded = replay.folders.load_checkpoint(replay.folders.find(str(evaluated)), False, device)
    trained = replay.factory.config_of(loaded)
    homes = replay.factory.homes(trained.env, trained.geometry, "test")
    rank = EvalEnv(trained.env, homes[:8], 8, rank=(1, 2))
    policy = restore.policy_of(loaded, rank.env)
    played = playing.first_episodes(rank.env, policy, rank.seed)
    cfg = settings(f"run={evaluated}", "episodes=8", script="evaluate")
    table = replay.Table(evaluated, "", "", cfg, trained.env, trained.geometry, [], 2)
    rows = [{"episode": 1}, {"episode": 5}]  # environments 0 and 2 of the second rank
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(replay.factory, "homes", lambda *_: homes[:8])
        shown = [*table.plays(rows, loaded, torch.device(device))]
    assert [lane for *_, lane in shown] == [0, 2] and shown[0][1] is shown[1][1]
    again = playing.first_episodes(shown[0][1], shown[0][2], seed=12345)
    assert (again.returns == played.returns).all() and (again.starts == played.starts).all()
