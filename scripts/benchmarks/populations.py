"""Benchmarks of populations: `members`, `small_members`."""

import statistics
from collections.abc import Iterator

import torch
from timing import measurement
from training import rates, trained

#: (members, lanes of each, lanes of the run beside them)
MEMBERS = {"cuda": (8, 4096, 4096), "cpu": (2, 64, 64)}
SMALL_MEMBERS = {"cuda": (64, 256, 16384), "cpu": (4, 16, 64)}


def members(device: torch.device, seconds: int = 30) -> Iterator[dict]:
    """Training of Explorer with an LSTM of 128 units: samples per second of 8 members in sum with
    4,096 lanes each, and of one run with 4,096 lanes.
    """
    yield from _rates(device, seconds, *MEMBERS[device.type])


def small_members(device: torch.device, seconds: int = 30) -> Iterator[dict]:
    """The same of 64 members with 256 lanes each, and of one run with 16,384 lanes."""
    yield from _rates(device, seconds, *SMALL_MEMBERS[device.type])


def _rates(device, seconds, n, n_lanes, n_lanes_of_one) -> Iterator[dict]:
    """Measures a population and a run beside it, and what the one has of the other."""
    medians = []
    for count, lanes in ((1, n_lanes_of_one), (n, n_lanes)):
        words = "env=explorer", "geometry=bench", "agent.width=128", f"env.n_envs={lanes}"
        size = f"population.size={count}", "population.every=1e15", f"seconds={seconds}"
        with trained(device, (*words, *size, "logger=none")) as (run,):
            # all do the same updates, and the first one's clock is that of all
            found = [count * r / 1e6 for r in rates(run if count == 1 else run / "member-0")]
        found = found[1:] or found
        medians.append(statistics.median(found))
        whose = "one run" if count == 1 else f"{count} members in sum"
        yield measurement(f"Explorer, LSTM-128, {whose}, {lanes:,} lanes each", "M/s", found)
    share = 100 * medians[1] / medians[0]
    what = f"Explorer, LSTM-128, {n} members of {n_lanes:,} lanes, of one run of {n_lanes_of_one:,}"
    yield measurement(what, "%", [share])
