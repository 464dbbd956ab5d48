"""A private cache of what was built, for this user alone.

It lies in ``$MEGASTEP_CACHE`` (else ``$XDG_CACHE_HOME/megastep``, else ``~/.cache/megastep``) and
is made with mode 0700. What is loaded from it runs with the user's rights, so nothing is read that
another user may write. A cached file ends in its own SHA-256, so a damaged one is seen and built
again; it is written beside its place and renamed, so that two processes cannot harm each other. The
digest is of the name too, so no file passes for another. A cache that cannot be used costs a
warning of one line and a build per start.
"""

import hashlib
import math
import os
import stat
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path

DIGEST = 32  # bytes


def fetch(name: str, build: Callable[[], bytes]) -> tuple[bytes, Path | None]:
    """What ``build`` gives, from the file ``name`` if an intact one is cached, and that file's
    path: None if there is no cache.
    """
    path = _folder() / name
    problem = _problem(path.parent)
    body = None if problem else intact(path)
    if body is not None:
        return body, path
    if problem is None and path.exists():
        warnings.warn(f"{path} is damaged or not this user's own: it is made again", stacklevel=2)
    body = build()
    if problem is None:
        try:
            _write(path, body)
            return body, path
        except OSError as error:
            problem = f"{path.parent} cannot be written ({error.strerror})"
    warn(problem)
    return body, None


def warn(problem: str) -> None:
    warnings.warn(
        f"the kernel cache is not used, so kernels are built, and spawn points, shortest ways and "
        f"visible texels found, at each start: {problem}; set MEGASTEP_CACHE to another folder of "
        f"your own",
        stacklevel=2,
    )


def prune(prefix: str, keep: int, max_bytes: float = math.inf) -> None:
    """Deletes all files whose names begin with ``prefix`` but the ``keep`` that are newest, and as
    many of those as it takes until the rest is ``max_bytes`` at most.
    """
    try:
        found = sorted(_folder().glob(f"{prefix}*"), key=lambda path: -path.stat().st_mtime)
        for number, path in enumerate(found):
            max_bytes -= path.stat().st_size
            if number >= keep or max_bytes < 0:
                path.unlink()
    except OSError:
        pass  # another process deletes too, or there is no cache


def intact(path: Path) -> bytes | None:
    """The bytes of a cached file less the digest it ends in; None if it is missing, damaged or not
    private.
    """
    try:
        with open(path, "rb") as file:
            if not _is_private(os.fstat(file.fileno())):
                return None
            content = file.read()
    except OSError:
        return None
    body, digest = content[:-DIGEST], content[-DIGEST:]
    return body if body and _digest(path.name, body) == digest else None


def _digest(name, body):
    digest = hashlib.sha256(f"{name}\0".encode())
    digest.update(body)
    return digest.digest()


def _folder():
    chosen = os.environ.get("MEGASTEP_CACHE")
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(chosen) if chosen else Path(base) / "megastep"


def _problem(folder):
    """Why the folder, made if need be, is no place for the cache; None if it is one."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not _is_private(folder.stat()):
            return f"other users may write in {folder} (chmod 700 makes it private)"
        for parent in folder.resolve().parents:
            mode = parent.stat().st_mode
            if mode & stat.S_IWOTH and not mode & stat.S_ISVTX:
                return f"other users may replace {folder}, for they may write in {parent}"
    except OSError as error:
        return f"{folder} cannot be used ({error.strerror})"
    return None


def _is_private(status):
    """Can only this user and the administrator write it?"""
    ours = status.st_uid in (os.geteuid(), 0)
    return ours and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def _write(path, body):
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=path.name)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(body)
            file.write(_digest(path.name, body))
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise
