"""megastep check path=FILE: what the floor plans of a file do not satisfy."""

from collections import Counter
from pathlib import Path

from megastep.agents import console
from megastep.agents.cli.command import Command
from megastep.agents.errors import UserError, user_errors

HELP = """Checks the floor plans of an .npz file: that each is closed, every room can be reached,
lights are indoors, and no two walls are the same or cross.

  megastep check path=plans.npz          also the file of an import: megastep import --help"""
SHOWN = 20  # plans whose errors are printed


def run(path: str) -> None:
    """Checks the floor plans of a file. Raises UserError if there are errors."""
    from megastep.geometries import checks, databases

    file = Path(path)
    with user_errors():
        plans = databases.load(file)
    errors = {index: checks.errors(g) for index, g in enumerate(plans)}
    errors = {index: sentences for index, sentences in errors.items() if sentences}
    for index, sentences in list(errors.items())[:SHOWN]:
        console.say(f"geometry {index} (id {plans[index].id}): {'; '.join(sentences)}")
    if errors:
        kinds = Counter(sentence for sentences in errors.values() for sentence in sentences)
        counts = ", ".join(f"{n} times {sentence!r}" for sentence, n in kinds.most_common())
        raise UserError(f"{len(errors):,} of {len(plans):,} geometries have errors: {counts}")
    console.say(f"{len(plans):,} geometries, {sum(len(g.walls) for g in plans):,} walls: no errors")


COMMAND = Command("check", run, HELP)
main = COMMAND.main
