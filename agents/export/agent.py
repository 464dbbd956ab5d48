"""Turns a run, or a policy, into an agent file with its acting weights, and a card beside it.

Evaluate the run first, for the tables: `megastep evaluate run=RUN`, with geometry=suite
episodes=8000 if it plays in homes of all kinds, and against=bot for duels. What follows "What it is
for" in a card is written by hand, and kept when the agent is exported again.
"""

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import torch

from megastep.agents import console, package
from megastep.agents.errors import UserError, user_errors
from megastep.agents.evaluation import eval_env, tables
from megastep.agents.factory import check, components, settings
from megastep.agents.factory import make as factory
from megastep.agents.networks.policy import Policy
from megastep.agents.runs import (
    agent_file,
    checkpoint,
    folders,
    json_lines,
    provenance,
    restore,
    scores,
    trust,
    typed_json,
)
from megastep.agents.types import Config, Row
from megastep.atomic_files import write_atomically
from megastep.types import Env

#: Settings of a run that are of no use to others, or name files of the machine that trained it.
PRIVATE = dict(
    folder=None, resume=None, rerun=None, init=None, more_samples=None, more_seconds=None
)
#: The part of a card that people write begins here.
BY_HAND = "## What it is for"


def rounded(policy: Policy) -> dict[str, torch.Tensor]:
    """Returns a policy's state with weights as float16. UserError if one is too large."""
    weights = dict(policy.named_parameters())
    state = {k: v.half() if k in weights else v for k, v in policy.state_dict().items()}
    for name, tensor in state.items():
        if not tensor.isfinite().all():
            raise UserError(f"{name} has numbers beyond 65,504, the largest of float16")
    return {name: tensor.detach().cpu() for name, tensor in state.items()}


def command_of(words: str) -> str:
    """Returns a command without where Python and the script are on the machine."""
    words = re.sub(r"^.*?(\S*/)?((train\.py|megastep train)\b.*)$", r"python \2", words)
    return re.sub(r"(?<!\S)/\S*/", "", words).replace("python megastep", "megastep")


def tables_of(folder: Path, step: int, has_homes: bool) -> list[dict]:
    """Returns the evaluations of a run after so many samples, oldest first: titles, commands, and
    rows of players that everybody has; of geometry=suite if there are such and `has_homes`.
    """
    suites, others = [], []
    own = vars(components.settings_for("geometry", components.SUITE))
    files = sorted((folder / "evaluations").glob("*.json"), key=lambda path: path.stat().st_mtime)
    for path in files:
        table = scores.evaluation(path)
        how = table.get("evaluation", {})
        geometry = how.get("geometry") or {}
        is_suite = geometry.get("name") == components.SUITE
        is_other = how.get("env") is not None or (has_homes and geometry and not is_suite)
        kind = "against" if how.get("against") else "baseline"
        players = how.get(kind) or []
        rows = _rows_of_known(table["rows"], kind, players)
        if table.get("step") != step or is_other or not rows:
            continue
        words = ["geometry=suite"] * is_suite
        for key, value in geometry.items() if is_suite else ():
            if value != own.get(key):
                words.append("'geometry.{}={}'".format(key, json.dumps(value).replace('"', "")))
        words += [f"{key}={how[key]}" for key in ("split", "episodes", "seed") if key in how]
        words += ["greedy=true"] * how.get("greedy", False)
        words += [f"max_steps={how['max_steps']}"] * (how.get("max_steps") is not None)
        if (known := [*filter(_is_known, players)]) != ["random"]:  # the default
            words.append(f"{kind}={','.join(known) or 'none'}")
        title = re.sub(f"^{re.escape(folder.name)}(?=, )", "the agent", table["title"])
        about = {"title": title, "command": " ".join(words), "rows": rows}
        (suites if is_suite else others).append(about)
    return (suites if has_homes else []) or others


def _is_known(player: str) -> bool:
    """Whether a colleague has a player: a bot, an agent of the package, or an import path."""
    return eval_env.is_bot(player) or player in folders.pretrained()


def _rows_of_known(rows, kind, players) -> "list[Row]":
    """Returns the rows of the agent itself, and of the players that a colleague has."""
    names = [*dict.fromkeys(row.get("against", row.get("agent")) for row in rows)]
    typed = [None] * (kind == "baseline") + [*dict.fromkeys(players)]
    known = [name for name, one in zip(names, typed) if one is None or _is_known(one)]
    return [row for row in rows if row.get("against", row.get("agent")) in known]


def write(run: str, file: Path) -> None:
    """Writes the file of a run's agent, NAME.safetensors, and its card. Raises UserError if a
    weight is too large, or they cannot be written.
    """
    loaded = folders.load_checkpoint(folders.find(run), False, factory.make_device("cpu"))
    if not loaded.numbers:
        raise UserError(f"{loaded.path} has weights only; export a run or its checkpoint")
    folder = folders.folder_of(loaded.path)
    has_homes = components.takes_geometries(factory.config_of(loaded).env.name)
    if not (rows := tables_of(folder, loaded.step, has_homes)):
        command = folders.command_of("evaluate", "run", loaded.path)
        console.warn(f"the card has no results, for {command} was not run")
    lines = json_lines.read(folder / provenance.FILE, typed_json.Start)
    lines = [line for line in lines if line["samples"] < loaded.step]
    made_with = {"device": "unknown", "torch": "unknown", "ranks": 1, **loaded.made_with}
    facts = {
        "commands": [command_of(line["command"]) for line in lines if "command" in line],
        "commit": ", ".join(dict.fromkeys(line.get("commit", "unknown") for line in lines)),
        "samples": loaded.step,
        "seconds": round(loaded.numbers["seconds"], 1),
        "device": made_with["device"].removeprefix("cuda "),
        "torch": made_with["torch"],
        "ranks": made_with["ranks"],
    }
    write_loaded(loaded, file, facts, rows)


