"""Finds the run that torchrun's ranks trained before a restart.

torchrun's key-value store keeps the path of the run folder, but anyone who can reach the store may
write another path. So rank 0 also writes a random token into the folder and into the store, and a
folder is accepted only if it holds the token.
"""

import contextlib
import hmac
import json
import os
import secrets
from pathlib import Path
from typing import TYPE_CHECKING

from megastep.agents.runs import strange_files
from megastep.agents.runs.atomic_files import write_atomically

if TYPE_CHECKING:
    from torch.distributed import Store  # pyright: ignore[reportPrivateImportUsage]

#: The file with the token, and the store's key with the folder and the token.
FILE, KEY = ".started", "run"


def leave_proof(store: "Store", folder: Path) -> None:
    """Writes a token into a run folder, and the folder's path and the token into the store."""
    token = secrets.token_hex()
    with contextlib.suppress(OSError):  # without a token, a restart begins another run
        write_atomically(folder / FILE, token.encode())
        store.set(KEY, json.dumps([str(folder), token]))


def proven_folder(store: "Store") -> Path | None:
    """Returns the run folder in the store if it holds the token and is this user's, else None."""
    if not store.check([KEY]):
        return None
    with contextlib.suppress(OSError, ValueError, TypeError, AttributeError):
        folder, token = json.loads(store.get(KEY))
        path = Path(folder) / FILE
        content = strange_files.read_bytes(path, 1024)
        is_ours = {os.stat(one).st_uid for one in (folder, path)} == {os.geteuid()}
        if is_ours and hmac.compare_digest(content, token.encode()) and len(token) == 64:
            return Path(folder)
    return None


def remove_proof(folder: Path) -> None:
    """Removes the token of a finished run."""
    with contextlib.suppress(OSError):
        (folder / FILE).unlink()
