"""docs/new-environment.md: its code runs in order and behaves as the text says."""

import re
from pathlib import Path

import pytest
import torch

from megastep import arrdict, capture, contract, types
from tests.helpers import pages

PAGE = Path(__file__).resolve().parents[2] / "docs" / "new-environment.md"


@pytest.fixture(scope="module")
def names(tmp_path_factory):
    """The variables of the page's code, run in an empty folder. Recording needs PyAV."""
    variables = {"__name__": "__main__", "folder": tmp_path_factory.mktemp("page")}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(variables["folder"])
        for block in re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.S):
            exec(compile(block, str(PAGE), "exec"), variables)
    return variables


def test_commands_train_evaluate_and_record(tmp_path, monkeypatch, capsys):
    """The commands of the first parts, in an empty folder. test_two_agents.py has the last one's.
    Safe has only what is required, so it trains and is evaluated, but cannot be filmed.
    """
    text = PAGE.read_text().split("## Two agents")[0]
    for name, body in zip(("safe.py", "rover.py"), pages.code(text)):
        assert f"This is `{name}`" in text
        (tmp_path / name).write_text(body)
    assert pages.type_all(text, tmp_path, monkeypatch) == [*pages.MAINS][:2] + [*pages.MAINS]
    shown = capsys.readouterr().out
    assert "safe: 64 episodes, after" in shown
    assert "rover: 64 episodes in 1 home, geometry=column, split=test" in shown
    (safe,), (rover,) = ([*(tmp_path / "runs").glob(f"*-{name}-*")] for name in ("safe", "rover"))
    assert (rover / "video.mp4").stat().st_size > 1000
    with pages.inside(tmp_path, monkeypatch):
        assert pages.MAINS["record.py"]([f"run={safe}"]) == 2
    assert "Safe cannot be drawn: it needs the methods state(e)" in capsys.readouterr().err


def test_safe_is_open_where_dial_and_press_are_right(names):
    env = names["Safe"](n_envs=3, device="cpu")
    contract.rollout(env, 20)
    env.reset()
    dial = env.number + torch.tensor([0, 0, 1])
    actions = arrdict.arrdict(dial=dial[:, None] % 4, press=torch.tensor([[1], [0], [1]]))
    assert env.step(arrdict.arrdict(actions=actions)).reward.tolist() == [1, 0, 0]


def test_resets_of_the_page_take_seeds_and_masks(names):
    env = names["SeededRover"](n_envs=5, device="cpu", limit=9)
    assert types.takes_masks(env)
    contract.rollout(env, 20)


def test_python_code_trains(names):
    assert all(bool(value.isfinite()) for value in names["losses"].values())
    assert names["rollout"].reward.any()


def test_rover_is_rewarded_for_metres_and_ends_at_walls(names):
    env = names["Rover"](n_envs=64, device="cpu", limit=50)
    worlds = contract.rollout(env, 150)
    assert any(bool(world.terminal.any()) for world in worlds)
    assert any(bool(world.truncated.any()) for world in worlds)
    assert max(float(world.reward.max()) for world in worlds) < 0.5, "at most 4 m/s for 0.1 s"


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_rover_runs_as_a_cuda_graph(names):
    runs = []
    for wrap in (lambda env: env, capture.Captured):
        env = wrap(names["Rover"](n_envs=16, device="cuda", limit=10))
        runs.append(arrdict.stack(contract.rollout(env, 30)))
    assert isinstance(env._step, capture.Graph) and contract.same(*runs)
