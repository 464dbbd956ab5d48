"""Videos: order and size of frames, errors, files."""

import os

import av
import numpy as np
import pytest
import torch
from PIL import Image

from megastep import engine, envs, modules, recording
from megastep.arrdict import arrdict
from megastep.core import AGENT_RADIUS
from megastep.geometries import sample
from megastep.recording import ParallelEncoder

SIZE = 32
TOLERANCE = 6  # grey levels: the loss of h264 at this quality on a flat colour


def plot_grey(state):
    """Draws a flat grey image."""
    return np.full((SIZE, SIZE, 3), state.grey, np.uint8)


def plot_badly(state):
    return 1 / state.x


class Env:
    @staticmethod
    def plot_static(state):
        return np.full((SIZE, SIZE, 3), state.grey, np.uint8)

    def plot_state(self, state):
        from matplotlib import pyplot

        figure = pyplot.figure(figsize=(1.01, 0.65), dpi=100)
        figure.add_subplot().plot(state.xs)
        return figure


def record(plot_state, states, **settings):
    with ParallelEncoder(plot_state, **settings) as encoder:
        for state in states:
            encoder(state)
    return encoder


def frames(path):
    """Returns the frames of a video file, (n, H, W, 3)."""
    with av.open(str(path)) as container:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])


def test_file_is_h264_in_yuv420p_at_the_given_fps(tmp_path):
    with ParallelEncoder(plot_grey, fps=12.5) as encoder:
        for _ in range(25):
            encoder.frame(np.zeros((SIZE, SIZE, 3)))
    with av.open(str(encoder.save(tmp_path / "new" / "video.mp4"))) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.pix_fmt, stream.frames) == ("h264", "yuv420p", 25)
        assert float(stream.average_rate) == 12.5
        assert float(stream.duration * stream.time_base) == 2.0
    assert os.listdir(tmp_path / "new") == ["video.mp4"]


def test_images_and_states_can_be_mixed(tmp_path):
    with ParallelEncoder(plot_grey) as encoder:
        encoder(arrdict(i=0, grey=50))
        encoder.frame(np.full((SIZE, SIZE, 3), 100, np.uint8))
        encoder.frame(np.full((SIZE, SIZE, 3), 150 / 255))
        encoder(arrdict(i=9, grey=200))
    means = frames(encoder.save(tmp_path / "video.mp4")).mean((1, 2, 3))
    assert np.abs(means - [50, 100, 150, 200]).max() < TOLERANCE


def test_odd_sizes_are_padded_to_even(tmp_path):
    with ParallelEncoder(plot_grey) as encoder:
        encoder.frame(np.full((33, 47, 3), 200, np.uint8))
    video = frames(encoder.save(tmp_path / "video.mp4"))
    assert video.shape == (1, 34, 48, 3) and abs(video[0, -1, -1].mean() - 200) < TOLERANCE


def test_figures_of_pyplot_are_closed(tmp_path):
    from matplotlib import pyplot

    open_before = pyplot.get_fignums()
    encoder = record(Env().plot_state, [arrdict(xs=torch.arange(i)) for i in range(3)])
    assert pyplot.get_fignums() == open_before
    assert frames(encoder.save(tmp_path / "video.mp4")).shape == (3, 66, 102, 3)


@pytest.mark.parametrize("x, error", [(0, "ZeroDivision"), (1, "TypeError: plot_state must retu")])
def test_an_error_names_the_frame(x, error):
    with pytest.raises(RuntimeError, match=f"frame 1 could not be recorded: {error}"):
        with ParallelEncoder(plot_badly) as encoder:
            encoder.frame(np.zeros((SIZE, SIZE, 3)))
            encoder(arrdict(x=x))


class Stopped(BaseException):
    """What a signal handler raises."""


def test_a_signal_is_not_changed(monkeypatch):
    """Also if closing the video fails too."""

    def stop(*_):
        raise Stopped

    def broken(self):
        raise OSError("the container is broken")

    monkeypatch.setattr(recording.Mp4Writer, "close", broken)
    with pytest.raises(Stopped), ParallelEncoder(stop) as encoder:
        encoder(arrdict(grey=0))


def test_exception_in_the_block_is_not_changed():
    with pytest.raises(KeyError, match="mine"), ParallelEncoder(plot_grey) as encoder:
        encoder(arrdict(i=0, grey=0))
        raise KeyError("mine")


def test_frames_before_an_error_can_be_saved(tmp_path):
    with pytest.raises(KeyError), ParallelEncoder(plot_grey) as encoder:
        encoder.frame(np.zeros((SIZE, SIZE, 3)))
        raise KeyError
    assert len(frames(encoder.save(tmp_path / "video.mp4"))) == 1


def test_frame_of_another_size_is_refused():
    with pytest.raises(RuntimeError, match="frame 1 .*32 x 16.*32 x 32"):
        with ParallelEncoder(plot_grey) as encoder:
            encoder.frame(np.zeros((16, 32, 3)))
            encoder.frame(np.zeros((32, 32, 3)))


@pytest.mark.parametrize(
    ("array", "error"),
    [
        (np.zeros((4, 4)), r"shape \(H, W, 3\).* \(4, 4\)"),
        (np.zeros((4, 4, 4)), r"\(4, 4, 4\)"),
        (np.zeros((0, 4, 3)), r"\(0, 4, 3\)"),
        (np.zeros((4, 4, 3), int), "uint8 or floats.*int"),
    ],
)
def test_bad_images_are_refused(array, error):
    with pytest.raises(ValueError, match=error), ParallelEncoder(plot_grey) as encoder:
        encoder.frame(array)


