"""The format of a checkpoint: a folder of these files.

    manifest.json  size and SHA-256 of every file and of itself, to detect damage; format, step,
                   score, versions and device, and the counters of the state, such as samples
    config.json    the run's configuration; infinity is written as {"$float": "inf"}, and a dict
                   with keys other than strings as {"$dict": [[0, 1.0]]}
    state.pt       weights, optimizer, statistics and everything else that is small
    world.pt       environments and the actor state (observations and hidden states)
    replay.pt      the replay buffer, if it was saved
    rank1.pt, ...  with several ranks: the state of each other rank without the policy's weights,
                   which are equal on all ranks. The files above are rank 0's

The .pt files hold plain dicts of tensors, numbers and strings. Resuming reads all files; evaluation
only `state.pt`. JSON is read without PyTorch.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import json
import os
import pickle
import re
import time
import zipfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from megastep.agents.errors import memory_problem, shortened
from megastep.agents.runs import formats, strange_files, trust, typed_json
from megastep.agents.runs.atomic_files import sync_folder

if TYPE_CHECKING:
    import torch

    from megastep.agents.types import Config, Row, StateDict

#: The format number. Increase it if an earlier version would misread these checkpoints, or this
#: version earlier ones; then add the last commit of the old format to `READERS`.
FORMAT = 7
#: Commits that read the older formats. `MIGRATED` is read here, see `_migrated`.
READERS = {1: "e17fabe", 2: "6f4fbf1", 3: "3ffd1d5", 4: "e9908db", 5: "916221d"}
MIGRATED = 6
#: Files other than state.pt, and the keys of the state that they hold.
PARTS = {"world.pt": ("env", "collector"), "replay.pt": ("replay",)}
_RANK_FILE = re.compile(r"rank[1-9]\d*\.pt")
_LOGGERS = "megastep.agents.training.loggers"
_CHUNK = _MAX_JSON = 2**24  # bytes


class CheckpointError(RuntimeError):
    """No checkpoint can be used. The message names each one tried, its problem and the cure."""


class DamagedCheckpoint(CheckpointError):
    """A checkpoint does not match its manifest. An earlier checkpoint may be intact."""


class GoneCheckpoint(CheckpointError):
    """A checkpoint was deleted before all its files were open, because its run saved later ones."""

    def __init__(self, path: Path):
        super().__init__(
            f"Checkpoint {path} is gone: a run deletes its earlier checkpoints as it saves later "
            "ones; name the run's folder to get its newest"
        )


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """A loaded checkpoint.

    Attributes:
        path: its folder.
        step: environment steps of all lanes before it was saved.
        numbers: counters of the state, such as samples and seconds.
        config: the run's configuration, as saved.
        made_with: versions, device and threads that the numbers depend on.
        state: dicts of tensors and numbers, as saved; None if it was not loaded.
        untrusted: import paths outside megastep in `config`; empty if this user wrote it.
        n_ranks: number of ranks whose state it holds.
    """

    path: Path
    step: int
    numbers: dict[str, float]
    config: Config
    made_with: Row
    state: StateDict | None = None
    untrusted: tuple[str, ...] = ()
    n_ranks: int = 1


def rank_file(rank: int) -> str:
    """Returns the file name of a rank's state, for ranks other than 0."""
    return f"rank{rank}.pt"


# ---- Writing ----


