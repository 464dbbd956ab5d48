"""Videos of trained agents."""

import io
import os
import re
import shutil
import signal

import numpy as np
import pytest
from matplotlib import pyplot as plt

from megastep import recording
from megastep.agents import console
from megastep.agents.cli import record, train
from tests.helpers import faults, tiny
from tests.helpers.tiny import settings

TINY = [*tiny.TINY, "samples=1"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        base = tmp_path_factory.mktemp("trained")
        patch.chdir(base)
        return base / train.run(settings(*TINY))


def test_video_has_a_frame_per_step(trained, monkeypatch, capsys):
    import av

    monkeypatch.setattr(console, "LINE_EVERY", 0)
    assert record.main([f"run={trained}", "steps=3", "device=cpu"]) == 0
    out = capsys.readouterr().out
    assert "\n2 of 3 frames · 0 s left\n" in out and "Filmed 3 steps of one environment: " in out
    with av.open(str(trained / "video.mp4")) as video:
        frames = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
        assert video.streams.video[0].average_rate == 10  # the environment's
    assert len(frames) == 3 and frames[0].std() > 10
    assert frames[0].shape[0] % 2 == frames[0].shape[1] % 2 == 0


def test_recordings_take_the_next_free_name(trained, tmp_path, monkeypatch, capsys):
    copy = shutil.copytree(trained, tmp_path / "copy", ignore=lambda *_: ["video.mp4"])
    filmed = []

    def film(players, path, *_, **look):
        filmed.append(path.name)
        if len(filmed) == 3:
            raise RuntimeError("Frame 0 could not be drawn: by chance")
        path.write_text(str(len(filmed)))

    monkeypatch.setattr(recording, "film_all", film)
    words = [f"run={copy}", "steps=1", "device=cpu"]
    assert [record.main(words) for _ in range(4)] == [0, 0, 2, 0]
    names = ["video.mp4", "video-2.mp4", "video-3.mp4"]
    assert filmed == [*names, names[2]], "the third failed and left no file"
    assert [(copy / name).read_text() for name in names] == ["1", "2", "4"]
    assert f"{copy / 'video-2.mp4'}" in capsys.readouterr().out
    assert record.main([*words, f"file={copy / 'video.mp4'}"]) == 0
    assert (copy / "video.mp4").read_text() == "5", "a file that is named is overwritten"


@pytest.fixture(scope="module")
def filmed(trained, tmp_path_factory):
    """Returns the bytes of a film of four steps, by its ending."""
    folder = tmp_path_factory.mktemp("filmed")

    def film(ending, *words):
        path = folder / "new" / f"film{ending}"
        common = [f"run={trained}", "steps=4", "device=cpu", f"file={path}"]
        assert record.main([*common, *words]) == 0
        return path.read_bytes()

    return film


def frames_of(content):
    import av

    with av.open(io.BytesIO(content)) as video:
        return [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]


def test_pictures_are_the_last_frame(filmed):
    last = frames_of(filmed(".mp4"))[-1]
    gif = frames_of(filmed(".gif"))
    drawn = (255 * plt.imread(io.BytesIO(filmed(".png")))[..., :3]).round()
    assert len(gif) == 4 and drawn.shape == last.shape == gif[-1].shape == (720, 640, 3)
    assert drawn.std() > 10 and np.abs(drawn - last).mean() < 3, "compression loses as much"
    assert np.abs(drawn - gif[-1]).mean() < 1, "a level of 256"
    svg, pdf = filmed(".svg"), filmed(".pdf")
    assert b"step 3" in svg and pdf.startswith(b"%PDF")


def test_homes_in_a_grid(filmed):
    grid = frames_of(filmed(".gif", "homes=[0,2,1]", "geometry=homes"))[-1]
    alone = frames_of(filmed(".gif", "home=2", "geometry=homes", "title='home 2'"))[-1]
    assert grid.shape == (1440, 1280, 3)
    assert np.abs(grid[:720, 640:].astype(int) - alone).mean() < 1, "the second of the first row"
    assert len(np.unique(grid[720:, 640:].reshape(-1, 3), axis=0)) == 1, "an empty corner"


def test_runs_side_by_side_begin_alike(trained, filmed, tmp_path):
    path = tmp_path / "two.gif"
    words = [f"runs=[{trained},{trained}]", "steps=3", "device=cpu", f"file={path}"]
    assert record.main(words) == 0
    for frame in frames_of(path.read_bytes()):
        assert frame.shape == (720, 1280, 3) and (frame[:, :640] == frame[:, 640:]).all()


@pytest.mark.parametrize(
    "words, text",
    [
        (["home=1000000"], r"There is no home 1000000: split=test has \d+, from home=0"),
        (["homes=[0,1000000]"], "There is no home 1000000"),
        (["theme=blue"], "theme"),
        (["runs=[a,b]"], "runs: cannot be combined with run"),
        (["file=a.webm"], r"'a.webm' is neither a film, .mp4 or .gif"),
    ],
)
def test_film_that_cannot_be(trained, here, monkeypatch, capsys, words, text):
    monkeypatch.setattr(recording, "film_moments", lambda *_: pytest.fail("it is drawn"))
    assert record.main([f"run={trained}", "steps=1", "device=cpu", *words]) == 2
    assert re.search(text, capsys.readouterr().err) and not os.listdir()


def test_environment_without_homes_has_one(here, capsys):
    words = ["env=pong", "steps=2", "device=cpu"]
    assert record.main([*words, "home=1"]) == 2
    assert "There is no home 1: the environment has none" in capsys.readouterr().err
    assert record.main([*words, "file=pong.gif"]) == 0 and os.listdir() == ["pong.gif"]


def test_disk_that_fills_up_while_the_film_is_written(trained, here, capsys):
    with faults.full_disk(2000):
        assert record.main([f"run={trained}", "steps=3", "device=cpu", "file=film.mp4"]) == 2
    assert "File too large" in capsys.readouterr().err and not os.listdir()


@pytest.mark.parametrize(
    "file, text",
    [
        ("/proc/video.mp4", "The video /proc/video.mp4 could not be made: "),
        ("folder.mp4", "The video folder.mp4 could not be made: folder.mp4 is a folder"),
        (f"{300 * 'x'}.mp4", "File name too long"),
    ],
)
def test_video_that_cannot_be_made(trained, here, monkeypatch, capsys, file, text):
    (here / "folder.mp4").mkdir()
    monkeypatch.setattr(recording, "film_moments", lambda *_: pytest.fail("it is drawn"))
    assert record.main([f"run={trained}", "steps=1", "device=cpu", f"file={file}"]) == 2
    assert text in capsys.readouterr().err and os.listdir() == ["folder.mp4"]


@pytest.fixture
def handlers():
    """Restores the signal handlers."""
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize(
    "script, number, code", [("record", signal.SIGTERM, 143), ("train", signal.SIGINT, 130)]
)
def test_signal_while_filming(
    script, number, code, trained, tmp_path, handlers, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(recording.Mp4Writer, "add", lambda *_: os.kill(os.getpid(), number))
    if script == "record":
        assert record.main([f"run={trained}", "steps=9", "device=cpu"]) == code
    else:
        assert train.main([*TINY, "finish.record=true"]) == code
    assert "could not be" not in capsys.readouterr().err
    assert not list(tmp_path.rglob("*.mp4"))


def failing(*_, **__):
    raise RuntimeError("Frame 0 could not be drawn: by chance")


def test_training_survives_a_failed_video(trained, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(recording, "_image", failing)
    assert train.main([*TINY, "finish.record=true"]) == 0
    assert "Frame 0 could not be drawn" in capsys.readouterr().err
    assert not list(tmp_path.glob("runs/*/*.mp4"))