def write_loaded(
    loaded: checkpoint.Checkpoint,
    file: Path,
    facts: "Row",
    rows: "Sequence[Row]" = (),
    env: Env | None = None,
) -> None:
    """Writes a loaded checkpoint, which must be able to act in `env`, as an agent's file with a
    card: how it was trained, `facts`, and its evaluations, `rows`.
    """
    if not re.fullmatch(r"[a-z][a-z0-9_]*", file.stem):
        raise UserError(
            f"{file.stem!r} is not a name for an agent; use small letters, digits and _"
        )
    config = {**loaded.config, "train": loaded.config["train"] | PRIVATE}
    opponents = config["train"].get("opponents") or {}
    if "/" in (bot := opponents.get("bot_class") or ""):  # a file of that machine
        config["train"]["opponents"] = opponents | {"bot_class": Path(bot).stem}
    state = rounded(restore.policy_of(loaded, env))
    if names := trust.foreign_names(config):
        console.warn(f"{file} needs {', '.join(names)}, and of others who load it trust=true")
    facts = {"environment": config["train"]["env"]["name"], **facts}
    facts["parameters"] = sum(v.numel() for v in state.values())
    wrappers = cast(dict, loaded.state).get("wrappers")
    with user_errors(f"{file} cannot be written: "):
        file.parent.mkdir(parents=True, exist_ok=True)
        agent_file.write(file, state, config, facts, rows, wrappers)
        write_card(file, config, facts, rows)


# ---- The card ----


def write_card(file: Path, config: "Config", facts: "Row", rows: "Sequence[Row]") -> None:
    """Writes the card beside an agent's file, and keeps what its author wrote in it."""
    path, title = file.with_suffix(".md"), f"# {file.stem}\n"
    text = path.read_text() if path.exists() else title
    if not text.startswith(title):
        console.warn(f"{path} is not a card of {file.stem} and stays as it is")
        return
    _, found, by_hand = text.partition(f"\n{BY_HAND}\n")
    if not found:
        train = config["train"]
        where = f"It was trained in `geometry={components.label(train['geometry']['name'])}`. "
        where *= components.takes_geometries(train["env"]["name"])
        spaces = "; ".join(f"`{name}` {space}" for name, space in config["spaces"].items())
        by_hand = (
            "\nA baseline, an opponent, or a start for training.\n\n## Limits\n\n"
            f"{where}Its observations and actions must be {spaces}.\n"
        )
    parts = title, card(file.name, config, facts, rows), f"{BY_HAND}\n{by_hand}"
    write_atomically(path, "{}\n{}\n\n{}".format(*parts).encode())


def card(name: str, config: "Config", facts: "Row", rows: "Sequence[Row]") -> str:
    """Returns the part of a card that follows from the agent's file of a name."""
    train, env = config["train"], config["train"]["env"]
    labels = {path: label for label, path in components.members("env").items()}
    task = f"env={labels.get(env['name'], env['name'])}"
    task += f" env.id={env['id']}" if env.get("id") else ""
    trusted = " trust=true" * bool(trust.foreign_names(config))
    commands = " ".join(f"{table['command']} " for table in rows)
    # in place of files that only the author has
    files = [v for k, v in check.leaves(train["geometry"]) if k.rpartition(".")[2] == "path" and v]
    homes = " geometry=homes" * bool(files and components.takes_geometries(env["name"]))
    suite = " geometry=suite" if "geometry=suite " in commands else homes
    duels = " against=bot" * bool(re.search(r"against=(\S+,)?bot\b", commands))
    learner = " agent.critic=plain" * (train["agent"].get("critic") is None)
    learner = " learner=r2d2" if train["agent"].get("output") == "duelling" else learner
    learner += " env.n_envs=16" * (env.get("n_envs", 16) < 16)  # for the learner's minibatches
    parts = [
        f"A trained agent of megastep (`pip install {package.DISTRIBUTION}`) for `{task}`. In the "
        f"folder of `{name}`:",
        f"```\nmegastep evaluate run={name}{suite}{duels}{trusted}\n"
        f"megastep record run={name}{homes}{duels}{trusted}\n"
        f"megastep train init={name}{homes}{learner} seconds=60{trusted}\n```",
    ]
    played = {key: train.get(key) for key in settings.Trained.__dataclass_fields__}
    if foreign := trust.foreign_names({"train": played}):
        parts.append(
            f"It needs `{'`, `'.join(foreign)}`: modules that can be imported, such as files in "
            "the current folder. `trust=true` runs their code, so read it before."
        )
    ranks, device = facts.get("ranks", 1), facts.get("device", "")
    lines = {
        "command": "; then ".join(f"`{command}`" for command in facts.get("commands", ())),
        "commit": facts.get("commit"),
        "samples": f"{facts['samples']:,}",
        "seconds of training": f"{facts.get('seconds', 0):,}",
        "device": f"{ranks} x {device}" if ranks > 1 else device,
        "PyTorch": facts.get("torch"),
        "size": f"{facts['parameters']:,} numbers: weights in float16, no critic",
    }
    lines = [
        f"- {k}: {text}" for k, text in lines.items() if text not in (None, "", "0", "unknown")
    ]
    parts += ["## Training", "\n".join(lines), "## Evaluations" if rows else "Not evaluated."]
    for table in rows:
        parts += [
            f"`megastep evaluate run={name} {table['command']}{trusted}`, measured before the "
            f"weights were rounded. {table['title']}:",
            console.table(*tables.grid(table["rows"]), is_markdown=True),
        ]
    return "\n\n".join(parts)
