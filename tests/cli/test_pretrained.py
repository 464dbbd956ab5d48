"""Agents in one file: exported from a run, and then used by their names. Those of the package."""

import json
import re
import shutil
from pathlib import Path

import pytest
import torch

from megastep import geometries
from megastep.agents import package, pretrained
from megastep.agents.cli import evaluate, export, inspect, train
from megastep.agents.export import agent
from megastep.agents.networks.policy import TRAINING_ONLY
from megastep.agents.networks.running_norm import RunningNorm
from megastep.agents.runs import agent_file, checkpoint, folders, restore, trust
from megastep.agents.runs.checkpoint import CheckpointError
from megastep.types import n_lanes
from tests.helpers.agents import env_of

NAME = "tiny_agent"
CONFIG = {
    "train": {**dict.fromkeys(("env", "geometry", "learner"), {"name": "x"}), "agent": {}},
    "spaces": {},
}
PARTS = "geometry.parts={bench: 2, braided: {source: maze, n: 2, braid: 1}}"
TINY = [
    *("env=deathmatch", "env.n_agents=2", "env.res=16", "env.n_envs=4", "env.limit=20"),
    *("geometry=mixed", PARTS, "device=cpu", "agent.width=8", "seed=1"),
    *("learner.n_steps=8", "learner.n_minibatches=2", "logging.every=4"),
]
SUITE = ["geometry=suite", PARTS, "episodes=8", "device=cpu"]
#: The agents of the package.
FILES = sorted(package.PRETRAINED.glob("*.safetensors"))


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A folder with a run, `run`, evaluated in the suite, and its agent in `agents`."""
    folder = tmp_path_factory.mktemp("exported")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert train.main([*TINY, "samples=512", "checkpoints.snapshots=2", "folder=run"]) == 0
        shutil.copytree("run", "mine")  # a run that a colleague lacks
        for words in ([], ["against=mine,bot"]):
            assert evaluate.main(["run=run", *SUITE, *words]) == 0
        assert (
            export.main(["run=run", "format=safetensors", f"file=agents/{NAME}.safetensors"]) == 0
        )
    return folder


@pytest.fixture
def folder(exported, tmp_path, monkeypatch):
    """Changes to a folder of its own, with the exported agent as the only one of the package."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(exported / "agents", "package")
    monkeypatch.setattr(package, "PRETRAINED", tmp_path / "package")
    return tmp_path


@pytest.fixture
def file(folder):
    return folder / "package" / f"{NAME}.safetensors"


def original_of(exported, env):
    """The run's own policy."""
    loaded = checkpoint.load_latest(exported / "run/checkpoints")
    return restore.policy_of(loaded, env)


# ---- Exporting ----


def test_weights_are_float16_and_statistics_float32(file):
    read, policy = agent_file.read(file, "cpu"), pretrained.load(NAME, "cpu")
    norms = [name for name, part in policy.named_modules() if isinstance(part, RunningNorm)]
    state = read.state["policy"]
    assert norms and not [name for name in state if name.startswith(TRAINING_ONLY)]
    for name, tensor in state.items():
        is_statistic = name.rpartition(".")[0] in norms
        assert tensor.dtype == (torch.float32 if is_statistic else torch.float16), name
    assert (read.step, read.numbers) == (512, {})
    train = read.config["train"]
    assert (train["folder"], train["resume"], train["init"]) == (None, None, None)


def test_file_has_the_results_of_the_run(file, exported):
    tables = agent_file.read(file, None).about["tables"]
    written = json.loads(next((exported / "run/evaluations").glob("suite-*.json")).read_text())
    assert tables[0]["rows"][0]["return"] == written["rows"][0]["return"]
    assert tables[0]["command"] == f"geometry=suite '{PARTS}' split=test episodes=8 seed=1"
    assert "the agent, 512 samples, in deathmatch: 8 duels" in tables[1]["title"]
    assert {row["against"] for row in tables[1]["rows"]} == {"bot"}
    assert tables[1]["command"].endswith(" against=bot") and "mine" not in json.dumps(tables)


@pytest.mark.parametrize(
    "words, command",
    [
        ("/x/.venv/bin/python /y/train.py env=pong seed=2", "python train.py env=pong seed=2"),
        ("python train.py 'a={b: 1}' folder=x/y", "python train.py 'a={b: 1}' folder=x/y"),
        ("python -m megastep train seed=1", "megastep train seed=1"),
    ],
)
def test_commands_are_without_places_of_the_machine(words, command):
    assert agent.command_of(words) == command


