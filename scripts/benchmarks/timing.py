"""Times calls: with CUDA events on a GPU, with the clock on the CPU. Gives medians and spreads."""

import itertools
import statistics
import time
from collections.abc import Callable

import torch

from megastep import capture

N_SAMPLES = 15  # per measurement
SAMPLE_SECONDS = 0.05
N_CALLS = 16  # calls in one CUDA graph; also how many random actions are drawn beforehand
SCALES = {"k": 1e3, "M": 1e6}


def lap_seconds(
    function: Callable[[], object], device: torch.device, n_calls: int, n_laps: int
) -> list[float]:
    """Returns the seconds of each of ``n_laps`` laps of ``n_calls`` calls."""
    on_gpu = device.type == "cuda"

    def timestamp():
        if not on_gpu:
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)
        event.record()
        return event

    timestamps = [timestamp()]
    for _ in range(n_laps):
        for _ in range(n_calls):
            function()
        timestamps.append(timestamp())
    if on_gpu:
        torch.cuda.synchronize(device)
    return [
        start.elapsed_time(end) / 1e3 if on_gpu else end - start
        for start, end in itertools.pairwise(timestamps)
    ]


def seconds_per_call(
    function: Callable[[], object], device: torch.device, n_samples: int | None = None
) -> list[float]:
    """Returns samples of the seconds that a call takes, each a mean over ``SAMPLE_SECONDS``."""
    n_calls = max(1, round(SAMPLE_SECONDS / min(lap_seconds(function, device, 1, 3))))
    laps = lap_seconds(function, device, n_calls, n_samples or N_SAMPLES)
    return [seconds / n_calls for seconds in laps]


def graph_seconds_per_call(function: Callable[[int], object], device: torch.device) -> list[float]:
    """Returns samples of the seconds that ``function(i)`` takes, for i from 0 to 15 in turn.

    On a GPU the sixteen calls are one CUDA graph, so that Python's own time does not count.
    """
    if device.type != "cuda":
        indices = itertools.cycle(range(N_CALLS))
        return seconds_per_call(lambda: function(next(indices)), device)

    def call_all():
        for i in range(N_CALLS):
            function(i)

    graph = capture.capture(call_all, (), ())
    return [seconds / N_CALLS for seconds in seconds_per_call(graph, device)]


def measurement(what: str, unit: str, samples: list[float]) -> dict:
    """Returns the median of ``samples`` as a measurement.

    ``lower`` and ``upper`` are the 10th and 90th percentiles, None if there is one sample.
    """
    lower, *_, upper = (
        statistics.quantiles(samples, n=10, method="inclusive")
        if len(samples) > 1
        else [None, None]
    )
    value = statistics.median(samples)
    return dict(what=what, value=value, unit=unit, lower=lower, upper=upper, n=len(samples))


def rate(what: str, count: int, seconds: list[float], unit: str = "M/s") -> dict:
    """Returns the measurement of a rate: ``count`` items in each sample of ``seconds``.

    The first letter of ``unit`` is its scale, k or M.
    """
    return measurement(what, unit, [count / sample / SCALES[unit[0]] for sample in seconds])
