"""Videos: order, sizes, workers, errors, files."""

import os
import subprocess
import sys
import threading
import time
import types
import warnings

import av
import numpy as np
import pytest
import torch

from megastep import recording
from megastep.arrdict import arrdict
from megastep.recording import ParallelEncoder

SIZE = 32
TOLERANCE = 6  # grey levels: what h264 at this quality loses on flat colour


def plot_grey(state):
    """A flat image of the state's grey level; early frames take longest, so that workers finish
    out of order.
    """
    time.sleep(0.2 / (1 + state.i))
    return np.full((SIZE, SIZE, 3), state.grey, np.uint8)


def plot_facts(state):
    """Writes what a worker's process is like to the file that the state names."""
    import matplotlib

    facts = [
        os.getpid(),
        matplotlib.get_backend().capitalize(),
        torch.get_num_threads(),
        torch.cuda.is_initialized(),
        os.environ["CUDA_VISIBLE_DEVICES"],
        type(state).__name__,
        type(state.x).__name__,
    ]
    with open(state.path, "w") as file:
        file.write(" ".join(map(str, facts)))
    return np.zeros((SIZE, SIZE, 3), np.uint8)


def plot_badly(state):
    return 1 / state.x


def plot_fatally(state):
    os._exit(3)


class Env:
    def __init__(self):
        self.pids = []

    @classmethod
    def plot_class(cls, state):
        return np.full((SIZE, SIZE, 3), os.getpid() % 2, np.uint8)

    @staticmethod
    def plot_static(state):
        return np.full((SIZE, SIZE, 3), state.grey, np.uint8)

    def plot_state(self, state):
        from matplotlib import pyplot

        self.pids.append(os.getpid())
        figure = pyplot.figure(figsize=(1.01, 0.65), dpi=100)
        figure.add_subplot().plot(state.xs)
        return figure


def record(plot_state, states, **settings):
    with ParallelEncoder(plot_state, **settings) as encoder:
        for state in states:
            encoder(state)
    return encoder


def frames(path):
    """(n, H, W, 3) of a video file."""
    with av.open(str(path)) as container:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])


def test_frames_come_out_in_the_order_they_went_in(tmp_path):
    greys = [int(grey) for grey in np.linspace(0, 255, 12)]
    states = [arrdict(i=i, grey=torch.tensor(grey)) for i, grey in enumerate(greys)]
    path = record(plot_grey, states, n_workers=2).save(tmp_path / "video.mp4")
    assert np.abs(frames(path).mean((1, 2, 3)) - greys).max() < TOLERANCE


def test_the_file_is_h264_in_yuv420p_at_the_rate_asked_for(tmp_path):
    with ParallelEncoder(plot_grey, fps=12.5) as encoder:
        for _ in range(25):
            encoder.frame(np.zeros((SIZE, SIZE, 3)))
    with av.open(str(encoder.save(tmp_path / "new" / "video.mp4"))) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.pix_fmt, stream.frames) == ("h264", "yuv420p", 25)
        assert (
            float(stream.average_rate) == 12.5 and float(stream.duration * stream.time_base) == 2.0
        )
    assert os.listdir(tmp_path / "new") == ["video.mp4"]


def test_images_and_states_can_be_mixed_and_keep_their_order(tmp_path):
    with ParallelEncoder(plot_grey, n_workers=1) as encoder:
        encoder(arrdict(i=0, grey=50))
        encoder.frame(np.full((SIZE, SIZE, 3), 100, np.uint8))
        encoder.frame(np.full((SIZE, SIZE, 3), 150 / 255))
        encoder(arrdict(i=9, grey=200))
    means = frames(encoder.save(tmp_path / "video.mp4")).mean((1, 2, 3))
    assert np.abs(means - [50, 100, 150, 200]).max() < TOLERANCE


def test_odd_sizes_are_padded_to_even(tmp_path):
    with ParallelEncoder(plot_grey) as encoder:
        encoder.frame(np.full((33, 47, 3), 200, np.uint8))
    shot = frames(encoder.save(tmp_path / "video.mp4"))
    assert shot.shape == (1, 34, 48, 3) and abs(shot[0, -1, -1].mean() - 200) < TOLERANCE


def test_a_state_may_change_once_it_was_given(tmp_path):
    state = arrdict(i=0, grey=torch.tensor(200))
    with ParallelEncoder(plot_grey, n_workers=1) as encoder:
        encoder(state)
        state.grey.zero_()
    assert abs(frames(encoder.save(tmp_path / "video.mp4")).mean() - 200) < TOLERANCE


def test_workers_are_other_processes_with_one_thread_and_no_gpu(tmp_path):
    record(plot_facts, [arrdict(path=str(tmp_path / "facts"), x=torch.zeros(1))], n_workers=1)
    pid, *facts = (tmp_path / "facts").read_text().split(" ")
    assert int(pid) != os.getpid()
    assert facts == ["Agg", "1", "False", "", "arrdict", "ndarray"]


