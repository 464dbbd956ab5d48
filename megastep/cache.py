"""A private cache on disk for built kernels and other results that are expensive to compute.

The folder is ``$MEGASTEP_CACHE``, else ``$XDG_CACHE_HOME/megastep``, else ``~/.cache/megastep``.
Libraries loaded from it run with the user's rights, so nothing is read that another user could have
written. Each file ends in a SHA-256 of its name and content: a damaged or renamed one is built
again. If the cache cannot be used, there is one warning, and everything is built at each start.
"""

import contextlib
import hashlib
import io
import math
import os
import stat
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from megastep.atomic_files import write_atomically

if TYPE_CHECKING:
    import numpy as np

DIGEST = 32  # bytes


def fetch(name: str, build: Callable[[], bytes]) -> tuple[bytes, Path | None]:
    """Returns a file's content, made by ``build`` if need be, and its path, None if uncached."""
    path = _folder() / name
    if problem := _problem(path.parent):
        warn(problem)
        return build(), None
    if (body := intact(path)) is not None:
        return body, path
    if path.exists():
        warnings.warn(
            f"{path} is damaged or not owned by this user: it is built again", stacklevel=2
        )
    body = build()
    try:
        write_atomically(path, body + _digest(path.name, body), mode=0o600)
    except OSError as error:
        warn(f"{path.parent} cannot be written ({error.strerror})")
        return body, None
    return body, path


def arrays(
    prefix: str,
    parts: Iterable[object],
    build: Callable[[], "Mapping[str, np.ndarray]"],
    max_files: int,
    max_bytes: float = math.inf,
) -> "dict[str, np.ndarray]":
    """Returns arrays by name from the cache. Where it has none, ``build`` makes them.

    Args:
        prefix: of the file's name, of which at most ``max_files`` and ``max_bytes`` are kept.
        parts: what the arrays depend on: arrays, paths of sources, and what has a repr.
    """
    import numpy as np

    key = hashlib.sha256(np.__version__.encode())
    for part in parts:
        if isinstance(part, np.ndarray):
            key.update(repr((part.shape, part.dtype)).encode() + part.tobytes())
        else:
            key.update(part.read_bytes() if isinstance(part, Path) else repr(part).encode())

    def write() -> bytes:
        file = io.BytesIO()
        np.savez(file, **build())  # pyright: ignore[reportArgumentType]
        prune(prefix, max_files - 1, max_bytes - file.tell())
        return file.getvalue()

    body, _ = fetch(f"{prefix}{key.hexdigest()[:20]}", write)
    with np.load(io.BytesIO(body)) as loaded:
        return dict(loaded)


def records(
    prefix: str, parts: Iterable[object], build: "Callable[[], Sequence[Mapping]]", *limits: Any
) -> "list[dict[str, Any]]":
    """Returns what `build` does, as `arrays`: dicts of numbers and arrays, with the same keys."""
    import numpy as np

    def joined() -> "dict[str, np.ndarray]":
        rows = [{key: np.asarray(value) for key, value in row.items()} for row in build()]
        ends = {key: np.concatenate([row[key].ravel() for row in rows]) for key in rows[0]}
        return ends | {f"{key} shapes": np.array([r[key].shape for r in rows], int) for key in ends}

    columns, stored = {}, arrays(prefix, parts, joined, *limits)
    for key in [key for key in stored if f"{key} shapes" in stored]:
        shapes = stored[f"{key} shapes"]
        values = np.split(stored[key], shapes.prod(1).cumsum()[:-1])
        pairs = zip(values, shapes.tolist())
        columns[key] = [v.reshape(shape) if shape else v.item() for v, shape in pairs]
    return [dict(zip(columns, row)) for row in zip(*columns.values())]


def warn(problem: str) -> None:
    warnings.warn(
        f"the cache is not used, so kernels, mazes, light, spawn points, shortest paths, visible "
        f"texels and the episodes of Keys are computed at each start: {problem}; set "
        "MEGASTEP_CACHE to a folder of your own",
        stacklevel=2,
    )


def prune(prefix: str, keep: int, max_bytes: float = math.inf) -> None:
    """Deletes the oldest files whose names start with ``prefix``, beyond a number and a size."""
    with contextlib.suppress(OSError):  # another process deletes too, or there is no cache
        paths = sorted(_folder().glob(f"{prefix}*"), key=lambda path: -path.stat().st_mtime)
        for number, path in enumerate(paths):
            max_bytes -= path.stat().st_size
            if number >= keep or max_bytes < 0:
                path.unlink()


def intact(path: Path) -> bytes | None:
    """Returns a file's content without its digest; None if missing, damaged or not private."""
    with contextlib.suppress(OSError), open(path, "rb") as file:
        if _is_private(os.fstat(file.fileno())):
            content = file.read()
            body, digest = content[:-DIGEST], content[-DIGEST:]
            return body if body and _digest(path.name, body) == digest else None


def _digest(name, body) -> bytes:
    return hashlib.sha256(f"{name}\0".encode() + body).digest()


def _folder() -> Path:
    override = os.environ.get("MEGASTEP_CACHE")
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(override) if override else Path(base) / "megastep"


def _problem(folder) -> str | None:
    """Creates the folder if necessary. Returns why it cannot be the cache, or None if it can."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not _is_private(folder.stat()):
            return f"other users can write to {folder} (chmod 700 makes it private)"
        for parent in folder.resolve().parents:
            mode = parent.stat().st_mode
            if mode & stat.S_IWOTH and not mode & stat.S_ISVTX:
                return f"other users can replace {folder}, as they can write to {parent}"
    except OSError as error:
        return f"{folder} cannot be used ({error.strerror})"
    return None


def _is_private(status) -> bool:
    """True if only this user and root can write to the file."""
    ours = status.st_uid in (os.geteuid(), 0)
    return ours and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
