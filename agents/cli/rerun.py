"""megastep rerun RUN: repeats a run and compares its metrics, byte for byte."""

from megastep.agents.cli import train
from megastep.agents.errors import UserError


def main(words: list[str]) -> int:
    """Runs the command: `megastep train rerun=RUN`. Returns the exit code."""
    if not words:
        raise UserError("takes a run: its folder, or latest")
    return train.main([f"rerun={words[0]}", *words[1:]])