def write(
    path: Path,
    step: int,
    state: StateDict,
    config: Config,
    score: float | None,
    made_with: Row | None = None,
    replay_seconds: float | None = None,
    add_files: Callable[[Path], Row] = lambda path: {},
) -> None:
    """Writes a checkpoint into a new folder and flushes it to disk.

    Args:
        path, step, state, config, score, made_with: as for `checkpoint.save`.
        replay_seconds: `replay.pt` is left out if it takes longer to write; None: no limit.
        add_files: puts the files of other ranks into the folder; returns their manifest entries by
            name.
    """
    import torch

    path.mkdir()
    apart = {key for keys in PARTS.values() for key in keys}
    parts = {"state.pt": {key: part for key, part in state.items() if key not in apart}}
    for name, keys in PARTS.items():
        if part := {key: state[key] for key in keys if key in state}:
            parts[name] = part
    files = {}
    for name, part in parts.items():
        deadline = None
        if name == "replay.pt" and replay_seconds is not None:
            deadline = time.monotonic() + replay_seconds
        try:
            files[name] = _write_file(path / name, functools.partial(torch.save, part), deadline)
        except _TooLate:
            (path / name).unlink()
    text = typed_json.dumps(config, indent=2).encode()
    files["config.json"] = _write_file(path / "config.json", lambda file: file.write(text))
    files |= add_files(path)
    numbers = {key: value for key, value in state.items() if isinstance(value, (int, float))}
    manifest: dict = dict(format=FORMAT, step=step, score=score, numbers=numbers)
    manifest |= dict(torch=torch.__version__, made_with=made_with or {}, files=files)
    manifest["signature"] = trust.sign(text)
    text = sealed(manifest)
    _write_file(path / "manifest.json", lambda file: file.write(text))
    sync_folder(path)


def write_state(path: Path, state: StateDict, replay_seconds: float | None = None) -> Row:
    """Writes a rank's state into one file and flushes it to disk. Returns its manifest entry.

    Args:
        replay_seconds: the replay buffer is left out if the file takes longer; None: no limit.
    """
    import torch

    deadline = None
    if "replay" in state and replay_seconds is not None:
        deadline = time.monotonic() + replay_seconds
    try:
        return _write_file(path, functools.partial(torch.save, state), deadline)
    except _TooLate:
        state = {key: part for key, part in state.items() if key != "replay"}
        return _write_file(path, functools.partial(torch.save, state))


def check_plain(tree: object, name: str) -> None:
    """Checks that a tree can be loaded without running code: it may hold tensors, numbers, strings,
    None, and lists, tuples and dicts of these.

    Args:
        tree: what to check.
        name: the tree's name in messages.

    Raises:
        TypeError: naming the path of anything else.
    """
    if isinstance(tree, dict):
        for key, part in tree.items():
            check_plain(part, f"{name}.{key}")
    elif isinstance(tree, (list, tuple)):
        for i, part in enumerate(tree):
            check_plain(part, f"{name}.{i}")
    elif type(tree) not in (bool, int, float, str, type(None)) and not hasattr(
        tree, "untyped_storage"
    ):
        raise TypeError(
            f"{name} is a {type(tree).__module__}.{type(tree).__name__}, and checkpoints hold "
            "tensors, numbers, strings, lists and dicts only: convert it, for example with float()"
        )


class _TooLate(Exception):
    """A file took longer to write than its deadline."""


class _HashedFile:
    """A file that counts and hashes the bytes written to it.

    Attributes:
        error: the first error; kept, because `torch.save` would replace a raised one by its own.
    """

    def __init__(self, file: BinaryIO, deadline: float | None):
        self.file, self.deadline, self.error = file, deadline, None
        self.n_bytes, self.sha256 = 0, hashlib.sha256()

    def write(self, data) -> int:
        data = memoryview(data).cast("B")
        for start in range(0, len(data) if self.error is None else 0, _CHUNK):
            chunk = data[start : start + _CHUNK]
            try:
                self.file.write(chunk)
            except OSError as error:
                self.error = error
            self.sha256.update(chunk)
            if self.deadline is not None and time.monotonic() > self.deadline:
                self.error = _TooLate()
        self.n_bytes += len(data)
        return len(data)

    def flush(self) -> None:
        pass


def _write_file(path: Path, write: Callable[[Any], object], deadline: float | None = None) -> Row:
    """Writes a file and flushes it to disk. Returns its manifest entry."""
    with open(path, "wb") as file:
        hashed = _HashedFile(file, deadline)
        write(hashed)
        if hashed.error is not None:
            raise hashed.error
        file.flush()
        os.fsync(file.fileno())
    return {"sha256": hashed.sha256.hexdigest(), "bytes": hashed.n_bytes}


