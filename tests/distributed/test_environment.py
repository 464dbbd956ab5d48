"""torchrun's environment variables tell a process that it is a rank."""

import pytest

from megastep.agents.distributed import environment


@pytest.fixture(autouse=True)
def no_rank(monkeypatch):
    for name in (*environment.NAMES, "TORCHELASTIC_RESTART_COUNT"):
        monkeypatch.delenv(name, raising=False)


def set_rank(monkeypatch, *values):
    for name, value in zip(environment.NAMES, values, strict=True):
        monkeypatch.setenv(name, value)


def test_process_of_its_own():
    assert environment.rank_info() is None and environment.rank() == 0


def test_rank(monkeypatch):
    set_rank(monkeypatch, "3", "4", "1")
    assert environment.rank_info() == (3, 4, 1, 0) and environment.rank() == 3
    monkeypatch.setenv("TORCHELASTIC_RESTART_COUNT", "2")
    assert environment.rank_info().attempt == 2


@pytest.mark.parametrize("values", [("2", "2", "0"), ("-1", "2", "0"), ("one", "2", "0")])
def test_contradiction(monkeypatch, values):
    set_rank(monkeypatch, *values)
    with pytest.raises(ValueError, match=f"RANK={values[0]} WORLD_SIZE=2.*unset"):
        environment.rank_info()
