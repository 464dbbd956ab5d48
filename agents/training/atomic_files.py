"""Files that are whole or as they were."""

import os
from pathlib import Path


def replace(path: Path, data: bytes) -> None:
    """Writes a file beside its place, forces it to the disk and renames it: whoever reads it, and
    whenever the process is killed, sees the old content or the new. OSError if there is no room.
    """
    copy = path.with_name(f"{path.name}.tmp")
    try:
        with open(copy, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(copy, path)
    except BaseException:
        copy.unlink(missing_ok=True)
        raise