def sealed(manifest: Row) -> bytes:
    """Returns a manifest as JSON, with its own SHA-256 added."""
    digest = hashlib.sha256(json.dumps(manifest).encode()).hexdigest()
    return json.dumps({**manifest, "sha256": digest}, indent=2).encode()


# ---- Reading ----


def read(
    path: Path, device: torch.device | str | None, is_whole: bool = False, rank: int = 0
) -> Checkpoint:
    """Loads a checkpoint. Opens all files before it reads any, so it can still read them if the run
    deletes them meanwhile.

    Args:
        path: the checkpoint's folder.
        device: device of the tensors in `state.pt`; None verifies all files and loads no state.
        is_whole: also loads the rank's other files, to the CPU; rank 0 verifies all files.
        rank: the rank whose state is loaded. If it has no file, only rank 0's `state.pt` is read.

    Raises:
        DamagedCheckpoint: a file is missing, damaged, or could run code when loaded.
        GoneCheckpoint: it was deleted before all files were open.
        CheckpointError: another version of megastep wrote it.
    """
    manifest = read_manifest(path)
    n_ranks = 1 + sum(map(bool, map(_RANK_FILE.fullmatch, manifest["files"])))
    parts = ["state.pt"]
    if is_whole:
        parts += [rank_file(rank)] if rank else PARTS
        parts = [name for name in parts if name in manifest["files"]]
    is_verified = device is None or (is_whole and rank == 0)
    names = manifest["files"] if is_verified else [*parts, "config.json"]
    with verified(path, manifest, names) as files:
        text = files["config.json"].read(_MAX_JSON + 1)
        try:
            if len(text) > _MAX_JSON:
                raise ValueError("it is too long")
            config = typed_json.loads(text)
        except (ValueError, RecursionError):
            problem = f"Checkpoint {path} is damaged: config.json is not JSON"
            raise DamagedCheckpoint(problem) from None
        checkpoint = Checkpoint(
            path,
            manifest["step"],
            manifest["numbers"],
            config,
            manifest.get("made_with", {}),
            untrusted=tuple(trust.untrusted_names(text, manifest.get("signature"))),
            n_ranks=n_ranks,
        )
        if device is None:
            return checkpoint
        state = {}
        for name in parts:
            to = device if name == "state.pt" else "cpu"
            state |= _load(path / name, files[name], to)
    return dataclasses.replace(checkpoint, state=_migrated(state, manifest))


def _load(path, file, device) -> Any:
    """Returns the state in an open file. Raises DamagedCheckpoint."""
    import torch

    try:
        _check_zip(file)
        file.seek(0)
        state = torch.load(file, map_location=device, weights_only=True)
        if not isinstance(state, dict):
            raise ValueError("it is not a dict")
        return state
    except pickle.UnpicklingError:
        raise DamagedCheckpoint(
            f"Checkpoint {path.parent} is refused: {path.name} holds more than tensors and "
            "numbers, so loading it could run code"
        ) from None
    except Exception as error:  # unpickling a forged file may raise anything
        if memory_problem(error):
            raise
        raise DamagedCheckpoint(
            f"Checkpoint {path.parent} is damaged: {path.name} cannot be read ({shortened(error)})"
        ) from None


def _check_zip(file) -> None:
    """Raises ValueError for a zip file with compressed parts: a small one may unpack to more than
    fits in memory, and `torch.save` never compresses.
    """
    if zipfile.is_zipfile(file):
        with zipfile.ZipFile(file) as archive:
            if any(entry.compress_size != entry.file_size for entry in archive.infolist()):
                raise ValueError("its parts are compressed")


def _migrated(state, manifest) -> dict:
    """Converts a state of format `MIGRATED` to `FORMAT`; returns one of `FORMAT` as it is."""
    import torch
    from torch.nn.functional import pad

    if manifest["format"] == FORMAT:
        return state
    if "learner" in state and "optimizer" in state["learner"]:
        state["learner"].setdefault("check", torch.zeros(2, dtype=torch.float64))
    if stats := state.get("episode_stats"):  # format 6 did not count episodes left out of a metric
        n_metrics = len(stats["sums"]) - 4
        stats["sums"] = pad(stats["sums"], (0, 0, 0, n_metrics))
        stats["windows"] = [
            pad(one, (0, n_metrics)) if len(one) else one for one in stats["windows"]
        ]
    return state | {"samples_at_report": state.get("samples", 0)}


