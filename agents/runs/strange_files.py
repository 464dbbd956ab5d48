"""Opens and reads files that may come from strangers: follows no links, never blocks, limits sizes.

A downloaded run may hold links to the user's files, or a FIFO or device that can be read forever.
"""

import errno
import os
import stat
from pathlib import Path

from megastep.agents.errors import UserError, shortened

#: Most entries that a run folder may have.
MAX_ENTRIES = 1_000_000
_FLAGS = sum(getattr(os, f"O_{name}", 0) for name in ("NOFOLLOW", "NONBLOCK", "CLOEXEC"))
_NO_FILE = "It is a link, a device or no file at all"


def opener(path: str | Path, flags: int) -> int:
    """Opens a regular file without following a link. Use it as `open(path, opener=opener)`.

    Raises:
        OSError: the file cannot be opened or is not a regular file.
    """
    if os.path.lexists(path) and not stat.S_ISREG(os.lstat(path).st_mode):
        raise OSError(errno.EINVAL, _NO_FILE, str(path))
    handle = os.open(path, flags | _FLAGS, 0o666)
    if not stat.S_ISREG(os.fstat(handle).st_mode):  # it has just been replaced
        os.close(handle)
        raise OSError(errno.EINVAL, _NO_FILE, str(path))
    return handle


def read_bytes(path: Path, max_bytes: int) -> bytes:
    """Returns the content of a regular file.

    Raises:
        OSError: it cannot be read, is not a regular file, or has more than `max_bytes`.
    """
    with open(path, "rb", opener=opener) as file:
        content = file.read(max_bytes + 1)
    if len(content) > max_bytes:
        raise OSError(errno.EFBIG, f"It has more than {max_bytes:,} bytes", str(path))
    return content


def check_folder(folder: Path) -> None:
    """Checks that a folder holds only files, folders, and links that stay inside it.

    The folder itself may be a link.

    Raises:
        UserError: naming the first entry that is something else.
    """
    root, n_entries = os.path.realpath(folder), 0
    folders = [root]
    while folders:
        try:
            entries = [*os.scandir(folders.pop())]
        except OSError:  # reported when it is read
            continue
        n_entries += len(entries)
        for entry in entries:
            name = shortened(Path(folder, os.path.relpath(entry.path, root)))
            if entry.is_symlink():
                target = os.path.realpath(entry.path)
                if os.path.commonpath([root, target]) != root:
                    raise UserError(
                        f"{name} is a link that leaves the run, to {shortened(target)}; if this is "
                        "your run, replace the link by what it names"
                    )
            elif entry.is_dir(follow_symlinks=False):
                folders.append(entry.path)
            elif not entry.is_file(follow_symlinks=False) and os.path.lexists(entry.path):
                raise UserError(f"{name} is neither a file nor a folder; delete it")
        if n_entries > MAX_ENTRIES:
            raise UserError(f"{shortened(folder)} holds more than {MAX_ENTRIES:,} files")
