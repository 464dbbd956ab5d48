"""docs/new-environment.md, part "Two agents": its code and its commands."""

import json
import re
import shlex
import sys
from pathlib import Path

import pytest
import torch

from megastep import arrdict, capture, contract, plotting
from tests.helpers import pages

PAGE = Path(__file__).resolve().parents[2] / "docs" / "new-environment.md"


@pytest.fixture(scope="module")
def section():
    return PAGE.read_text().split("## Two agents")[1]


@pytest.fixture
def convoy(section, tmp_path, monkeypatch):
    """The page's class, imported from a file in the current folder."""
    (code,) = re.findall(r"```python\n(.*?)```", section, re.S)
    (tmp_path / "convoy.py").write_text(code)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "convoy", raising=False)
    import convoy

    yield convoy.Convoy
    del sys.modules["convoy"]


@pytest.mark.slow
def test_commands_train_evaluate_and_record(section, convoy, tmp_path, capsys):
    commands = re.findall(r"^python (\S+\.py) (.*)$", section, re.M)
    assert [script for script, _ in commands] == list(pages.MAINS)
    for script, words in commands:
        assert pages.MAINS[script](pages.few(script, shlex.split(words))) == 0
    output = capsys.readouterr().out
    (run,) = (path for path in (tmp_path / "runs").iterdir() if path.is_dir())
    last = json.loads((run / "metrics.jsonl").read_text().splitlines()[-1])
    for name in ("return", "together"):
        by_role = [last[f"episode/{name}/{role}"] for role in ("leader", "follower")]
        assert last[f"episode/{name}"] == pytest.approx(sum(by_role) / 2)
    (table,) = (run / "evaluations").glob("*.json")
    rows = json.loads(table.read_text())["rows"]
    assert [row.get("role") for row in rows] == 2 * [None, "leader", "follower"]
    assert rows[1]["metrics"]["together"] == rows[2]["metrics"]["together"]
    assert "trained: follower" in output and "together" in output
    assert (run / "video.mp4").stat().st_size > 1000


@pytest.mark.parametrize("scripted", [False, True])
def test_convoy_rewards_the_leader_for_metres_and_the_follower_for_closeness(convoy, scripted):
    env = convoy(16, device="cpu", limit=20, scripted=scripted)
    worlds = contract.rollout(env, 60)
    leader, follower = torch.stack([w.reward for w in worlds[:21]]).unflatten(1, (16, 2)).sum(0).T
    last = worlds[20]
    assert last.truncated.all() and last.learns.tolist() == 16 * [not scripted, True]
    torch.testing.assert_close(last.metrics.together[::2], follower / 0.1 / 20)
    assert last.metrics.together.max() > last.metrics.together.min()
    assert leader.min() > 0 and leader.max() < 20 * 0.4, "at most 4 m/s for 0.1 s"
    assert plotting.rasterise(env.plot_state(arrdict.numpyify(env.state(1)))).std() > 5


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_convoy_runs_as_a_cuda_graph(convoy):
    runs = []
    for wrap in (lambda env: env, capture.Captured):
        env = wrap(convoy(16, device="cuda", limit=10, scripted=True))
        runs.append(arrdict.stack(contract.rollout(env, 30)))
    assert isinstance(env._step, capture.Graph) and contract.same(*runs)
