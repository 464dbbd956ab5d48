"""An agent in one file: its acting weights, and what rebuilds its environment and policy.

The format is safetensors (https://github.com/huggingface/safetensors): eight bytes with the length
of a JSON header, the header, and the bytes of all tensors. The header's `__metadata__`, texts by
name, holds

    format    of what follows, `FORMAT`
    config    as config.json of a checkpoint, JSON
    facts     what made the agent, such as samples, seconds, command and commit, JSON
    tables    its evaluations: a list of {title, command, rows}, JSON
    sha256    of the bytes of all tensors

Weights are float16, statistics float32. The header is read without PyTorch.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from megastep.agents.runs import trust
from megastep.agents.runs.atomic_files import write_atomically
from megastep.agents.runs.checkpoint_format import Checkpoint, CheckpointError, DamagedCheckpoint

if TYPE_CHECKING:
    import torch

SUFFIX = ".safetensors"
FORMAT = "1"
#: Names of PyTorch's dtypes, and their bytes, by safetensors' names.
DTYPES = {"F16": ("float16", 2), "F32": ("float32", 4), "F64": ("float64", 8), "I64": ("int64", 8)}
_MAX_HEADER = 2**24  # bytes


def is_agent_file(path: Path) -> bool:
    """Returns True if a path names the file of an agent."""
    return path.suffix == SUFFIX


def write(
    path: Path,
    tensors: Mapping[str, torch.Tensor],
    config: dict[str, Any],
    facts: Mapping[str, Any],
    tables: Sequence[dict[str, Any]] = (),
) -> None:
    """Writes the file of an agent, whole or not at all.

    Args:
        tensors: the policy's state, of the dtypes that the file shall have; on the CPU.
        config: as a checkpoint's.
        facts: plain values by name; `samples` is among them.
        tables: its evaluations.

    Raises:
        ValueError: a tensor has another dtype than those of `DTYPES`.
        OSError: the file cannot be written.
    """
    names = {dtype: name for name, (dtype, _) in DTYPES.items()}
    header, parts, end = {}, [], 0
    # the widest first, so that each tensor begins at a multiple of its element's size
    for name, tensor in sorted(tensors.items(), key=lambda item: (-item[1].itemsize, item[0])):
        dtype = str(tensor.dtype).removeprefix("torch.")
        if dtype not in names:
            raise ValueError(f"{name} is {dtype}, and files of agents hold {', '.join(names)}")
        parts.append(tensor.detach().contiguous().numpy().tobytes())
        start, end = end, end + len(parts[-1])
        entry = {"dtype": names[dtype], "shape": [*tensor.shape], "data_offsets": [start, end]}
        header[name] = entry
    data = b"".join(parts)
    metadata = {"format": FORMAT, "sha256": hashlib.sha256(data).hexdigest()}
    for name, value in (("config", config), ("facts", dict(facts)), ("tables", [*tables])):
        metadata[name] = json.dumps(value)
    text = json.dumps({"__metadata__": metadata, **header}).encode()
    text += b" " * (-len(text) % 8)
    write_atomically(path, len(text).to_bytes(8, "little") + text + data)


def read(path: Path, device: torch.device | str | None) -> Checkpoint:
    """Loads an agent as a checkpoint with the policy's state alone.

    Args:
        device: where the tensors go; None leaves out the state, and does not import PyTorch.

    Raises:
        DamagedCheckpoint: the file is damaged, or no agent's.
        CheckpointError: a later version of megastep wrote it.
    """
    header, metadata, data = _read(path)
    return Checkpoint(
        path,
        step=metadata["facts"]["samples"],
        numbers={},
        config=metadata["config"],
        made_with={},
        state=None if device is None else {"policy": _tensors(header, data, device)},
        untrusted=metadata["untrusted"],
    )


def read_metadata(path: Path) -> dict[str, Any]:
    """Returns `config`, `facts` and `tables` of the file of an agent, and `untrusted`, the import
    paths outside megastep in its configuration.

    Raises: as `read`.
    """
    return _read(path)[1]


def _read(path):
    """Returns the entries of the header, what `read_metadata` returns, and the tensors' bytes."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DamagedCheckpoint(f"{path} cannot be read ({error.strerror})") from None
    try:
        n = int.from_bytes(content[:8], "little")
        if not 0 < n <= min(_MAX_HEADER, len(content) - 8):
            raise ValueError("it has no header of safetensors")
        header, data = json.loads(content[8 : 8 + n]), memoryview(content)[8 + n :]
        texts = header.pop("__metadata__")
        version = texts["format"]
        if version == FORMAT:
            if hashlib.sha256(data).hexdigest() != texts["sha256"]:
                raise ValueError("its tensors do not match their SHA-256")
            _check(header, len(data))
            metadata = {name: json.loads(texts[name]) for name in ("config", "facts", "tables")}
            if type(metadata["facts"]["samples"]) is not int:
                raise ValueError("its number of samples is none")
            if not {"train", "spaces"} <= metadata["config"].keys():
                raise ValueError("its configuration is not whole")
            config = texts["config"].encode(errors="surrogatepass")
            metadata["untrusted"] = tuple(trust.foreign_names(config))
            return header, metadata, data
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        problem = str(error) if type(error) is ValueError else "its header is not an agent's"
        raise DamagedCheckpoint(f"{path} is damaged, or no agent of megastep: {problem}") from None
    raise CheckpointError(
        f"{path} has format {version!r}, and this version of megastep reads {FORMAT}. Update "
        "megastep"
    )


def _check(header, n_bytes):
    """Raises ValueError, KeyError or TypeError unless tensors fill the bytes without gaps."""
    end = 0
    for entry in sorted(header.values(), key=lambda entry: entry["data_offsets"]):
        start, stop = entry["data_offsets"]
        sizes = [*entry["shape"], DTYPES[entry["dtype"]][1]]
        if any(type(n) is not int or n < 0 for n in sizes):
            raise ValueError("the shape of a tensor is none")
        if start != end or stop - start != math.prod(sizes):
            raise ValueError("its tensors have gaps or overlap")
        end = stop
    if end != n_bytes:
        raise ValueError("it is cut off, or too long")


def _tensors(header, data, device):
    import torch

    content, tensors = bytearray(data), {}
    for name, entry in header.items():
        dtype = getattr(torch, DTYPES[entry["dtype"]][0])
        start, stop = entry["data_offsets"]
        tensor = torch.empty(0, dtype=dtype)
        if stop > start:
            n = (stop - start) // dtype.itemsize
            tensor = torch.frombuffer(content, dtype=dtype, count=n, offset=start).clone()
        tensors[name] = tensor.reshape(entry["shape"]).to(device)
    return tensors
