"""A process of a training run with several ranks, which `launch` or torchrun started: it joins the
others, speaks with one voice, and ends with them.
"""

import contextlib
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NoReturn, TypeVar

from megastep.agents import console, package
from megastep.agents.distributed import environment
from megastep.agents.errors import UserError, user_errors
from megastep.agents.launch import endings, launcher, signals, started

#: Seconds that a rank with an error gives rank 0 to tell of the same one, and to save.
GRACE_SECONDS, SAVING_SECONDS = 10.0, 60.0
#: The ranks that this process has joined.
_team = None
T = TypeVar("T")


def announce(number: int) -> None:
    """Rank 0 announces a signal, unless it is torchrun's, which ends what is left of the ranks."""
    job = os.environ.get(launcher.JOB)
    if environment.rank() == 0 and (
        job is None or os.path.exists(os.path.join(job, launcher.STOPPED))
    ):
        signals.announce(number)


def refuse(problem: str) -> None:
    """Raises UserError if torchrun started this process. Rank 0 says it for all."""
    if environment.launched():
        raise UserError(problem) if environment.rank() == 0 else SystemExit(UserError.code)


def tell(ending: endings.Ending) -> None:
    """Says how the ranks end: on stderr, or to the process that launched them, which says it."""
    place = environment.launched()
    if launcher.JOB in os.environ:
        if place.rank > 0 and ending.code != launcher.LOST:
            name = f"rank {place.rank} on {environment.hostname()}: "
            ending = ending._replace(text=f"{name}{ending.text.removeprefix(name)}")
        path = Path(os.environ[launcher.JOB], f"ending-{place.attempt}")
        if not path.exists():
            ending.write(path)
    elif ending.text:
        console.say(f"{package.command('train')}: {ending.text}", sys.stderr)


class Team:
    """The ranks of a training run, as one of them sees them.

    Attributes:
        folder: the run's folder, once it is known.
    """

    def __init__(self):
        from megastep.agents.distributed import process_group
        from megastep.agents.launch import watch

        self.folder = None
        self.store = process_group.store("job")
        self.watch = watch.Watch(self.end)
        self.watch.start()

    def set_folder(self, folder: Path) -> None:
        """Tells where the run is, for those who end it or start it again."""
        self.folder = folder
        if environment.rank() == 0:
            if launcher.JOB in os.environ:
                Path(os.environ[launcher.JOB], launcher.RUN).write_text(str(folder))
            else:
                started.leave_proof(self.store, folder)

    def earlier_folder(self) -> Path | None:
        """Returns the run that was trained before torchrun started the ranks again."""
        if environment.launched().attempt == 0:
            return None
        if launcher.JOB in os.environ:  # a folder that is this user's alone
            path = Path(os.environ[launcher.JOB], launcher.RUN)
            return Path(path.read_text()) if path.exists() else None
        return started.proven_folder(self.store)

    def end(self, problem: str | None) -> NoReturn:
        """Ends this process in the middle of training, since a rank is lost.

        Args:
            problem: is told; None if another rank tells it.
        """
        if problem:
            tell(endings.Ending(launcher.LOST, f"{problem}. {launcher.hint(self.folder)}"))
        console.restore()
        is_ours = launcher.JOB in os.environ
        os._exit(launcher.LOST if problem or not is_ours else 0)

    def leave(self, seconds: float = 0.0) -> None:
        """Lets the others go on without this rank.

        Args:
            seconds: how long to wait for rank 0 to leave as well.
        """
        self.watch.leave(seconds)

    def finish(self) -> None:
        """Forgets the run, which is done."""
        if environment.rank() == 0 and self.folder is not None:
            started.remove_proof(self.folder)


@contextlib.contextmanager
def joined() -> Iterator[Team | None]:
    """Joins the ranks that torchrun started, and ends with them: one of them tells of an error.

    Does nothing in a process of its own, and inside itself.

    Raises:
        UserError, Interrupted: as in a process of its own, if this rank is the one to tell.
        SystemExit: another rank tells.
    """
    global _team
    with user_errors():
        place = environment.launched()
    if place is None or place.n_ranks == 1 or _team is not None:
        yield _team
        return
    from megastep.agents.distributed import process_group

    if place.rank > 0:
        console.is_silent = True
        console.prefix = f"{console.prefix}rank {place.rank} on {environment.hostname()}: "
    address = f"{os.environ.get('MASTER_ADDR')}:{os.environ.get('MASTER_PORT')}"
    problem = f"The ranks cannot meet at {address}; is the port in use, or closed? "
    with user_errors(problem, (RuntimeError, ValueError)):
        has_joined = process_group.n_ranks() == 1
        process_group.start()
    _team = team = Team()
    try:
        yield team
    except (Exception, signals.Interrupted) as error:
        if loss := _cause(error, process_group.RankLost):
            with signals.handled(lambda number: None):  # torchrun sends SIGTERM
                team.watch.await_verdict()  # which ends this process
            team.end(f"A rank is lost: {loss}" if team.watch.claim() else None)
        is_signal = isinstance(error, signals.Interrupted)
        tells = place.rank == 0 and team.watch.claim()
        team.leave(SAVING_SECONDS if is_signal else GRACE_SECONDS)
        if tells or team.watch.claim():
            raise
        code = 128 + error.args[0] if is_signal else getattr(error, "code", 1)
        raise SystemExit(code) from None
    finally:
        _team = None
    team.finish()
    team.leave()
    if has_joined:
        process_group.stop()


def _cause(error, kind):
    """Returns the error of a kind that another was raised from or after, None if there is none."""
    while error is not None and not isinstance(error, kind):
        error = error.__context__
    return error


def together(function: Callable[[], T]) -> T:
    """Calls a function on every rank, as `agreement.together` does, once the ranks have joined."""
    if _team is None:
        return function()
    from megastep.agents.distributed import agreement

    return agreement.together(function)
