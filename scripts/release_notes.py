"""Prints what CHANGELOG.md says of a release, for its page on GitHub.

    python scripts/release_notes.py v0.3.0

Exits with one sentence if the tag is not the version that the files state.
"""

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
#: Where the version stands: file, pattern.
VERSIONS = {
    "pyproject.toml": r'^version = "(.+)"$',
    "CITATION.cff": r"^version: (.+)$",
    "CHANGELOG.md": r"^## (\d\S*)",
}


def notes(tag: str, root: Path = ROOT) -> str:
    """Returns the section of CHANGELOG.md for a tag, without its title.

    Raises:
        ValueError: if a file states another version, or the section is empty.
    """
    texts = {name: (root / name).read_text() for name in VERSIONS}
    for name, pattern in VERSIONS.items():
        version = re.search(pattern, texts[name], re.MULTILINE)[1]
        if tag != f"v{version}":
            raise ValueError(f"The tag is {tag}, but {name} has version {version}.")
    sections = re.split(r"^## .*\n", texts["CHANGELOG.md"], flags=re.MULTILINE)
    unreleased, section = sections[1].strip(), sections[2].strip()
    if unreleased or not section:
        raise ValueError("CHANGELOG.md: move what stands under Unreleased to the release.")
    return section


if __name__ == "__main__":
    try:
        print(notes(sys.argv[1]))
    except ValueError as error:
        sys.exit(str(error))
