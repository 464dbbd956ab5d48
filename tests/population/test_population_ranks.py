"""Populations whose members are spread over ranks, two processes on CPUs."""

import signal
import time

import pytest

from megastep.agents.runs import checkpoint, populations
from tests.helpers import ranks
from tests.helpers.processes import ROOT
from tests.population.test_population_runs import (
    LONG,
    POPULATION,
    assert_equal,
)

pytestmark = pytest.mark.usefixtures("here")
#: Three members: two of the first rank, one of the second.
WORDS = [*POPULATION, LONG, "device=cpu"]


@pytest.fixture(scope="module")
def left_alone(tmp_path_factory):
    """The folder of the population in one process."""
    folder = tmp_path_factory.mktemp("alone") / "P"
    ranks.train(*WORDS, f"folder={folder}", n_ranks=1)
    return folder


def crossings(root):
    """Returns how many copies went from one rank to the other."""
    rows = [row for rows in populations.read(root / populations.FILE) for row in rows]
    return sum(row["from"] % 2 != row["member"] % 2 for row in rows)


@pytest.mark.slow
def test_two_ranks_equal_one_process(here, left_alone):
    assert crossings(left_alone) >= 3
    first, second = ranks.train(*WORDS)
    assert "Training 3 members on 2 x cpu" in first.stdout
    assert not second.stdout and not first.stderr + second.stderr
    assert_equal(here / "P", left_alone)