def test_few_frames_are_in_flight(monkeypatch):
    submitted = []

    class Future:
        def __init__(self):
            self.read = False

        def done(self):
            return False

        def result(self):
            self.read = True
            return np.zeros((SIZE, SIZE, 3), np.uint8)

    def submit(*args):
        submitted.append(Future())
        return submitted[-1]

    with ParallelEncoder(plot_grey, n_workers=3) as encoder:
        pool = types.SimpleNamespace(submit=submit, shutdown=lambda **how: None)
        monkeypatch.setattr(encoder, "_pool", pool)
        for i in range(20):
            encoder(arrdict(i=i))
            assert sum(not future.read for future in submitted) == min(i + 1, 6)
    assert all(future.read for future in submitted)


@pytest.mark.parametrize(
    "plot_state", [Env.plot_class, Env().plot_class, Env.plot_static, Env().plot_static]
)
def test_classmethods_and_staticmethods_go_to_workers_silently(plot_state):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert ParallelEncoder(plot_state)._payload is not None


def test_a_method_of_an_object_draws_here_with_one_warning(tmp_path):
    from matplotlib import pyplot

    env, open_before = Env(), pyplot.get_fignums()
    with pytest.warns(
        UserWarning,
        match="plot_state is a method of a Env object, so frames are drawn in this process",
    ) as caught:
        encoder = record(env.plot_state, [arrdict(xs=torch.arange(i)) for i in range(3)])
    assert len(caught) == 1 and caught[0].filename == __file__
    assert env.pids == 3 * [os.getpid()] and pyplot.get_fignums() == open_before
    assert frames(encoder.save(tmp_path / "video.mp4")).shape == (3, 66, 102, 3)


def test_what_cannot_be_sent_draws_here_with_a_warning(tmp_path):
    lock = threading.Lock()
    with pytest.warns(UserWarning, match="cannot be sent to another process"):
        encoder = record(lambda state, lock=lock: np.zeros((SIZE, SIZE, 3)), [arrdict()])
    assert len(frames(encoder.save(tmp_path / "video.mp4"))) == 1


def test_a_fault_in_a_worker_names_the_frame():
    states = [arrdict(x=1), arrdict(x=0)]
    with pytest.raises(
        RuntimeError, match="frame 0 could not be recorded: TypeError: plot_state must return"
    ):
        record(plot_badly, states, n_workers=1)
    with pytest.raises(
        RuntimeError, match="frame 0 could not be recorded: ZeroDivisionError: division by zero"
    ):
        record(plot_badly, states[1:], n_workers=1)


def test_a_worker_that_dies_names_the_frame():
    with pytest.raises(
        RuntimeError, match="^frame 0 could not be recorded: TerminatedWorkerError: .*"
    ):
        record(plot_fatally, [arrdict()], n_workers=1)


def test_a_fault_in_this_process_names_the_frame():
    def plot_state(self, state):
        return 1 / state.x

    bound = types.MethodType(plot_state, Env())
    with (
        pytest.warns(UserWarning),
        pytest.raises(RuntimeError, match="frame 0 could not be recorded: ZeroDivision"),
    ):
        record(bound, [arrdict(x=0)])


def test_an_exception_in_the_block_is_passed_on_unchanged():
    with pytest.raises(KeyError, match="mine"), ParallelEncoder(plot_grey, n_workers=1) as encoder:
        encoder(arrdict(i=0, grey=0))
        raise KeyError("mine")


class Stopped(BaseException):
    """As signal handlers raise."""


@pytest.mark.parametrize("how", ["waiting", "drawing", "encoding"])
def test_a_signal_is_passed_on_unchanged_wherever_it_strikes(how, monkeypatch):
    """While it waits for a worker, draws here, or encodes; also where closing the video fails."""

    def stop(*args, **options):
        raise Stopped

    def broken(self):
        raise OSError("the container is broken")

    plot_state = types.MethodType(stop, Env()) if how == "drawing" else plot_grey
    if how == "waiting":
        monkeypatch.setattr(recording, "_is_done", stop)
    if how == "encoding":
        monkeypatch.setattr(recording._Video, "add", stop)
    monkeypatch.setattr(recording._Video, "close", broken)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        encoder = ParallelEncoder(plot_state, n_workers=1)
    with pytest.raises(Stopped), encoder:
        encoder(arrdict(i=9, grey=0))
    assert encoder._pool is None


def test_what_was_recorded_before_an_error_can_be_saved(tmp_path):
    with pytest.raises(KeyError), ParallelEncoder(plot_grey) as encoder:
        encoder.frame(np.zeros((SIZE, SIZE, 3)))
        raise KeyError
    assert len(frames(encoder.save(tmp_path / "video.mp4"))) == 1


