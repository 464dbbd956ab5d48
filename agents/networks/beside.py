"""Work beside an LSTM's sequence, whose kernel waits for itself most of the time and leaves a fifth
of a GPU idle. The sequence runs on a second stream; what it does not need, on the usual one.
"""

import contextlib
import functools
import threading
from collections.abc import Callable, Iterator
from typing import Any

import torch

from megastep.kernels.build import launch

_THREAD = threading.local()  # its `work` waits for a sequence to run beside
#: The latest gradient's event, until a sequence asks for any.
_latest: torch.cuda.Event | None = None


@functools.cache
def _second_of(stream) -> torch.cuda.Stream:
    """Each stream has its own, since what is freed there waits for this stream alone. It is above
    others, so that clusters of blocks find neighbouring multiprocessors that are free.
    """
    return torch.cuda.Stream(stream.device, priority=-1)


def now(device: torch.device) -> torch.cuda.Event | None:
    """Returns the end of what is launched so far; None if a second stream would not help."""
    if device.type != "cuda" or launch.is_shared():
        return None
    event = torch.cuda.Event()
    event.record(torch.cuda.current_stream(device))
    return event


@contextlib.contextmanager
def second_stream(
    device: torch.device, after: torch.cuda.Event | None
) -> Iterator[Callable[[], object]]:
    """Launches on a second stream inside, after an event alone. Gives a function that makes the
    current stream wait for it. Without an event there is only the current stream.

    Memory allocated inside is the second stream's. What the current one allocates after the event
    must not be used inside: freed memory may still be read there.
    """
    if after is None:
        yield lambda: None
        return
    current = torch.cuda.current_stream(device)
    stream = _second_of(current)
    stream.wait_event(after)
    with torch.cuda.stream(stream):
        yield lambda: current.wait_stream(stream)


@contextlib.contextmanager
def meanwhile(work: Callable[[], object]) -> Iterator[list[Any]]:
    """Runs `work` beside the first sequence of an LSTM inside, or at the end. Gives a list, to
    which its result is added. It has no gradient, and reads nothing that is computed inside.
    """
    results: list[Any] = []
    _THREAD.work = lambda: results.append(work())
    try:
        yield results
        if (left := waiting()) is not None:
            left()
    finally:
        _THREAD.work = None


def waiting() -> Callable[[], object] | None:
    """Returns the work that waits for a sequence, which the caller must do."""
    work, _THREAD.work = getattr(_THREAD, "work", None), None
    return work


def mark(gradient: torch.Tensor, *still_read: torch.Tensor) -> torch.Tensor:
    """Returns a gradient, and keeps with it that it is computed `now`; see `ready`. And tensors
    allocated on the second stream that the current one still reads: the next sequence allocates
    there before they are freed, and does not wait for those reads.
    """
    global _latest
    _latest = event = now(gradient.device)
    if event is not None:
        gradient.ready = event, gradient._version, still_read  # pyright: ignore[reportAttributeAccessIssue]
    return gradient


def ready(gradient: torch.Tensor) -> torch.cuda.Event | None:
    """Returns when the gradient that was marked last was computed, to the first who asks for any.
    None: it is another, or something was added to it since.

    Who gets None waits for the current stream, which may still read what was computed on the second
    stream after the mark, and has been freed there.
    """
    global _latest
    latest, _latest = _latest, None
    event, version, _ = getattr(gradient, "ready", (None, 0, ()))
    return event if event is latest and version == gradient._version else None
