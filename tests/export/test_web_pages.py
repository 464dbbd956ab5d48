"""`megastep web` writes a page of a run, or says in one sentence why it cannot."""

import base64
import gzip
import json
import re
import struct

import pytest
import torch

from megastep import envs
from megastep.agents.cli import train, web
from megastep.agents.errors import UserError
from megastep.agents.export import web as pages
from megastep.kernels.build import compile
from megastep.kernels.build.kernel_library import KernelLibrary
from megastep.kernels.build.launch import launch
from tests.helpers.tiny import TINY

SMALL = [*TINY, "samples=100", "logger=none", "finish.evaluate=false", "finish.record=false"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Runs of environments that a page can play, and of one that it cannot."""
    folder = tmp_path_factory.mktemp("runs")
    homeless = "env=", "env.res=", "geometry="
    anywhere = [word for word in SMALL if not word.startswith(homeless)]
    for name, words in {
        "pong": [*anywhere, "env=pong", "env.n_envs=8"],
        "explorer": [*SMALL[1:], "env=explorer", "agent.core=mingru"],
        "minimal": SMALL,
    }.items():
        assert train.main([*words, f"folder={folder / name}"]) == 0
    return folder


def data_of(path):
    """Returns the JSON in a page."""
    text = path.read_text()
    body = gzip.decompress(base64.b64decode(re.search(r'id="data">([^<]*)<', text)[1]))
    (size,) = struct.unpack("<I", body[:4])
    return json.loads(body[12 : 12 + size])


def test_a_page_of_a_run_is_in_its_folder(folder, capsys):
    assert web.main([f"run={folder / 'pong'}"]) == 0
    path = folder / "pong/page.html"
    assert f"Wrote {path}, 0." in capsys.readouterr().out
    data = data_of(path)
    assert data["controls"] == {"ArrowUp": 1, "ArrowDown": 2}
    assert [(one["name"], one["lanes"]) for one in data["policies"]] == [("pong", [0, 2])]
    assert "metrics.points_won" in data["world"] and data["homes"] == []


def test_opponents_homes_and_seeds_are_chosen(folder, tmp_path):
    words = [f"run={folder / 'pong'}", f"against={folder / 'pong'}", "seed=7"]
    assert web.main([*words, f"file={tmp_path / 'new/duel.html'}"]) == 0
    data = data_of(tmp_path / "new/duel.html")
    assert data["seed"] == 7 and [one["lanes"] for one in data["policies"]] == [[0, 1], [1, 2]]
    path = tmp_path / "explorer.html"
    assert web.main([f"run={folder / 'explorer'}", "homes=[0]", f"file={path}"]) == 0
    data = data_of(path)
    assert data["homes"] == ["0"] and len(data["rooms"]) == 1
    assert data["controls"]["ArrowLeft"] == 5


@pytest.mark.parametrize(
    "words, sentence",
    [
        (["file=x.html"], "run: is missing"),
        (["run={}/pong", "file=x.txt"], "file=x.txt is not a page; its name ends with .html"),
        (["run={}/pong", "seed=-1"], "seed: -1 is out of range"),
        (["run={}/none"], "none"),
        (["run={}/explorer", "homes=[99]"], "There is no home 99: split=test has 1, from 0"),
        (["run={}/explorer", "against={}/explorer"], "agent"),
        (["run={}/minimal"], "PyTorch's operation .* computes between its kernels"),
        (["run={}/pong", "against=bot"], "against=bot is scripted"),
        (["run={}/pong", "against={}/explorer"], "was trained in"),
        (["run={}/pong", "file=/proc/x.html"], "/proc/x.html cannot be written"),
    ],
)
def test_what_cannot_be_is_said(words, sentence, folder, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert web.main([word.format(folder) for word in words]) == 2
    assert re.search(sentence, capsys.readouterr().err)
    assert not [*tmp_path.iterdir()]


def test_large_pages_are_refused(folder, monkeypatch):
    monkeypatch.setattr(pages, "MAX_BYTES", 1000)
    with pytest.raises(UserError, match="the page would have 0.. MB, and may have 0: choose fewer"):
        pages.make(str(folder / "pong"))


#: A kernel that adds the actions up.
HEADER = """
#pragma once
struct SumUpParams {
    const long long* actions;  // (B)
    float* sums;               // (B) in and out
    float* obs;                // (B, 1, 1)
    unsigned char* flags;      // (B) zeros
    int n_lanes;
};
"""
SOURCE = """
#include "common/backend.h"
#include "params.h"
KERNEL sum_up(const SumUpParams& p) {
    for (int i = 0; i < p.n_lanes; i++) {
        p.obs[i] = p.sums[i] += (float)p.actions[i];
        p.flags[i] = 0;
    }
}
"""


class Sums(envs.Pong):
    """A stranger's environment: its own kernel, and Pong's spaces."""

    def __init__(self, library):
        super().__init__(2, device="cpu")
        self.library, self.sums = library, torch.zeros(2)

    def reset(self):
        return self._world(self.no_actions)

    def _world(self, actions):
        obs, flags = torch.empty(2, 1, 1), torch.empty(2, dtype=torch.bool)
        numbers = dict(actions=actions, sums=self.sums, obs=obs, flags=flags, n_lanes=2)
        launch(self.library, "sum_up", torch.device("cpu"), 2, **numbers)
        return dict(obs=obs, reward=self.sums, reset=flags, terminal=flags, truncated=flags)


def test_a_strangers_kernels_are_built(tmp_path, monkeypatch):
    from megastep.web.page import module
    from megastep.web.recording import record

    (tmp_path / "params.h").write_text(HEADER)
    (tmp_path / "sum_up.cpp").write_text(SOURCE)
    program = record(Sums(KernelLibrary(tmp_path)))
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(compile.EngineError, match="lacks sum_up.*Debian: apt install clang"):
        module(program)
    monkeypatch.undo()
    try:
        compile.wasm_tools()
    except compile.EngineError as error:
        pytest.skip(str(error))
    assert [*compile.wasm_keys(module(program))] == ["sum_up"]
