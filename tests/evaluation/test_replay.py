"""Episodes of an evaluation, filmed as they were: worst=, episode=, home=."""

import csv
import json
import os
import shutil

import numpy as np
import pytest
import torch

from megastep import recording
from megastep.agents.cli import evaluate, record, train
from megastep.agents.evaluation import arena, playing, replay
from megastep.agents.selfplay.bots.random import RandomActions
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
    rows = list(csv.DictReader(path.open()))
    return [row for row in rows if row["agent"] == "trained"]


@pytest.fixture
def returns(monkeypatch):
    """Returns the returns that a film shows, a list of each player's in each frame."""
    shown, original = [], recording._returns
    monkeypatch.setattr(recording, "_returns", lambda r: shown.append(float(r[0])) or original(r))
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
    for path in (copy / "evaluations").glob("*.npz"):
        path.unlink()
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
    path.with_suffix(".npz").write_bytes(b"PK")
    assert record.main(words) == 2
    assert ".npz cannot be used: " in capsys.readouterr().err


def test_actions_of_several_ranks(evaluated, monkeypatch):
    cfg = settings(*WORDS, "geometry=homes", "env.res=16")
    homes = [*replay.factory.homes(cfg.env, cfg.geometry, "test")][:8]
    stages = [arena.Stage(cfg.env, homes, 8, rank=(number, 2)) for number in range(2)]
    played, recorders = [], [playing.Recorder(), playing.Recorder()]
    for number, (stage, recorder) in enumerate(zip(stages, recorders, strict=True)):
        policy = RandomActions(stage.env.action_space)
        steps = 4 + 2 * number  # the ranks end after as many steps as their episodes take
        arguments = stage.seed, False, steps, recorder
        played.append(playing.first_episodes(stage.env, policy, *arguments))

    def of_both(value):
        if isinstance(value, int):
            return [4, 6]
        other = recorders[1].actions()[""]
        return [value, {"": torch.as_tensor(other).long().transpose(0, 1)}]

    monkeypatch.setattr("megastep.agents.distributed.process_group.gather_objects", of_both)
    monkeypatch.setattr("megastep.agents.distributed.shard.gather_objects", of_both)
    actions = stages[0].actions(recorders[0])
    assert actions.n_ranks == 2 and actions.leaves[""].shape[:2] == (6, 8)
    for number, stage in enumerate(stages):
        own = {"": actions.leaves[""][:, [*stage.shard.envs]]}
        again = arena.Stage(cfg.env, homes, 8, rank=(number, 2))
        steps = 4 + 2 * number
        same = playing.first_episodes(again.env, replay.Replay(again.env, own), 1, False, steps)
        assert (same.returns == played[number].returns).all()
        assert (same.starts == played[number].starts).all()


def test_too_many_actions_are_not_kept(monkeypatch):
    recorder = playing.Recorder()
    monkeypatch.setattr(playing, "MAX_BYTES", 100)
    for number in range(20):
        recorder.add({"move": torch.full((4, 1), 300), "turn": torch.full((4, 1), number)})
        if number == 15:
            recorder.keep(16)
    assert recorder.actions() is None and replay.as_bytes([None]) is None
    assert playing.narrow(np.array([0, 300])).dtype == np.uint16


@pytest.mark.cuda
def test_an_episode_on_a_gpu_is_the_same_on_a_cpu(evaluated, tmp_path):
    copy = shutil.copytree(evaluated, tmp_path / "copy")
    shutil.rmtree(copy / "evaluations")
    words = ["episodes=256", "device=cuda", "baseline=none"]
    assert evaluate.main([f"run={copy}", *words]) == 0
    film = [f"run={copy}", "worst=3", "dpi=30", "device=cpu", f"file={tmp_path / 'a.png'}"]
    assert record.main(film) == 0
