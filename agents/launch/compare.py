"""Compares a run that was repeated with the original, byte for byte."""

import itertools
from pathlib import Path

from megastep.agents import console
from megastep.agents.errors import Differs
from megastep.agents.runs import populations, provenance

METRICS = "metrics.jsonl"


def run(folder: Path, original: Path) -> None:
    """Checks that two runs have the same metrics. Raises Differs if not."""
    generation = populations.first_copy(original)
    cause = generation and (
        f"in generation {generation} it copied another member, which a run of its own cannot: "
        f"rerun={original.parent} repeats the whole population"
    )
    _check(METRICS, folder, original, cause or "")
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


def _check(name: str, folder: Path, original: Path, cause: str = "") -> None:
    ours, theirs = ((one / name).read_bytes() for one in (folder, original))
    if ours == theirs:
        return
    pairs = enumerate(itertools.zip_longest(ours.split(b"\n"), theirs.split(b"\n")), 1)
    number = next(number for number, (one, other) in pairs if one != other)
    cause = cause or (
        f"equal bits need the same versions, device and threads: see {provenance.FILE} of both"
    )
    raise Differs(f"{name} differs from that of {original} from line {number} on; {cause}")
