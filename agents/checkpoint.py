"""Checkpoints that are whole or absent, and say so when they are damaged.

A checkpoint is a folder `step_<N>` of state.pt (plain dicts of tensors and numbers), config.json
and manifest.json (sizes and sha256 of the two). It is written beside its place, forced to the disk,
renamed into it and read again; so a reader sees all of it or none.
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

import torch

#: Raised by one whenever what is written changes so that an older reader would misread it.
FORMAT = 2
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
    state: dict
    config: dict


def save(folder, step, state, config, keep=2, score=None):
    """Writes `folder/step_<step>` and deletes older ones: the last `keep` stay, and the one of the
    highest `score`.

    Raises OSError, with nothing changed, when the disk is full or not writable. Returns the
    checkpoint's folder.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    sweep(folder)
    place, temporary = folder / f"step_{step}", folder / f"step_{step}.tmp-{os.getpid()}"
    try:
        temporary.mkdir()
        buffer = io.BytesIO()
        torch.save(state, buffer)
        contents = {
            "state.pt": buffer.getvalue(),
            "config.json": json.dumps(config, indent=2).encode(),
        }
        manifest = {
            "format": FORMAT,
            "step": step,
            "score": score,
            "torch": torch.__version__,
            "files": {
                name: {"sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data)}
                for name, data in contents.items()
            },
        }
        for name, data in [
            *contents.items(),
            ("manifest.json", json.dumps(manifest, indent=2).encode()),
        ]:
            _write(temporary / name, data)
        _sync(temporary)
        if place.exists():
            shutil.rmtree(place)  # the same step again, after a resume
        os.replace(temporary, place)
        _sync(folder)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    _read(place)  # older ones go only once this one is known to be whole
    _prune(folder, keep)
    return place


def load(folder, device="cpu"):
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


def checkpoints(folder):
    """The checkpoint folders in `folder`, oldest first; unfinished ones are not among them."""
    found = [p for p in Path(folder).glob("step_*") if re.fullmatch(r"step_\d+", p.name)]
    return sorted(found, key=lambda p: int(p.name[5:]))


def sweep(folder):
    """Deletes what an interrupted `save` of a process that is gone left behind."""
    for path in Path(folder).glob("step_*.tmp-*"):
        owner = path.name.rpartition("-")[2]
        if not (owner.isdigit() and Path("/proc", owner).exists() and int(owner) != os.getpid()):
            shutil.rmtree(path, ignore_errors=True)


def _write(path, data):
    with open(path, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def _sync(folder):
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


def _read(path):
    """`{name: bytes}` of a checkpoint and its manifest, each file compared with its sha256."""
    try:
        manifest = json.loads((path / "manifest.json").read_bytes())
        version, entries = (
            manifest["format"],
            {name: manifest["files"][name]["sha256"] for name in FILES},
        )
    except (OSError, ValueError, KeyError, TypeError):
        raise Damaged(f"Checkpoint {path} is damaged: manifest.json cannot be read") from None
    if version != FORMAT:
        raise CheckpointError(
            f"Checkpoint {path} has format {version} and this megastep reads format {FORMAT}; "
            f"use the megastep that wrote it, with torch {manifest.get('torch')}"
        )
    contents = {}
    for name, digest in entries.items():
        try:
            contents[name] = (path / name).read_bytes()
        except OSError as error:
            raise Damaged(
                f"Checkpoint {path} is damaged: {name} cannot be read ({error.strerror})"
            ) from None
        if hashlib.sha256(contents[name]).hexdigest() != digest:
            raise Damaged(
                f"Checkpoint {path} is damaged: {name} does not have the sha256 its manifest gives"
            )
    return contents, manifest


def _load(path, device):
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


def _prune(folder, keep):
    found = checkpoints(folder)
    scores = {}
    for path in found:
        try:
            scores[path] = json.loads((path / "manifest.json").read_bytes())["score"]
        except (OSError, ValueError, KeyError):
            scores[path] = None
    scored = [p for p in found if scores[p] is not None]
    best = max(scored, key=scores.get, default=None)
    for path in found[:-keep]:
        if path != best:
            shutil.rmtree(path, ignore_errors=True)
