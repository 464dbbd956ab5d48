"""The format of one checkpoint: a folder of `state.pt`, `config.json` and `manifest.json`.

`state.pt` holds plain dicts of tensors and numbers. The manifest has the size and SHA-256 of the
other two files, and a SHA-256 of itself, so any damaged byte is detected. It repeats the numbers at
the top of the state, such as samples and seconds. All but `state.pt` is read without PyTorch.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import os
import pickle
from pathlib import Path
from typing import TYPE_CHECKING, Any

from megastep.agents.training import trust
from megastep.agents.training.atomic_files import write_synced

if TYPE_CHECKING:
    import torch

#: The format number. Increase it whenever older readers would misread a new checkpoint, or newer
#: readers an old one, and add the last commit of the old format to `READERS`.
FORMAT = 6
#: Commits of megastep that read the older formats.
READERS = {1: "e17fabe", 2: "6f4fbf1", 3: "3ffd1d5", 4: "e9908db", 5: "916221d"}
FILES = ("state.pt", "config.json")


class CheckpointError(RuntimeError):
    """No checkpoint can be used. The message names each one tried, its problem, and the cure."""


class DamagedCheckpoint(CheckpointError):
    """A checkpoint does not match its manifest. An earlier checkpoint may be intact."""


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """A loaded checkpoint.

    Attributes:
        path: its folder.
        step: environment steps of all lanes before it was saved.
        numbers: the numbers at the top of the state.
        config: the run's configuration, as saved.
        state: dicts of tensors and numbers, as saved; None if it was not loaded.
        untrusted: import paths outside megastep that it names, if this user did not make it.
    """

    path: Path
    step: int
    numbers: dict[str, float]
    config: dict[str, Any]
    state: dict[str, Any] | None = None
    untrusted: tuple[str, ...] = ()


# ---- Writing ----


def write(
    path: Path, step: int, state: dict[str, Any], config: dict[str, Any], score: float | None
) -> None:
    """Writes a checkpoint into a new folder and flushes it to disk."""
    import torch

    path.mkdir()
    buffer = io.BytesIO()
    torch.save(state, buffer)
    contents = {"state.pt": buffer.getvalue(), "config.json": json.dumps(config, indent=2).encode()}
    files = {
        name: {"sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data)}
        for name, data in contents.items()
    }
    numbers = {key: value for key, value in state.items() if isinstance(value, (int, float))}
    manifest = dict(format=FORMAT, step=step, score=score, numbers=numbers)
    manifest |= dict(torch=torch.__version__, files=files)
    manifest["signature"] = trust.sign(contents["config.json"])
    for name, data in {**contents, "manifest.json": sealed(manifest)}.items():
        write_synced(path / name, data)
    sync_folder(path)


def sealed(manifest: dict[str, Any]) -> bytes:
    """Returns the text of a manifest, with its own SHA-256 added."""
    digest = hashlib.sha256(json.dumps(manifest).encode()).hexdigest()
    return json.dumps({**manifest, "sha256": digest}, indent=2).encode()


def sync_folder(folder: Path) -> None:
    """Flushes a folder's entries to disk. Does nothing on systems that cannot open folders."""
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:
        return
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


# ---- Reading ----


def read(path: Path, device: torch.device | str | None) -> Checkpoint:
    """Loads a checkpoint onto a device, or, if that is None, all but its state.

    Raises:
        DamagedCheckpoint: a file is missing or damaged, or could run code when loaded.
        CheckpointError: another version of megastep wrote it.
    """
    contents, manifest = read_files(path)
    try:
        config = json.loads(contents["config.json"])
    except (ValueError, RecursionError):
        raise DamagedCheckpoint(f"Checkpoint {path} is damaged: config.json is no JSON") from None
    untrusted = trust.untrusted_names(contents["config.json"], manifest.get("signature"))
    numbers = manifest["numbers"]
    checkpoint = Checkpoint(path, manifest["step"], numbers, config, untrusted=tuple(untrusted))
    if device is None:
        return checkpoint
    import torch

    try:
        state = torch.load(io.BytesIO(contents["state.pt"]), map_location=device, weights_only=True)
    except pickle.UnpicklingError:
        raise DamagedCheckpoint(
            f"Checkpoint {path} is refused: state.pt holds more than tensors and numbers, so "
            "loading it could run code"
        ) from None
    except (RuntimeError, EOFError, ValueError) as error:
        raise DamagedCheckpoint(
            f"Checkpoint {path} is damaged: state.pt cannot be read ({str(error).splitlines()[0]})"
        ) from None
    return dataclasses.replace(checkpoint, state=state)


def read_files(path: Path) -> tuple[dict[str, bytes], dict[str, Any]]:
    """Returns a checkpoint's files by name, and its manifest. Verifies every SHA-256.

    Raises: as `read`.
    """
    manifest, contents = read_manifest(path), {}
    for name in FILES:
        try:
            contents[name] = (path / name).read_bytes()
        except OSError as error:
            raise DamagedCheckpoint(
                f"Checkpoint {path} is damaged: {name} cannot be read ({error.strerror})"
            ) from None
        if hashlib.sha256(contents[name]).hexdigest() != manifest["files"][name]["sha256"]:
            raise DamagedCheckpoint(
                f"Checkpoint {path} is damaged: {name} does not match the SHA-256 in its manifest"
            )
    return contents, manifest


def read_manifest(path: Path) -> dict[str, Any]:
    """Returns a checkpoint's manifest, which must equal what `sealed` writes to the last byte.

    Raises: as `read`.
    """
    try:
        data = (path / "manifest.json").read_bytes()
        manifest = json.loads(data)
        version = manifest["format"]
        body = {key: value for key, value in manifest.items() if key != "sha256"}
        is_intact = data == sealed(body)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        version, is_intact = None, False
    is_without_digest = version == 1 and "sha256" not in manifest
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
    if version != FORMAT:
        raise CheckpointError(
            f"Checkpoint {path} has format {version}, which is unknown: this version reads format "
            f"{FORMAT}. Update megastep"
        )
    return manifest