@pytest.mark.parametrize(
    "words, text",
    [
        (["run", "Tiny"], "not a name for an agent"),
        (["run/snapshots/step_512", NAME], "has weights only"),
        (["", NAME], "a run has no name here; give its folder, or latest"),
        (["nowhere", NAME], "nowhere is neither a run folder nor a pretrained agent"),
    ],
)
def test_export_refuses(words, text, exported, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(exported)
    run, name = words
    file = f"file={tmp_path}/new/{name}.safetensors"
    assert export.main([f"run={run}", "format=safetensors", file]) == 2
    assert re.search(text, capsys.readouterr().err)
    assert not (tmp_path / "new").exists()


# ---- Using an agent by its name ----


def test_evaluates_into_a_folder_of_its_own(folder, capsys):
    assert evaluate.main([f"run={NAME}", *SUITE, "baseline=false"]) == 0
    table = json.loads(Path(f"runs/pretrained-{NAME}/evaluations/suite-test-512.json").read_text())
    assert {row["source"] for row in table["rows"]} == {"bench", "braided"}
    names = {path.name for path in (folder / "package").iterdir()}
    assert names == {f"{NAME}.md", f"{NAME}.safetensors"}
    assert folders.known() == [], "its folder is not a run"


def test_meets_others_in_duels(exported, capsys):
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(exported)
        patch.setattr(package, "PRETRAINED", exported / "agents")
        words = ["geometry=box", "episodes=4", "device=cpu"]
        assert evaluate.main(["run=run", f"against={NAME},bot", *words]) == 0
        assert f"{NAME}, 512 samples" in capsys.readouterr().out
        assert evaluate.main([f"run={NAME}", "against=run", *words]) == 0
        assert f"{NAME}, 512 samples, in deathmatch" in capsys.readouterr().out
        assert evaluate.main([f"run={NAME}", "against=bot", "ratings=true", *words]) == 0
        assert Path(f"runs/pretrained-{NAME}/ratings.csv").exists()
        assert evaluate.main([f"run={NAME}", "ratings=true", *words]) == 2
        assert "nothing to compare it with" in capsys.readouterr().err


def test_starts_a_run_with_a_new_critic(file, capsys):
    words = [f"init={NAME}", "device=cpu", "learner.n_minibatches=2"]
    assert train.main([*words, "learner.lr=1e-12", "samples=1", "folder=second"]) == 0
    assert "tiny_agent has no critic, so this run begins with a new one" in capsys.readouterr().out
    loaded = checkpoint.load_latest("second/checkpoints")
    weights = agent_file.read(file, "cpu").state["policy"]
    for name in ("intake.project.weight", "core.input.weight", "output.head.weight"):
        if name in weights:
            torch.testing.assert_close(
                loaded.state["policy"][name], weights[name].float(), rtol=0, atol=1e-6
            )
    assert any(name.startswith("critic.") for name in loaded.state["policy"])
    assert loaded.config["train"]["env"]["res"] == 16, "its environment"
    assert train.main(["resume=second", "more_samples=1"]) == 0


@torch.no_grad()
def test_loads_in_python_and_acts_as_the_run(folder, exported):
    env = env_of(NAME, geometries.sample("maze", 2), n_envs=3)
    assert (env.n_envs, n_lanes(env)) == (3, 6)
    policy, original = pretrained.load(NAME, "cpu"), original_of(exported, env)
    assert policy.critic is None and not any(p.requires_grad for p in policy.parameters())
    world, states = env.reset(), [one.initial(6) for one in (policy, original)]
    for one, state in zip((policy, original), states, strict=True):
        logits = one(world, state, sample=False)[0]["logits"]
        torch.testing.assert_close(logits, policy(world, states[0])[0]["logits"], atol=0.01, rtol=0)
    assert pretrained.load(f"package/{NAME}.safetensors", "cpu").width == 8


def test_inspect_prints_what_is_in_a_file(file, capsys):
    assert inspect.main([NAME]) == 0
    out = capsys.readouterr().out
    assert f"{NAME}.safetensors: intact" in out and "samples: 512" in out and "policy" in out
    file.write_bytes(file.read_bytes()[:-1] + b"!")
    assert inspect.main([NAME]) == 1
    assert "SHA-256" in capsys.readouterr().out


# ---- Names and files that cannot be used ----


@pytest.mark.parametrize(
    "main, words, text",
    [
        (evaluate.main, ["run=tiny_agnet"], "did you mean tiny_agent?"),
        (evaluate.main, ["run=zzz"], "train.py makes runs, and pretrained agents are tiny_agent"),
        (train.main, [f"resume={NAME}"], f"has the weights only. init={NAME} starts"),
        (train.main, [f"rerun={NAME}"], "rerun= takes the run's folder"),
        (evaluate.main, [f"run={NAME}", "env=pong"], "was trained in another environment"),
    ],
)
def test_wrong_names_are_one_sentence(main, words, text, folder, capsys):
    assert main(words) == 2
    err = capsys.readouterr().err
    assert text in err and err.count("\n") == 1 and not Path("runs").exists()


def test_a_folder_of_the_name_comes_first(folder, exported, capsys):
    shutil.copytree(exported / "run", NAME)
    assert folders.find(NAME) == Path(NAME)
    shutil.rmtree(f"{NAME}/checkpoints")
    assert evaluate.main([f"run={NAME}"]) == 2
    assert f"rename it to use the pretrained agent {NAME}" in capsys.readouterr().err


def changed(content, entries=(), **texts):
    """Returns the bytes of a file of an agent with other entries and texts in its header."""
    n = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + n]) | dict(entries)
    header["__metadata__"] |= texts
    text = json.dumps(header, separators=(",", ":")).encode()
    return agent_file.sealed(len(text).to_bytes(8, "little") + text + content[8 + n :])


