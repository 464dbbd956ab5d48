"""The state of several ranks in one checkpoint, with the ranks' savers in this process."""

import time

import pytest
import torch

from megastep.agents.cli import inspect
from megastep.agents.factory.trainer import differing
from megastep.agents.runs import checkpoint
from megastep.agents.runs import saver as saver_module
from megastep.agents.runs.saver import Saver
from tests.training.test_trainer import UPDATE, make_trainer


def state(rank):
    return {
        "samples": 8,
        "policy": {"w": torch.zeros(3)},
        "learner": {"m": torch.ones(3)},
        "env": {"x": torch.full((2,), float(rank))},
        "replay": {"rows": torch.full((2,), float(rank))},
    }


def savers(folder, n_ranks=2, launch="now"):
    return [
        Saver(folder, {"train": {}}, launch=launch, rank=rank, n_ranks=n_ranks)
        for rank in range(n_ranks)
    ]


def names(folder):
    return {path.name for path in folder.iterdir()}


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "checkpoints"


def test_checkpoint_holds_the_state_of_every_rank(folder, capsys):
    both = savers(folder)
    for step in (8, 16):
        for rank, saver in enumerate(both):  # rank 0 waits for rank 1
            saver(step, state(rank), is_last=step == 16)
    for saver in both:
        saver.wait()
        assert saver.error is None
    assert names(folder) == {"step_8", "step_16"}
    assert names(folder / "step_16") == {
        *("manifest.json", "config.json", "state.pt", "world.pt", "replay.pt", "rank1.pt")
    }
    first, second, third = (checkpoint.load_latest(folder, rank=rank) for rank in range(3))
    assert first.n_ranks == second.n_ranks == 2
    assert first.state["env"]["x"].tolist() == [0, 0] and first.state["replay"]
    assert second.state["env"]["x"].tolist() == second.state["replay"]["rows"].tolist() == [1, 1]
    assert second.state["policy"]["w"].tolist() == [0, 0, 0]
    assert third.state["samples"] == 8 and "env" not in third.state  # it has no file
    assert inspect.main([str(folder / "step_16")]) == 0
    assert "rank1.pt" in capsys.readouterr().out
    assert {*checkpoint.load_latest(folder, is_whole=False).state} == {
        *("samples", "policy", "learner")
    }


def test_damage_in_a_ranks_file_is_found(folder):
    both = savers(folder)
    for rank, saver in enumerate(both):
        saver(8, state(rank))
    both[0].wait()
    path = folder / "step_8" / "rank1.pt"
    data = bytearray(path.read_bytes())
    data[100] ^= 1
    path.write_bytes(data)
    for rank in range(2):
        with pytest.raises(checkpoint.CheckpointError, match="rank1.pt does not match"):
            checkpoint.load_latest(folder, rank=rank)
    assert checkpoint.load_latest(folder, is_whole=False).step == 8  # to evaluate


def test_rank_that_hands_in_nothing_costs_a_warning(folder, monkeypatch):
    monkeypatch.setattr(saver_module, "RANK_SECONDS", 0.05)
    first, second = savers(folder)
    first(8, state(0))
    with pytest.warns(UserWarning, match=r"rank 1 did not write its state within") as caught:
        first.wait()
    assert len(caught) == 1 and not checkpoint.list_checkpoints(folder)
    for step in (8, 16):  # too late, and in time
        second(step, state(1))
        second.wait()
    first(16, state(0))
    first.wait()
    assert first.error is None and checkpoint.load_latest(folder).step == 16


def test_rank_0_waits_no_longer_once_another_has_ended(folder, recwarn):
    first, _ = savers(folder)
    began = time.monotonic()
    first(8, state(0))
    first.give_up()
    first.wait()
    assert "rank 1" in first.error and time.monotonic() - began < saver_module.RANK_SECONDS / 2
    assert not recwarn and not checkpoint.list_checkpoints(folder)


def test_files_of_earlier_starts_are_deleted(folder):
    _, second = savers(folder, launch="before")
    second(8, state(1))
    second.wait()
    assert names(folder) == {".rank1-before-1"}
    savers(folder)
    assert not names(folder)


def test_new_rank_has_rank_0s_optimizer_and_its_own_generators(tmp_path):
    first = make_trainer(tmp_path, samples=3 * UPDATE)
    first.train()
    saved = first.run_state.state_dict(has_episodes=False)
    saved["episode_stats"]["sums"] += 1
    new = make_trainer(tmp_path / "new")
    own = new.learner.state_dict()["generator"]
    new.run_state.load_state_dict(saved, is_new_rank=True)
    assert new.lost == ["added ranks start new episodes"]
    now, then = new.learner.state_dict(), saved["learner"]
    assert now["generator"] == own and now["generator"].keys() != then["generator"].keys()
    assert str(now["optimizer"]) == str(then["optimizer"]) and now["optimizer"]
    assert not new.episodes.stats.sums.any() and new.samples == 3 * UPDATE


def test_resume_names_another_number_of_ranks():
    assert differing({"torch": "2"}, {"torch": "2"}) == []
    assert differing({"torch": "2"}, {"torch": "2", "ranks": 2}) == ["ranks was 1 and is 2"]
    assert differing({"ranks": 4, "torch": "1"}, {"torch": "2"}) == [
        "ranks was 4 and is 1",
        "torch was 1 and is 2",
    ]
