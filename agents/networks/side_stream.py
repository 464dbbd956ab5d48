"""A side stream for an LSTM's sequence, whose kernel waits for itself most of the time and leaves
a fifth of a GPU idle. What does not depend on the sequence overlaps with it on the usual stream.
"""

import contextlib
import functools
import threading
from collections.abc import Callable, Iterator

import torch

from megastep.kernels.build import launch

_THREAD = threading.local()  # its `work` is to overlap with the next sequence


@functools.cache
def _side_of(stream) -> torch.cuda.Stream:
    """Each stream has one of its own, since what is freed there waits for this stream alone. Its
    priority is high, so that clusters of blocks find neighbouring multiprocessors that are free.
    """
    return torch.cuda.Stream(stream.device, priority=-1)


def fork_point(device: torch.device) -> torch.Event | None:
    """Returns the end of what is launched so far; None if a side stream would not help."""
    is_alone = device.type == "cuda" and not launch.is_shared()
    return torch.cuda.current_stream(device).record_event() if is_alone else None


@contextlib.contextmanager
def fork(after: torch.Event | None) -> Iterator[torch.cuda.Stream | None]:
    """Gives a stream that waits for an event alone, and for which the current one waits in the end;
    None without an event. What runs there must not use memory that the current one allocates after
    the event, nor allocate any if something was launched since: what is freed may still be read.
    """
    if after is None:
        yield None
        return
    current = torch.cuda.current_stream(after.device)
    _side_of(current).wait_event(after)
    try:
        yield _side_of(current)
    finally:  # also where what runs here is out of memory, which is then freed
        current.wait_stream(_side_of(current))


@contextlib.contextmanager
def overlap(work: Callable[[], object]) -> Iterator[None]:
    """Has the first sequence of an LSTM inside, if there is one, call `work`. This has no gradient,
    and reads nothing that is computed inside.
    """
    _THREAD.work = work
    try:
        yield
    finally:
        _THREAD.work = None


def take_work() -> Callable[[], object] | None:
    """Returns the work that waits for a sequence, which the caller must do."""
    work, _THREAD.work = getattr(_THREAD, "work", None), None
    return work


def mark_ready(gradient: torch.Tensor) -> torch.Tensor:
    """Returns a gradient, and keeps with it that it is computed now, see `ready_event`."""
    gradient.ready = fork_point(gradient.device), gradient._version  # pyright: ignore[reportAttributeAccessIssue]
    return gradient


def ready_event(gradient: torch.Tensor) -> torch.Event | None:
    """Returns when a gradient was marked; None if never, or something was added to it since."""
    event, version = getattr(gradient, "ready", (None, None))
    return event if version == gradient._version else None
