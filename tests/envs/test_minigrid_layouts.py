"""The layouts of MiniGrid's tasks have the distribution of the original's own generator."""

import pytest

from megastep.envs.minigrid.tasks import TASKS
from tests.helpers.minigrids import original_layouts, our_layouts, p_value

LEVEL = 0.01
ONE_OF_EACH = (
    *("Empty-Random-5x5-v0", "FourRooms-v0", "DoorKey-5x5-v0", "UnlockPickup-v0"),
    *("KeyCorridorS3R2-v0", "MultiRoom-N2-S4-v0", "LavaGapS5-v0", "LavaCrossingS9N2-v0"),
    *("MemoryS13Random-v0", "RedBlueDoors-6x6-v0", "Dynamic-Obstacles-5x5-v0"),
    *("PutNear-6x6-N2-v0", "GoToDoor-5x5-v0"),
)


def assert_same(ids, id, n):
    assert p_value(our_layouts(id, n), original_layouts(id, n)) > LEVEL / len(ids)


@pytest.mark.slow
@pytest.mark.parametrize("name", ONE_OF_EACH)
def test_layouts_have_the_originals_distribution(name):
    assert_same(ONE_OF_EACH, f"MiniGrid-{name}", 2000)


@pytest.mark.nightly
@pytest.mark.parametrize("id", TASKS)
def test_100_000_layouts_have_the_originals_distribution(id):
    assert_same(TASKS, id, 100_000)


class WithoutLast:
    """A generator that seldom draws the last of several integers."""

    def __init__(self, generator):
        self.generator = generator

    def integers(self, low, high):
        value = self.generator.integers(low, high)
        return self.generator.integers(low, high) if value == high - 1 else value


@pytest.mark.slow
@pytest.mark.parametrize("name", ["DoorKey-5x5-v0", "MultiRoom-N2-S4-v0", "PutNear-6x6-N2-v0"])
def test_a_generator_that_is_slightly_wrong_is_caught(name):
    ours = our_layouts(f"MiniGrid-{name}", 2000)
    theirs = original_layouts(f"MiniGrid-{name}", 2000, generator=WithoutLast)
    assert p_value(ours, theirs) < LEVEL / len(TASKS)
