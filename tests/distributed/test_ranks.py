"""What ranks agree on and how those that differ are named, with the other ranks' part made up."""

import pytest
import torch

from megastep.agents.distributed import environment, process_group, ranks
from megastep.agents.distributed.process_group import together
from megastep.agents.distributed.ranks import ONE, Plan, Ranks
from megastep.agents.errors import UserError
from megastep.agents.generator import seed_of

GOES_ON = Plan(goes_on=True, saves=False, lr_fraction=0.75)


# ---- torchrun's variables ----


@pytest.mark.parametrize(
    "values, attempt, expected",
    [((), None, None), (("3", "4", "1"), None, (3, 4, 1, 0)), (("3", "4", "1"), "2", (3, 4, 1, 2))],
)
def test_rank_of_this_process(monkeypatch, values, attempt, expected):
    for name in (*environment.NAMES, "TORCHELASTIC_RESTART_COUNT"):
        monkeypatch.delenv(name, raising=False)
    for name, value in zip(environment.NAMES, values):
        monkeypatch.setenv(name, value)
    if attempt:
        monkeypatch.setenv("TORCHELASTIC_RESTART_COUNT", attempt)
    assert environment.rank_info() == expected
    assert environment.rank() == (expected[0] if expected else 0)


@pytest.mark.parametrize("values", [("2", "2", "0"), ("-1", "2", "0"), ("one", "2", "0")])
def test_contradicting_variables(monkeypatch, values):
    for name, value in zip(environment.NAMES, values, strict=True):
        monkeypatch.setenv(name, value)
    with pytest.raises(ValueError, match=f"RANK={values[0]} WORLD_SIZE=2.*unset"):
        environment.rank_info()


def test_each_rank_has_a_seed_of_its_own():
    seeds = [seed_of("rank", rank, 7) for rank in range(100)]
    assert seeds[0] == 7 and len({*seeds}) == 100 and max(seeds) < 2**31
    assert not {*seeds} & {seed_of("rank", rank, 8) for rank in range(100)}


# ---- Plans and calls ----


@pytest.fixture
def others(monkeypatch):
    """Sets what the other ranks say; this one is rank `rank`. Returns what this one says."""

    def are(values, rank=0):
        said = []

        def gathered(value):
            said.append(value)
            return [*values[:rank], value, *values[rank:]]

        monkeypatch.setattr(process_group, "exchange", gathered)
        monkeypatch.setattr(process_group, "gather_objects", gathered)
        monkeypatch.setattr(process_group, "n_ranks", lambda: 1 + len(values))
        monkeypatch.setattr(process_group, "rank", lambda: rank)
        monkeypatch.setattr(process_group, "hostname", lambda: "here")
        return said

    return are


def test_one_process_follows_its_own_plan():
    assert ONE.agree(GOES_ON, False, False) == GOES_ON
    assert not ONE.agree(GOES_ON, True, False).goes_on
    assert not ONE.agree(GOES_ON._replace(saves=True), False, True).saves


def test_clock_of_rank_0_decides_unless_a_rank_has_a_signal_or_a_slow_disk(others):
    others([[True, True, 0.5, False, False]], rank=1)
    assert Ranks(1, 2).agree(Plan(False, False, 0.25), False, False) == Plan(True, True, 0.5)
    saving = GOES_ON._replace(saves=True)
    others([[1, 1, 0.9, 0, 0], [1, 1, 0.9, 1, 0]])
    assert Ranks(0, 3).agree(saving, False, False) == saving._replace(goes_on=False)
    others([[1, 1, 0.9, 0, 0], [1, 1, 0.9, 0, 1]])
    assert Ranks(0, 3).agree(saving, False, False) == GOES_ON


def failing(error):
    raise error


def test_error_of_one_rank_is_the_error_of_all(others):
    others([UserError("rank 1 on node-7: no GPU")])
    with pytest.raises(UserError, match="rank 1 on node-7: no GPU"):
        together(lambda: 1)
    others([None], rank=1)
    with pytest.raises(UserError, match="rank 1 on here: no GPU"):
        together(lambda: failing(UserError("no GPU")))
    others([None])
    with pytest.raises(UserError, match="^no GPU"):
        together(lambda: failing(UserError("no GPU")))
    assert together(lambda: 3) == 3


def test_error_that_cannot_be_sent_is_sent_as_text(others):
    class Local(ValueError):
        pass

    said = others([None], rank=1)
    with pytest.raises(Local, match="rank 1 on here: bad"):
        together(lambda: failing(Local("bad")))
    assert type(said[0]) is RuntimeError and "Local: rank 1 on here: bad" in str(said[0])


def test_numbers_of_ranks(monkeypatch):
    assert ONE.any(True) and not ONE.any(False)
    monkeypatch.setattr(process_group, "exchange", lambda row: [[*row], [1.0]])
    assert Ranks(0, 2).any(False)
    nan = float("nan")
    values = {"a": 1.0, "b": nan, "c": nan}
    assert ONE.mean(values) == {"a": 1}
    rows = [values, {"a": 3.0, "b": 5.0, "c": nan}]
    monkeypatch.setattr(process_group, "gather_objects", lambda value: rows)
    assert Ranks(0, 2).mean(values) == {"a": 2, "b": 5}


# ---- Ranks that differ ----


@pytest.mark.parametrize(
    "dtype", [torch.float32, torch.float16, torch.int64, torch.bool, torch.complex64]
)
def test_checksum_sees_one_bit(dtype):
    tensor = torch.ones(3, 5, dtype=dtype)
    other = tensor.clone()
    other[1, 2] = 0
    before, same, after = (ranks.checksums([x]) for x in (tensor, tensor.clone(), other))
    assert torch.equal(before, same) and not torch.equal(before, after)


def test_checksum_sees_negative_zero_and_nan():
    values = torch.tensor([0.0, -0.0, torch.nan, torch.inf])
    assert len({ranks.checksums([value]).item() for value in values}) == 4


def test_first_difference_names_tensor_and_ranks(monkeypatch):
    network = torch.nn.Sequential(torch.nn.Linear(2, 2), torch.nn.BatchNorm1d(2))
    ONE.check_drift(network)

    def gather(sums):
        rows = sums.repeat(3, 1)
        rows[1:, 1] += 1  # of 0.weight, 0.bias, ...
        rows[2, 4] += 1
        return rows

    monkeypatch.setattr(ranks, "all_gather", gather)
    text = "policy.0.bias differs on rank 1, rank 2; .*average_gradients"
    with pytest.raises(UserError, match=text):
        Ranks(0, 3).check_drift(network)
