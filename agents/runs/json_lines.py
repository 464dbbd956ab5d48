"""JSON Lines files: one object per line, whose `samples` are the environment steps so far.

A killed run loses no complete line, and a damaged line does not affect others.
"""

import json
import math
import os
import warnings
from pathlib import Path

from megastep.agents.errors import user_errors
from megastep.agents.runs import typed_json
from megastep.agents.types import Row
from megastep.atomic_files import write_atomically


class AppendedFile:
    """A file that bytes are appended to, cut to ``n_bytes`` first. Bytes that a full disk refuses
    are in `unwritten`, and are written with the next. All methods raise OSError.
    """

    def __init__(self, path: Path, n_bytes: int | None = None):
        self.path, self.unwritten = path, bytearray()
        self.file = open(path, "ab", buffering=0)
        if n_bytes is not None:
            self.file.truncate(n_bytes)

    def write(self, data: bytes) -> None:
        self.unwritten += data
        self.flush()

    def flush(self) -> None:
        """Writes `unwritten`."""
        while self.unwritten:
            del self.unwritten[: self.file.write(self.unwritten)]

    def sync(self) -> None:
        """Writes `unwritten` and flushes the file to disk."""
        self.flush()
        os.fsync(self.file.fileno())

    def close(self) -> None:
        """Writes `unwritten` and closes the file."""
        with self.file:
            self.flush()


class JsonLines:
    """Appends lines to a file, unbuffered. What a full disk refuses is written with the next."""

    def __init__(self, path: Path | str):
        self.path, self.has_warned = Path(path), False
        self.file = AppendedFile(self.path)

    def write(self, step: int, values: dict[str, float | str]) -> None:
        """Appends a line. NaN and infinity become null."""
        json_values = {
            key: value if isinstance(value, str) or math.isfinite(value) else None
            for key, value in values.items()
        }
        line = json.dumps({"samples": step, **json_values}) + "\n"
        self._tolerated(self.file.write, line.encode())

    def sync(self) -> bool:
        """Flushes the lines to disk. Returns whether they are there."""
        return self._tolerated(self.file.sync)

    def close(self) -> None:
        """Closes the file."""
        self._tolerated(self.file.close)

    def _tolerated(self, call, *arguments) -> bool:
        try:
            call(*arguments)
        except OSError as error:
            if not self.has_warned:
                text = f"{self.path} cannot be written ({error}); the run goes on"
                warnings.warn(text, stacklevel=3)
            self.has_warned = True
            return False
        return True


def read(path: Path | str, kind: object = None) -> list[Row]:
    """Returns the objects of a `kind` in a file, else UserError. Skips damaged lines, and warns."""
    if kind is None:
        return [row for row, _ in _intact_lines(Path(path))]
    with user_errors(f"{path} cannot be used: "):
        rows = [row for row, _ in _intact_lines(Path(path))] if os.path.exists(path) else []
        typed_json.check(list[kind], rows)
        return rows


def truncate_after(path: Path | str, step: int) -> None:
    """Removes damaged lines and those after `step`. If there is an OSError, nothing."""
    path = Path(path)
    if not path.exists():
        return
    lines = (line + b"\n" for row, line in _intact_lines(path) if row["samples"] <= step)
    data = b"".join(lines)
    if data != path.read_bytes():
        write_atomically(path, data)


def _intact_lines(path: Path) -> list[tuple[Row, bytes]]:
    """Returns (object, bytes) of each intact line."""
    intact, damaged, lines = [], [], path.read_bytes().split(b"\n")
    for number, line in enumerate(lines, 1):
        try:
            row = typed_json.loads(line, typed_json.Row)
            typed_json.check(int, row.get("samples"))
            intact.append((row, line))
        except ValueError:
            damaged.append(str(number))
    if damaged := [number for number in damaged if number != str(len(lines))]:
        which = f"line {damaged[0]} is" if len(damaged) == 1 else f"lines {', '.join(damaged)} are"
        warnings.warn(f"{path}: {which} damaged and skipped", stacklevel=3)
    return intact
