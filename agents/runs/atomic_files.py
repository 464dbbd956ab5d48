"""Writes that a crash cannot leave half done, in folders that several writers may share."""

import contextlib
import itertools
import os
import re
import secrets
import shutil
import socket
import time
from pathlib import Path

from megastep.agents.runs import strange_files

#: Age in seconds at which another machine's temporary files are deleted: its processes cannot be
#: seen from here.
ABANDONED = 24 * 3600
_NAME = re.compile(r".*\.tmp-(?P<machine>.+)-(?P<pid>\d+)-(?P<token>\w+)-\d+")
#: The token tells this process from an earlier one with the same number.
_TOKEN, _COUNT = secrets.token_hex(4), itertools.count()


def write_atomically(path: Path, data: bytes) -> None:
    """Writes a file through a temporary one that is renamed into place.

    A reader sees either the old or the new content, even if the process is killed or others write
    the same file: the last one wins. Deletes what killed writers left in the folder.

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


def write_synced(path: Path, data: bytes) -> None:
    """Writes a file and flushes it to disk."""
    with open(path, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def temporary_path(path: Path) -> Path:
    """Returns an unused path beside `path` for a temporary file or folder of this process."""
    owner = f"{_machine()}-{os.getpid()}-{_TOKEN}-{next(_COUNT)}"
    return path.with_name(f"{path.name[:40]}.tmp-{owner}")  # of at most 255 bytes


def delete_leftovers(folder: Path | str) -> None:
    """Deletes temporary files and folders in `folder` whose process no longer runs. Those of
    another machine go when they are a day old.
    """
    for path in Path(folder).glob("*.tmp-*"):
        name = _NAME.fullmatch(path.name)
        with contextlib.suppress(OSError):  # another process deletes or renames it
            if not name or _is_in_use(path, name["machine"], int(name["pid"]), name["token"]):
                continue
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink()


def _is_in_use(path, machine, pid, token):
    if machine != _machine():
        return time.time() - path.stat().st_mtime < ABANDONED
    return token == _TOKEN if pid == os.getpid() else _is_alive(pid)


def _is_alive(pid):
    try:
        os.kill(pid, 0)  # sends nothing; not all systems have /proc
    except PermissionError:  # it is another user's
        return True
    except (ProcessLookupError, OverflowError):
        return False
    return True


def _machine():
    """The name of what process numbers belong to: a host, or a container on it."""
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
    """A file that grows. What a full disk refuses is kept, and written by the next call from the
    byte where it stopped, so the file never has a hole.

    Args:
        path: the file, made if it does not exist.
        n_bytes: length to cut it to first; None keeps all.

    Raises:
        OSError: the file cannot be opened or cut, or is a link.

    Attributes:
        unwritten: bytes to write.
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
        """Writes what is left, with errors as `write`."""
        while self.unwritten:
            del self.unwritten[: self.file.write(self.unwritten)]

    def sync(self) -> None:
        """Writes what is left and flushes the file to disk, with errors as `write`."""
        self.flush()
        os.fsync(self.file.fileno())

    def close(self) -> None:
        try:
            self.flush()
        finally:
            self.file.close()
