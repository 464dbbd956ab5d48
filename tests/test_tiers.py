"""The tiers of tests, slow and nightly, are found by the text of a file."""

import re

from tests.helpers.pages import ROOT


def test_tiers_are_named_in_the_files_of_their_tests():
    """`pytest_ignore_collect` in conftest.py does not look for marks anywhere else."""
    paths = (path for path in (ROOT / "tests").rglob("*.py") if not path.name.startswith("test_"))
    assert not [path for path in paths if re.search(r"mark\.(slow|nightly)", path.read_text())]
