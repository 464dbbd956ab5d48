"""Runs and agent files with random changes whose SHA-256 is right: one sentence, or no change at
all. SEED=2 makes others, FUZZ=1000 so many.
"""

import json
import os
import random
import shutil
from pathlib import Path

import pytest
import torch

from megastep.agents.cli import evaluate, inspect, train
from megastep.agents.errors import UserError
from megastep.agents.runs import agent_file, checkpoint, checkpoint_format, strange_files
from tests.helpers.tiny import TINY, UPDATE

pytestmark = pytest.mark.nightly
SEED, N = int(os.environ.get("SEED", 1)), int(os.environ.get("FUZZ", 200))
#: What any value may be replaced by.
VALUES = [None, True, -1, 0, 3, 10**30, 0.5, float("nan"), float("inf"), "", "x", "\x1b[31m", "a:b"]
VALUES += ["x" * 100_000, [], {}, [1], {"name": "x"}, {"": {}}, [[[]]], "../../x", "\ud800"]
TENSORS = [
    torch.zeros(0),
    torch.tensor(torch.nan),
    torch.ones(3, dtype=torch.bool),
    torch.arange(5),
]
TENSORS += [torch.zeros(2, 2).to_sparse(), torch.zeros(1).expand(10**6), torch.zeros(2) * 1j]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A folder with a run and the file of its agent."""
    folder = tmp_path_factory.mktemp("trained")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        words = [["env=pong", *TINY[4:], "env.n_envs=4"], TINY][SEED % 2]
        assert train.main([*words, f"samples={8 * UPDATE}", "folder=run"]) == 0
    loaded = checkpoint.load_latest(folder / "run/checkpoints")
    weights = {name: weight.float() for name, weight in loaded.state["policy"].items()}
    facts = {"samples": loaded.step, "commands": ["x"], "device": "cpu"}
    tables = [{"title": "x", "command": "y", "rows": [{"return": 1.0}]}]
    agent_file.write(folder / "a.safetensors", weights, loaded.config, facts, tables)
    return folder


def mutate(tree, draw, values):
    """Returns nested dicts and lists with a value somewhere replaced, removed or added."""
    if isinstance(tree, (list, tuple)) and tree and draw.random() < 0.8:
        tree = [*tree]
        place = draw.randrange(len(tree))
        tree[place] = mutate(tree[place], draw, values)
        return tree
    if isinstance(tree, dict) and tree and draw.random() < 0.9:
        key, tree = draw.choice([*tree]), dict(tree)
        action = draw.random()
        if action < 0.1:
            del tree[key]
        elif action < 0.2:
            tree[draw.choice(["x", "\x1b", "a.b", "", "name"])] = draw.choice(values)
        else:
            tree[key] = mutate(tree[key], draw, values)
        return tree
    return draw.choice(values)


def seal(path, manifest):
    if isinstance(manifest, dict):
        manifest.pop("sha256", None)
        path.write_bytes(checkpoint_format.sealed(manifest))
    else:
        path.write_text(json.dumps(manifest))


def change_run(folder, draw):
    """Changes a part of the newest checkpoint of a run, or another file. Returns which."""
    path = checkpoint.list_checkpoints(folder / "checkpoints")[-1]
    manifest = json.loads((path / "manifest.json").read_bytes())
    names = ["manifest.json", "config.json", "state.pt", "world.pt", "metrics.jsonl"]
    name = draw.choice([*names, "annealing.f64"])
    if name == "manifest.json":
        seal(path / name, mutate(manifest, draw, VALUES))
    elif name == "metrics.jsonl":
        lines = (folder / name).read_text().splitlines()
        place = draw.randrange(len(lines))
        lines[place] = json.dumps(mutate(json.loads(lines[place]), draw, VALUES))
        (folder / name).write_text("\n".join(lines))
    elif name == "annealing.f64":
        (folder / name).write_bytes(draw.randbytes(draw.randrange(200)))
    else:
        if name == "config.json":
            tree = mutate(json.loads((path / name).read_bytes()), draw, VALUES)
            (path / name).write_text(json.dumps(tree))
        else:
            state = torch.load(path / name, weights_only=True)
            torch.save(mutate(state, draw, VALUES + TENSORS), path / name)
        manifest["files"][name]["sha256"] = checkpoint_format._digest(path / name)
        manifest["files"][name]["bytes"] = (path / name).stat().st_size
        seal(path / "manifest.json", manifest)
    return name


def change_agent(path, draw):
    """Changes a text of the header of an agent's file, or a weight. Returns which."""
    from safetensors.torch import load_file, save

    about, weights = agent_file.read_metadata(path), load_file(path)
    texts = {name: about[name] for name in ("config", "facts", "tables")}
    name = draw.choice([*texts, "weights"])
    if name == "weights":
        key = draw.choice([*weights])
        weights[key] = draw.choice([one for one in TENSORS if one.layout == torch.strided]).clone()
        weights[key] = weights[key].real.contiguous() if weights[key].is_complex() else weights[key]
    else:
        texts[name] = mutate(texts[name], draw, VALUES)
    metadata = {key: json.dumps(text) for key, text in texts.items()}
    metadata |= {"format": agent_file.FORMAT, "sha256": "0" * 64}
    path.write_bytes(agent_file.sealed(save(weights, metadata)))
    return name


def call(main, words, capsys):
    """Returns the exit code of a command, and what it printed."""
    try:
        code = main(words)
    except UserError as error:  # of inspect, whose caller prints it
        code, _ = error.code, print(error)
    printed = capsys.readouterr()
    return code, printed.out, printed.err


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("number", range(N))
def test_a_planted_file_is_one_sentence_or_harmless(number, trained, tmp_path, monkeypatch, capsys):
    draw = random.Random(f"{SEED} {number}")
    monkeypatch.chdir(tmp_path)
    shutil.copytree(trained / "run", "run")
    shutil.copy(trained / "a.safetensors", ".")
    if draw.random() < 0.75:
        what = change_run(Path("run"), draw)
        more = f"more_samples={2 * UPDATE}"
        commands = [(inspect.main, ["run"]), (evaluate.main, ["run=run", "episodes=4"])]
        commands += [(train.main, ["resume=run", more]), (train.main, ["rerun=run"])]
    else:
        what = change_agent(Path("a.safetensors"), draw)
        commands = [(inspect.main, ["a.safetensors"])]
        commands += [(evaluate.main, ["run=a.safetensors", "episodes=4", "device=cpu"])]
    for main, words in commands:
        code, out, err = call(main, words, capsys)
        text = f"{out}{err}"
        assert code in (0, 1, 2) and "Traceback" not in text, (what, words, code, text)
        assert "\x1b" not in text and "\x07" not in text, (what, words, text)
        errors = [line for line in err.splitlines() if not line.startswith("warning: ")]
        assert code == 0 or main is inspect.main or len(errors) == 1, (what, words, text)
    assert {*os.listdir()} <= {"run", "a.safetensors", "runs"}
    strange_files.check_folder(Path("run"))
