"""Atomic writes, safe against crashes and other writers in the same folder."""

import contextlib
import itertools
import os
import re
import secrets
import shutil
import socket
import time
from collections.abc import Iterable
from pathlib import Path

from megastep.agents.runs import strange_files

#: Age in seconds at which temporary files of other machines are deleted, whose processes cannot be
#: checked from here.
ABANDONED = 24 * 3600
#: A name as long as the longest of a run's files and folders.
ROOM = 120 * "x"
_NAME = re.compile(r".*\.tmp-(?P<machine>.+)-(?P<pid>\d+)-(?P<token>\w+)-\d+")
#: The token distinguishes this process from an earlier one with the same id.
_TOKEN, _COUNT = secrets.token_hex(4), itertools.count()


def write_atomically(path: Path, data: bytes) -> None:
    """Writes a temporary file and renames it to `path`.

    Readers see either the old or the new content, even if the process is killed. The last of
    several writers wins. Deletes temporary files that killed writers left in the folder.

    Raises:
        OSError: the disk is full or not writable. The old file is unchanged.
    """
    delete_leftovers(path.parent)
    temporary = temporary_path(path)
    try:
        write_synced(temporary, data)
        os.replace(temporary, path)
        sync_folder(path.parent)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def make_folders(path: Path) -> list[Path]:
    """Creates a folder and its missing parents. Returns the folders created, innermost first.

    Raises:
        OSError: one cannot be created, or the path is too long for the files of a run. No folder is
            left behind.
    """
    check_room(path)
    absent = [one for one in (path, *path.parents) if not os.path.lexists(one)]
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError:
        remove_folders(absent)
        raise
    return absent


def check_room(path: Path) -> None:
    """Raises OSError if a folder's path is too long for the files of a run in it."""
    with contextlib.suppress(FileNotFoundError, NotADirectoryError, PermissionError):
        os.lstat(path.absolute() / ROOM / ROOM)


def remove_folders(paths: Iterable[Path]) -> None:
    """Removes the folders that `make_folders` created; stops at the first that is not empty."""
    with contextlib.suppress(OSError):
        for path in paths:
            if os.path.lexists(path):
                path.rmdir()


def write_synced(path: Path, data: bytes) -> None:
    """Writes a file and flushes it to disk."""
    with open(path, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def temporary_path(path: Path) -> Path:
    """Returns an unused path beside `path` for a temporary file or folder of this process."""
    owner = f"{_machine()}-{os.getpid()}-{_TOKEN}-{next(_COUNT)}"
    return path.with_name(f"{path.name[:40]}.tmp-{owner}")  # at most 255 bytes


def delete_leftovers(folder: Path | str) -> None:
    """Deletes temporary files and folders in `folder` whose process has ended, and those of other
    machines after a day.
    """
    for path in Path(folder).glob("*.tmp-*"):
        name = _NAME.fullmatch(path.name)
        with contextlib.suppress(OSError):  # another process may delete or rename it
            if not name or _is_in_use(path, name["machine"], int(name["pid"]), name["token"]):
                continue
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink()


def _is_in_use(path, machine, pid, token) -> bool:
    if machine != _machine():
        return time.time() - path.stat().st_mtime < ABANDONED
    return token == _TOKEN if pid == os.getpid() else _is_alive(pid)


def _is_alive(pid) -> bool:
    try:
        os.kill(pid, 0)  # sends no signal; not all systems have /proc
    except PermissionError:  # the process is another user's
        return True
    except (ProcessLookupError, OverflowError):
        return False
    return True


def _machine() -> str:
    """Returns a name for the host or container, within which process ids are unique."""
    name = re.sub(r"[^\w.]", "_", socket.gethostname())[:32]
    with contextlib.suppress(OSError):  # not all systems have namespaces
        name += "-" + re.sub(r"\D", "", os.readlink("/proc/self/ns/pid"))
    return name


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


class AppendedFile:
    """A file to append to. Data that a full disk refuses is kept and written by the next call, from
    the byte where it stopped, so the file has no gaps.

    Args:
        path: the file, created if missing.
        n_bytes: length to truncate it to first; None keeps all.

    Raises:
        OSError: the file cannot be opened or truncated, or is a link.

    Attributes:
        unwritten: bytes still to write.
    """

    def __init__(self, path: Path, n_bytes: int | None = None):
        self.path, self.unwritten = path, bytearray()
        self.file = open(path, "ab", buffering=0, opener=strange_files.opener)
        if n_bytes is not None:
            self.file.truncate(n_bytes)

    def write(self, data: bytes) -> None:
        """Appends bytes.

        Raises:
            OSError: the disk is full or not writable.
        """
        self.unwritten += data
        self.flush()

    def flush(self) -> None:
        """Writes `unwritten`. Raises as `write`."""
        while self.unwritten:
            del self.unwritten[: self.file.write(self.unwritten)]

    def sync(self) -> None:
        """Writes `unwritten` and flushes the file to disk. Raises as `write`."""
        self.flush()
        os.fsync(self.file.fileno())

    def close(self) -> None:
        try:
            self.flush()
        finally:
            self.file.close()
