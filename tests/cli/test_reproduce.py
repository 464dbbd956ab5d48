"""`megastep reproduce`: its rows beside the pages that state them, its verdicts, its errors."""

import functools
import json
import re
import sys
from pathlib import Path

import pytest
import reference

from megastep.agents.cli import entry, evaluate, reproduce, train
from megastep.agents.cli.compose import Composer
from megastep.agents.cli.reproduce import Interval
from megastep.agents.launch import gpu

LAB = Path(__file__).parents[2] / "docs" / "lab"
ROWS = reproduce.read()
RESULTS = [result for row in ROWS.values() for result in row["results"]]


def row_of(train, *results):
    """A row for a CPU, of results (metric, value and interval, words of the evaluation)."""
    results = [{"page": "page.md", "evaluate": w, "states": {k: v}} for k, v, w in results]
    return {"device": "cpu", "train": train, "results": results}


def lines_of(page):
    """A page's paragraphs, and the lines of its tables."""
    text = re.sub(r"^\|.*", r"\n\g<0>\n", reference.expand((LAB / page).read_text()), flags=re.M)
    return [" ".join(block.split()) for block in re.split(r"\n\n+", text)]


# ---- The rows and the pages ----


@pytest.mark.parametrize("page", sorted({result["page"] for result in RESULTS}))
def test_page_states_the_results_of_the_rows(page):
    lines = lines_of(page)
    for result in RESULTS:
        for text in result["states"].values() if result["page"] == page else ():
            assert any(result["line"] in line and text in line for line in lines), result


@pytest.mark.slow
def test_words_of_rows_compose():
    composer = Composer(train.COMMAND)
    for row in ROWS.values():
        composer.settings([*row["train"].split(), f"device={row['device']}"])
    composer = Composer(evaluate.COMMAND)
    for words in {result.get("evaluate", "") for result in RESULTS}:
        composer.settings(["run=runs/x", *words.split()])


# ---- Verdicts ----


@pytest.mark.parametrize(
    "text, agreeing, differing",
    [
        ("0.999 (0.997 to 1)", [(0.99, 0.9966), (1.0, 1.0)], [(0.99, 0.9964)]),
        ("29.1 (27.2 to 31.0)", [(20, 27.2), (31.04, 40), (20, 40)], [(20, 27.1), (31.06, 40)]),
        ("92.9 % (91.9 to 93.9)", [(0.9, 0.919), (0.92, 0.93)], [(0.9, 0.918), (0.94, 0.95)]),
        ("-6.4 (-6.8 to -6.1)", [(-9, -6.8), (-6.1, -5)], [(-9, -6.9), (-6.0, -5)]),
    ],
)
def test_intervals_with_a_number_in_common_agree(text, agreeing, differing):
    assert all(Interval(0, *ends).agrees(text) for ends in agreeing)
    assert not any(Interval(0, *ends).agrees(text) for ends in differing)


def test_values_of_an_evaluation_and_of_duels():
    spl = {"mean": 0.5, "lower": 0.4, "upper": 0.6}
    rows = [{"return": 3.0, "lower": 2.0, "upper": 4.0, "metrics": {"spl": spl}}, {"return": 1.0}]
    assert reproduce.found_in(rows, "return") == (3, 2, 4)
    assert reproduce.found_in(rows, "spl") == (0.5, 0.4, 0.6)
    random, bot = {"against": "random"}, {"against": "bot", "won": 0.3, "lower": 0.2, "upper": 0.4}
    assert reproduce.found_in([random, bot], "bot") == (0.3, 0.2, 0.4)


def test_each_place_is_evaluated_once(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    calls = []

    def called(script, words):
        """Writes what training and evaluation leave behind; the n-th call earns n."""
        calls.append(" ".join([script, *words]))
        folder = Path(re.search(r"(?:folder|run)=(\S+)", calls[-1])[1])
        (folder / "evaluations").mkdir(parents=True, exist_ok=True)
        (folder / "metrics.jsonl").write_text('{"samples": 64}\n')
        n, spl = len(calls), {"mean": 0.5, "lower": 0.5, "upper": 0.5}
        rows = [{"return": n, "lower": n - 0.2, "upper": n + 0.2, "metrics": {"spl": spl}}]
        (folder / f"evaluations/{len(calls)}.json").write_text(json.dumps({"rows": rows}))

    for module, name in ((train, "train"), (evaluate, "evaluate")):
        monkeypatch.setattr(module, "main", functools.partial(called, name))
    homes = ("return", "2 (1 to 3)", ""), ("spl", "0.5 | 0.4 to 0.6", "")
    row = row_of("env=minimal samples=64", *homes, ("return", "2 (1 to 2)", "geometry=bench"))
    assert reproduce.reproduce("row", row) == 1
    training, homes, bench = calls
    assert training.startswith("train env=minimal samples=64 ") and "device=cpu" in training
    assert "geometry" not in homes and bench.endswith(" geometry=bench")
    shown = capsys.readouterr().out
    assert "agrees: 2 (1.8 to 2.2), stated return 2" in shown
    assert "DIFFERS: 3 (2.8 to 3.2), stated return 2" in shown


def test_a_result_that_differs_is_not_reproduced(tmp_path, capsys):
    (tmp_path / "metrics.jsonl").write_text('{"samples": 64}\n')
    row = row_of("env=minimal seconds=9", ("return", "0 (0 to 0)", ""))
    assert reproduce.compare("slow", row, tmp_path, [Interval(0, 0, 0)]) == 0
    assert reproduce.compare("slow", row, tmp_path, [Interval(1, 1, 2)]) == 1
    shown = capsys.readouterr().out
    assert "DIFFERS: 1 (1 to 2), stated return 0 (0 to 0), docs/lab/page.md" in shown
    assert "The run had 64 samples" in shown


# ---- The command ----


def test_a_training_that_fails_ends_the_command_with_its_code(tmp_path, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setattr(train, "main", lambda words: 130)
    monkeypatch.setattr(evaluate, "main", None)
    assert reproduce.main(["pong-cpu"]) == 130


@pytest.mark.parametrize(
    "words, text",
    [
        (["pong-12s"], "pong-12s needs a GPU"),
        (["pong-cp"], "did you mean pong-cpu?"),
        (["pong-cpu", "seed=2"], "seed: no such key"),
    ],
)
def test_errors_are_one_sentence(tmp_path, monkeypatch, capsys, words, text):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(gpu, "is_available", lambda: False)
    monkeypatch.setattr(sys, "argv", ["megastep", "reproduce", *words])
    assert entry.main() == 2
    assert text in capsys.readouterr().err
    assert not [*tmp_path.iterdir()]
