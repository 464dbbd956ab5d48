"""docs/new-environment.md: its code runs in order and behaves as the text says."""

import importlib.util
import re
from pathlib import Path

import loky
import pytest
import torch

from megastep import arrdict, capture, contract, plotting
from tests.helpers import pages
from tests.helpers.in_this_process import InThisProcess

PAGE = Path(__file__).resolve().parents[2] / "docs" / "new-environment.md"


@pytest.fixture(scope="module")
def names(tmp_path_factory):
    """The variables of the page's code, run in an empty folder. Recording needs PyAV."""
    variables = {"__name__": "__main__", "folder": tmp_path_factory.mktemp("page")}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(variables["folder"])
        patch.setattr(loky, "ProcessPoolExecutor", InThisProcess)
        for block in re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.S):
            if "record.film" not in block or importlib.util.find_spec("av"):
                exec(compile(block, str(PAGE), "exec"), variables)
    return variables


@pytest.mark.usefixtures("drawn_in_this_process")
def test_commands_train_evaluate_and_record(tmp_path, monkeypatch, capsys):
    """The commands of the first part, in an empty folder. test_two_agents.py has the second's."""
    pytest.importorskip("av")
    text = PAGE.read_text().split("## Two agents")[0]
    assert "This is `rover.py`" in text
    (tmp_path / "rover.py").write_text(pages.code(text)[0])
    assert pages.type_all(text, tmp_path, monkeypatch) == list(pages.MAINS)
    assert "rover in the test homes of column" in capsys.readouterr().out
    (run,) = (path for path in (tmp_path / "runs").iterdir() if path.is_dir())
    assert (run / "video.mp4").stat().st_size > 1000


def test_python_code_trains(names):
    assert all(bool(value.isfinite()) for value in names["losses"].values())
    assert names["rollout"].reward.any()


def test_rover_is_rewarded_for_metres_and_ends_at_walls(names):
    env = names["Rover"](n_envs=64, device="cpu", limit=50)
    worlds = contract.rollout(env, 150)
    assert any(bool(world.terminal.any()) for world in worlds)
    assert any(bool(world.truncated.any()) for world in worlds)
    assert max(float(world.reward.max()) for world in worlds) < 0.5, "at most 4 m/s for 0.1 s"


def test_rover_is_displayed(names):
    env = names["Rover"](n_envs=2, device="cpu")
    env.reset()
    assert plotting.rasterise(env.display(1)).std() > 5


def test_video_has_the_fps_of_rover(names):
    av = pytest.importorskip("av")
    with av.open(str(names["folder"] / "rover.mp4")) as container:
        video = container.streams.video[0]
        assert (video.frames, video.average_rate) == (20, 10)


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_rover_runs_as_a_cuda_graph(names):
    runs = []
    for wrap in (lambda env: env, capture.Captured):
        env = wrap(names["Rover"](n_envs=16, device="cuda", limit=10))
        runs.append(arrdict.stack(contract.rollout(env, 30)))
    assert isinstance(env._step, capture.Graph) and contract.same(*runs)
