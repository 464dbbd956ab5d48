"""Episodes as arrays by name, and the npz files that hold one each. T steps, T + 1 rows.

Row t has the observation at time t, and the action, reward and flags that led there, as in Memory
Maze's offline set (Pasukonis et al. 2022). Row 0 of these is zeros.
"""

import errno
import functools
import io
import os
import struct
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from megastep import spaces
from megastep.arrdict import arrdict
from megastep.atomic_files import delete
from megastep.colour import gamma_decode, gamma_encode

#: What Memory Maze's offline set calls observations of ours; all others keep their names.
NAMES = {"rgb": "image", "cue": "target_color"}
OUTCOMES = "reward", "terminal", "truncated"
#: Names of what is no observation, or of linear light alone.
RESERVED = "action", "mask", "image", *OUTCOMES
#: Names of floor plans, which all rows of an episode share.
PLANS = "maze_layout", "maze_frame", "walls"
Arrays = dict[str, np.ndarray]


@functools.cache
def _to_srgb(device: torch.device) -> torch.Tensor:
    """Returns the 8-bit sRGB value of each float16 of linear light, by its bits."""
    light = np.arange(2**16, dtype=np.uint16).view(np.float16).astype(np.float64)
    light = np.nan_to_num(light, nan=0.0).clip(0, 1)
    return torch.from_numpy(np.round(255 * gamma_encode(light)).astype(np.uint8)).to(device)


@functools.cache
def _to_linear(device: torch.device) -> torch.Tensor:
    """Returns the linear light of each 8-bit sRGB value, float16."""
    return torch.from_numpy(gamma_decode(np.arange(256) / 255).astype(np.float16)).to(device)


class Codec:
    """Turns observations and actions of some spaces into arrays of files, and back.

    Images in linear light are stored as `image` (T + 1, H, W, 3), 8-bit sRGB, which is read back
    within 0.3 % of full light; all others to the bit. An axis of one agent is left out.

    Args:
        texts: the spaces of a dataset, as `{'obs.rgb': 'MultiImage(...)', 'actions': ...}`.
    """

    def __init__(self, texts: Mapping[str, str]):
        self.spaces: dict[str, Any] = {path: spaces.from_text(one) for path, one in texts.items()}
        self.names = {path: self._name(path) for path in self.spaces}
        taken = [*self.names.values()]
        if clash := [name for name in taken if taken.count(name) > 1]:
            raise ValueError(f"two observations or actions would both be called {clash[0]}")

    def _name(self, path) -> str:
        kind, _, rest = path.partition(".")
        if kind == "actions":
            return "action" + (rest and f".{rest}")
        known = NAMES.get(rest)
        if known and not (known == "image" and not self._is_image(path)):
            return known
        return f"obs.{rest}" if rest in RESERVED or rest in PLANS else rest or "obs"

    def _is_image(self, path) -> bool:
        space = self.spaces[path]
        is_light = isinstance(space, spaces.MultiImage) and space.dtype in (None, torch.float16)
        return is_light and space.C == 3 and space.n_agents == 1

    def encode(self, path: str, leaf: torch.Tensor) -> torch.Tensor:
        """Returns rows (..., *space.shape) as they are stored; integer actions one-hot, uint8."""
        space = self.spaces[path]
        n_axes = len(space.shape)
        if path.startswith("actions") and isinstance(space, spaces.MultiDiscrete):
            leaf = torch.nn.functional.one_hot(leaf.long(), space.n_actions).to(torch.uint8)
            n_axes += 1
        elif self.names[path] == "image":
            codes = leaf.contiguous().view(torch.int16).int() & 0xFFFF
            leaf = _to_srgb(leaf.device)[codes].movedim(-3, -1)
        return leaf.squeeze(-n_axes) if space.n_agents == 1 else leaf

    def decode(self, path: str, leaf: torch.Tensor, n_axes: int = 1) -> torch.Tensor:
        """The inverse of `encode`, of rows with `n_axes` axes; of an all-zero action, action 0."""
        space = self.spaces[path]
        if space.n_agents == 1:
            leaf = leaf.unsqueeze(n_axes)
        if path.startswith("actions") and isinstance(space, spaces.MultiDiscrete):
            return leaf.argmax(-1)
        if self.names[path] == "image":
            return _to_linear(leaf.device)[leaf.long()].movedim(-1, -3)
        return leaf

    def decoded(self, arrays: Mapping[str, np.ndarray]) -> arrdict:
        """Returns an episode as tensors.

        - obs: (T + 1, ...) per leaf of the observation space
        - actions: (T, ...) per leaf of the action space
        - reward: (T,) float32; terminal, truncated: (T,) bool
        - the rest, such as `mask` and `agent_pos`: as stored, (T + 1, ...), or a floor plan
        """
        # files of 0.3.0 have `obs.` for `obs`
        left = {name.rstrip("."): torch.from_numpy(array) for name, array in arrays.items()}
        leaves = {path: self.decode(path, left.pop(name)) for path, name in self.names.items()}
        leaves = {k: leaf[1:] if k.startswith("actions") else leaf for k, leaf in leaves.items()}
        outcomes = {name: left.pop(name)[1:] for name in OUTCOMES}
        return arrdict(spaces.nested(leaves), **outcomes, **left)


# ---- Files ----
# Episodes are short and many: the package zipfile takes four times as long to write one, and numpy
# six times as long to read one.

