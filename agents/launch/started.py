"""Which run torchrun's ranks trained before they were started again.

torchrun's store keeps the name of its folder, and whoever reaches the store can write another name.
So the folder proves itself: it holds a token that this start made.
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
    """Leaves a token in a run's folder, and both in the store."""
    token = secrets.token_hex()
    with contextlib.suppress(OSError):  # without it, a restart is another run
        write_atomically(folder / FILE, token.encode())
        store.set(KEY, json.dumps([str(folder), token]))


def proven_folder(store: "Store") -> Path | None:
    """Returns the folder that the store names, if it has the token and is this user's."""
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
    """Removes the token of a run that is done."""
    with contextlib.suppress(OSError):
        (folder / FILE).unlink()
