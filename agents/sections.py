"""Where the time of an iteration goes: sections of a rollout and of an update.

    with section("env"):
        world = env.step(decision)

A section's time is its own: sections inside it have theirs. On the CPU, sections always add up, and
`pop` reads them. On a GPU the host's times say nothing, so sections are measured while `Spans`
records: each section leaves CUDA events, also in a CUDA graph that is captured meanwhile. Graphs
captured at any other time hold no events.
"""

from __future__ import annotations

import contextlib
import time
from typing import NamedTuple

import torch

_seconds: dict[str, float] = {}  # the host's, since the last `pop`
_open: list[section] = []
_recording: list[_Span] | None = None


class _Span(NamedTuple):
    """One pass of a section on a GPU."""

    name: str
    outer: str | None  # the section around it
    start: torch.cuda.Event
    end: torch.cuda.Event
    is_captured: bool


class section(contextlib.ContextDecorator):
    """A context or decorator whose time counts for a name, less that of the sections inside it.

    Args:
        name: act, env, store, returns, forward, backward or optimiser.
    """

    def __init__(self, name: str):
        self.name, self.event = name, None

    def _recreate_cm(self):  # each call of a decorated function is a pass of its own
        return type(self)(self.name)

    def __enter__(self) -> None:
        if _recording is not None:
            self.event = _recorded_event()
        _open.append(self)
        self.start = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        elapsed = time.perf_counter() - self.start
        _open.pop()
        outer = _open[-1].name if _open else None
        _add(_seconds, self.name, outer, elapsed)
        if _recording is not None and self.event is not None:
            is_captured = torch.cuda.is_current_stream_capturing()
            span = _Span(self.name, outer, self.event, _recorded_event(), is_captured)
            _recording.append(span)


def pop() -> dict[str, float]:
    """Returns the host's seconds by section since the last call. Call it outside of sections."""
    global _seconds
    seconds, _seconds = _seconds, {}
    return seconds


class Spans:
    """A context in which sections record CUDA events.

        with Spans() as spans:
            graph = capture(function)
        graph()
        seconds = spans.seconds()

    Each replay of a graph records its events again. Eager calls count only if nothing is captured:
    before a capture they warm up.
    """

    def __enter__(self) -> Spans:
        global _recording
        _recording = self.spans = []
        return self

    def __exit__(self, *_: object) -> None:
        global _recording
        _recording = None

    def seconds(self) -> dict[str, float]:
        """Returns the GPU's seconds by section, of the last replay. Synchronises."""
        seconds = {}
        for span in [span for span in self.spans if span.is_captured] or self.spans:
            span.end.synchronize()
            elapsed = span.start.elapsed_time(span.end) / 1000
            _add(seconds, span.name, span.outer, elapsed)
        return seconds


def _add(seconds, name, outer, elapsed):
    """Adds the time of a section, and takes it off the section around it."""
    seconds[name] = seconds.get(name, 0.0) + elapsed
    if outer is not None:
        seconds[outer] = seconds.get(outer, 0.0) - elapsed


def _recorded_event():
    # in a graph, only an external event has a time that the host can read
    event = torch.cuda.Event(enable_timing=True, external=torch.cuda.is_current_stream_capturing())
    event.record()
    return event
