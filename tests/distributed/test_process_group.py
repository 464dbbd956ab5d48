"""What ranks wait for, and for how long."""

import time

import pytest

from megastep.agents.distributed import process_group
from tests.helpers import ranks

#: Seconds within which two ranks join.
START_SECONDS = 8.0


def wait_for_longer_than_a_start():
    process_group.stop()
    process_group.start(START_SECONDS)
    if process_group.rank() == 1:
        time.sleep(START_SECONDS + 2)
    return process_group.exchange([process_group.rank()])


@pytest.mark.slow
def test_rank_may_evaluate_for_longer_than_ranks_may_take_to_join():
    """Limits of a wait are those of the watch, not PyTorch's."""
    assert ranks.call(wait_for_longer_than_a_start) == 2 * [[[0.0], [1.0]]]
