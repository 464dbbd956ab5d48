"""The classes and commands of docs/networks.md."""

import json
import pathlib

import pytest
import torch

from megastep.agents.networks import cores
from tests.helpers import pages

PAGE = pages.ROOT / "docs" / "networks.md"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("networks")
    text = PAGE.read_text()
    for name, body in zip(("cores.py", "encoders.py"), pages.code(text), strict=True):
        assert f"`{name}`" in text
        (place / name).write_text(body)
    return place


@pytest.mark.nightly
def test_commands_of_page_train_and_evaluate(folder, monkeypatch):
    scripts = pages.type_all(PAGE.read_text(), folder, monkeypatch)
    assert scripts == 2 * ["train.py"] + 2 * ["train.py", "evaluate.py"]
    runs = [path for path in (folder / "runs").iterdir() if path.is_dir()]
    agents = [config(run)["agent"] for run in runs]
    parts = {(agent["core"], agent["encoder"]) for agent in agents}
    of_page = {("cores:Trace", "linear"), ("lstm", "encoders:Patches")}
    assert parts == {("gru", "linear"), ("none", "linear"), *of_page}


def config(run):
    (checkpoint, *_) = sorted(pathlib.Path(run, "checkpoints").glob("step_*"))
    return json.loads((checkpoint / "config.json").read_text())["train"]


def test_core_of_page_is_decaying_mean(folder, monkeypatch):
    with pages.inside(folder, monkeypatch):
        core = cores.make_core("cores:Trace", 2)
    with torch.no_grad():
        core.input.weight.copy_(torch.eye(2)), core.input.bias.zero_()
        core.rate.zero_()  # keeps one half
    x = torch.tensor([1.0, 0.0, 0.0, 8.0]).view(4, 1, 1).expand(4, 1, 2)
    reset = torch.tensor([True, False, True, False])[:, None]
    outputs, state = core(x, reset, core.initial(1))
    expected = torch.tensor([0.5, 0.25, 0.0, 4.0])
    torch.testing.assert_close(outputs[:, 0, 0], expected.tanh())
    assert state.trace.tolist() == [[4.0, 4.0]]
