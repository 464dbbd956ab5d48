"""Agent files: a trained agent in one file, with its environment's and policy's configuration.

The format is safetensors (https://github.com/huggingface/safetensors). The metadata in its header
maps names to strings:

    format    version of this metadata, `FORMAT`
    config    config.json of a checkpoint
    facts     how the agent was trained, such as samples, seconds, command and commit; JSON
    tables    its evaluations: a list of {title, command, rows}; JSON
    wrappers  what wrappers around its environment have learnt, if anything; JSON
    sha256    hash of the whole file, with zeros in place of these 64 digits

Weights are float16, statistics float32. Without a device, reading does not import PyTorch.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import safetensors

from megastep.agents.errors import shortened
from megastep.agents.runs import typed_json
from megastep.agents.runs.checkpoint import Checkpoint, CheckpointError
from megastep.atomic_files import write_atomically

if TYPE_CHECKING:
    import torch

    from megastep.agents.types import Config, Row

FORMAT, SUFFIX = "2", ".safetensors"
#: The kinds of the texts in the header.
KINDS = {
    "config": typed_json.Config,
    "facts": typed_json.Facts,
    "tables": list[typed_json.Table],
    "wrappers": None,
}
#: The digest in a header. Texts in the header have their quotes escaped.
_SEAL = re.compile(rb'"sha256":"([0-9a-f]{64})"')


def write(
    path: Path,
    tensors: Mapping[str, torch.Tensor],
    config: Config,
    facts: Mapping[str, object],
    tables: Sequence[Row] = (),
    wrappers: Mapping[str, object] | None = None,
) -> None:
    """Writes an agent file: the policy's state in the dtypes to store, and what the head says."""
    from safetensors.torch import save

    texts: dict = dict(config=config, facts=dict(facts), tables=[*tables])
    if wrappers:
        texts["wrappers"] = {
            path: getattr(value, "tolist", lambda value=value: value)()
            for path, value in wrappers.items()
        }
    metadata = {name: typed_json.dumps(value) for name, value in texts.items()}
    metadata |= {"format": FORMAT, "sha256": "0" * 64}
    tensors = {name: tensor.detach().contiguous() for name, tensor in tensors.items()}
    write_atomically(path, sealed(save(tensors, metadata)))


def sealed(content: bytes) -> bytes:
    """Returns a file's bytes with the SHA-256 in its header recomputed."""
    header_end = 8 + int.from_bytes(content[:8], "little")
    if not (match := _SEAL.search(content, 0, header_end)):
        raise ValueError("its header has no SHA-256")
    start, end = match.span(1)
    digest = hashlib.sha256(content[:start] + b"0" * 64 + content[end:]).hexdigest()
    return content[:start] + digest.encode() + content[end:]


def read(path: Path, device: torch.device | str | None) -> Checkpoint:
    """Loads an agent file as a checkpoint that has only the policy's state, on a device; without
    one no state. Raises CheckpointError if it is damaged or of another version.
    """
    try:
        with safetensors.safe_open(path, framework="np") as file:
            texts = {"wrappers": "{}", **(file.metadata() or {})}
        if (version := texts.get("format")) != FORMAT:
            raise CheckpointError(
                f"{path} has format {shortened(repr(version), 20)}, and this version of megastep "
                f"reads {FORMAT}; export the agent again"
            )
        if (content := path.read_bytes()) != sealed(content):
            raise ValueError("its bytes do not match their SHA-256")
        about = {name: typed_json.loads(texts[name], kind) for name, kind in KINDS.items()}
    except OSError as error:
        raise CheckpointError(f"{path} cannot be read ({shortened(error)})") from None
    except (safetensors.SafetensorError, ValueError, KeyError) as error:
        raise CheckpointError(
            f"{path} is damaged or not an agent file of megastep: {shortened(error)}"
        ) from None
    state = None
    if device is not None:
        from safetensors.torch import load_file

        state = {"policy": load_file(path, str(device)), "wrappers": about["wrappers"]}
    return Checkpoint(path, about["facts"]["samples"], {}, about["config"], {}, state, about=about)
