"""Turns a run into an agent file with its acting weights.

Evaluate the run first, for the file's tables: `megastep evaluate run=RUN geometry=suite
episodes=8000`, and with against=bot for duels.
"""

import json
import re
from pathlib import Path

import torch

from megastep.agents import console, factory
from megastep.agents.errors import UserError, user_errors
from megastep.agents.factory import components, settings
from megastep.agents.networks.policy import Policy
from megastep.agents.runs import (
    agent_file,
    folders,
    json_lines,
    provenance,
    restore,
    trust,
)
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


def rounded(policy: Policy) -> dict[str, torch.Tensor]:
    """Returns a policy's state with weights as float16; statistics keep their dtype. Raises
    UserError if a weight is too large.
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


def command_of(words: str) -> str:
    """Returns a command without where Python and the script are on the machine."""
    return re.sub(r"^.*?(\S*/)?((train\.py|megastep train)\b.*)$", r"python \2", words).replace(
        "python megastep", "megastep"
    )


def tables_of(folder: Path, step: int, has_homes: bool) -> list[dict]:
    """Returns the evaluations of a run after so many samples, oldest first: titles, commands
    without their run, and rows. Of an environment with floor plans those in geometry=suite, or, if
    there are none, those in homes of the run's own source.
    """
    tables: dict[bool, list[dict]] = {False: [], True: []}
    own = vars(components.settings_for("geometry", components.SUITE))
    files = sorted((folder / "evaluations").glob("*.json"), key=lambda path: path.stat().st_mtime)
    for path in files:
        table = json.loads(path.read_text())
        how = table.get("evaluation", {})
        geometry = how.get("geometry") or {}
        is_suite = geometry.get("name") == components.SUITE
        if table.get("step") != step or (has_homes and geometry and not is_suite):
            continue
        words = ["geometry=suite"] * is_suite
        for key, value in geometry.items() if is_suite else ():
            if value != own[key]:
                words.append("'geometry.{}={}'".format(key, json.dumps(value).replace('"', "")))
        words += [f"{key}={how[key]}" for key in ("split", "episodes", "seed")]
        words += ["greedy=true"] * how["greedy"]
        for key in ("baseline", "against"):
            if how.get(key) and how[key] != ["random"]:  # the default
                words.append(f"{key}={','.join(how[key])}")
        title = re.sub(f"^{re.escape(folder.name)}(?=, )", "the agent", table["title"])
        about = {"title": title, "command": " ".join(words), "rows": table["rows"]}
        tables[is_suite].append(about)
    return tables[has_homes] or tables[False]


def write(run: str, file: Path, max_error: float = MAX_ERROR) -> None:
    """Writes an agent's file.

    Args:
        run: a run's folder, or one of its checkpoints.
        file: NAME.safetensors.
        max_error: bound of `rounding_error`.

    Raises:
        UserError: the run acts otherwise once it is rounded, or cannot be written.
    """
    if not re.fullmatch(r"[a-z][a-z0-9_]*", file.stem):
        raise UserError(
            f"{file.stem!r} is not a name for an agent; use small letters, digits and _"
        )
    loaded = folders.load_checkpoint(folders.find(run), False, factory.make_device("cpu"))
    if not loaded.numbers:
        raise UserError(f"{loaded.path} has weights only; export a run or its checkpoint")
    assert loaded.state is not None
    config = {**loaded.config, "train": loaded.config["train"] | PRIVATE}
    trained, folder = factory.config_of(loaded), folders.folder_of(loaded.path)
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
    if not (rows := tables_of(folder, loaded.step, bool(homes))):
        words = " geometry=suite episodes=8000" if homes else ""
        command = f"{folders.command_of('evaluate', 'run', loaded.path)}{words}"
        console.warn(f"the file has no results, for {command} was not run")
    lines = json_lines.read(folder / provenance.FILE)
    lines = [line for line in lines if line["samples"] < loaded.step]
    commits = dict.fromkeys(line.get("commit", "unknown") for line in lines)
    made_with = {"device": "unknown", "torch": "unknown", "ranks": 1, **loaded.made_with}
    facts = {
        "environment": config["train"]["env"]["name"],
        "commands": [command_of(line["command"]) for line in lines],
        "commit": ", ".join(commits) or "unknown",
        "samples": loaded.step,
        "seconds": round(loaded.numbers["seconds"], 1),
        "device": made_with["device"].removeprefix("cuda "),
        "torch": made_with["torch"],
        "ranks": made_with["ranks"],
        "parameters": sum(v.numel() for v in state.values()),
        "rounding": error,
    }
    with user_errors(f"{file} cannot be written: "):
        file.parent.mkdir(parents=True, exist_ok=True)
        agent_file.write(file, state, config, facts, rows, loaded.state.get("wrappers"))
