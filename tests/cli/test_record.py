"""Videos of trained agents."""

import os
import re
import shutil
import signal

import numpy as np
import pytest
from matplotlib import pyplot as plt

from megastep import plotting, recording
from megastep.agents.cli import record, train
from megastep.agents.runs import checkpoint
from tests.helpers import tiny
from tests.helpers.tiny import settings

TINY = [*tiny.TINY, "samples=1"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        base = tmp_path_factory.mktemp("trained")
        patch.chdir(base)
        return base / train.run(settings(*TINY))


def test_video_has_a_frame_per_step(trained):
    import av

    assert record.main([f"run={trained}", "steps=3", "device=cpu"]) == 0
    with av.open(str(trained / "video.mp4")) as video:
        frames = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
        assert video.streams.video[0].average_rate == 10  # the environment's
    assert len(frames) == 3 and frames[0].std() > 10
    assert frames[0].shape[0] % 2 == frames[0].shape[1] % 2 == 0


def test_recordings_take_the_next_free_name(trained, tmp_path, monkeypatch, capsys):
    copy = shutil.copytree(trained, tmp_path / "copy", ignore=lambda *_: ["video.mp4"])
    filmed = []

    def film(env, policy, path, *_):
        filmed.append(path.name)
        if len(filmed) == 3:
            raise RuntimeError("Frame 0 could not be drawn: by chance")
        path.write_text(str(len(filmed)))

    monkeypatch.setattr(recording, "film", film)
    words = [f"run={copy}", "steps=1", "device=cpu"]
    assert [record.main(words) for _ in range(4)] == [0, 0, 2, 0]
    names = ["video.mp4", "video-2.mp4", "video-3.mp4"]
    assert filmed == [*names, names[2]], "the third failed and left no file"
    assert [(copy / name).read_text() for name in names] == ["1", "2", "4"]
    assert f"{copy / 'video-2.mp4'}" in capsys.readouterr().out
    assert record.main([*words, f"file={copy / 'video.mp4'}"]) == 0
    assert (copy / "video.mp4").read_text() == "5", "a file that is named is overwritten"


def test_png_is_the_last_frame(trained, tmp_path):
    import av

    video, still = tmp_path / "a.mp4", tmp_path / "folder" / "a.png"
    common = [f"run={trained}", "steps=4", "device=cpu"]
    assert record.main([*common, f"file={video}"]) == 0
    with av.open(str(video)) as file:
        *_, last = [frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)]
    assert record.main([*common, f"file={still}"]) == 0
    drawn = (255 * plt.imread(still)[..., :3]).round()
    height, width = drawn.shape[:2]  # of the video, sizes are even
    errors = np.abs(drawn - last[:height, :width])
    assert drawn.std() > 10 and errors.mean() < 3, "compression loses as much"


@pytest.mark.parametrize("env", ["explorer", "pointgoal"])
def test_several_cameras(env, tmp_path):
    options = [f"env={env}", "geometry=box", "env.cameras=[0,120,240]", "device=cpu", "steps=1"]
    heights = []
    for cameras in options[2], "env.cameras=[0]":
        file = tmp_path / "a.png"
        assert record.main([*options[:2], cameras, *options[3:], f"file={file}"]) == 0
        heights.append(len(plt.imread(file)))
    strip = 100 * plotting.STRIP * (6 - 2 * 0.55)
    # two rows more in each of two strips
    assert heights[0] - heights[1] == pytest.approx(2 * 2 * strip, abs=2)


@pytest.mark.parametrize(
    "file, text",
    [
        ("/proc/video.mp4", "The video /proc/video.mp4 could not be made: "),
        ("a/video.gif", "file: 'a/video.gif' is neither a video, .mp4, nor its last frame, .png"),
        ("folder.mp4", "The video folder.mp4 could not be made: folder.mp4 is a folder"),
        (f"{300 * 'longer/'}{300 * 'x'}.mp4", "File name too long"),
    ],
)
def test_video_that_cannot_be_made(trained, here, monkeypatch, capsys, file, text):
    (here / "folder.mp4").mkdir()
    monkeypatch.setattr(recording, "_states", lambda *_: pytest.fail("it is drawn"))
    assert record.main([f"run={trained}", "steps=1", "device=cpu", f"file={file}"]) == 2
    assert text in capsys.readouterr().err and os.listdir() == ["folder.mp4"]


def test_run_of_another_environment(trained, tmp_path, capsys):
    loaded = checkpoint.load_latest(trained / "checkpoints")
    loaded.config["train"]["env"]["res"] = 16
    checkpoint.save(tmp_path / "checkpoints", 32, loaded.state, loaded.config)
    assert record.main([f"run={tmp_path}", "steps=1", "device=cpu"]) == 2
    error = capsys.readouterr().err
    assert re.search(r"obs was MultiImage\(.*W=8\) and is MultiImage\(.*W=16\)", error)
    assert os.listdir(tmp_path) == ["checkpoints"]


@pytest.fixture
def handlers():
    """Restores the signal handlers."""
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number, code", [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
@pytest.mark.parametrize("script", ["record", "train"])
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
    monkeypatch.setattr(recording.ParallelEncoder, "__call__", failing)
    assert train.main([*TINY, "finish.record=true"]) == 0
    assert "Frame 0 could not be drawn" in capsys.readouterr().err
    assert not list(tmp_path.glob("runs/*/*.mp4"))


def test_geometry_keys_need_a_geometry(capsys):
    assert record.main(["env=minimal", "geometry.n=4"]) == 2
    assert re.search("geometry: .*give geometry=", capsys.readouterr().err)