def test_frames_are_added_inside_the_block_and_saved_after_it(tmp_path):
    encoder = ParallelEncoder(plot_grey)
    with pytest.raises(RuntimeError, match="inside the with block"):
        encoder(arrdict(i=0, grey=0))
    with encoder, pytest.raises(RuntimeError, match="after it"):
        encoder.save(tmp_path / "video.mp4")
    with pytest.raises(ValueError, match="no frames"):
        encoder.save(tmp_path / "video.mp4")
    with pytest.raises(ValueError, match="no frames"):
        encoder.notebook()
    assert not os.listdir(tmp_path)


def test_failed_save_keeps_the_old_file(tmp_path, monkeypatch):
    with ParallelEncoder(plot_grey) as encoder:
        encoder.frame(np.zeros((SIZE, SIZE, 3)))
    (tmp_path / "video.mp4").write_text("old")

    def fail(*args):
        raise OSError("no space left")

    with monkeypatch.context() as patched, pytest.raises(OSError, match="no space left"):
        patched.setattr(recording.os, "replace", fail)
        encoder.save(tmp_path / "video.mp4")
    assert os.listdir(tmp_path) == ["video.mp4"] and (tmp_path / "video.mp4").read_text() == "old"
    with pytest.raises(ValueError, match="format mp4.*use video.mp4"):
        encoder.save(tmp_path / "video.gif")


def test_notebook_embeds_the_video():
    with ParallelEncoder(plot_grey) as encoder:
        encoder.frame(np.zeros((SIZE, SIZE, 3)))
    assert (
        encoder.notebook()
        ._repr_html_()
        .startswith('<video controls autoplay loop muted src="data:video/mp4;base64,AAAA')
    )


# ---- Films ----


class Stranger:
    """Counts its steps. Drawn as a flat image, or as a matplotlib figure."""

    n_envs, fps, device = 1, 10.0, torch.device("cpu")

    def reset(self):
        self.age = 0
        return self.world(True)

    def step(self, decision):
        self.age += 1
        return self.world(self.age == 3)

    def world(self, reset):
        return arrdict(reward=torch.tensor([2.0 * (not reset)]), reset=torch.tensor([reset]))

    def state(self, e):
        return arrdict(grey=torch.tensor(10 * self.age))

    plot_state = staticmethod(Env.plot_static)


class Still:
    def initial(self, n_lanes, device):
        return None

    def __call__(self, world, hidden, sample=True, generator=None):
        return arrdict(), None


def test_films_of_strangers_have_a_caption_and_show_themselves(tmp_path, monkeypatch):
    notes, styled = [], recording.plotting.captioned

    def captioned(image):
        notes.append(recording.plotting.current().note)
        return styled(image)

    monkeypatch.setattr(recording.plotting, "captioned", captioned)
    film = recording.film(Stranger(), Still(), tmp_path / "film.mp4", steps=5, title="A title")
    assert notes[-5:] == [f"return {earned}.0" for earned in (0, 2, 4, 0, 2)]
    shown = frames(film)
    assert shown.shape[0] == 5 and shown.shape[1] > 640, "enlarged"
    assert np.abs(shown[-1, -10, 10].astype(int) - 40).max() < TOLERANCE
    assert film == tmp_path / "film.mp4" and "video/mp4;base64,AAAA" in film._repr_html_()
    assert (
        "image/png;base64"
        in recording.film(Stranger(), Still(), tmp_path / "film.png", steps=2)._repr_html_()
    )


def test_state_renders_the_environment_that_is_shown_alone(monkeypatch):
    """Its images are those that all environments' have, bit by bit, objects included."""
    homes = sample("bench", 3)
    env = envs.Deathmatch(6, n_agents=2, geometries=homes, res=16, subsample=1, device="cpu")
    things = modules.Objects(homes, env.core, {"crate": modules.Crate(2)})["crate"]
    env.reset()
    things.place(torch.ones(6, dtype=torch.bool))
    every = engine.observe(env.core.scenery, env.core.agents)
    seen, observe = [], engine.observe

    def counted(scenery, *arguments, **options):
        seen.append(scenery.n_envs)
        return observe(scenery, *arguments, **options)

    monkeypatch.setattr(engine, "observe", counted)
    for e in (5, 0, 3):
        state = env.state(e)
        depth = 1 - (state.core.distances - AGENT_RADIUS) / 10
        assert torch.allclose(depth[:, 0], every.depth[e].float(), atol=1e-6)
        assert (state.rgb[:, :, 0] == every.rgb[e]).all()
        assert (state.core.positions == env.core.agents.positions[e]).all()
        assert len(state.core.objects.shapes) == int(env.core.scenery.objects.visible[e].sum()) > 0
    assert seen and {*seen} == {1}


@pytest.mark.parametrize("fps", [10, 24, 50, 60, 80, 120, 2000])
@pytest.mark.parametrize("format", ["gif", "mp4"])
def test_films_take_as_long_as_they_should_at_any_speed(tmp_path, format, fps):
    """Browsers show a GIF's frames of one hundredth of a second for ten."""
    with ParallelEncoder(plot_grey, fps, format) as encoder:
        for i in range(2 * fps):
            encoder.frame(np.full((8, 8, 3), i % 256, np.uint8))
    film = encoder.save(tmp_path / f"film.{format}")
    if format == "mp4":
        with av.open(str(film)) as container:
            stream = container.streams.video[0]
            assert float(stream.duration * stream.time_base) == pytest.approx(2, abs=0.01)
            assert stream.average_rate <= 120
        return
    gif = Image.open(film)
    delays = [gif.info["duration"] for i in range(gif.n_frames) if gif.seek(i) is None]
    assert sum(delays) == pytest.approx(2000, abs=10) and min(delays) >= 20
