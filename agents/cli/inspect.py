"""megastep inspect RUN: what is in a run's checkpoints, or an agent's file, every byte verified."""

import datetime
import math
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from megastep.agents import console
from megastep.agents.cli.command import Command
from megastep.agents.errors import UserError
from megastep.agents.runs import agent_file, checkpoint, folders
from megastep.settings import frozen

if TYPE_CHECKING:
    import torch

    from megastep.agents.types import StateDict

HELP = """Verifies a run's checkpoints and prints what is in them.

  megastep inspect RUN     a run folder, one of its checkpoints, latest, or a pretrained agent"""


@frozen
class Inspect:
    run: str


def run(cfg: Inspect) -> int:
    """Inspects a run. Returns the exit code: 1 if one of its checkpoints is damaged."""
    path = folders.find(cfg.run)
    if agent_file.is_agent_file(path):
        return _inspect([path], _lines_of_agent)
    if folders.checkpoints_of(path) == path:
        return _inspect([path], _lines)
    path = folders.checkpoints_of(path)
    if not checkpoint.list_checkpoints(path):
        raise UserError(f"There is no checkpoint in {path}; has the run saved one yet?")
    return _inspect(checkpoint.list_checkpoints(path), _lines, path)


def _inspect(
    paths: list[Path], lines_of: Callable[[Path], Iterable[str]], folder: Path | None = None
) -> int:
    """Prints the lines about each path. Returns 1 if one is damaged, else 0.

    Args:
        folder: where a run may delete some of these checkpoints meanwhile, and save others.
    """
    is_damaged, n_printed = False, 0
    while paths:
        path, *paths = paths
        try:
            console.say("\n".join(lines_of(path)))
            n_printed += 1
        except checkpoint.GoneCheckpoint as error:
            if folder is None:
                raise UserError(str(error)) from None
            paths = paths if paths or n_printed else checkpoint.list_checkpoints(folder)
        except checkpoint.CheckpointError as error:
            is_damaged = True
            console.say(str(error))
    return int(is_damaged)


def _lines(path: Path) -> Iterator[str]:
    """Yields the text about a checkpoint."""
    manifest = checkpoint.read_manifest(path)
    loaded = checkpoint.read(path, "cpu", is_whole=True)
    try:
        written = datetime.datetime.fromtimestamp((path / "manifest.json").stat().st_mtime)
    except FileNotFoundError:
        raise checkpoint.GoneCheckpoint(path) from None
    numbers = [f"{name} {value:,.6g}" for name, value in loaded.numbers.items()]
    made_with = [f"{name} {value}" for name, value in loaded.made_with.items()]
    yield f"{path}: intact, format {manifest['format']}, written {written:%Y-%m-%d %H:%M:%S}"
    yield f"  {'; '.join(numbers)}"
    if made_with:
        yield f"  {'; '.join(made_with)}"
    for name, entry in manifest["files"].items():
        yield f"  {name:<14}{console.number(entry['bytes'])} bytes, sha256 {entry['sha256'][:16]}"
    head = ["part", "tensors", "numbers", "bytes", "largest"]
    rows = [
        _row(name, part) for name, part in (loaded.state or {}).items() if isinstance(part, dict)
    ]
    yield from (f"  {line}" for line in console.table(head, rows).splitlines())


def _lines_of_agent(path: Path) -> Iterator[str]:
    """Yields the text about the file of an agent."""
    loaded, about = agent_file.read(path, "cpu"), agent_file.read_metadata(path)
    yield f"{path}: intact, {console.number(path.stat().st_size)} bytes"
    yield from (f"  {name}: {value}" for name, value in about["facts"].items())
    head = ["part", "tensors", "numbers", "bytes", "largest"]
    rows = [_row(name, part) for name, part in (loaded.state or {}).items()]
    yield from (f"  {line}" for line in console.table(head, rows).splitlines())
    for table in about["tables"]:
        yield f"  {table['title']}: {len(table['rows'])} rows"


def _row(name: str, part: "StateDict") -> list[str]:
    """Returns the cells about a part of a checkpoint's state."""
    tensors = dict(_tensors(part))
    n_numbers = sum(math.prod(leaf.shape) for leaf in tensors.values())
    n_bytes = sum(leaf.nbytes for leaf in tensors.values())
    path, leaf = max(tensors.items(), key=lambda item: item[1].nbytes, default=("", None))
    largest = "" if leaf is None else f"{path.lstrip('.')} {tuple(leaf.shape)}"
    numbers = [console.number(number) for number in (len(tensors), n_numbers, n_bytes)]
    return [name, *numbers, largest]


def _tensors(tree, path="") -> "Iterator[tuple[str, torch.Tensor]]":
    """Yields (path, tensor) of nested dicts and lists."""
    if hasattr(tree, "nbytes"):
        yield path, tree
    elif isinstance(tree, (dict, list, tuple)):
        pairs = tree.items() if isinstance(tree, dict) else enumerate(tree)
        for key, part in pairs:
            yield from _tensors(part, f"{path}.{key}".replace("..", "."))


COMMAND = Command("inspect", Inspect, HELP)
main = COMMAND.main
