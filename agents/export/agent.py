"""Turns a run into an agent file with its acting weights, and a card beside it.

Evaluate the run first, for the card's tables: `megastep evaluate run=RUN geometry=suite
episodes=8000`, and with against=bot for duels. What follows "What it is for" in a card is written
by hand, and kept when the agent is exported again.
"""

import json
import re
from pathlib import Path

import torch

from megastep.agents import console, factory
from megastep.agents.errors import UserError, user_errors
from megastep.agents.evaluation import tables
from megastep.agents.factory import components, settings
from megastep.agents.networks.policy import Policy
from megastep.agents.runs import (
    agent_file,
    checkpoint,
    folders,
    json_lines,
    provenance,
    restore,
    trust,
)
from megastep.atomic_files import write_atomically
from megastep.dotdict import leaves
from megastep.types import n_lanes

#: Bound of `rounding_error`. Float16 changes a weight by at most 1 part in 2,048.
MAX_ERROR = 0.005
#: Environments and steps in which it is measured.
N_ENVS, N_STEPS = 64, 256
#: Settings of a run that are of no use to others, or name files of the machine that trained it.
PRIVATE = dict(
    folder=None, resume=None, rerun=None, init=None, more_samples=None, more_seconds=None
)
BY_HAND = "## What it is for"


# ---- The file ----


def rounded(policy: Policy) -> dict[str, torch.Tensor]:
    """Returns a policy's state with weights as float16; statistics keep their dtype.

    Raises:
        UserError: a weight is too large for float16.
    """
    weights = dict(policy.named_parameters())
    state = {k: v.half() if k in weights else v for k, v in policy.state_dict().items()}
    for name, tensor in state.items():
        if not tensor.isfinite().all():
            raise UserError(f"{name} has numbers beyond 65,504, the largest of float16")
    return {name: tensor.detach().cpu() for name, tensor in state.items()}


@torch.no_grad()
def rounding_error(exported: Policy, original: Policy, env, n_steps: int = N_STEPS) -> float:
    """Returns how far the logits of two policies are apart, as a fraction of their size: of root
    mean squares over all lanes and steps. Both see what the original's actions lead to.
    """
    world = env.reset()
    states = [policy.initial(n_lanes(env), env.device) for policy in (exported, original)]
    generator = torch.Generator(env.device).manual_seed(1)
    difference = size = 0.0
    for _ in range(n_steps):
        mine, states[0] = exported(world, states[0], sample=False)
        theirs, states[1] = original(world, states[1], generator=generator)
        for one, other in zip(leaves(mine["logits"]), leaves(theirs["logits"]), strict=True):
            difference += (one.double() - other.double()).square().sum().item()
            size += other.double().square().sum().item()
        world = env.step(theirs)
    return (difference / max(size, 1e-300)) ** 0.5


def facts_of(folder: Path, loaded: checkpoint.Checkpoint) -> dict:
    """Returns what made the agent, from what its run recorded."""
    lines = json_lines.read(folder / provenance.FILE)
    lines = [line for line in lines if line["samples"] < loaded.step]
    commits = dict.fromkeys(line.get("commit", "unknown") for line in lines)
    return {
        "environment": loaded.config["train"]["env"]["name"],
        "commands": [command_of(line["command"]) for line in lines],
        "commit": ", ".join(commits) or "unknown",
        "samples": loaded.step,
        "seconds": round(loaded.numbers["seconds"], 1),
        "device": loaded.made_with.get("device", "unknown").removeprefix("cuda "),
        "torch": loaded.made_with.get("torch", "unknown"),
        "ranks": loaded.made_with.get("ranks", 1),
    }


def command_of(words: str) -> str:
    """Returns a command without where Python and the script are on the machine."""
    return re.sub(r"^.*?(\S*/)?((train\.py|megastep train)\b.*)$", r"python \2", words).replace(
        "python megastep", "megastep"
    )


def tables_of(folder: Path, step: int, has_homes: bool = True) -> list[dict]:
    """Returns the evaluations of a run after so many samples, oldest first: titles, commands
    without their run, and rows. Of an environment with floor plans those in geometry=suite, or, if
    there are none, those in homes of the run's own source.
    """
    tables: dict[bool, list[dict]] = {False: [], True: []}
    files = sorted((folder / "evaluations").glob("*.json"), key=lambda path: path.stat().st_mtime)
    for path in files:
        table = json.loads(path.read_text())
        how = table.get("evaluation", {})
        geometry = how.get("geometry") or {}
        is_suite = geometry.get("name") == components.SUITE
        if table.get("step") != step or (has_homes and geometry and not is_suite):
            continue
        words = ["geometry=suite", *options_of(geometry)] if is_suite else []
        words += [f"{key}={how[key]}" for key in ("split", "episodes", "seed")]
        words += ["greedy=true"] * how["greedy"]
        for key in ("baseline", "against"):
            if how.get(key) and how[key] != ["random"]:  # the default
                words.append(f"{key}={','.join(how[key])}")
        title = re.sub(f"^{re.escape(folder.name)}(?=, )", "the agent", table["title"])
        about = {"title": title, "command": " ".join(words), "rows": table["rows"]}
        tables[is_suite].append(about)
    return tables[has_homes] or tables[False]


def options_of(geometry: dict) -> list[str]:
    """Returns the words of a command line for those options of a suite that are not its own."""
    own = vars(components.settings_for("geometry", components.SUITE))
    return [
        "'geometry.{}={}'".format(key, json.dumps(value).replace('"', ""))
        for key, value in geometry.items()
        if value != own[key]
    ]


