"""Fixtures of the tests of the command line."""

import pytest


@pytest.fixture(autouse=True)
def videos(drawn_in_this_process):
    """Has videos drawn without worker processes."""
