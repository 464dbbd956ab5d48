"""A process of a training run with several ranks, which `launch` or torchrun started: it joins the
others, speaks with one voice, and ends with them.
"""

import contextlib
import json
import os
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

from megastep import workers
from megastep.agents.cli import console, endings, launch, program, signals
from megastep.agents.distributed import environment

#: Seconds that a rank with an error gives rank 0 to tell of the same one, and to save.
GRACE_SECONDS, SAVING_SECONDS = 10.0, 60.0


def main() -> int:
    """Trains as one of the ranks that `launch` has started. Returns the exit code: 0 unless torchrun
    should start the ranks again.
    """
    place, job = environment.launched(), Path(os.environ[launch.JOB])
    for number in signals.SIGNALS:  # while there is nothing to save
        signal.signal(number, lambda number, frame: os._exit(128 + number))
    (job / f"pid-{place.attempt}-{place.rank}").write_text(str(os.getpid()))
    if (job / launch.STOPPED).exists():
        return 0
    facts = json.loads((job / launch.SETTINGS).read_text())
    sys.argv[:], sys.orig_argv[:] = facts["argv"], facts["command"]
    workers.end_with_parent(facts["parent"])
    console.open_streams()
    console.prefix = facts["prefix"]
    threading.excepthook = console.warn_of_thread
    warnings.showwarning = console.warn
    from megastep.agents.cli import check, settings, train

    folder = None

    def work():
        nonlocal folder
        folder = train.run(check.check(settings.Train, facts["settings"]))

    try:
        ending = endings.ending_of(work)._replace(folder=folder and str(folder))
        code = 0
    except Exception as error:
        traceback.print_exc()
        text = f"{type(error).__name__}: {program.shortened(error, 400)}"
        ending, code = endings.Ending(1, text), 1
    if ending.text or place.rank == 0:
        tell(ending)
    return code


def tell(ending: endings.Ending) -> None:
    """Says how the ranks end: on stderr, or to the process that launched them, which says it."""
    place = environment.launched()
    if launch.JOB in os.environ:
        if place.rank > 0 and ending.code != launch.LOST:
            named = f"rank {place.rank} on {environment.hostname()}: {ending.text}"
            ending = ending._replace(text=named)
        path = Path(os.environ[launch.JOB], f"ending-{place.attempt}")
        if not path.exists():
            ending.write(path)
    elif ending.text:
        console.say(f"{program.name('train')}: {ending.text}", sys.stderr)


class Team:
    """The ranks of a training run, as one of them sees them; in a process of its own, that alone.

    Attributes:
        folder: the run's folder, once it is known.
        watch: watches over the other ranks; None in a process of its own.
    """

    def __init__(self):
        self.folder = self.watch = None

    def exempt(self) -> contextlib.AbstractContextManager:
        """Returns a context in which the others wait for this rank as long as it takes."""
        return self.watch.exempt() if self.watch else contextlib.nullcontext()

    def end(self, problem: str | None) -> NoReturn:
        """Ends this process in the middle of training, since a rank is lost.

        Args:
            problem: is told; None if another rank tells it.
        """
        if problem:
            tell(endings.Ending(launch.LOST, f"{problem}. {launch.hint(self.folder)}"))
        console.restore()
        is_ours = launch.JOB in os.environ
        os._exit(launch.LOST if problem or not is_ours else 0)


@contextlib.contextmanager
def joined() -> Iterator[Team]:
    """Joins the ranks that torchrun started, and ends with them: one of them tells of an error. Does
    nothing in a process of its own.

    Raises:
        UserError, Interrupted: as in a process of its own, if this rank is the one to tell.
        SystemExit: another rank tells.
    """
    team = Team()
    if environment.launched() is None:
        yield team
        return
    from megastep.agents.distributed import process_group, watch

    with program.errors("The ranks cannot be joined: ", (RuntimeError,)):
        process_group.start()
    if process_group.n_ranks() == 1:
        yield team
        process_group.stop()
        return
    if process_group.rank() > 0:
        console.is_silent = True
        console.prefix = f"{console.prefix}{process_group.place()}: "
    team.watch = watch.Watch(team.end)
    team.watch.start()
    try:
        yield team
    except process_group.RankLost as error:
        team.watch.await_verdict()  # which ends this process
        team.end(f"A rank is lost: {error}" if team.watch.claim() else None)
    except (Exception, signals.Interrupted) as error:
        is_signal = isinstance(error, signals.Interrupted)
        team.watch.leave(SAVING_SECONDS if is_signal else GRACE_SECONDS)
        if not team.watch.claim():
            raise SystemExit(128 + error.args[0] if is_signal else 1) from None
        raise
    team.watch.leave()
    process_group.stop()
