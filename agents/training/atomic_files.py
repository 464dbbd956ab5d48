"""Writes that a crash cannot leave half done."""

import os
from pathlib import Path


def write_atomically(path: Path, data: bytes) -> None:
    """Writes a file through a temporary one that is renamed into place.

    A reader sees either the old or the new content, even if the process is killed.

    Raises:
        OSError: the disk is full or not writable. The old file is unchanged.
    """
    temporary = path.with_name(f"{path.name}.tmp")
    try:
        write_synced(temporary, data)
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_synced(path: Path, data: bytes) -> None:
    """Writes a file and flushes it to disk."""
    with open(path, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


class AppendedFile:
    """A file that grows. What a full disk refuses is kept, and written by the next call from the
    byte where it stopped, so the file never has a hole.

    Args:
        path: the file, made if it does not exist.
        n_bytes: length to cut it to first; None keeps all.

    Raises:
        OSError: the file cannot be opened or cut.

    Attributes:
        unwritten: bytes to write.
    """

    def __init__(self, path: Path, n_bytes: int | None = None):
        self.path, self.unwritten = path, bytearray()
        self.file = open(path, "ab", buffering=0)
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

    def close(self) -> None:
        try:
            self.flush()
        finally:
            self.file.close()
