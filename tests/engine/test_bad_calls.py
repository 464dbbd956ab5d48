"""Wrong arguments and buffers raise errors that name them: nothing crashes or is silently wrong."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

TESTS = Path(__file__).parents[1]


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
def test_bad_arguments_are_named(device):
    process = subprocess.run(
        [sys.executable, str(TESTS / "helpers" / "bad_calls.py"), device],
        capture_output=True,
        text=True,
        cwd=TESTS.parent,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(TESTS.parent), *sys.path])},
    )
    rows = [json.loads(line) for line in process.stdout.splitlines()]
    assert process.returncode == 0, f"it crashed in {rows[-1:]}: {process.stderr[-2000:]}"
    results = [row for row in rows if "wrong" in row]
    wrong = [f"{row['call']}: {row['wrong']}" for row in results if row["wrong"]]
    assert not wrong, f"{len(wrong)} of {len(results)} calls:\n" + "\n".join(wrong)
    assert len(results) > 300
