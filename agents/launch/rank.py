"""One rank of a training run, started by `launcher` or torchrun: it joins the other ranks and ends
with them. Only one rank reports an error.
"""

import contextlib
import math
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NoReturn, TypeVar

from megastep.agents import console, package
from megastep.agents.distributed import environment
from megastep.agents.errors import UserError, user_errors
from megastep.agents.launch import endings, launcher, signals, started

#: Seconds that a rank waits for rank 0 to end: after an error; and after a signal, as rank 0 saves.
GRACE_SECONDS, SAVING_SECONDS = 10.0, 60.0
#: Seconds after which ranks that have not started yet are named.
NOTICE_SECONDS = 30.0
#: The team that this process has joined.
_team = None
T = TypeVar("T")


def announce(number: int) -> None:
    """Announces on rank 0 that training stops, unless torchrun sent the signal in tear-down."""
    job = os.environ.get(launcher.JOB)
    if environment.rank() == 0 and (
        job is None or os.path.exists(os.path.join(job, launcher.STOPPED))
    ):
        signals.announce(number)


def refuse(problem: str) -> None:
    """Raises UserError on rank 0 if torchrun started this process; other ranks exit silently."""
    if environment.rank_info():
        raise UserError(problem) if environment.rank() == 0 else SystemExit(UserError.code)


def report_ending(ending: endings.Ending) -> None:
    """Reports the ranks' ending to the process that launched them, or on stderr under torchrun."""
    info = environment.rank_info()
    if launcher.JOB in os.environ:
        assert info is not None
        if info.rank > 0 and ending.code != launcher.LOST:
            name = f"rank {info.rank} on {environment.hostname()}: "
            ending = ending._replace(text=f"{name}{ending.text.removeprefix(name)}")
        path = Path(os.environ[launcher.JOB], f"ending-{info.attempt}")
        if not path.exists():
            ending.write(path)
    elif ending.text:
        console.say(f"{package.command('train')}: {ending.text}", sys.stderr)


def is_first_here() -> bool:
    """Returns whether this is the first rank of its machine."""
    info = environment.rank_info()
    return info is not None and info.local_rank == 0


class Team:
    """The ranks of a training run, as one of them sees them.

    Attributes:
        folder: the run folder, once it is known.
        watch: detects lost ranks.
    """

    def __init__(self) -> None:
        from megastep.agents.distributed import process_group
        from megastep.agents.launch import watch

        self.folder = None
        self.store = process_group.store("job")
        # where `launcher` is, which Ctrl-Z suspends
        is_ours = launcher.JOB in os.environ
        self.watch = watch.Watch(self.end, self.end_in_silence, may_be_silent=is_ours)
        self.watch.start()

    def await_all(self) -> None:
        """Waits until all ranks have started. Raises UserError if some have not in time."""
        from megastep.agents.distributed import process_group

        began, warns_at = time.monotonic(), NOTICE_SECONDS
        while missing := self.watch.missing():
            names = f"{'rank' if len(missing) == 1 else 'ranks'} {', '.join(map(str, missing))}"
            problem = f"{names} of {self.watch.n_ranks} did not start within {{:.0f}} s"
            cure = "see what torchrun printed on the other machines"
            seconds = time.monotonic() - began
            if seconds > process_group.START_SECONDS:
                raise UserError(f"{problem.format(process_group.START_SECONDS)}; {cure}")
            if seconds > warns_at and is_first_here():
                console.warn(f"{problem.format(warns_at)}; {cure}. Waiting on")
                warns_at = math.inf
            time.sleep(0.1)

    def set_folder(self, folder: Path) -> None:
        """Publishes the run folder to the launcher and to restarted ranks."""
        self.folder = folder
        if environment.rank() == 0:
            if launcher.JOB in os.environ:
                Path(os.environ[launcher.JOB], launcher.RUN).write_text(str(folder))
            else:
                started.leave_proof(self.store, folder)

    def earlier_folder(self) -> Path | None:
        """Returns the run folder of the previous attempt if torchrun restarted the ranks."""
        if launcher.JOB in os.environ:  # the job folder, to which only this user can write
            info = environment.rank_info()
            assert info is not None
            if info.attempt == 0:
                return None
            path = Path(os.environ[launcher.JOB], launcher.RUN)
            return Path(path.read_text()) if path.exists() else None
        return started.proven_folder(self.store)

    def end(self, problem: str | None) -> NoReturn:
        """Exits at once, because a rank was lost.

        Args:
            problem: what to report; None if another rank reports it.
        """
        from megastep.agents.launch.watch import CALL_SECONDS, within

        # a folder on a machine that is gone blocks whoever reads it, and so may a pipe
        if problem:
            unknown = "Its run folder does not answer, so what is saved is not known"
            hint = within(CALL_SECONDS, lambda: launcher.hint(self.folder), unknown)
            ending = endings.Ending(launcher.LOST, f"{problem}. {hint}")
            within(CALL_SECONDS, lambda: report_ending(ending), None)
        within(CALL_SECONDS, console.restore, None)
        is_ours = launcher.JOB in os.environ
        os._exit(launcher.LOST if problem or not is_ours else 0)

    def end_in_silence(self, seconds: float | None = None) -> NoReturn:
        """Exits at once, because the store has not answered for so many seconds, or has closed the
        connection. One rank of this machine reports it, as the others may be out of reach.
        """
        silence = (
            "closed the connection" if seconds is None else f"not answered for {seconds:.0f} s"
        )
        problem = (
            f"{os.environ.get('MASTER_ADDR')}, where torchrun keeps the ranks' store, has "
            f"{silence}: torchrun has ended there, or that machine or the network is down"
        )
        self.end(problem if is_first_here() else None)

    def leave(self, seconds: float = 0.0) -> None:
        """Leaves the team; the other ranks no longer expect heartbeats from this one.

        Args:
            seconds: how long to wait for rank 0 to leave, too.
        """
        self.watch.leave(seconds)

    def finish(self) -> None:
        """Removes the proof by which restarted ranks would find the run, which is done."""
        if environment.rank() == 0 and self.folder is not None:
            started.remove_proof(self.folder)


