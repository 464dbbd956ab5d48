"""How the benchmarks time a call: CUDA events on a GPU, the clock on the CPU; median and spread."""

import itertools
import statistics
import time
from collections.abc import Callable

import torch

from megastep import capture

REPEATS = 15  # samples per measurement
SECONDS = 0.05  # per sample
TURNS = 16  # operations in one CUDA graph
SCALES = {"k": 1e3, "M": 1e6}


def laps(work: Callable[[], object], device: torch.device, calls: int, n: int) -> list[float]:
    """Seconds that each of ``n`` laps of ``calls`` calls takes."""
    gpu = device.type == "cuda"

    def mark():
        if not gpu:
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)
        event.record()
        return event

    marks = [mark()]
    for _ in range(n):
        for _ in range(calls):
            work()
        marks.append(mark())
    if gpu:
        torch.cuda.synchronize(device)
    return [
        start.elapsed_time(end) / 1e3 if gpu else end - start
        for start, end in itertools.pairwise(marks)
    ]


def timed(work: Callable[[], object], device: torch.device, repeats: int | None = None):
    """Seconds per call of ``work``, a list of samples."""
    calls = max(1, round(SECONDS / min(laps(work, device, 1, 3))))
    return [lap / calls for lap in laps(work, device, calls, repeats or REPEATS)]


def alone(function: Callable[[int], object], device: torch.device) -> list[float]:
    """Seconds per call of ``function(i)``, i in turn from 0 to 15, by itself: on a GPU the sixteen
    are one CUDA graph, so that none waits for Python.
    """
    if device.type != "cuda":
        turn = itertools.cycle(range(TURNS))
        return timed(lambda: function(next(turn)), device)

    def turns():
        for i in range(TURNS):
            function(i)

    return [lap / TURNS for lap in timed(capture.capture(turns, (), ()), device)]


def measurement(what: str, unit: str, samples: list[float]) -> dict:
    """The median of ``samples``; of several also ``lower`` and ``upper``, their 10th and 90th
    percentiles.
    """
    lower, *_, upper = (
        statistics.quantiles(samples, n=10, method="inclusive")
        if len(samples) > 1
        else [None, None]
    )
    value = statistics.median(samples)
    return dict(what=what, value=value, unit=unit, lower=lower, upper=upper, n=len(samples))


def rate(what: str, count: int, times: list[float], unit: str = "M/s") -> dict:
    """The measurement of ``count`` things done in each of ``times`` seconds; ``unit`` begins with
    its scale.
    """
    return measurement(what, unit, [count / t / SCALES[unit[0]] for t in times])
