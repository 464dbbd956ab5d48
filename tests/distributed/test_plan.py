"""What ranks agree upon, with the other ranks' part made up in this process."""

import pytest

from megastep.agents.distributed import agreement, process_group
from megastep.agents.distributed.agreement import Plan, agree
from megastep.agents.distributed.ranks import ONE, Ranks
from megastep.agents.errors import UserError
from megastep.agents.generator import rank_seed

GOES_ON = Plan(goes_on=True, saves=False, lr_fraction=0.75)


@pytest.fixture
def others(monkeypatch):
    """Sets what the other ranks say; this one is rank `rank`."""

    def are(values, rank=0):
        def gathered(value):
            return [*values[:rank], value, *values[rank:]]

        for name in "exchange", "gather_objects":
            monkeypatch.setattr(agreement, name, gathered)
        monkeypatch.setattr(agreement, "n_ranks", lambda: 1 + len(values))
        monkeypatch.setattr(agreement, "rank", lambda: rank)
        monkeypatch.setattr(agreement, "rank_label", lambda: f"rank {rank} on here")

    return are


def test_one_process_follows_its_own_plan():
    assert agree(GOES_ON, False, False) == GOES_ON
    assert agree(Plan(False, True, 1 / 3), False, False) == Plan(False, True, 1 / 3)
    assert not agree(GOES_ON, True, False).goes_on
    assert not agree(GOES_ON._replace(saves=True), False, True).saves


def test_clock_of_rank_0_decides(others):
    others([[True, True, 0.5, False, False]], rank=1)
    assert agree(Plan(False, False, 0.25), False, False) == Plan(True, True, 0.5)


def test_a_signal_or_a_slow_disk_of_any_rank_counts(others):
    saving = GOES_ON._replace(saves=True)
    others([[1, 1, 0.9, 0, 0], [1, 1, 0.9, 1, 0]])
    assert agree(saving, False, False) == saving._replace(goes_on=False)
    others([[1, 1, 0.9, 0, 0], [1, 1, 0.9, 0, 1]])
    assert agree(saving, False, False) == GOES_ON


def test_error_of_one_rank_is_the_error_of_all(others):
    def fails():
        raise UserError("no GPU")

    others([UserError("rank 1 on node-7: no GPU")])
    with pytest.raises(UserError, match="rank 1 on node-7: no GPU"):
        agreement.together(lambda: 1)
    others([None], rank=1)
    with pytest.raises(UserError, match="rank 1 on here: no GPU"):
        agreement.together(fails)
    others([None])
    with pytest.raises(UserError, match="^no GPU"):
        agreement.together(fails)
    assert agreement.together(lambda: 3) == 3


def test_error_that_cannot_be_sent_is_sent_as_text(others, monkeypatch):
    class Local(ValueError):
        pass

    def fails():
        raise Local("bad")

    sent = []
    others([None], rank=1)
    gather = agreement.gather_objects
    monkeypatch.setattr(agreement, "gather_objects", lambda one: sent.append(one) or gather(one))
    with pytest.raises(Local, match="rank 1 on here: bad"):
        agreement.together(fails)
    assert type(sent[0]) is RuntimeError and "Local: rank 1 on here: bad" in str(sent[0])


def test_any_rank(monkeypatch):
    assert ONE.any(True) and not ONE.any(False)
    monkeypatch.setattr(process_group, "exchange", lambda row: [[*row], [1.0]])
    assert Ranks(0, 2).any(False)


def test_mean_over_ranks_leaves_out_nan(monkeypatch):
    nan = float("nan")
    values = {"a": 1.0, "b": nan, "c": nan}
    assert ONE.mean(values) == {"a": 1}
    rows = [values, {"a": 3.0, "b": 5.0, "c": nan}]
    monkeypatch.setattr(process_group, "gather_objects", lambda value: rows)
    assert Ranks(0, 2).mean(values) == {"a": 2, "b": 5}


def test_each_rank_has_a_seed_of_its_own():
    seeds = [rank_seed(7, rank) for rank in range(100)]
    assert seeds[0] == 7 and len({*seeds}) == 100 and max(seeds) < 2**31
    assert not {*seeds} & {rank_seed(8, rank) for rank in range(100)}
