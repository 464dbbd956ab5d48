"""Long use: a run that is interrupted, killed and resumed again and again, and environments that
are stepped for long.
"""

import pytest
import soak

pytestmark = pytest.mark.nightly


@pytest.mark.parametrize("seed", [1, 2])
def test_disturbed_runs_end_like_those_left_alone(seed):
    """Signals, kills, full disks and damaged checkpoints, at random moments."""
    assert soak.main(["--minutes", "5", "--seed", str(seed)]) == 0
