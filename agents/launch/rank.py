"""One rank of a training run: it joins the others and ends with them; one reports errors."""

import contextlib
import os
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, TypeVar

from megastep.agents import console
from megastep.agents.distributed import environment
from megastep.agents.errors import user_errors
from megastep.agents.launch import endings, signals

if TYPE_CHECKING:
    from megastep.agents.launch.watch import Team

#: Seconds that a rank waits for rank 0 to end: after an error; and after a signal, as rank 0 saves.
GRACE_SECONDS, SAVING_SECONDS = 10.0, 60.0
#: The team that this process has joined.
_team = None
T = TypeVar("T")


@contextlib.contextmanager
def joined() -> "Iterator[Team | None]":
    """Yields the team of ranks that torchrun started, one of which reports errors; None alone."""
    global _team
    with user_errors():
        info = environment.rank_info()
    if info is None or _team is not None or (info.n_ranks == 1 and endings.JOB not in os.environ):
        yield _team
        return
    from megastep.agents.distributed import process_group
    from megastep.agents.launch import watch

    if info.rank > 0:
        console.is_silent = True
        console.prefix = f"{console.prefix}rank {info.rank} on {environment.hostname()}: "
    address = f"{os.environ.get('MASTER_ADDR')}:{os.environ.get('MASTER_PORT')}"
    problem = f"The ranks cannot connect to {address}; is the port in use, or closed? "
    with user_errors(problem, (RuntimeError, ValueError)):
        _team = team = watch.Team()
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
        is_signal = isinstance(error, signals.Interrupted)
        with signals.handled(lambda number: None):  # ignores torchrun's SIGTERM
            loss: BaseException | None = error
            while loss is not None and not isinstance(loss, process_group.RankLost):
                loss = loss.__context__
            if loss is not None:
                team.end_lost(loss)
            reports = info.rank == 0 and team.claim()
            team.leave(SAVING_SECONDS if is_signal else GRACE_SECONDS)
            reports = reports or team.claim()
        if reports:
            raise
        code = 128 + error.args[0] if is_signal else getattr(error, "code", 1)
        raise SystemExit(code) from None
    finally:
        _team = None
    team.leave()
    if has_joined:
        process_group.stop()


def together(function: Callable[[], T]) -> T:
    """Calls `process_group.together(function)` if ranks have joined, otherwise just it."""
    if _team is None:
        return function()
    from megastep.agents.distributed import process_group

    return process_group.together(function)
