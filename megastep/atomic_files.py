"""Files and folders that are whole or absent."""

import contextlib
import os
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path

#: Marks temporary names.
MARK = ".tmp-"


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yields an unused path beside `path`. What is made there takes its place at the end of the
    context, or is deleted after an error: readers see the old content or the new, even if the power
    fails.
    """
    temporary = path.with_name(f"{path.name[:40]}{MARK}{secrets.token_hex(8)}")
    try:
        yield temporary
        sync(temporary)
        os.replace(temporary, path)
        sync(path.parent)
    except BaseException:
        delete(temporary)
        raise


def write_atomically(path: Path, data: bytes, mode: int = 0o666) -> None:
    """Writes a file as `replacing` does, with permissions less those of the umask."""
    with replacing(path) as temporary:
        with open(temporary, "xb", opener=lambda name, flags: os.open(name, flags, mode)) as file:
            file.write(data)


def sync(path: Path) -> None:
    """Flushes a file, or the names in a folder, to disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def delete(path: Path) -> None:
    """Deletes a file or a folder, if it is there and can be deleted."""
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    with contextlib.suppress(OSError):
        path.unlink()