DAMAGES = {
    "cut off": (lambda content: content[:-7], "file not fully covered"),
    "a bit": (lambda content: content[:-3] + b"!" + content[-2:], "do not match their SHA-256"),
    "a fact": (lambda content: content.replace(b'samples\\": 512', b'samples\\": 513'), "SHA-256"),
    "no text": (lambda content: content[:30] + b"\xff" + content[31:], "invalid UTF-8 in header"),
    "long header": (lambda content: b"\xff" * 8 + content, "header too large"),
    "of others": (lambda content: b"\x02" + b"\0" * 7 + b"{}", "has format None"),
    "no samples": (lambda content: changed(content, facts='{"samples": null}'), "samples"),
    "tables": (lambda content: changed(content, tables='[{"rows": 3}]'), "0.title"),
    "no config": (lambda content: changed(content, config="{}"), "train: Field required"),
    "deep": (lambda content: changed(content, tables="[" * 100_000), "too deeply nested"),
    "newer": (lambda content: changed(content, format="99"), "has format '99', and this"),
}


@pytest.mark.parametrize("damage, text", DAMAGES.values(), ids=DAMAGES)
def test_damaged_files_are_one_sentence(damage, text, file, capsys):
    file.write_bytes(damage(file.read_bytes()))
    with pytest.raises(CheckpointError, match=text):
        agent_file.read(file, None)
    assert evaluate.main([f"run={NAME}"]) == 2
    assert text in (err := capsys.readouterr().err) and err.count("\n") == 1


