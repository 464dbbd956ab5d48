"""Checkpoints that are whole or absent, and say so when they are damaged.

A checkpoint is a folder `step_<N>` of state.pt (plain dicts of tensors and numbers), config.json
and manifest.json (sizes and sha256 of the two, and a sha256 of its own). It is written beside its
place, forced to the disk, renamed into it and read again; so a reader sees all of it or none. A
second one of a step is `step_<N>-2`: none is replaced, the earlier one goes when the later stands.
"""

import dataclasses
import hashlib
import io
import json
import os
import pickle
import re
import shutil
import warnings
from pathlib import Path
from typing import Any

import torch

#: Raised by one whenever what is written changes so that an older reader would misread it, or a
#: newer one what is older.
FORMAT = 4
FILES = ("state.pt", "config.json")


class CheckpointError(RuntimeError):
    """No checkpoint can be used; the message says which were tried, what is wrong with each and the
    cure.
    """


class Damaged(CheckpointError):
    """One checkpoint is not what its manifest says; an earlier one may be whole."""


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """A checkpoint as loaded: its folder, its step (environment steps so far), and what `save` was
    given.
    """

    path: Path
    step: int
    state: dict[str, Any]
    config: dict[str, Any]


def save(
    folder: Path | str,
    step: int,
    state: dict[str, Any],
    config: dict[str, Any],
    keep: int = 2,
    score: float | None = None,
) -> Path:
    """Writes the checkpoint of a step and deletes older ones: the last `keep` stay, and the one of
    the highest `score`.

    Raises OSError, with nothing changed, when the disk is full or not writable. Returns the
    checkpoint's folder.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    sweep(folder)
    temporary = folder / f"step_{step}.tmp-{os.getpid()}"
    try:
        temporary.mkdir()
        for name, data in _contents(step, state, config, score).items():
            _write(temporary / name, data)
        _sync(temporary)
        last = max((n for s, n in map(_order, checkpoints(folder)) if s == step), default=0)
        place = folder / (f"step_{step}-{last + 1}" if last else f"step_{step}")
        os.replace(temporary, place)
        _sync(folder)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    _read(place)  # older ones go only once this one is known to be whole
    rewind(folder, step)
    _prune(folder, keep, step)
    return place


def load_latest(folder: Path | str, device: torch.device | str = "cpu") -> Checkpoint:
    """The newest whole checkpoint of a `checkpoints` folder, or the checkpoint that `folder` is
    itself.

    A damaged one is named in a warning and the one before it is used; with none left,
    CheckpointError.
    """
    folder = Path(folder)
    if (folder / "manifest.json").exists():
        return _load(folder, device)
    found, wrong = checkpoints(folder), []
    for path in reversed(found):
        try:
            checkpoint = _load(path, device)
        except Damaged as error:
            wrong.append(str(error))
            continue
        for sentence in wrong:
            warnings.warn(f"{sentence}; using {path.name} instead", stacklevel=2)
        return checkpoint
    if wrong:
        raise CheckpointError(f"Every checkpoint in {folder} is damaged: {'; '.join(wrong)}")
    raise CheckpointError(f"There is no checkpoint in {folder}; has the run saved one yet?")


def rewind(folder: Path | str, step: int) -> None:
    """Sets aside the checkpoints of later steps, as `step_<N>.aside`: a run that goes on from
    `step` makes its own. `save` deletes them once it has come as far.
    """
    for path in checkpoints(folder):  # the newest last: it counts until the others are aside
        if step_of(path) > step:
            aside = path.with_name(f"{path.name}.aside")
            _delete(aside)
            os.replace(path, aside)


def checkpoints(folder: Path | str) -> list[Path]:
    """The checkpoint folders in `folder`, oldest first; no unfinished ones, none set aside."""
    found = Path(folder).glob("step_*")
    return sorted((p for p in found if re.fullmatch(r"step_\d+(-\d+)?", p.name)), key=_order)


def step_of(path: Path) -> int:
    """The environment steps before the checkpoint in this folder, by its name."""
    return _order(path)[0]


def _order(path: Path) -> tuple[int, int]:
    """A checkpoint's step, and its number among those of that step."""
    step, n = re.match(r"step_(\d+)(?:-(\d+))?", path.name).groups()
    return int(step), int(n or 1)


def sweep(folder: Path | str) -> None:
    """Deletes what an interrupted `save` of a process that is gone left behind."""
    for path in Path(folder).glob("step_*.tmp-*"):
        owner = path.name.rpartition("-")[2]
        if not (owner.isdigit() and Path("/proc", owner).exists() and int(owner) != os.getpid()):
            shutil.rmtree(path, ignore_errors=True)