@contextlib.contextmanager
def joined() -> Iterator[Team | None]:
    """Joins the ranks that torchrun started. If one fails, all end and one of them reports it.

    Yields:
        The team; None in a single process. Nested contexts yield the same team.

    Raises:
        UserError, Interrupted: as in a single process, if this rank reports the error.
        SystemExit: another rank reports it.
    """
    global _team
    with user_errors():
        info = environment.rank_info()
    if info is None or info.n_ranks == 1 or _team is not None:
        yield _team
        return
    from megastep.agents.distributed import process_group

    if info.rank > 0:
        console.is_silent = True
        console.prefix = f"{console.prefix}rank {info.rank} on {environment.hostname()}: "
    address = f"{os.environ.get('MASTER_ADDR')}:{os.environ.get('MASTER_PORT')}"
    problem = f"The ranks cannot connect to {address}; is the port in use, or closed? "
    with user_errors(problem, (RuntimeError, ValueError)):
        _team = team = Team()
    has_joined = process_group.n_ranks() == 1
    try:
        team.await_all()
        problem = (
            "The ranks cannot connect to each other; set GLOO_SOCKET_IFNAME to the interface that "
            "connects their machines. "
        )
        with user_errors(problem, (RuntimeError, ValueError)):
            process_group.start()
        yield team
    except (Exception, signals.Interrupted) as error:
        if loss := _cause(error, process_group.RankLost):
            with signals.handled(lambda number: None):  # ignores torchrun's SIGTERM
                team.watch.await_verdict()  # which ends this process
            if team.watch.is_gone:
                team.end_in_silence()
            team.end(f"A rank is lost: {loss}" if team.watch.claim() else None)
        is_signal = isinstance(error, signals.Interrupted)
        reports = info.rank == 0 and team.watch.claim()
        team.leave(SAVING_SECONDS if is_signal else GRACE_SECONDS)
        if reports or team.watch.claim():
            raise
        code = 128 + error.args[0] if is_signal else getattr(error, "code", 1)
        raise SystemExit(code) from None
    finally:
        _team = None
    team.finish()
    team.leave()
    if has_joined:
        process_group.stop()


def _cause(error, kind) -> BaseException | None:
    """Returns the error of a kind in the chain of an error's contexts; None if there is none."""
    while error is not None and not isinstance(error, kind):
        error = error.__context__
    return error


def together(function: Callable[[], T]) -> T:
    """Calls `agreement.together(function)` if ranks have joined, otherwise just the function."""
    if _team is None:
        return function()
    from megastep.agents.distributed import agreement

    return agreement.together(function)