def write(run: str, file: Path, max_error: float = MAX_ERROR) -> tuple[Path, Path]:
    """Writes an agent's file and its card. Returns their paths. Of an agent's file, only writes its
    card again.

    Args:
        run: a run's folder, one of its checkpoints, or an agent's file.
        file: NAME.safetensors.
        max_error: bound of `rounding_error`.

    Raises:
        UserError: the run acts otherwise once it is rounded, or cannot be written. Nothing was
            written then.
    """
    if not re.fullmatch(r"[a-z][a-z0-9_]*", file.stem):
        raise UserError(
            f"{file.stem!r} is not a name for an agent; use small letters, digits and _"
        )
    path = folders.find(run)
    if agent_file.is_agent_file(path):
        return path, write_card(path)
    loaded = folders.load_checkpoint(path, False, factory.make_device("cpu"))
    if not loaded.numbers:
        raise UserError(f"{loaded.path} has weights only; export a run or its checkpoint")
    assert loaded.state is not None
    config = {**loaded.config, "train": loaded.config["train"] | PRIVATE}
    trained, run_folder = factory.config_of(loaded), folders.folder_of(loaded.path)
    homes = factory.spread(factory.homes(trained.env, trained.geometry, "test"), N_ENVS)
    env = factory.construct(
        settings.changed(trained.env, n_envs=N_ENVS), geometries=homes, seed=1, device="cpu"
    )
    restore.load_wrappers(env, loaded)
    original, exported = (restore.policy_of(loaded, env) for _ in range(2))
    state = rounded(original)
    exported.load_state_dict(state)
    error = rounding_error(exported, original, env)
    if not error <= max_error:
        raise UserError(
            f"{loaded.path} acts otherwise with weights in float16: its logits differ by "
            f"{error:.1%}, and may by {max_error:.1%}"
        )
    if names := trust.foreign_names(config):
        console.warn(f"{file} needs {', '.join(names)}, and of others who load it trust=true")
    if not (rows := tables_of(run_folder, loaded.step, bool(homes))):
        words = " geometry=suite episodes=8000" if homes else ""
        command = f"{folders.command_of('evaluate', 'run', loaded.path)}{words}"
        console.warn(f"the card has no results, for {command} was not run")
    facts = facts_of(run_folder, loaded)
    facts |= {"parameters": sum(v.numel() for v in state.values()), "rounding": error}
    with user_errors(f"{file} cannot be written: "):
        file.parent.mkdir(parents=True, exist_ok=True)
        agent_file.write(file, state, config, facts, rows, loaded.state.get("wrappers"))
    return file, write_card(file)


# ---- The card ----


def write_card(file: Path) -> Path:
    """Writes the card beside an agent's file. Keeps what its authors wrote. Returns its path."""
    about = agent_file.read_metadata(file)
    path = file.with_suffix(".md")
    text = path.read_text() if path.exists() else ""
    start = text.find(BY_HAND)
    by_hand = text[start:] if start >= 0 else default_words(about)
    write_atomically(path, f"{card(file)}\n{by_hand}".encode())
    return path


def card(file: Path) -> str:
    """Returns the part of a card that follows from the agent's file."""
    about = agent_file.read_metadata(file)
    facts, name = about["facts"], file.stem
    commands = "; then ".join(f"`{command}`" for command in facts["commands"]) or "unknown"
    plays = any("won" in table["rows"][0] for table in about["tables"])
    is_suite = any("geometry=suite" in table["command"] for table in about["tables"])
    suite, maze = (" geometry=suite", " geometry=maze") if is_suite else ("", "")
    against = " against=bot" if plays else ""
    gpus = f"{facts['ranks']} × {facts['device']}" if facts["ranks"] > 1 else facts["device"]
    lines = {
        "command": commands,
        "commit": facts["commit"],
        "samples": f"{facts['samples']:,}",
        "seconds of training": f"{facts['seconds']:,}",
        "device": f"{gpus}, PyTorch {facts['torch']}",
        "size": f"{file.stat().st_size / 1e6:.2f} MB, {facts['parameters']:,} numbers: weights in "
        "float16, statistics of observations in float32, no critic",
        "error of rounding": f"{100 * facts['rounding']:.2g} % of its logits' root mean square",
    }
    parts = [
        f"# {name}",
        "```\n"
        f"python evaluate.py run={name}{suite}{against}\n"
        f"python record.py run={name}{maze}{against}\n"
        f"python train.py init={name} seconds=60\n"
        "```",
        "## Training",
        "\n".join(f"- {key}: {text}" for key, text in lines.items()),
        "## Skill" if about["tables"] else "Not evaluated.",
    ]
    for table in about["tables"]:
        are_duels = "won" in table["rows"][0]
        cells = [*map(tables.duel_cells if are_duels else tables.cells, table["rows"])]
        lines = [[*row.values()] for row in cells]
        parts += [
            f"`python evaluate.py run={name} {table['command']}`, measured before the weights were "
            f"rounded. {table['title']}:",
            console.table([*cells[0]], lines, is_markdown=True),
        ]
    return "\n\n".join(parts) + "\n"


def default_words(about: dict) -> str:
    """Returns what a new card says where people write."""
    train, spaces = about["config"]["train"], about["config"]["spaces"]
    spaces = "; ".join(f"`{name}` {space}" for name, space in spaces.items())
    environment = train["env"].get("id") or settings.label(train["env"]["name"])
    has_homes = components.takes_geometries(train["env"]["name"])
    homes = settings.label(train["geometry"]["name"])
    where = f"in `geometry={homes}`" if has_homes else "there"
    return "\n\n".join(
        [
            BY_HAND,
            f"It acts in `env={environment}`: as a baseline, as an opponent, and as a start for "
            "training with `init=`.",
            "## Limits",
            f"It was trained {where} and measured where the tables say. Its "
            f"observations and actions must be {spaces}. It has no critic.",
            "## Licence",
            "MIT, as megastep.\n",
        ]
    )
