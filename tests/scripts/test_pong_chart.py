"""The chart of what a step of Pong costs: measuring, storing and drawing."""

import pong_chart
import pytest
import records
import timing


@pytest.fixture
def tiny_measurements(monkeypatch):
    """Shrinks the measurements to three environments, timed for milliseconds."""
    implementations = {
        name: (implementation, 3)
        for name, (implementation, _) in pong_chart.IMPLEMENTATIONS.items()
    }
    monkeypatch.setattr(pong_chart, "IMPLEMENTATIONS", implementations)
    monkeypatch.setattr(pong_chart, "N_WARM_UP", 3)
    monkeypatch.setattr(timing, "N_SAMPLES", 2)
    monkeypatch.setattr(timing, "SAMPLE_SECONDS", 1e-3)


def test_sizes_alternate_factors_of_three_and_ten():
    assert pong_chart.sizes(100) == [1, 3, 10, 30, 100]
    assert pong_chart.sizes(50)[-2:] == [30, 50]


@pytest.mark.slow
def test_installed_implementations_are_measured_and_drawn(tiny_measurements, tmp_path, capsys):
    path, chart = tmp_path / "pong.jsonl", tmp_path / "pong.svg"
    arguments = ["--records", str(path), "--chart", str(chart)]
    pong_chart.main(["measure", *arguments])
    output, rows = capsys.readouterr().out, records.read(path)
    assert ("Atari emulator, 1" in output) != ("pip install ale-py" in output)
    for name in ("plain Python", "NumPy", "megastep"):
        measured_rows = [row for row in rows if row["name"] == name]
        assert [row["environments"] for row in measured_rows] == [1, 3]
        assert all(row["seconds"] > 0 for row in measured_rows)
    pong_chart.main(["draw", *arguments])
    svg = chart.read_text()
    assert "megastep, one CPU thread" in svg and "megastep, one NVIDIA" in svg
    pong_chart.main(["draw", *arguments])
    assert chart.read_text() == svg, "the same records must give the same chart"


def test_new_record_replaces_old_one_of_same_size(tmp_path):
    path, record = tmp_path / "pong.jsonl", dict(name="NumPy", environments=3)
    for seconds in (2.0, 1.0):
        pong_chart.store(path, record | dict(seconds=seconds))
    pong_chart.store(path, record | dict(environments=10, seconds=3.0))
    assert [row["seconds"] for row in records.read(path)] == [1.0, 3.0]


def test_gpu_points_are_seconds_per_environment():
    """Two million environment steps per second are half a microsecond each."""
    images = dict(
        benchmark="pong", what="pong, pictures, `env.step`, 4,096 environments", value=2.0
    )
    images |= dict(on="NVIDIA H200", unit="M/s", date="2026-11-21")
    features = images | dict(what="pong, features, `env.step`, 4,096 environments")
    on_cpu = images | dict(on="CPU, 2 threads of AMD EPYC")
    points = list(pong_chart.gpu_points([images, features, on_cpu]))
    assert points == [(4096, 5e-7, "NVIDIA H200")]
