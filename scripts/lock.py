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
    "--no-header --no-annotate --constraint constraints.txt pyproject.toml"
)
#: The extras of all files, and of those that the image gets, with a package of another extra.
ALL, IMAGE = ["--extra=test"], ["--extra=wandb", "--extra=sweep", "-"]
OF_IMAGE = "gymnasium"
#: Files: what they hold, and which packages these are. Of the last, `test.txt` takes those that the
#: image does not get.
FILES = {
    "build.txt": ("What builds packages from source", r"setuptools"),
    "torch.txt": (
        "PyTorch for CUDA and what it alone needs, as the default package index has them",
        r"torch|triton|(nvidia|cuda)-.*",
    ),
    "test.txt": ("What only tests, checks and the site need", r"(?!)"),
    "packages.txt": ("All other packages, those of the extras included", r".*"),
}


def split(lock: str, of_image: set[str]) -> dict[str, str]:
    """Returns the content of each file of a compiled lock.

    Args:
        lock: all packages.
        of_image: names of those that the image gets.
    """
    contents = {name: f"# {what}. Written by `make lock`.\n" for name, (what, _) in FILES.items()}
    for block in re.findall(r"^\S.*(?:\n .*)*", lock, re.MULTILINE):
        package = block.partition("==")[0]
        name = next(name for name, (_, names) in FILES.items() if re.fullmatch(names, package))
        if name == "packages.txt" and package not in of_image:
            name = "test.txt"
        contents[name] += f"{block}\n"
    return contents


def compiled(extras: list[str]) -> str:
    """Returns what uv resolves for some of the extras."""
    words = [*COMMAND.split(), *extras]
    return subprocess.run(
        words, cwd=ROOT, input=OF_IMAGE, stdout=subprocess.PIPE, text=True, check=True
    ).stdout


def main() -> None:
    of_image = {*re.findall(r"^([\w-]+)==", compiled(IMAGE), re.MULTILINE)}
    for name, content in split(compiled(ALL), of_image).items():
        (ROOT / "requirements" / name).write_text(content)


if __name__ == "__main__":
    main()
