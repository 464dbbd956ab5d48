"""Saves, lists and loads the checkpoints of a run. Each is a folder `step_<N>`, after N steps.

    manifest.json  size and SHA-256 of every file and of itself, to detect damage; format, step,
                   score, versions and device, and the counters of the state, such as samples
    config.json    the run's configuration, as `typed_json` writes it
    state.pt       weights, optimizer, statistics and everything else that is small
    world.pt       environments and the actor state (observations and hidden states)
    replay.pt      the replay buffer, if it was saved
    rank1.pt, ...  with several ranks: the state of each other rank without the policy's weights,
                   which are equal on all ranks. The files above are rank 0's

The .pt files hold plain dicts of tensors, numbers and strings. Resuming reads all files; evaluation
only `state.pt`. A reader sees a complete checkpoint or none. A second checkpoint of the same step
is `step_<N>-2`; the first is deleted once the second is written.
"""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import hashlib
import json
import os
import pickle
import re
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from megastep.agents.errors import memory_problem, shortened
from megastep.agents.runs import trust, typed_json
from megastep.atomic_files import MARK, delete, replacing, sync

if TYPE_CHECKING:
    import torch

    from megastep.agents.types import Config, Row, StateDict

#: The format number. Increase it if an earlier version would misread these checkpoints, or this
#: version earlier ones.
FORMAT = 8
#: Files besides state.pt, and the keys of the state that they hold.
PARTS = {"world.pt": ("env", "collector"), "replay.pt": ("replay",)}
_NAME = re.compile(r"step_(\d+)(?:-(\d+))?")


class CheckpointError(RuntimeError):
    """No checkpoint can be used. The message names each one tried, its problem and the cure."""


class DamagedCheckpoint(CheckpointError):
    """A checkpoint does not match its manifest, or is gone. An earlier one may be intact."""

    def __init__(self, path: Path, problem: object):
        text = f"Checkpoint {path} is damaged: {shortened(problem, 300)}"
        if not path.exists():
            text = (
                f"Checkpoint {path} is gone: a run deletes its earlier checkpoints as it saves "
                "later ones; name the run's folder to get its newest"
            )
        super().__init__(text)


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """A loaded checkpoint, or an agent file."""

    path: Path  # its folder, or the file
    step: int  # environment steps of all lanes before it was saved
    numbers: dict[str, float]  # counters of the state, such as samples and seconds
    config: Config
    made_with: Row  # versions, device and threads that the numbers depend on
    state: StateDict | None = None  # None if it was not loaded
    n_ranks: int = 1  # whose state it holds
    about: Row = dataclasses.field(default_factory=dict)  # `facts` and `tables` of an agent file


# ---- Writing ----


