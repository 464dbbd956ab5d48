"""Reports of several ranks, whose exchange is made up in this process."""

import copy

import pytest
import torch

from megastep.agents.distributed.ranks import ONE, Ranks
from megastep.agents.runs import json_lines, provenance
from megastep.agents.training import callbacks
from megastep.agents.training.episode_stats import EpisodeStats
from tests.training.test_trainer import UPDATE, make_trainer

LABELS = "rank 0 on here", "rank 1 on there"


@pytest.fixture
def one_by_one(monkeypatch):
    """Makes the guard gather the reports of two ranks: rank 1's first call gets two copies of rank
    1's, rank 0's next call rank 0's and rank 1's.
    """
    of_rank_1 = []

    def act_as(rank):
        class Made(Ranks):
            def gather_if_any(self, value, is_needed):
                if rank == 1:
                    assert is_needed, "rank 0 would not be told"
                    of_rank_1.append(value)
                    return [value, value]
                return [value, of_rank_1.pop(0)]

        monkeypatch.setattr(callbacks, "rank_label", lambda: LABELS[rank])
        return Made(rank, 2)

    return act_as


def test_means_are_over_the_episodes_of_all_ranks():
    ranks = [EpisodeStats(2, "cpu") for _ in range(2)]
    ended = torch.ones(1, 2, dtype=torch.bool)
    for stats, reward in zip(ranks, ([1.0, 2.0], [6.0, 7.0])):
        stats.add(torch.tensor([reward]), ~ended, ended)
        stats.is_whole[:] = False  # no other episode runs
    own = []
    for stats in ranks:
        copy.deepcopy(stats).pop(lambda sums: own.append(sums) or sums)
    first, second = (stats.pop(lambda sums: sum(own)) for stats in ranks)
    assert first == second and ranks[0].windows == ranks[1].windows
    assert (first["episode/count"], first["episode/return"]) == (4, 4)


def test_nan_of_another_rank_is_told_by_rank_0(tmp_path, one_by_one, recwarn):
    trainers = []
    for rank, faults in ((1, {("reward", 2, 3): torch.nan}), (0, {})):
        run = make_trainer(tmp_path, faults, ranks=one_by_one(rank))
        run.update()
        assert not run.nonfinite_guard.check(run)
        trainers.append(run)
    (warning,) = recwarn
    sentence = r"reward of lane 3 was nan at step 2 \(rank 1 on there\); its rollout was skipped"
    assert sentence.replace("\\", "") in str(warning.message)
    assert len({str(run.nonfinite_guard.value) for run in trainers}) == 1


class Three(Ranks):
    """Stands for three ranks of which this one speaks for all."""

    any, mean, sum = ONE.any, ONE.mean, ONE.sum
    gather_if_any = ONE.gather_if_any


def test_samples_of_all_ranks_are_counted(tmp_path):
    run = make_trainer(tmp_path, samples=6 * UPDATE, ranks=Three(0, 3))
    run.train()
    assert run.updates == 2 and run.samples == 6 * UPDATE


def test_provenance_has_the_ranks(tmp_path):
    device = torch.device("cpu")
    for hosts in (["a"], ["a", "a", "b"]):
        provenance.record(tmp_path, 0, device, hosts)
    alone, three = json_lines.read(tmp_path / provenance.FILE)
    assert "hosts" not in alone and "ranks" not in alone
    assert (three["ranks"], three["hosts"]) == (3, "a, b")
    assert provenance.made_with(device, 2)["ranks"] == 2
    assert "ranks" not in provenance.made_with(device)
