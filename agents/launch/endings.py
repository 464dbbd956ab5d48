"""How a script ends, an exit code and one sentence, and how the ranks of a run say so."""

import errno
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, cast

from megastep.agents import console, package
from megastep.agents.distributed import environment
from megastep.agents.errors import UserError, memory_problem, shortened
from megastep.agents.launch import signals
from megastep.atomic_files import write_atomically

#: Environment variable with the job folder, set for ranks that `launcher` started.
JOB = "MEGASTEP_JOB"
#: Files of the job folder: settings; how the ranks ended; the run folder's path.
SETTINGS, ENDING, RUN = "settings.json", "ending.json", "run"
#: Exit code if a rank was killed or cannot be reached.
LOST = 3


class Ending(NamedTuple):
    """How a script ended."""

    code: int = 0
    text: str = ""  # the error or the signal; empty after success, or if it was printed already
    folder: str | None = None  # the run folder, after training finished


def ending_of(work: Callable[[], int | Path | None]) -> Ending:
    """Calls a function, which returns an exit code, a folder or None. Raises bugs as they are."""
    try:
        with signals.interrupting():
            result = work()
            return Ending(folder=str(result)) if isinstance(result, Path) else Ending(result or 0)
    except SystemExit as end:  # from argparse, Hydra's help, or a rank that exits silently
        return Ending(cast(int, end.code or 0))
    except UserError as error:
        return Ending(error.code, str(error))
    except (MemoryError, RuntimeError) as error:
        if not (problem := memory_problem(error)):
            raise
        cure = "choose fewer environments or episodes, or a smaller network"
        return Ending(UserError.code, f"{problem}; {cure}")
    except OSError as error:
        if error.errno != errno.ENAMETOOLONG:
            raise
        return Ending(UserError.code, f"A path is too long: {shortened(error.filename)}")
    except signals.Interrupted as stop:
        return Ending(128 + stop.args[0], stop.args[1])


def report_ending(ending: Ending) -> None:
    """Reports the ranks' ending to the process that launched them, or on stderr under torchrun."""
    info = environment.rank_info()
    if JOB in os.environ:
        assert info is not None
        if info.rank > 0 and ending.code != LOST:
            name = f"rank {info.rank} on {environment.hostname()}: "
            ending = ending._replace(text=f"{name}{ending.text.removeprefix(name)}")
        path = Path(os.environ[JOB], ENDING)
        if not path.exists():
            write_atomically(path, json.dumps(ending).encode())
    elif ending.text:
        console.say(f"{package.command('train')}: {ending.text}", sys.stderr)
