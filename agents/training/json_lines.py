"""Files of JSON lines: one object per line, each with the environment steps before it, `samples`.

Written so that a killed run loses no line, read so that a damaged line costs no other.
"""

import json
import math
import warnings
from pathlib import Path
from typing import Any

from megastep.agents.training import atomic_files


class JsonLines:
    """A file that lines are appended to, each written at once."""

    def __init__(self, path: Path | str):
        self.path = Path(path)
        self.file = open(self.path, "a", encoding="utf-8")

    def write(self, step: int, values: dict[str, float | str]) -> None:
        """Appends numbers and words; a number that is not finite becomes null: JSON has none."""
        finite = {
            key: value if isinstance(value, str) or math.isfinite(value) else None
            for key, value in values.items()
        }
        self.file.write(json.dumps({"samples": step, **finite}) + "\n")
        self.file.flush()

    def close(self) -> None:
        self.file.close()


def read(path: Path | str) -> list[dict[str, Any]]:
    """The objects of a file. Damaged lines are named in a warning and skipped, without one if it is
    the last, cut short by a crash.
    """
    return [row for row, _ in _lines(Path(path))]


def rewind(path: Path | str, step: int) -> None:
    """Drops the lines after `step` environment steps, which a resumed run writes again, and those
    that are damaged. OSError, with the file as it was, if there is no room for a copy.
    """
    path = Path(path)
    if not path.exists():
        return
    kept = b"".join(line + b"\n" for row, line in _lines(path) if row["samples"] <= step)
    if kept != path.read_bytes():
        atomic_files.replace(path, kept)


def _lines(path: Path) -> list[tuple[dict[str, Any], bytes]]:
    """The lines that are whole, as objects and as they stand in the file."""
    *lines, last = path.read_bytes().split(b"\n")
    rows = [(_row(line), line) for line in [*lines, last]]
    damaged = [str(n) for n, (row, _) in enumerate(rows[:-1], 1) if row is None]
    if damaged:
        which = f"line {damaged[0]} is" if len(damaged) == 1 else f"lines {', '.join(damaged)} are"
        skipped = "is skipped" if len(damaged) == 1 else "are skipped"
        warnings.warn(f"{path}: {which} damaged and {skipped}", stacklevel=4)
    return [(row, line) for row, line in rows if row is not None]


def _row(line: bytes) -> dict[str, Any] | None:
    try:
        row = json.loads(line)
    except ValueError:
        return None
    whole = isinstance(row, dict) and isinstance(row.get("samples"), int)
    return row if whole else None
