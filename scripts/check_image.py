"""Builds the image of the Dockerfile with buildah and tries it: as a user whom it does not know,
without a network, with a mounted `runs`.

    python scripts/check_image.py --tag megastep
    python scripts/check_image.py --stand-in --torch torch==2.13.0

Prints the size of each layer, then what the commands in the image print. The exit code is that of
the first that fails. Needs Linux, root and Debian's `buildah`. Where no registry can be reached,
`--stand-in` makes a base image with `debootstrap`: Debian 12, whose Python is of the same minor
version, with this machine's certificates and settings of apt and pip.
"""

import argparse
import json
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
#: What the stand-in for the base image has, beside the smallest Debian.
PACKAGES = "python3,python3-pip,python3-venv,python3-dev,ca-certificates"
MIRROR = "http://deb.debian.org/debian"
#: Files of this machine that the stand-in gets, where they exist.
SETTINGS = "etc/ssl/certs/ca-certificates.crt", "etc/pip.conf"
#: A user whom the image does not know.
USER = "4321:4321"
RUN = "runs/tried"
#: Commands run in a plain chroot: no daemon and no other program is needed.
ISOLATION = "BUILDAH_ISOLATION", "chroot"
#: Packages that the image must not have.
UNWANTED = "clang-format", "coverage", "hypothesis", "pyright", "pytest", "ruff", "sphinx"
#: Where the Dockerfile has the source while it installs the package.
SOURCES = "/source", "/tmp/megastep"
#: Commands in the image. The quickstart evaluates and films by itself, too.
COMMANDS = (
    f"megastep train experiment=quickstart samples={{samples}} folder={RUN}",
    f"megastep evaluate run={RUN} episodes=64",
    f"megastep record run={RUN} file=runs/film.gif",
    "megastep reproduce {row}",
)


class Builder:
    """buildah with a store of images in a folder; default: its own."""

    def __init__(self, store: Path | None):
        self.options = [f"--root={store}/images", f"--runroot={store}/run"] if store else []

    def words(self, *words: object) -> list[str]:
        return ["buildah", *self.options, *map(str, words)]

    def call(self, *words: object) -> str:
        """Returns what a command prints. Exits with its code if it fails."""
        done = subprocess.run(self.words(*words), stdout=subprocess.PIPE, text=True)
        if done.returncode:
            raise SystemExit(done.returncode)
        return done.stdout.strip()


def problem() -> str | None:
    """Returns why no image can be built here, as a sentence; None if one can."""
    if missing := [name for name in ("buildah", "debootstrap") if shutil.which(name) is None]:
        return f"Building an image needs Debian's {missing[0]}."
    return None if os.geteuid() == 0 else "Building an image needs root."


def make_base(builder: Builder, folder: Path) -> str:
    """Makes the stand-in for the base image. Returns its name."""
    subprocess.run(
        ["debootstrap", "--variant=minbase", f"--include={PACKAGES}", "bookworm", folder, MIRROR],
        stdout=sys.stderr,
        check=True,
    )
    (folder / "usr/bin/python").symlink_to("python3")
    for path in folder.glob("usr/lib/python3*/EXTERNALLY-MANAGED"):
        path.unlink()  # pip may install what it likes, as in the real one
    for name in SETTINGS:
        if Path("/", name).exists():
            shutil.copy2(Path("/", name), folder / name)
    if links := os.environ.get("PIP_FIND_LINKS"):
        with open(folder / "etc/pip.conf", "a") as file:
            file.write(f"[install]\nfind-links = {links}\n")
    container = builder.call("from", "scratch")
    builder.call("copy", "--quiet", container, folder, "/")
    path = "/usr/local/bin:/usr/bin:/bin:/usr/sbin:/sbin"
    builder.call("config", f"--env=PATH={path}", "--env=LANG=C.UTF-8", container)
    builder.call("commit", "--quiet", "--rm", container, "stand-in")
    return "localhost/stand-in"


