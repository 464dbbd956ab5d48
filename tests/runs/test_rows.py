"""The rows of a run: which a resumed run keeps, and the scores that are computed of them."""

import json

import pytest

from megastep.agents.runs import json_lines, scores


def test_a_resumed_run_keeps_the_rows_up_to_its_checkpoint(tmp_path):
    rows = [{"samples": n} for n in (1, 2, 3)]
    path = tmp_path / "metrics.jsonl"
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    json_lines.truncate_after(path, 2)
    assert json_lines.read(path) == rows[:2]


@pytest.mark.parametrize("window, expected", [(3, (1 + 3 * 5) / 4), (4, 5)], ids=str)
def test_each_episode_counts_once_in_a_mean(window, expected):
    """A window may reach back over the reports before."""
    rows = [
        {f"episode/{name}": value for name, value in zip(("window", "count", "return"), row)}
        for row in ((1, 1, 1.0), (window, 3, 5.0))
    ]
    assert scores.mean(rows) == expected
