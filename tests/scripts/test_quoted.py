"""The figures in README.md and docs/: each is what its record says."""

import re

import pytest
import quoted

#: Speeds, which are always from a record.
SPEED = r"\d ?(?:k|M|million|billion)?\*? (?:samples|frames|steps|transitions)/s|\d ?[kM]/s"
SPEED_UP = r"\d times as (?:fast|long)|\d %? (?:faster|slower)"
#: Results: a decimal after a word such as success, or an interval.
RESULT = (
    r"\b(?:success|SPL|coverage|covers|wins?|won|scores?|returns?|earns?|reach(?:es)?)\b"
    r"[^.;|\n]{0,30}?\d\.\d|\(-?\d+\.\d+ to \d+\.\d+\)"
)
CODE = re.compile(r"^```.*?^```|`[^`\n]+`", re.S | re.M)


@pytest.mark.parametrize("path", quoted.PAGES, ids=lambda path: path.name)
def test_quotes_are_what_the_records_say(path):
    text = path.read_text()
    assert quoted.rewritten(text) == text, "python scripts/benchmarks/benchmark.py report"
    assert text.count("<!-- quote: ") == text.count("<!-- end -->") == len(quoted.names(path))
    # a comment at the start of a line would end the paragraph
    assert not re.search(r"^<!-- quote: .*<!-- end -->", text, re.M)


@pytest.mark.parametrize("path", quoted.PAGES, ids=lambda path: path.name)
def test_no_measurement_is_typed_by_hand(path):
    text = CODE.sub("", quoted.MARKED.sub("", path.read_text()))
    assert re.findall(f"{SPEED}|{SPEED_UP}|{RESULT}", text) == []
    ours = [line for line in text.splitlines() if "✓" in line and line.startswith("|")]
    assert not re.search(r"\d M\b", "".join(ours))


@pytest.mark.parametrize(
    "text",
    [
        "19.2 M samples/s",
        "1.28 times as fast",
        "has success 0.992",
        "| generated | 0.668 (0.633 to 0.703) |",
    ],
)
def test_measurements_are_recognised(text):
    assert re.search(f"{SPEED}|{SPEED_UP}|{RESULT}", text)


def test_every_quote_is_used():
    used = [name for path in quoted.PAGES for name in quoted.names(path)]
    assert {*quoted.quotes()} == {*used}


def test_a_figure_is_of_the_newest_record_of_its_card(monkeypatch):
    def record(what, value, date, on="NVIDIA H200"):
        return dict(benchmark="step", what=what, value=value, date=date, on=on, unit="M/s") | dict(
            lower=1.0, upper=2.0, commit=f"c{value}"
        )

    rows = [
        record("a, seed 1", 1.0, "2026-01-02"),
        record("a, seed 2", 4.0, "2026-01-01"),
        record("a, seed 1", 9.0, "2026-01-03", "NVIDIA H100"),
    ]
    monkeypatch.setattr(quoted, "_newest", lambda: quoted.records.newest(rows))
    form = "{low:.0f} to {high:.0f}, {value:.1f}, {n} on {on}, {commit}, {date}"
    quotes = {
        "a": dict(what=r"a, seed \d", card="NVIDIA H200", **{"as": form}),
        "absent": dict(what="b", card="NVIDIA H200", **{"as": form}),
        "unsaid": dict(page="speed.md", line="| one H200 |", says="a million"),
        "agent": dict(agent="pointgoal_anywhere", source="bench", **{"as": "{spl:.1f} {lanes}"}),
    }
    monkeypatch.setattr(quoted, "quotes", lambda: quotes)
    page = "<!-- quote: a -->5<!-- end -->"
    text = "1 to 4, 2.5, 2 on NVIDIA H200, c1.0, c4.0, 2026-01-02"
    assert quoted.rewritten(page) == page.replace("5", text)
    assert quoted.text_of("agent") == "0.8 8000"
    for name, words in (("absent", "no record"), ("unsaid", "does not say"), ("x", "has no x")):
        with pytest.raises(ValueError, match=words):
            quoted.text_of(name)
