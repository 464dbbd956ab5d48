"""Signatures of checkpoints, which tell a user's own runs from downloaded ones.

A checkpoint's configuration names classes by import path, and importing a module runs its code.
megastep's own classes may always be imported. A `config.json` that names others is signed with
HMAC-SHA256 (RFC 2104) and a key of the user: `megastep/key` in `$XDG_CONFIG_HOME`, by default
`~/.config`. Does not import PyTorch.
"""

import contextlib
import hmac
import json
import os
import re
import secrets
import stat
import tempfile
import warnings
from pathlib import Path

KEY_BYTES = 32
#: Settings groups that may contain import paths.
GROUPS = ("env", "geometry", "agent", "learner", "opponents", "curriculum", "logger", "callbacks")
#: Import paths of megastep's own components.
OWN = re.compile(
    r"megastep\.(envs|geometries|agents\.(algorithms|networks|selfplay|training))(\.\w+)*:\w+"
)


def sign(config: bytes) -> str | None:
    """Returns the signature of a `config.json`; None if it names no modules outside megastep.

    Creates the user's key on first use; if that fails, warns and returns None.
    """
    if not foreign_names(config):
        return None
    try:
        return _digest(_make_key(), config)
    except (OSError, RuntimeError) as error:
        warnings.warn(
            f"this run cannot be signed ({error}), so whatever loads it later needs trust=true",
            stacklevel=2,
        )
        return None


def untrusted_names(config: bytes, signature: object) -> list[str]:
    """Returns the import paths outside megastep in a `config.json`; none if this user signed it."""
    names = foreign_names(config)
    with contextlib.suppress(OSError, RuntimeError):
        given = str(signature).encode(errors="replace")
        if names and hmac.compare_digest(_digest(_read_key(), config).encode(), given):
            return []
    return names


def foreign_names(config: bytes) -> list[str]:
    """Returns the import paths in a `config.json` that are not megastep's own."""
    tree, names = json.loads(config), []
    train = tree.get("train") if isinstance(tree, dict) else None
    stack = [train.get(group) for group in GROUPS] if isinstance(train, dict) else []
    while stack:  # not recursive: a forged file may be deeply nested
        value = stack.pop()
        if isinstance(value, (dict, list)):
            stack += [*value, *value.values()] if isinstance(value, dict) else value
        elif isinstance(value, str) and ":" in value and not OWN.fullmatch(value):
            names.append(value)
    return sorted({*names})


def _digest(key, config) -> str:
    return hmac.new(key, config, "sha256").hexdigest()


def _path() -> Path:
    base = os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config"
    return Path(base) / "megastep" / "key"


def _read_key() -> bytes:
    """Returns the key. Raises OSError if it does not exist or is not private."""
    with open(_path(), "rb") as file:
        status, key = os.fstat(file.fileno()), file.read()
    is_private = status.st_uid == os.geteuid() and not stat.S_IMODE(status.st_mode) & 0o077
    if not is_private or len(key) != KEY_BYTES:
        raise OSError(f"{_path()} is not a private file of {KEY_BYTES} bytes; delete it")
    return key


def _make_key() -> bytes:
    """Returns the key. Creates it if missing; among several processes, the first one does."""
    with contextlib.suppress(FileNotFoundError):
        return _read_key()
    path = _path()
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent)  # of mode 0600
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(secrets.token_bytes(KEY_BYTES))
            file.flush()
            os.fsync(file.fileno())
        with contextlib.suppress(FileExistsError):
            os.link(temporary, path)  # unlike a rename, does not replace an existing key
    finally:
        os.unlink(temporary)
    return _read_key()
