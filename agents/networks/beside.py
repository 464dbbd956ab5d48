"""A second stream for an LSTM's sequence, whose kernel waits for itself most of the time and leaves
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
def _second_of(stream) -> torch.cuda.Stream:
    """Each stream has its own, since what is freed there waits for this stream alone. It is above
    others, so that clusters of blocks find neighbouring multiprocessors that are free.
    """
    return torch.cuda.Stream(stream.device, priority=-1)


def now(device: torch.device) -> torch.Event | None:
    """Returns the end of what is launched so far; None if a second stream would not help."""
    is_alone = device.type == "cuda" and not launch.is_shared()
    return torch.cuda.current_stream(device).record_event() if is_alone else None


@contextlib.contextmanager
def second_stream(after: torch.Event | None) -> Iterator[torch.cuda.Stream | None]:
    """Gives a stream that waits for an event alone, and for which the current one waits in the end;
    None without an event. What runs there must not use memory that the current one allocates after
    the event, and allocates none itself unless that is `now`: what is freed may still be read.
    """
    if after is None:
        yield None
        return
    current = torch.cuda.current_stream(after.device)
    _second_of(current).wait_event(after)
    yield _second_of(current)
    current.wait_stream(_second_of(current))


@contextlib.contextmanager
def meanwhile(work: Callable[[], object]) -> Iterator[None]:
    """Has the first sequence of an LSTM inside, if there is one, call `work`. This has no gradient,
    and reads nothing that is computed inside.
    """
    _THREAD.work = work
    try:
        yield
    finally:
        _THREAD.work = None


def waiting() -> Callable[[], object] | None:
    """Returns the work that waits for a sequence, which the caller must do."""
    work, _THREAD.work = getattr(_THREAD, "work", None), None
    return work


def mark(gradient: torch.Tensor) -> torch.Tensor:
    """Returns a gradient, and keeps with it that it is computed now, see `ready`."""
    gradient.ready = now(gradient.device), gradient._version  # pyright: ignore[reportAttributeAccessIssue]
    return gradient


def ready(gradient: torch.Tensor) -> torch.Event | None:
    """Returns when a gradient was marked; None if never, or something was added to it since."""
    event, version = getattr(gradient, "ready", (None, None))
    return event if version == gradient._version else None
