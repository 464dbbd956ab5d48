"""megastep inspect RUN: what is in a run's checkpoints, or an agent's file, every byte verified."""

import datetime
from collections.abc import Iterator
from pathlib import Path

from megastep.agents import console
from megastep.agents.cli.command import Command
from megastep.agents.errors import UserError
from megastep.agents.runs import agent_file, checkpoint, folders
from megastep.agents.types import StateDict

HELP = """Verifies a run's checkpoints and prints what is in them.

  megastep inspect RUN     a run folder, one of its checkpoints, latest, or a pretrained agent"""


def run(run: str) -> int:
    """Inspects a run. Returns the exit code: 1 if one of its checkpoints is damaged."""
    path = folders.find(run)
    is_agent, folder = path.suffix == agent_file.SUFFIX, folders.checkpoints_of(path)
    is_one = is_agent or folder == path
    paths = [path] if is_one else checkpoint.list_checkpoints(folder)
    if not paths:
        raise UserError(f"There is no checkpoint in {folder}; has the run saved one yet?")
    is_damaged, n_printed = False, 0
    for path in paths:
        try:
            console.say("\n".join((_lines_of_agent if is_agent else _lines)(path)))
            n_printed += 1
        except checkpoint.CheckpointError as error:
            if path.exists():
                is_damaged = True
                console.say(str(error))
            elif is_one:
                raise UserError(str(error)) from None
            elif path == paths[-1] and not n_printed:  # the run has saved others meanwhile
                paths += checkpoint.list_checkpoints(folder)
    return int(is_damaged)


def _lines(path: Path) -> Iterator[str]:
    """Yields the text about a checkpoint."""
    manifest = checkpoint.read_manifest(path)
    loaded = checkpoint.read(path, "cpu", is_whole=True)
    written = datetime.datetime.fromtimestamp((path / "manifest.json").stat().st_mtime)
    yield f"{path}: intact, format {manifest['format']}, written {written:%Y-%m-%d %H:%M:%S}"
    yield f"  {'; '.join(f'{name} {value:,.6g}' for name, value in loaded.numbers.items())}"
    if loaded.made_with:
        yield f"  {'; '.join(f'{name} {value}' for name, value in loaded.made_with.items())}"
    for name, entry in manifest["files"].items():
        yield f"  {name:<14}{console.number(entry['bytes'])} bytes, sha256 {entry['sha256'][:16]}"
    yield from _parts(loaded.state)


def _lines_of_agent(path: Path) -> Iterator[str]:
    """Yields the text about the file of an agent."""
    loaded = agent_file.read(path, "cpu")
    yield f"{path}: intact, {console.number(path.stat().st_size)} bytes"
    yield from (f"  {name}: {value}" for name, value in loaded.about["facts"].items())
    yield from _parts(loaded.state)
    for table in loaded.about["tables"]:
        yield f"  {table['title']}: {len(table['rows'])} rows"


def _parts(state: StateDict | None) -> Iterator[str]:
    """Yields a line for each part of a state."""
    from torch.utils._pytree import tree_leaves

    for name, part in (state or {}).items():
        tensors = [leaf for leaf in tree_leaves(part) if hasattr(leaf, "nbytes")]
        if tensors:
            n_bytes = console.number(sum(leaf.nbytes for leaf in tensors))
            yield f"  {name}: {len(tensors)} tensors, {n_bytes} bytes"


COMMAND = Command("inspect", run, HELP)
main = COMMAND.main
