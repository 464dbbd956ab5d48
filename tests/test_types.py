"""Types: what `make lint` does not hold."""

import pathlib
import re

ROOT = pathlib.Path(__file__).parents[1]


def test_few_lines_take_any_type():
    """A Protocol, `object` or a name of `megastep.agents.types` says more than `Any`."""
    files = [path for folder in ("agents", "megastep") for path in (ROOT / folder).rglob("*.py")]
    lines = [line for path in files for line in path.read_text().splitlines()]
    n_lines = sum(bool(re.search(r"\bAny\b", line)) for line in lines)
    assert 0 < n_lines < 200
