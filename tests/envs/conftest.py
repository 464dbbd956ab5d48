"""Fixtures of the tests of environments."""

import pytest


@pytest.fixture(autouse=True)
def videos(drawn_in_this_process):
    """Has videos drawn without worker processes."""
