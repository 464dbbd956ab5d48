"""Tables of results: on the terminal, and in a run's folder for people and for machines."""

import json
from collections.abc import Sequence
from pathlib import Path

from megastep.agents.cli.console import markdown
from megastep.agents.cli.errors import UserError
from megastep.agents.training.atomic_files import write_atomically

INTERVAL = "95 % interval"


def write(
    folder: Path, name: str, result: dict, head: Sequence[str], lines: Sequence[Sequence[str]]
) -> Path:
    """Writes a result for machines and its table for people, `name`.json and .md, each whole or not
    at all. Returns the .json's path.
    """
    texts = {
        ".md": f"{result['title']}\n\n{markdown(head, lines)}",
        ".json": json.dumps(result, indent=2) + "\n",
    }
    try:
        folder.mkdir(exist_ok=True)
        for suffix, text in texts.items():
            write_atomically(folder / f"{name}{suffix}", text.encode())
    except OSError as error:
        raise UserError(
            f"The evaluation cannot be written to {folder} ({error.strerror})"
        ) from error
    return folder / f"{name}.json"
