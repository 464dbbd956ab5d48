"""How a script ends: an exit code and one sentence for the user."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, cast

from megastep.agents.errors import UserError, memory_problem
from megastep.agents.launch import signals
from megastep.agents.runs.atomic_files import write_atomically


class Ending(NamedTuple):
    """How a script ended.

    Attributes:
        code: exit code of the process.
        text: the error or the signal; empty after success, or if it was printed already.
        folder: the run folder, after training finished.
    """

    code: int = 0
    text: str = ""
    folder: str | None = None

    def write(self, path: Path) -> None:
        write_atomically(path, json.dumps(self).encode())

    @classmethod
    def read(cls, path: Path) -> "Ending":
        return cls(*json.loads(path.read_text()))

    def raise_error(self) -> None:
        """Raises the error or signal that ended the script, as UserError or Interrupted, if any."""
        if self.code > 128:
            raise signals.Interrupted(self.code - 128, self.text)
        if self.code:
            error = UserError(self.text)
            error.code = self.code
            raise error


def ending_of(work: Callable[[], int | None]) -> Ending:
    """Calls a function and returns how it ended.

    Args:
        work: returns an exit code, None for 0.

    Raises:
        Exception: errors that the user cannot fix, such as bugs.
    """
    try:
        with signals.interrupting():
            return Ending(work() or 0)
    except SystemExit as end:  # from argparse, Hydra's help, or a rank that exits silently
        return Ending(cast(int, end.code or 0))
    except UserError as error:
        return Ending(error.code, str(error))
    except (MemoryError, RuntimeError) as error:
        if not (problem := memory_problem(error)):
            raise
        cure = "choose fewer environments or episodes, or a smaller network"
        return Ending(UserError.code, f"{problem}; {cure}")
    except signals.Interrupted as stop:
        return Ending(128 + stop.args[0], stop.args[1])