def with_loggers(config: Config) -> Config:
    """Returns a configuration whose `train.logger` has the loggers by label. In older ones, it is
    W&B or none, and TensorBoard is implied.
    """
    match config:
        case {"train": {"logger": {"name": "none" | "wandb" as name, **keys}} as train}:
            chosen = {"tensorboard": {"name": f"{_LOGGERS}.tensorboard:TensorBoard"}}
            if name == "wandb":
                chosen["wandb"] = {"name": f"{_LOGGERS}.wandb:Wandb", **keys}
            return config | {"train": train | {"logger": chosen}}
    return config


@contextlib.contextmanager
def verified(path: Path, manifest: Row, names: Iterable[str]) -> Iterator[dict[str, BinaryIO]]:
    """Opens files of a checkpoint and compares each with the SHA-256 in its manifest.

    Yields:
        The open files by name, each at its beginning.

    Raises:
        DamagedCheckpoint: a file is missing or differs.
        GoneCheckpoint: the checkpoint was deleted before all were open.
    """
    with contextlib.ExitStack() as stack:
        files = {}
        for name in names:
            with _readable(path, name):
                file = open(path / name, "rb", opener=strange_files.opener)
                files[name] = stack.enter_context(file)
        for name, file in files.items():
            with _readable(path, name):
                digest = _digest(file)
            if digest != manifest["files"][name]["sha256"]:
                problem = f"{name} does not match the SHA-256 in its manifest"
                raise DamagedCheckpoint(f"Checkpoint {path} is damaged: {problem}")
        yield files


@contextlib.contextmanager
def _readable(path, name) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if not path.exists():
            raise GoneCheckpoint(path) from None
        raise DamagedCheckpoint(
            f"Checkpoint {path} is damaged: {name} cannot be read ({error.strerror})"
        ) from None


def _digest(file) -> str:
    digest = hashlib.sha256()
    while chunk := file.read(_CHUNK):
        digest.update(chunk)
    file.seek(0)
    return digest.hexdigest()


def read_manifest(path: Path) -> Row:
    """Returns a checkpoint's manifest.

    Raises:
        DamagedCheckpoint: its bytes are not those that `sealed` writes.
        GoneCheckpoint: the checkpoint no longer exists.
        CheckpointError: it has an unknown format.
    """
    try:
        data = strange_files.read_bytes(path / "manifest.json", _MAX_JSON)
        manifest = json.loads(data)
        version = manifest["format"]
        body = {key: value for key, value in manifest.items() if key != "sha256"}
        is_intact = data == sealed(body) and isinstance(version, (int, str))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        version, is_intact = None, False
    if is_intact and version in (FORMAT, MIGRATED):
        try:
            formats.check(formats.Manifest, manifest)
        except ValueError as error:
            raise DamagedCheckpoint(
                f"Checkpoint {path} is damaged: manifest.json: {error}"
            ) from None
        others = {*manifest["files"]} - {"config.json", "state.pt", *PARTS}
        is_intact = all(map(_RANK_FILE.fullmatch, others))  # a forged manifest may name any path
        is_intact &= {"config.json", "state.pt"} <= {*manifest["files"]}
    is_without_digest = version == 1 and "sha256" not in manifest
    if not (is_intact or is_without_digest or path.exists()):
        raise GoneCheckpoint(path)
    if not (is_intact or is_without_digest):
        raise DamagedCheckpoint(
            f"Checkpoint {path} is damaged: manifest.json cannot be read or does not match its own "
            "SHA-256"
        )
    if version in READERS:
        raise CheckpointError(
            f"Checkpoint {path} was written by an earlier version (format {version}); commit "
            f"{READERS[version]} reads it"
        )
    if version not in (FORMAT, MIGRATED):
        raise CheckpointError(
            f"Checkpoint {path} has format {version}, which is unknown: this version reads format "
            f"{FORMAT}. Update megastep"
        )
    return manifest