_LOCAL, _CENTRAL, _END = "<4s5H3L2H", "<4s6H3L5H2L", "<4s4H2LH"
_DATE = 0x21  # 1980-01-01, and not the time of now


@functools.cache
def _header(dtype, shape) -> bytes:
    file = io.BytesIO()
    fields = dict(descr=np.lib.format.dtype_to_descr(dtype), fortran_order=False, shape=shape)
    np.lib.format.write_array_header_1_0(file, fields)
    return file.getvalue()


@functools.cache
def _parsed(header) -> tuple[tuple[int, ...], np.dtype]:
    file = io.BytesIO(header)
    np.lib.format.read_magic(file)
    shape, _, dtype = np.lib.format.read_array_header_1_0(file)
    return shape, dtype


@functools.lru_cache(4096)
def _packed(dtype, shape, row, n_rows) -> tuple[int, int, bytes]:
    """Returns checksum, size and deflated bytes of an array that repeats the bytes of a row."""
    body, packer = _header(dtype, shape) + n_rows * row, zlib.compressobj(1, zlib.DEFLATED, -15)
    return zlib.crc32(body), len(body), packer.compress(body) + packer.flush()


def write(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Writes an npz file, whole or not at all. Equal arrays give equal bytes. Floor plans are
    compressed. OSError if it cannot be written.
    """
    parts, central, offset = [], [], 0
    for key, array in arrays.items():
        name, method = f"{key}.npy".encode(), 0
        if key in PLANS:
            rows = array if array.strides[0] else array[:1]
            about = array.dtype, array.shape, rows.tobytes(), len(array) // len(rows)
            (crc, size, *body), method = _packed(*about), zipfile.ZIP_DEFLATED
        else:
            array = np.ascontiguousarray(array)
            body = [_header(array.dtype, array.shape), array.reshape(-1).view(np.uint8).data]
            crc, size = zlib.crc32(body[1], zlib.crc32(body[0])), sum(map(len, body))
        n_bytes = sum(map(len, body))
        about = 20, 0, method, 0, _DATE, crc, n_bytes, size, len(name), 0
        local = struct.pack(_LOCAL, b"PK\3\4", *about) + name
        attributes = 0, 0, 0, 0o600 << 16, offset
        central.append(struct.pack(_CENTRAL, b"PK\1\2", 3 << 8 | 20, *about, *attributes) + name)
        parts += [local, *body]
        offset += len(local) + n_bytes
    directory, n = b"".join(central), len(central)
    parts += [directory, struct.pack(_END, b"PK\5\6", 0, 0, n, n, len(directory), offset, 0)]
    temporary = f"{path}.tmp"
    try:
        with open(temporary, "wb", buffering=0) as file:
            # at once, as threads wait for one another between calls
            if os.writev(file.fileno(), parts) < sum(map(len, parts)):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        os.replace(temporary, path)
    except BaseException:
        delete(Path(temporary))
        raise


def read(path: Path) -> Arrays:
    """Returns the arrays of a file of `write`. OSError, or ValueError if it is damaged."""
    data, arrays, start = bytearray(path.read_bytes()), {}, 0  # whose arrays can be written to
    try:
        while (local := struct.unpack_from(_LOCAL, data, start))[0] == b"PK\3\4":
            method, crc, n_bytes, _, n_name = *local[3:4], *local[6:10]
            body = start + struct.calcsize(_LOCAL) + n_name
            name, start = data[body - n_name : body].decode(), body + n_bytes
            content = memoryview(data)[body:start]
            if method:
                content = memoryview(bytearray(zlib.decompress(content, -15)))
            if zlib.crc32(content) != crc:
                raise ValueError(f"{name} has other bytes than were written")
            length = 10 + int.from_bytes(content[8:10], "little")
            shape, dtype = _parsed(bytes(content[:length]))
            array = np.frombuffer(content, dtype, offset=length).reshape(shape)
            arrays[name.removesuffix(".npy")] = array
        end = struct.unpack_from(_END, data, len(data) - struct.calcsize(_END))
        if not arrays or end[0] != b"PK\5\6" or end[4] != len(arrays):
            raise ValueError("it has no end")
    except (ValueError, struct.error, zlib.error) as error:
        raise ValueError(f"{path} is damaged: {error}") from None
    return arrays


def with_plan(arrays: Arrays, home: Mapping[str, Any]) -> Arrays:
    """Returns an episode with its floor plan: `walls` (M, 2, 2), metres. In mazes of cells also
    `maze_layout` (T + 1, n, n), 1 where there is floor; places are in cells there, as those of
    Memory Maze, and not in metres: (0, 0) is the corner of the first cell. `maze_frame` (3,) has
    the corner's x and y and the side of a cell, in metres.
    """
    arrays = {**arrays, "walls": home["walls"]}
    if "floor" not in home:
        return arrays
    for name, array in arrays.items():
        if name.endswith("_pos"):
            arrays[name] = ((array - home["corner"]) / home["cell"]).astype(np.float32)
        elif name.endswith("_vec"):
            arrays[name] = (array / home["cell"]).astype(np.float32)
    rows, floor = len(arrays["reward"]), home["floor"].astype(np.uint8)
    frame = np.array([home["corner"], home["corner"], home["cell"]], np.float32)
    layout = np.broadcast_to(floor, (rows, *floor.shape))
    return arrays | {"maze_layout": layout, "maze_frame": frame}
