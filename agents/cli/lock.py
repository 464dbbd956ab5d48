"""One training per run folder."""

import contextlib
import errno
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

from megastep.agents.cli.console import warn
from megastep.agents.cli.errors import UserError

#: What file systems without locks answer.
NO_LOCKS = (errno.ENOSYS, errno.ENOTSUP, errno.ENOLCK)


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keeps other processes from training in a run folder; UserError names the one that does.

    The system holds the lock for as long as this process lives, so none is ever stale: neither
    after kill -9 nor when another process gets the number in the file.
    """
    path = folder / "lock"
    with _opened(path) as file:
        try:
            yield
        finally:
            if _is_at(file, path):  # delete it while it is locked, so that it is not another's
                path.unlink()


def _opened(path: Path) -> TextIO:
    """The lock file, open and locked, with the number of this process in it."""
    try:
        while True:
            file = open(path, "a+")
            _lock(file, path)
            if _is_at(file, path):
                break
            file.close()  # its last owner has just deleted it
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        return file
    except OSError as error:
        raise UserError(
            f"The run folder {path.parent} cannot be written to ({error.strerror}); choose another "
            "with folder="
        ) from error


def _lock(file: TextIO, path: Path) -> None:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.seek(0)
        owner = file.read()
        who = f"process {owner}; wait for it, or end it: kill {owner}" if owner else "another one"
        raise UserError(f"The run folder {path.parent} is in use by {who}") from None
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
        warn(f"{path.parent} is on a file system without locks; train in it only once at a time")


def _is_at(file: TextIO, path: Path) -> bool:
    """Whether an open file is still the one of this name."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False