def save(
    folder: Path | str,
    step: int,
    state: StateDict,
    config: Config,
    keep_checkpoints: int = 2,
    score: float | None = None,
    made_with: Row | None = None,
    add_files: Callable[[Path], object] = lambda path: None,
) -> Path:
    """Writes a checkpoint and deletes old ones. Returns its folder. Only one process may save into
    a folder at a time. Raises OSError if the disk is full; other checkpoints are unchanged then.

    Args:
        step: environment steps so far, of all lanes.
        state: dicts and lists of tensors and numbers.
        keep_checkpoints: number of latest steps to keep, besides the one with the highest score.
        add_files: puts the files of other ranks into the checkpoint's folder.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for leftover in folder.glob(f"step_*{MARK}*"):  # of a process that was killed
        delete(leftover)
    trust.remember(trust.foreign_names(config))
    numbers = {key: value for key, value in state.items() if isinstance(value, (int, float))}
    parts = {name: {k: state[k] for k in keys if k in state} for name, keys in PARTS.items()}
    others = {key for part in parts.values() for key in part}
    parts["state.pt"] = {key: part for key, part in state.items() if key not in others}
    taken = [n for at, n in map(_step_and_number, list_checkpoints(folder)) if at == step]
    path = folder / (f"step_{step}-{taken[-1] + 1}" if taken else f"step_{step}")
    with replacing(path) as temporary:
        temporary.mkdir()
        for name, part in parts.items():
            if part:
                save_tensors(temporary / name, part)
        _write(temporary / "config.json", typed_json.dumps(config, indent=2).encode())
        add_files(temporary)
        files = {}
        for file in sorted(temporary.iterdir()):
            with open(file, "rb") as data:
                files[file.name] = {"sha256": _digest(data), "bytes": file.stat().st_size}
        manifest: Row = dict(format=FORMAT, step=step, score=score, numbers=numbers)
        manifest |= dict(made_with=made_with or {}, files=files)
        _write(temporary / "manifest.json", sealed(manifest))
    set_aside_after(folder, step)
    _prune(folder, keep_checkpoints, step)
    return path


def save_tensors(path: Path, tree: StateDict) -> None:
    """Writes plain dicts of tensors and numbers into a file on disk. Raises OSError."""
    import torch

    try:
        torch.save(tree, path)
    except RuntimeError as error:  # which does not name the error of the disk
        if memory_problem(error):
            raise
        raise OSError(errno.EIO, "the disk is full or cannot be written") from error
    sync(path)


def sealed(manifest: Row) -> bytes:
    """Returns a manifest as JSON, with its own SHA-256 added."""
    digest = hashlib.sha256(json.dumps(manifest).encode()).hexdigest()
    return json.dumps({**manifest, "sha256": digest}, indent=2).encode()


def _write(path, content) -> None:
    path.write_bytes(content)
    sync(path)


def _digest(file) -> str:
    digest = hashlib.sha256()
    while chunk := file.read(2**24):
        digest.update(chunk)
    file.seek(0)
    return digest.hexdigest()


# ---- Reading ----


def load_latest(
    folder: Path | str,
    device: torch.device | str | None = "cpu",
    is_whole: bool = True,
    rank: int = 0,
) -> Checkpoint:
    """Loads the newest intact checkpoint of a folder, or that at it. Warns of damaged ones."""
    folder, messages = Path(folder), []
    if (folder / "manifest.json").exists() or _NAME.fullmatch(folder.name):
        return read(folder, device, is_whole, rank)
    paths = list_checkpoints(folder)
    while paths:
        path = paths.pop()
        try:
            checkpoint = read(path, device, is_whole, rank)
        except DamagedCheckpoint as error:
            messages.append(str(error))
            if not path.exists():  # deleted, as its run has saved another
                paths, messages = list_checkpoints(folder), []
            continue
        for message in messages:
            warnings.warn(f"{message}; using {path.name} instead", stacklevel=2)
        return checkpoint
    if messages:
        raise CheckpointError(f"Every checkpoint in {folder} is damaged: {'; '.join(messages)}")
    raise CheckpointError(f"There is no checkpoint in {folder}; has the run saved one yet?")


def read(
    path: Path, device: torch.device | str | None, is_whole: bool = False, rank: int = 0
) -> Checkpoint:
    """Loads a checkpoint. Opens all files before it reads any, as the run may delete them
    meanwhile. Raises DamagedCheckpoint if a file is missing, damaged, or could run code;
    CheckpointError if another version wrote it.

    Args:
        device: of the tensors in `state.pt`; None verifies all files and loads no state.
        is_whole: also loads the rank's other files, to the CPU; rank 0 verifies all files.
        rank: whose state is loaded; without a file of its own only rank 0's `state.pt`.
    """
    manifest = read_manifest(path)
    written, parts = manifest["files"], ["state.pt"]
    if is_whole:
        parts += [f"rank{rank}.pt"] if rank else PARTS
        parts = [name for name in parts if name in written]
    is_verified = device is None or (is_whole and rank == 0)
    with contextlib.ExitStack() as stack:
        files: dict[str, BinaryIO] = {}
        for name in written if is_verified else [*parts, "config.json"]:
            with _damage(path, name):
                files[name] = stack.enter_context(open(path / name, "rb"))
        for name, file in files.items():
            with _damage(path, name):
                digest = _digest(file)
            if digest != written[name]["sha256"]:
                raise DamagedCheckpoint(path, f"{name} does not match the SHA-256 in its manifest")
        with _damage(path, "config.json"):
            config = typed_json.loads(files["config.json"].read())
        state: StateDict | None = None if device is None else {}
        for name in parts if state is not None else ():
            state |= _load(path, name, files[name], device if name == "state.pt" else "cpu")
    n_ranks = 1 + sum(name.startswith("rank") for name in written)
    numbers, made_with = manifest["numbers"], manifest["made_with"]
    return Checkpoint(path, manifest["step"], numbers, config, made_with, state, n_ranks)


def read_manifest(path: Path) -> Row:
    """Returns a checkpoint's manifest. Raises as `read`."""
    with _damage(path, "manifest.json"):
        data = (path / "manifest.json").read_bytes()
        manifest = typed_json.loads(data)
        version = manifest["format"]
        if data != sealed({key: value for key, value in manifest.items() if key != "sha256"}):
            raise ValueError("it does not match its own SHA-256")
        if version == FORMAT:
            typed_json.check(typed_json.Manifest, manifest)
            if not {"config.json", "state.pt"} <= manifest["files"].keys():
                raise ValueError("it lacks config.json or state.pt")
            return manifest
    cure = "update megastep"
    if isinstance(version, int) and version < FORMAT:
        cure = "use the commit in the provenance.jsonl of its run"
    raise CheckpointError(
        f"Checkpoint {path} has format {shortened(repr(version), 20)}, and this version of "
        f"megastep reads format {FORMAT}; {cure}"
    )