def build(builder: Builder, tag: str, base: str | None, torch: str | None) -> None:
    """Builds the image of the Dockerfile. None for an argument keeps the Dockerfile's."""
    arguments = {"BASE": base, "TORCH": torch}
    words = [f"--build-arg={name}={text}" for name, text in arguments.items() if text]
    if (links := os.environ.get("PIP_FIND_LINKS", "")).startswith("/"):
        words.append(f"--volume={links}:{links}:ro")
    command = builder.words("build", "--layers", *words, f"--tag={tag}", ROOT)
    if code := subprocess.run(command, stdout=sys.stderr).returncode:
        raise SystemExit(code)


def layers(builder: Builder, tag: str, folder: Path) -> list[tuple[int, str]]:
    """Returns the bytes of each layer, not compressed, and the instruction that made it."""
    builder.call("push", "--quiet", "--disable-compression", tag, f"dir:{folder}")
    manifest = json.loads((folder / "manifest.json").read_text())
    config = json.loads((folder / manifest["config"]["digest"].partition(":")[2]).read_text())
    history = [step for step in config["history"] if not step.get("empty_layer")]
    made_by = [step.get("created_by", "").replace("/bin/sh -c ", "") for step in history]
    return [*zip((layer["size"] for layer in manifest["layers"]), made_by, strict=True)]


def run(builder: Builder, tag: str, command: str, runs: Path) -> tuple[int, str]:
    """Runs a command in a container of its own. Returns its exit code and all that it prints."""
    print(f"$ {command}", flush=True)
    container = builder.call("from", "--pull-never", tag)
    words = "run", f"--user={USER}", f"--volume={runs}:/megastep/runs", container, "--"
    process = subprocess.Popen(
        ["unshare", "--net", *builder.words(*words, *shlex.split(command))],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    lines = []
    assert process.stdout is not None
    for line in process.stdout:
        print(line, end="", flush=True)
        lines.append(line)
    code = process.wait()
    builder.call("rm", container)
    return code, "".join(lines)


def check(builder: Builder, tag: str, folder: Path, samples: float, row: str) -> int:
    """Tries the image. Returns the exit code of the first command that fails, 0 if none does."""
    runs = folder / "runs"
    runs.mkdir()
    os.chown(runs, *map(int, USER.split(":")))
    find = "from importlib.metadata import distributions as all\nfrom pathlib import Path\n"
    find += f"print(*{{one.name for one in all()}} & {{*{UNWANTED!r}}})\n"
    find += f"print(*(path for path in map(Path, {SOURCES!r}) if path.exists()))"
    code, text = run(builder, tag, f"python -c {shlex.quote(find)}", runs)
    if code or text.split():
        print(f"The image has packages that only tests need, or the source: {text}")
        return code or 1
    for command in COMMANDS:
        code, text = run(builder, tag, command.format(samples=f"{samples:g}", row=row), runs)
        if "the cache is not used" in text:
            return 1
        if code:
            return code
    return 0


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n\n")[0])
    parser.add_argument("--tag", default="megastep", help="name of the image")
    parser.add_argument("--stand-in", action="store_true", help="makes a base image")
    parser.add_argument("--torch", help="what pip installs as PyTorch, such as torch==2.13.0")
    parser.add_argument("--store", type=Path, help="folder for images; default: buildah's own")
    parser.add_argument("--samples", type=float, default=1e6, help="of the quickstart")
    parser.add_argument("--row", default="pong-cpu-1.5m", help="a result to reproduce")
    options = parser.parse_args()
    os.environ.setdefault(*ISOLATION)
    builder = Builder(options.store)
    with tempfile.TemporaryDirectory(prefix="image-") as scratch:
        folder = Path(scratch)
        base = make_base(builder, folder / "base") if options.stand_in else None
        build(builder, options.tag, base, options.torch)
        (folder / "layers").mkdir()
        rows = layers(builder, options.tag, folder / "layers")
        shutil.rmtree(folder / "layers")
        for size, made_by in [*rows, (sum(size for size, _ in rows), "in all")]:
            print(f"{size / 1e6:8.1f} MB  {' '.join(made_by.split())[:90]}", flush=True)
        return check(builder, options.tag, folder, options.samples, options.row)


if __name__ == "__main__":
    raise SystemExit(main())
