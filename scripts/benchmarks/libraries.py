"""The benchmark `libraries`: what other libraries learn in megastep's environments."""

import importlib
import sys
import time
from collections.abc import Iterator

import paths
import torch
from timing import measurement


def libraries(device: torch.device) -> Iterator[dict]:
    """What other libraries learn in Pong (points won) or PointGoal (success), by
    `scripts/examples/other_libraries.py`: the mean over 512 episodes, with its 95 % interval, of
    random actions and after training; and the seconds of a CPU core. Leaves out what is not
    installed.
    """
    sys.path.append(str(paths.ROOT / "scripts" / "examples"))
    other_libraries = importlib.import_module("other_libraries")
    for name, samples in other_libraries.BUDGETS.items():
        start = time.process_time()
        try:
            results = other_libraries.compare(name, samples, str(device))
        except ModuleNotFoundError as error:
            print(f"{name} is left out: {error.name} is not installed", file=sys.stderr)
            continue
        what = f"{name}, {samples:,} samples"
        for who, (mean, half) in zip(("random actions", "trained"), results):
            interval = dict(lower=mean - half, upper=mean + half, n=other_libraries.N_EPISODES)
            yield dict(what=f"{what}, {who}", value=mean, unit="") | interval
        yield measurement(f"{what}, time of a core", "s", [time.process_time() - start])
