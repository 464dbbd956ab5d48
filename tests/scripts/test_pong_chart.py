"""The chart of what a step of Pong costs: what is measured, kept and drawn."""

import json

import pong_chart
import pytest
import timing


@pytest.fixture
def brief(monkeypatch):
    """A few environments, stepped for a moment."""
    few = {name: (make, 3) for name, (make, _) in pong_chart.SUBJECTS.items()}
    monkeypatch.setattr(pong_chart, "SUBJECTS", few)
    monkeypatch.setattr(pong_chart, "STEPS", 3)
    monkeypatch.setattr(timing, "REPEATS", 2)
    monkeypatch.setattr(timing, "SECONDS", 1e-3)


def test_sizes_are_one_three_ten_and_so_on():
    assert pong_chart.sizes(100) == [1, 3, 10, 30, 100] and pong_chart.sizes(50)[-2:] == [30, 50]


def test_all_that_is_installed_is_measured_and_drawn(brief, tmp_path, capsys):
    records, chart = tmp_path / "pong.jsonl", tmp_path / "pong.svg"
    where = ["--records", str(records), "--chart", str(chart)]
    pong_chart.main(["measure", *where])
    said, found = capsys.readouterr().out, [json.loads(x) for x in records.read_text().splitlines()]
    assert ("Atari emulator, 1" in said) != ("pip install ale-py" in said)
    for name in ("plain Python", "NumPy", "megastep"):
        own = [r for r in found if r["name"] == name]
        assert [r["environments"] for r in own] == [1, 3] and all(r["seconds"] > 0 for r in own)
    pong_chart.main(["draw", *where])
    drawn = chart.read_text()
    assert "megastep, one CPU thread" in drawn and "megastep, one NVIDIA" in drawn
    pong_chart.main(["draw", *where])
    assert chart.read_text() == drawn, "the same records give the same chart"


def test_what_is_measured_again_takes_the_place_of_the_older(tmp_path):
    path, record = tmp_path / "pong.jsonl", dict(name="NumPy", environments=3)
    for seconds in (2.0, 1.0):
        pong_chart.store(path, dict(record, seconds=seconds))
    pong_chart.store(path, dict(record, environments=10, seconds=3.0))
    kept = [json.loads(line)["seconds"] for line in path.read_text().splitlines()]
    assert kept == [1.0, 3.0]


def test_a_million_steps_per_second_are_a_microsecond_each():
    rate = dict(benchmark="pong", what="pong, pictures, `env.step`, 4,096 environments", value=2.0)
    rate |= dict(on="NVIDIA H200", unit="M/s", date="2026-11-21")
    other = dict(rate, what="pong, features, `env.step`, 4,096 environments")
    found = list(pong_chart.on_gpu([rate, other, dict(rate, on="CPU, 2 threads of AMD EPYC")]))
    assert found == [(4096, 5e-7, "NVIDIA H200")]
