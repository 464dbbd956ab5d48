"""Builds the image of the Dockerfile with buildah and tries it: as a user whom it does not know,
without a network, with a mounted `runs`.

The exit code is that of the first command that fails. Needs Linux, root and Debian's `buildah`.
"""

import os
import shlex
import subprocess
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
#: A user whom the image does not know.
USER = 4321
#: Commands in the image. The quickstart evaluates and films by itself, too.
COMMANDS = (
    "megastep train experiment=quickstart samples=1e6 folder=runs/tried",
    "megastep evaluate run=runs/tried episodes=64",
    "megastep record run=runs/tried file=runs/film.gif",
)


def run(command: str, runs: str) -> int:
    """Runs a command in a container of its own. Returns its exit code."""
    print(f"$ {command}", flush=True)
    words = ["buildah", "from", "--pull-never", "megastep"]
    container = subprocess.check_output(words, text=True).strip()
    words = ["unshare", "--net", "buildah", "run", f"--user={USER}:{USER}"]
    words += [f"--volume={runs}:/megastep/runs", container, "--", *shlex.split(command)]
    code = subprocess.run(words).returncode
    subprocess.run(["buildah", "rm", container], check=True)
    return code


def main() -> int:
    os.environ.setdefault("BUILDAH_ISOLATION", "chroot")  # no daemon, and no other program
    subprocess.run(["buildah", "build", "--layers", "--tag=megastep", str(ROOT)], check=True)
    with tempfile.TemporaryDirectory(prefix="image-") as runs:
        os.chown(runs, USER, USER)
        return next((code for command in COMMANDS if (code := run(command, runs))), 0)


if __name__ == "__main__":
    raise SystemExit(main())