@contextlib.contextmanager
def _damage(path: Path, name: str) -> Iterator[None]:
    """Turns what reading a file raises if it is damaged into DamagedCheckpoint."""
    try:
        yield
    except OSError as error:
        raise DamagedCheckpoint(path, f"{name} cannot be read ({error.strerror})") from None
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise DamagedCheckpoint(path, f"{name}: {error}") from None


def _load(path, name, file, device) -> Any:
    import torch

    try:
        return dict(torch.load(file, map_location=device, weights_only=True))
    except pickle.UnpicklingError:
        problem = "holds more than tensors and numbers, so loading it could run code"
        raise DamagedCheckpoint(path, f"{name} is refused, as it {problem}") from None
    except Exception as error:  # unpickling a damaged file may raise anything
        if memory_problem(error):
            raise
        raise DamagedCheckpoint(path, f"{name} cannot be read ({shortened(error)})") from None


def is_intact(path: Path) -> bool:
    """Returns whether every file of a checkpoint is the one that was written."""
    with contextlib.suppress(CheckpointError):
        read(path, None)
        return True
    return False


# ---- The checkpoints of a folder ----


def list_checkpoints(folder: Path | str) -> list[Path]:
    """Returns the checkpoints in a folder, oldest first. Skips unfinished and set-aside ones."""
    paths = Path(folder).glob("step_*")
    return sorted((path for path in paths if _NAME.fullmatch(path.name)), key=_step_and_number)


def step_of(path: Path) -> int:
    """Returns the step in a checkpoint's folder name."""
    return _step_and_number(path)[0]


def set_aside_after(folder: Path | str, step: int) -> None:
    """Renames checkpoints after `step`, from which a run resumes, to `step_<N>.aside`."""
    for path in list_checkpoints(folder):  # newest last, so it is the latest until then
        if step_of(path) > step:
            aside = path.with_name(f"{path.name}.aside")
            _delete(aside)
            os.replace(path, aside)


def _step_and_number(path: Path) -> tuple[int, int]:
    """Returns a checkpoint's step, and its number among those of that step, from 1."""
    match = _NAME.match(path.name)
    assert match is not None
    return int(match[1]), int(match[2] or 1)


def _prune(folder: Path, keep_checkpoints: int, step: int) -> None:
    """Deletes all but the last steps, the best, the last with replay; and those set aside."""
    checkpoints, scores = list_checkpoints(folder), {}
    last_of_each_step = [*{step_of(path): path for path in checkpoints}.values()]
    for path in last_of_each_step:
        with contextlib.suppress(CheckpointError):
            if (score := read_manifest(path)["score"]) is not None:
                scores[path] = score
    best = max(scores, key=scores.__getitem__, default=None)
    with_replay = [path for path in last_of_each_step if (path / "replay.pt").exists()]
    kept = {*last_of_each_step[-keep_checkpoints:], best, *with_replay[-1:]}
    aside = [path for path in folder.glob("step_*.aside") if step_of(path) <= step]
    for path in [*(path for path in checkpoints if path not in kept), *aside]:
        _delete(path)


def _delete(path: Path) -> None:
    """Deletes a checkpoint. If killed midway, leaves a temporary folder, not a damaged one."""
    leftover = path.with_name(f"{path.name}{MARK}")
    with contextlib.suppress(OSError):  # it does not exist or cannot be moved
        os.replace(path, leftover)
        delete(leftover)