# ---- Writing ----


def _contents(step: int, state: dict, config: dict, score: float | None) -> dict[str, bytes]:
    """The files of a checkpoint, by name."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    contents = {"state.pt": buffer.getvalue(), "config.json": json.dumps(config, indent=2).encode()}
    files = {
        name: {"sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data)}
        for name, data in contents.items()
    }
    manifest = dict(format=FORMAT, step=step, score=score, torch=torch.__version__, files=files)
    return {**contents, "manifest.json": _sealed(manifest)}


def _sealed(manifest: dict[str, Any]) -> bytes:
    """The text of a manifest, with a digest of its own."""
    digest = hashlib.sha256(json.dumps(manifest).encode()).hexdigest()
    return json.dumps({**manifest, "sha256": digest}, indent=2).encode()


def _write(path: Path, data: bytes) -> None:
    with open(path, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def _sync(folder: Path) -> None:
    """Forces a folder's entries to the disk; where folders cannot be opened there is nothing to
    force.
    """
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:
        return
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _delete(path: Path) -> None:
    """Deletes a checkpoint; killed meanwhile, it leaves no half of one under its name."""
    leftover = path.with_name(f"{path.name}.tmp-{os.getpid()}")
    try:
        os.replace(path, leftover)
    except OSError:  # it is not there, or has to stay
        return
    shutil.rmtree(leftover, ignore_errors=True)


def _prune(folder: Path, keep: int, step: int) -> None:
    """Deletes all but the last `keep` steps and the best one, of each step all but the last; and
    what was set aside of steps up to `step`.
    """
    found = checkpoints(folder)
    last = list({step_of(path): path for path in found}.values())
    scores = {path: _score(path) for path in last}
    scored = [path for path in last if scores[path] is not None]
    stay = {*last[-keep:], max(scored, key=scores.get, default=None)}
    aside = [path for path in folder.glob("step_*.aside") if step_of(path) <= step]
    for path in [*(path for path in found if path not in stay), *aside]:
        _delete(path)


def _score(path: Path) -> float | None:
    try:
        return _manifest(path)["score"]
    except CheckpointError:
        return None


# ---- Reading ----


def _manifest(path: Path) -> dict[str, Any]:
    """A checkpoint's manifest, which must be what `_sealed` writes to the last byte."""
    try:
        data = (path / "manifest.json").read_bytes()
        manifest = json.loads(data)
        version = manifest["format"]
        body = {key: value for key, value in manifest.items() if key != "sha256"}
        whole = data == _sealed(body)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        version, whole = None, False
    before_digests = version == 1 and "sha256" not in manifest
    if not (whole or before_digests):
        raise Damaged(
            f"Checkpoint {path} is damaged: manifest.json cannot be read, or does not have the "
            "sha256 it gives"
        )
    if version != FORMAT:
        raise CheckpointError(
            f"Checkpoint {path} has format {version} and this megastep reads format {FORMAT}; "
            f"use the megastep that wrote it, with torch {manifest.get('torch')}"
        )
    return manifest


def _read(path: Path) -> tuple[dict[str, bytes], dict[str, Any]]:
    """`{name: bytes}` of a checkpoint and its manifest, each file compared with its sha256."""
    manifest, contents = _manifest(path), {}
    for name in FILES:
        try:
            contents[name] = (path / name).read_bytes()
        except OSError as error:
            raise Damaged(
                f"Checkpoint {path} is damaged: {name} cannot be read ({error.strerror})"
            ) from None
        if hashlib.sha256(contents[name]).hexdigest() != manifest["files"][name]["sha256"]:
            raise Damaged(
                f"Checkpoint {path} is damaged: {name} does not have the sha256 its manifest gives"
            )
    return contents, manifest


def _load(path: Path, device: torch.device | str) -> Checkpoint:
    contents, manifest = _read(path)
    try:
        state = torch.load(io.BytesIO(contents["state.pt"]), map_location=device, weights_only=True)
    except pickle.UnpicklingError:
        raise Damaged(
            f"Checkpoint {path} is refused: state.pt holds more than tensors and numbers, "
            "which could run code of its own"
        ) from None
    except (RuntimeError, EOFError, ValueError) as error:
        raise Damaged(
            f"Checkpoint {path} is damaged: state.pt cannot be read ({str(error).splitlines()[0]})"
        ) from None
    return Checkpoint(path, manifest["step"], state, json.loads(contents["config.json"]))
