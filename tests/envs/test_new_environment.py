"""The code of docs/new-environment.md, run in order, and what its text promises of it."""

import importlib.util
import re
from pathlib import Path

import pytest
import torch

from megastep import arrdict, capture, contract, plotting
from tests.helpers import pages

PAGE = Path(__file__).resolve().parents[2] / "docs" / "new-environment.md"


@pytest.fixture(scope="module")
def names(tmp_path_factory):
    """What the page's code defines, run in a folder of its own; without PyAV it is not filmed."""
    found = {"__name__": "__main__", "folder": tmp_path_factory.mktemp("page")}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(found["folder"])
        for block in re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.S):
            if "record.film" not in block or importlib.util.find_spec("av"):
                exec(compile(block, str(PAGE), "exec"), found)
    return found


def test_its_commands_train_evaluate_and_film(tmp_path, monkeypatch, capsys):
    """The first part's, in an empty folder; the second part has a test file of its own."""
    pytest.importorskip("av")
    text = PAGE.read_text().split("## Two agents")[0]
    assert "This is `rover.py`" in text
    (tmp_path / "rover.py").write_text(pages.code(text)[0])
    assert pages.type_all(text, tmp_path, monkeypatch) == list(pages.MAINS)
    assert "rover in the test homes of column" in capsys.readouterr().out
    (run,) = (path for path in (tmp_path / "runs").iterdir() if path.is_dir())
    assert (run / "video.mp4").stat().st_size > 1000


def test_the_page_trains(names):
    assert (
        all(bool(value.isfinite()) for value in names["losses"].values())
        and names["rollout"].reward.any()
    )


def test_rover_pays_metres_and_ends_at_walls(names):
    env = names["Rover"](n_envs=64, device="cpu", limit=50)
    worlds = contract.rollout(env, 150)
    assert any(bool(w.terminal.any()) for w in worlds) and any(
        bool(w.truncated.any()) for w in worlds
    )
    assert max(float(w.reward.max()) for w in worlds) < 0.5, "at most 4 m/s, a tenth of a second"


def test_rover_is_displayed(names):
    env = names["Rover"](n_envs=2, device="cpu")
    env.reset()
    assert plotting.rasterise(env.display(1)).std() > 5


def test_rover_is_filmed_at_its_own_rate(names):
    av = pytest.importorskip("av")
    with av.open(str(names["folder"] / "rover.mp4")) as container:
        video = container.streams.video[0]
        assert (video.frames, video.average_rate) == (20, 10)


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_rover_is_captured(names):
    runs = []
    for wrap in (lambda env: env, capture.Captured):
        env = wrap(names["Rover"](n_envs=16, device="cuda", limit=10))
        runs.append(arrdict.stack(contract.rollout(env, 30)))
    assert isinstance(env._step, capture.Graph) and contract.same(*runs)