def test_frames_of_another_size_are_refused():
    with pytest.raises(
        RuntimeError, match="frame 1 .* first, 32 x 16 pixels, but this one has 32 x 32"
    ):
        with ParallelEncoder(plot_grey) as encoder:
            encoder.frame(np.zeros((16, 32, 3)))
            encoder.frame(np.zeros((32, 32, 3)))


@pytest.mark.parametrize(
    ("array", "error"),
    [
        (np.zeros((4, 4)), r"shape \(H, W, 3\), but this one has \(4, 4\)"),
        (np.zeros((4, 4, 4)), r"has \(4, 4, 4\)"),
        (np.zeros((0, 4, 3)), r"has \(0, 4, 3\)"),
        (np.zeros((4, 4, 3), int), "uint8 or floats from 0 to 1, but this one holds int"),
    ],
)
def test_what_is_no_image_is_refused(array, error):
    with pytest.raises(ValueError, match=error), ParallelEncoder(plot_grey) as encoder:
        encoder.frame(array)


def test_no_frames_no_video(tmp_path):
    encoder = record(plot_grey, [])
    with pytest.raises(ValueError, match="no frames were recorded"):
        encoder.save(tmp_path / "video.mp4")
    with pytest.raises(ValueError, match="no frames were recorded"):
        encoder.notebook()
    assert not os.listdir(tmp_path)


def test_the_block_comes_first_and_the_video_after(tmp_path):
    encoder = ParallelEncoder(plot_grey)
    with pytest.raises(RuntimeError, match="inside the encoder's with block"):
        encoder(arrdict(i=0, grey=0))
    with encoder, pytest.raises(RuntimeError, match="use it after the block"):
        encoder.save(tmp_path / "video.mp4")


@pytest.mark.parametrize("settings", [dict(fps=0), dict(fps=float("nan")), dict(n_workers=0)])
def test_settings_are_checked(settings):
    with pytest.raises(ValueError, match="must be"):
        ParallelEncoder(plot_grey, **settings)


def test_a_save_that_fails_leaves_the_old_file(tmp_path, monkeypatch):
    with ParallelEncoder(plot_grey) as encoder:
        encoder.frame(np.zeros((SIZE, SIZE, 3)))
    (tmp_path / "video.mp4").write_text("old")

    def fail(*args):
        raise OSError("no space left")

    with monkeypatch.context() as patched, pytest.raises(OSError, match="no space left"):
        patched.setattr(recording.os, "replace", fail)
        encoder.save(tmp_path / "video.mp4")
    assert os.listdir(tmp_path) == ["video.mp4"] and (tmp_path / "video.mp4").read_text() == "old"
    with pytest.raises(ValueError, match="use video.mp4"):
        encoder.save(tmp_path / "video.gif")


def test_notebooks_get_an_embedded_video(monkeypatch):
    with ParallelEncoder(plot_grey) as encoder:
        encoder.frame(np.zeros((SIZE, SIZE, 3)))
    monkeypatch.setitem(sys.modules, "IPython", types.ModuleType("IPython"))
    monkeypatch.setitem(
        sys.modules, "IPython.display", types.SimpleNamespace(HTML=lambda text: text)
    )
    assert encoder.notebook().startswith(
        '<video controls autoplay loop muted src="data:video/mp4;base64,AAAA'
    )
    monkeypatch.setitem(sys.modules, "IPython.display", None)
    with pytest.raises(ImportError, match="pip install ipython"):
        encoder.notebook()


def test_without_pyav_one_sentence_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(ImportError, match="pip install av$"), ParallelEncoder(plot_grey):
        pass


SCRIPT = """
import numpy as np
from megastep import arrdict, recording
from matplotlib import pyplot as plt

class Env:
    @classmethod
    def plot_state(cls, state):
        figure = plt.figure(figsize=(1, 1), dpi=64)
        figure.add_subplot().plot(state.xs)
        return figure

print('started')
with recording.ParallelEncoder(Env().plot_state, n_workers=2) as encoder:
    for i in range(4):
        encoder(arrdict.arrdict(xs=np.arange(i)))
encoder.save('video.mp4')
"""


def test_a_script_without_a_main_guard_records(tmp_path):
    (tmp_path / "script.py").write_text(SCRIPT)
    root = os.path.dirname(os.path.dirname(recording.__file__))
    done = subprocess.run(
        [sys.executable, "-W", "error::UserWarning", "script.py"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
        env={**os.environ, "PYTHONPATH": root},
    )
    assert (done.returncode, done.stdout) == (0, "started\n"), done.stderr
    assert frames(tmp_path / "video.mp4").shape == (4, 64, 64, 3)
