"""Compares a run that was repeated with the original, byte for byte."""

import itertools
from pathlib import Path

from megastep.agents import console
from megastep.agents.errors import Differs
from megastep.agents.runs import populations, provenance

METRICS = "metrics.jsonl"


def run(folder: Path, original: Path) -> None:
    """Checks that two runs have the same metrics. Raises Differs if not."""
    _check(METRICS, folder, original)
    console.say(f"{METRICS} equals that of {original}, byte for byte.")


def population(folder: Path, original: Path) -> None:
    """Checks that two populations have the same generations, and their members the same metrics.
    Raises Differs if not.
    """
    members = populations.members(original)
    for name in (*(f"{member.name}/{METRICS}" for member in members), populations.FILE):
        _check(name, folder, original)
    console.say(
        f"{populations.FILE} and {METRICS} of all {len(members)} members equal those of "
        f"{original}, byte for byte."
    )


def _check(name: str, folder: Path, original: Path) -> None:
    ours, theirs = ((one / name).read_bytes() for one in (folder, original))
    if ours == theirs:
        return
    pairs = enumerate(itertools.zip_longest(ours.split(b"\n"), theirs.split(b"\n")), 1)
    number = next(number for number, (one, other) in pairs if one != other)
    raise Differs(
        f"{name} differs from that of {original} from line {number} on; equal bits need the same "
        f"versions, device and threads: see {provenance.FILE} of both"
    )
