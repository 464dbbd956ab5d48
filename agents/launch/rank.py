"""One rank of a training run, started by `launcher` or torchrun: it joins the other ranks and ends
with them. Only one rank reports an error.
"""

import contextlib
import hmac
import json
import math
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn, TypeVar

from megastep.agents import console, package
from megastep.agents.distributed import environment
from megastep.agents.errors import UserError, user_errors
from megastep.agents.launch import signals
from megastep.agents.runs import checkpoint, folders, populations, strange_files
from megastep.agents.runs.atomic_files import write_atomically

if TYPE_CHECKING:
    from torch.distributed import Store  # pyright: ignore[reportPrivateImportUsage]

#: Environment variable with the job folder, set for ranks that `launcher` started.
JOB = "MEGASTEP_JOB"
#: Files of the job folder: settings; how the ranks ended; the run folder's path.
SETTINGS, ENDING, RUN = "settings.json", "ending.json", "run"
#: The file of a run folder with the token of its start, and the store's key with folder and token.
STARTED, KEY = ".started", "run"
#: Exit code if a rank was killed, hangs or cannot be reached.
LOST = 3
#: Seconds that a rank waits for rank 0 to end: after an error; and after a signal, as rank 0 saves.
GRACE_SECONDS, SAVING_SECONDS = 10.0, 60.0
#: Seconds after which ranks that have not started yet are named.
NOTICE_SECONDS = 30.0
#: The team that this process has joined.
_team = None
T = TypeVar("T")


def report_ending(ending: signals.Ending) -> None:
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


def announce(number: int) -> None:
    """Announces on rank 0 that training stops."""
    if environment.rank() == 0:
        signals.announce(number)


def refuse(problem: str) -> None:
    """Raises UserError on rank 0 if torchrun started this process; other ranks exit silently."""
    if environment.rank_info():
        raise UserError(problem) if environment.rank() == 0 else SystemExit(UserError.code)


def hint(folder: Path | None) -> str:
    """Returns how to continue a run whose ranks were lost in the middle of an update."""
    runs = () if folder is None else populations.members(folder) or [folder]
    if folder is None or not all(checkpoint.list_checkpoints(run / "checkpoints") for run in runs):
        return "Nothing was saved yet"
    return f"Its last checkpoint is intact. To continue: {folders.resume_command(folder)}"


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
        self.watch = watch.Watch(self.end, may_be_silent=JOB in os.environ)

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
            if seconds > warns_at and environment.is_first_here():
                console.warn(f"{problem.format(warns_at)}; {cure}. Waiting on")
                warns_at = math.inf
            time.sleep(0.1)

    def set_folder(self, folder: Path) -> None:
        """Publishes the run folder, which holds the token of this start, to restarted ranks and to
        the launcher.
        """
        self.folder = folder
        if environment.rank() == 0:
            with contextlib.suppress(OSError):  # without a token, a restart begins another run
                token = (folder / STARTED).read_text()
                self.store.set(KEY, json.dumps([str(folder), token]))
            if JOB in os.environ:
                Path(os.environ[JOB], RUN).write_text(str(folder))

    def earlier_folder(self) -> Path | None:
        """Returns the run folder of an earlier attempt, if the ranks were restarted."""
        return proven_folder(self.store)

    def end(self, problem: str | None) -> NoReturn:
        """Exits at once, because a rank was lost.

        Args:
            problem: what to report; None if another rank reports it.
        """
        from megastep.agents.launch.watch import CALL_SECONDS, within

        # a folder on a machine that is gone blocks whoever reads it, and so may a pipe
        if problem:
            unknown = "Its run folder does not answer, so what is saved is not known"
            advice = within(CALL_SECONDS, lambda: hint(self.folder), unknown)
            ending = signals.Ending(LOST, f"{problem}. {advice}")
            within(CALL_SECONDS, lambda: report_ending(ending), None)
        within(CALL_SECONDS, console.restore, None)
        os._exit(0 if problem is None and JOB in os.environ else LOST)

    def finish(self) -> None:
        """Removes the token by which restarted ranks would find the run, which is done."""
        if environment.rank() == 0 and self.folder is not None:
            with contextlib.suppress(OSError):
                (self.folder / STARTED).unlink()


def proven_folder(store: "Store") -> Path | None:
    """Returns the run folder in the ranks' store if it is this user's and holds the token that is
    beside it there, else None: anyone who reaches the store can write another path.
    """
    if not store.check([KEY]):
        return None
    with contextlib.suppress(OSError, ValueError, TypeError, AttributeError):
        folder, token = json.loads(store.get(KEY))
        path = Path(folder) / STARTED
        content = strange_files.read_bytes(path, 1024)
        is_ours = {os.stat(one).st_uid for one in (folder, path)} == {os.geteuid()}
        if is_ours and hmac.compare_digest(content, token.encode()) and len(token) == 64:
            return Path(folder)
    return None


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
    is_alone = info is None or (info.n_ranks == 1 and JOB not in os.environ)
    if is_alone or _team is not None:
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
            team.end(f"A rank is lost: {loss}" if team.watch.claim() else None)
        is_signal = isinstance(error, signals.Interrupted)
        reports = info.rank == 0 and team.watch.claim()
        team.watch.leave(SAVING_SECONDS if is_signal else GRACE_SECONDS)
        if reports or team.watch.claim():
            raise
        code = 128 + error.args[0] if is_signal else getattr(error, "code", 1)
        raise SystemExit(code) from None
    finally:
        _team = None
    team.finish()
    team.watch.leave()
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
