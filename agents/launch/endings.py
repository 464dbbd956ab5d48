"""How a script ends: an exit code, and one sentence for people."""

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
        code: the exit code of the process.
        text: what went wrong, or which signal came; empty if nothing did, or all is said already.
        folder: the run's folder, of a training that is done.
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
        """Raises what ended the script, if anything did: UserError or Interrupted."""
        if self.code > 128:
            raise signals.Interrupted(self.code - 128, self.text)
        if self.code:
            error = UserError(self.text)
            error.code = self.code
            raise error


def ending_of(work: Callable[[], int | None]) -> Ending:
    """Calls a function that returns an exit code or None. Returns how it ended.

    Errors that no user can put right are raised.
    """
    try:
        with signals.interrupting():
            return Ending(work() or 0)
    except SystemExit as end:  # of argparse, of Hydra's help, and of a rank that leaves silently
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
