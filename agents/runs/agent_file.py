"""Agent files: a trained agent in one file, with its environment's and policy's configuration.

The format is safetensors (https://github.com/huggingface/safetensors). The metadata in its header
maps names to strings:

    format    version of this metadata, `FORMAT`
    config    config.json of a checkpoint
    facts     how the agent was trained, such as samples, seconds, command and commit; JSON
    tables    its evaluations: a list of {title, command, rows}; JSON
    wrappers  what wrappers around its environment have learnt, if anything; JSON
    sha256    hash of the whole file, with zeros in place of these 64 digits

Weights are float16, statistics float32. Without a device, reading does not import PyTorch. In files
of format 1, `sha256` is the hash of all bytes after the header, those of the tensors.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import safetensors

from megastep.agents.errors import shortened
from megastep.agents.runs import formats, strange_files, trust, typed_json
from megastep.agents.runs.atomic_files import write_atomically
from megastep.agents.runs.checkpoint_format import Checkpoint, CheckpointError, DamagedCheckpoint

if TYPE_CHECKING:
    import numpy as np
    import torch

    from megastep.agents.types import Config, Row

SUFFIX = ".safetensors"
FORMAT, FIRST_FORMAT = "2", "1"
#: NumPy's name of each dtype by safetensors' name.
DTYPES = {"F16": "float16", "F32": "float32", "F64": "float64", "I64": "int64"}
_MAX_HEADER, _MAX_BYTES = 2**24, 2**31
#: The digest in a header. Texts in the header have their quotes escaped.
_SEAL = re.compile(rb'"sha256":"([0-9a-f]{64})"')


def is_agent_file(path: Path) -> bool:
    """Returns True if a path has the suffix of agent files."""
    return path.suffix == SUFFIX


def write(
    path: Path,
    tensors: Mapping[str, torch.Tensor],
    config: Config,
    facts: Mapping[str, object],
    tables: Sequence[Row] = (),
    wrappers: Mapping[str, object] | None = None,
) -> None:
    """Writes an agent file atomically.

    Args:
        path: the file.
        tensors: the policy's state, on the CPU, in the dtypes to store.
        config: configuration as in a checkpoint.
        facts: plain values by name, among them `samples`.
        tables: evaluations.
        wrappers: of the environment, what they have learnt, by path: tensors and numbers.

    Raises:
        ValueError: a dtype is not in `DTYPES`.
        OSError: the file cannot be written.
    """
    from safetensors.numpy import save

    arrays = {name: tensor.detach().contiguous().numpy() for name, tensor in tensors.items()}
    for name, array in arrays.items():
        if array.dtype.name not in DTYPES.values():
            allowed = ", ".join(DTYPES.values())
            raise ValueError(f"{name} is {array.dtype}, but agent files hold {allowed}")
    metadata = {"format": FORMAT, "sha256": "0" * 64}
    texts = dict(config=config, facts=dict(facts), tables=[*tables])
    if wrappers:
        texts["wrappers"] = {
            path: getattr(value, "tolist", lambda value=value: value)()
            for path, value in wrappers.items()
        }
    metadata |= {name: typed_json.dumps(value) for name, value in texts.items()}
    write_atomically(path, sealed(save(arrays, metadata)))


def sealed(content: bytes) -> bytes:
    """Returns a file's bytes with the SHA-256 in its header recomputed."""
    match = _SEAL.search(content)
    assert match is not None
    start, end = match.span(1)
    digest = hashlib.sha256(content[:start] + b"0" * 64 + content[end:]).hexdigest()
    return content[:start] + digest.encode() + content[end:]


def _split(content) -> tuple[bytes, bytes]:
    """Returns the header of a file and the bytes of its tensors."""
    end = 8 + int.from_bytes(content[:8], "little")
    return content[8:end], content[end:]


def read(path: Path, device: torch.device | str | None) -> Checkpoint:
    """Loads an agent file as a checkpoint that has only the policy's state.

    Args:
        path: the file.
        device: device of the tensors; None loads no state and does not import PyTorch.

    Raises:
        DamagedCheckpoint: the file is damaged or not an agent file.
        CheckpointError: a later version of megastep wrote it.
    """
    metadata, entries = _read(path)
    return Checkpoint(
        path,
        step=metadata["facts"]["samples"],
        numbers={},
        config=metadata["config"],
        made_with={},
        state=None
        if device is None
        else {"policy": _tensors(entries, device), "wrappers": metadata["wrappers"]},
        untrusted=metadata["untrusted"],
    )


def read_metadata(path: Path) -> Row:
    """Returns `config`, `facts`, `tables` and `wrappers` of an agent file, and `untrusted`: the
    import paths outside megastep in its configuration.

    Raises:
        CheckpointError: as `read`.
    """
    return _read(path)[0]


def _read(path) -> tuple[Row, Row]:
    """Returns the result of `read_metadata`, and dtype, shape and bytes of each tensor by name."""
    try:
        # the given path may be a link, as in caches of downloaded files
        content = strange_files.read_bytes(path.resolve(), _MAX_BYTES)
    except OSError as error:
        raise DamagedCheckpoint(f"{path} cannot be read ({error.strerror})") from None
    import numpy as np  # not for commands that only look for a run

    header, data = _split(content)
    try:
        if len(header) > _MAX_HEADER:
            raise ValueError("its header is too long")
        entries = dict(sorted(safetensors.deserialize(content)))
        texts = json.loads(header)["__metadata__"]
        version = texts["format"]
        if version in (FORMAT, FIRST_FORMAT):
            if not _is_intact(content, data, texts):
                raise ValueError("its bytes do not match their SHA-256")
            if any(entry["dtype"] not in DTYPES for entry in entries.values()):
                raise ValueError(f"its tensors are not all of {', '.join(DTYPES)}")
            texts = {"wrappers": "{}", **texts}
            names = "config", "facts", "tables", "wrappers"
            metadata = {name: typed_json.loads(texts[name]) for name in names}
            formats.check(formats.Facts, metadata["facts"])
            formats.check(formats.Tables, metadata["tables"])
            if not {"train", "spaces"} <= metadata["config"].keys():
                raise ValueError("incomplete configuration")
            for name, array in _arrays(entries):
                if array.dtype.kind == "f" and not np.isfinite(array).all():
                    raise ValueError(f"{shortened(name, 60)} has a NaN or an infinity")
            metadata["untrusted"] = tuple(trust.foreign_names(texts["config"].encode()))
            return metadata, entries
    except safetensors.SafetensorError as error:
        problem = shortened(error)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        problem = str(error) if type(error) is ValueError else "unexpected header"
    else:
        raise CheckpointError(
            f"{path} has format {version!r}, and this version of megastep reads {FORMAT}. Update "
            "megastep"
        )
    raise DamagedCheckpoint(f"{path} is damaged or not an agent file of megastep: {problem}")


def _is_intact(content, data, texts) -> object:
    if texts["format"] == FIRST_FORMAT:
        return hashlib.sha256(data).hexdigest() == texts["sha256"]
    return _SEAL.search(content, 0, len(content) - len(data)) and sealed(content) == content


def _arrays(entries) -> Iterator[tuple[str, np.ndarray]]:
    """Yields (name, array) of tensors."""
    import numpy as np

    for name, entry in entries.items():
        yield name, np.frombuffer(entry["data"], DTYPES[entry["dtype"]]).reshape(entry["shape"])


def _tensors(entries, device) -> dict:
    import torch

    return {name: torch.tensor(array, device=device) for name, array in _arrays(entries)}
