"""Writes requirements/: every package with its hashes, as resolved today for pyproject.toml.

Run it with uv on the path: `make lock`. One resolution serves Python 3.10 and newer on every
system; the hashes are those of the package index that uv asks.
"""

import re
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
COMMAND = (
    "uv pip compile --no-config --quiet --universal --python-version 3.10 --generate-hashes "
    "--no-header --no-annotate --extra test --constraint constraints.txt pyproject.toml"
)
#: Files: what they hold, and which packages these are. The last takes the rest.
FILES = {
    "build.txt": ("What builds packages from source", r"setuptools"),
    "torch.txt": (
        "PyTorch for CUDA and what it alone needs, as the default package index has them",
        r"torch|triton|(nvidia|cuda)-.*",
    ),
    "packages.txt": ("All other packages, those of the extras included", r".*"),
}


def split(lock: str) -> dict[str, str]:
    """Returns the content of each file of a compiled lock."""
    contents = {name: f"# {what}. Written by `make lock`.\n" for name, (what, _) in FILES.items()}
    for block in re.findall(r"^\S.*(?:\n .*)*", lock, re.MULTILINE):
        package = block.partition("==")[0]
        name = next(name for name, (_, names) in FILES.items() if re.fullmatch(names, package))
        contents[name] += f"{block}\n"
    return contents


def main() -> None:
    lock = subprocess.run(
        COMMAND.split(), cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True
    ).stdout
    for name, content in split(lock).items():
        (ROOT / "requirements" / name).write_text(content)


if __name__ == "__main__":
    main()