def test_every_flipped_bit_of_a_header_is_found(tmp_path):
    path = tmp_path / "a.safetensors"
    agent_file.write(path, {"w": torch.ones(2)}, CONFIG, {"samples": 1})
    content = path.read_bytes()
    for bit in range(8 * len(content)):
        flipped = bytearray(content)
        flipped[bit // 8] ^= 1 << bit % 8
        path.write_bytes(flipped)
        with pytest.raises(CheckpointError):
            agent_file.read(path, None)


def test_modules_of_others_need_trust(file, capsys):
    content = file.read_bytes()
    config = agent_file.read(file, None).config
    config["train"]["agent"]["core"] = "planted:Core"
    file.write_bytes(changed(content, config=json.dumps(config)))
    assert evaluate.main([f"run={NAME}"]) == 2
    assert "planted:Core" in (err := capsys.readouterr().err) and "trust=true" in err
    assert evaluate.main([f"run={NAME}", "trust=true"]) == 2
    assert "planted" in (err := capsys.readouterr().err) and "trust=true" not in err


# ---- The format ----


def test_tensors_are_read_as_written(tmp_path):
    path = tmp_path / "a.safetensors"
    tensors = {"b": torch.rand(2, 3).half().T, "a": torch.tensor(3.5)}
    tensors["c"] = torch.zeros(0, 2, dtype=torch.int64)
    agent_file.write(path, tensors, CONFIG, {"samples": 7})
    read = agent_file.read(path, "cpu").state["policy"]
    assert {*read} == {"a", "b", "c"}
    for name, tensor in tensors.items():
        assert read[name].dtype == tensor.dtype and torch.equal(read[name], tensor)


# ---- The agents of the package ----


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
@torch.no_grad()
def test_agent_of_the_package(path):
    """It loads, acts, is small, and has a card."""
    assert path.stat().st_size <= 4_000_000
    assert trust.foreign_names(agent_file.read(path, None).config) == []
    about = agent_file.read(path, None).about
    assert about["tables"], "evaluated in the suite"
    card, facts = path.with_suffix(".md").read_text(), about["facts"]
    assert f"- samples: {facts['samples']:,}\n" in card and facts["commit"] in card
    source = "quadrant" if path.stem.startswith("hideandseek") else "homes"
    env = env_of(path.stem, geometries.sample(source, 2), n_envs=2)
    policy = pretrained.load(path.stem, "cpu")
    world, state = env.reset(), policy.initial(n_lanes(env))
    for _ in range(10):
        decision, state = policy(world, state)
        world = env.step(decision)
    assert decision.logits.isfinite().all() and world.reward.isfinite().all()


#: {agent: source, its settings, homes, episodes in each; the least mean of some metrics}, counted
#: by hand. By their cards: success 0.989 and SPL 0.81; coverage 0.990 and return 22.2; found 37.2,
#: of which an agent without memory finds half; found 69.9, 18 more or less from maze to maze;
#: success 0.996; hidden 0.938.
FIRST_EPISODES = {
    "pointgoal_anywhere": ("bench", {}, 30, 2, {"success": 0.94, "spl": 0.76}),
    "explorer_anywhere": ("homes", {}, 24, 1, {"coverage": 0.97, "return": 16}),
    "memory_9": ("memory_maze", {}, 16, 1, {"found": 32}),
    "memory_15": ("memory_maze", {"size": 15}, 4, 1, {"found": 55}),
    "keys_anywhere": ("homes", {}, 24, 1, {"success": 0.9}),
    "hideandseek_quadrant": ("quadrant", {}, 12, 1, {"hidden": 0.85}),
}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if "goal" in name else pytest.mark.nightly)
        for name in FIRST_EPISODES
    ],
)
@torch.no_grad()
def test_agent_of_the_package_does_what_its_card_says(name):
    source, settings, n_homes, n_each, least = FIRST_EPISODES[name]
    homes = geometries.sample(source, n_homes, "test", **settings)
    env = env_of(name, homes, n_envs=n_each * len(homes))
    env.spawner.resample = False
    policy, n = pretrained.load(name, "cpu"), n_lanes(env)
    world, state = env.reset(), policy.initial(n)
    ended, returns = torch.zeros(n, dtype=torch.bool), torch.zeros(n)
    values = {metric: torch.zeros(n) for metric in least}
    generator = torch.Generator().manual_seed(1)
    while not ended.all():
        decision, state = policy(world, state, generator=generator)
        world = env.step(decision)
        returns += world.reward * ~ended
        ends = (world.terminal | world.truncated) & ~ended
        for metric, numbers in {**world.metrics, "return": returns}.items():
            if metric in values:
                values[metric][ends] = numbers[ends]
        ended |= ends
    assert all(values[metric].mean() > bound for metric, bound in least.items()), values


@pytest.mark.nightly
def test_deathmatch_anywhere_beats_the_bot(tmp_path, monkeypatch, capsys):
    """In 128 duels in generated homes; it wins 0.999, draws counting half, by its card."""
    monkeypatch.chdir(tmp_path)
    words = ["run=deathmatch_anywhere", "against=bot", "geometry=homes", "episodes=128"]
    assert evaluate.main([*words, "device=cpu", "baseline=false"]) == 0
    (table,) = Path("runs").rglob("evaluations/*.json")
    (row,) = json.loads(table.read_text())["rows"]
    assert row["won"] > 0.97
