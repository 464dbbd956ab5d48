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
