"""Runs the lines of the Dockerfile without Docker, then the image's command without a network.

    python scripts/check_dockerfile.py --python PYTHON -- train env=minimal geometry=box samples=1e5

The clean root is this machine's file system below a layer that is thrown away (overlayfs), with
empty /root, /tmp, /home and /usr/local, Python in the latter, and an empty environment. So the
machine stands in for the base image: it should have its Debian release, and `--python` its minor
version. Needs Linux and root. The exit code is that of the first line that fails, else of the
image's command.
"""

import argparse
import fnmatch
import json
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
#: The environment of the base image.
BASE_ENV = {"PATH": "/usr/local/bin:/usr/bin:/bin:/usr/sbin:/sbin", "LANG": "C.UTF-8"}
#: Folders of this machine that the image must not see.
HIDDEN = "root", "tmp", "home", "usr/local"


def instructions(dockerfile: str) -> list[list[str]]:
    """Returns the instructions of a Dockerfile: [name, the rest of the line]."""
    text = re.sub(r"^#.*\n", "", dockerfile, flags=re.MULTILINE).replace("\\\n", " ")
    return [line.split(maxsplit=1) for line in text.splitlines() if line.strip()]


class Image:
    """An image that follows instructions.

    Args:
        root: folder that becomes its file system.
        build_args: values of ARG that replace the defaults.
    """

    def __init__(self, root: Path, build_args: dict[str, str]):
        self.root, self.build_args, self.args = root, build_args, {}
        self.env, self.user, self.folder, self.command = dict(BASE_ENV), "root", "/", {}

    def run(self, words: list[str], user: str | None = None, wrapper: tuple[str, ...] = ()) -> int:
        """Runs a command with the image's environment alone. Returns the exit code."""
        env = [f"{name}={value}" for name, value in {**self.env, **self.args}.items()]
        script = f'cd {shlex.quote(self.folder)} && exec "$@"'
        enter = ["chroot", f"--userspec={user or self.user}", str(self.root), "env", "-i", *env]
        return subprocess.run([*wrapper, *enter, "sh", "-c", script, "sh", *words]).returncode

    def follow(self, name: str, rest: str) -> None:
        """Follows an instruction. Exits if its command fails or it is an unknown one."""
        print(f"{name} {rest}", flush=True)
        if name == "RUN":
            if code := self.run(["sh", "-c", rest]):
                raise SystemExit(code)
        elif name == "ARG":
            key, _, default = rest.partition("=")
            self.args[key] = self.build_args.get(key, default.strip('"'))
        elif name == "ENV":
            self.env |= dict(word.split("=", 1) for word in shlex.split(rest))
        elif name == "WORKDIR":
            self.folder = rest
            (self.root / rest.lstrip("/")).mkdir(parents=True, exist_ok=True)
        elif name == "COPY":
            copy(rest.split()[0], self.root / self.folder.lstrip("/"))
        elif name == "USER":
            self.user = rest
        elif name in ("ENTRYPOINT", "CMD"):
            self.command[name] = json.loads(rest)
        elif name not in ("FROM", "VOLUME"):
            raise SystemExit(f"{name} is an instruction that check_dockerfile.py does not know")


def copy(source: str, folder: Path) -> None:
    """Copies files of the repository as COPY does, without what .dockerignore names."""
    ignored = (ROOT / ".dockerignore").read_text().split()
    listing = ["git", "ls-files", "--cached", "--others", "--exclude-standard", source]
    for name in subprocess.check_output(listing, cwd=ROOT, text=True).splitlines():
        if not any(fnmatch.fnmatch(Path(name).parts[0], pattern) for pattern in ignored):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name, follow_symlinks=False)


def mount(*words: object) -> None:
    subprocess.run(["mount", *map(str, words)], check=True)


def mount_root(scratch: Path, python: str) -> Path:
    """Mounts a clean root in a folder, with a copy of a Python in /usr/local. Returns the root."""
    root, layer, work = (scratch / name for name in ("root", "layer", "work"))
    for folder in (root, layer, work):
        folder.mkdir()
    mount("-t", "overlay", "overlay", "-o", f"lowerdir=/,upperdir={layer},workdir={work}", root)
    for name in ("proc", "dev", "sys"):
        mount("--rbind", f"/{name}", root / name)
    for name in HIDDEN:
        (hidden := scratch / "hidden" / name).mkdir(parents=True)
        hidden.chmod(0o1777 if name == "tmp" else 0o755)
        mount("--bind", hidden, root / name)
    facts = "import sys; print(sys.base_prefix); print('python%d.%d' % sys.version_info[:2])"
    prefix, version = subprocess.check_output([python, "-c", facts], text=True).splitlines()
    local, prefix = root / "usr/local", Path(prefix)
    (local / "bin").mkdir()
    shutil.copy2(prefix / "bin" / version, local / "bin")
    for name in ("python", "python3"):
        (local / "bin" / name).symlink_to(version)
    left_out = shutil.ignore_patterns("*-packages", "test", "__pycache__")
    shutil.copytree(prefix / "lib" / version, local / "lib" / version, ignore=left_out)
    for library in (prefix / "lib").glob("libpython3*.so*"):
        shutil.copy2(library, local / "lib", follow_symlinks=False)
    return root


def check(scratch: Path, options: argparse.Namespace) -> int:
    """Builds the image and runs its command in it. Returns the exit code."""
    root = mount_root(scratch, options.python)
    image = Image(root, dict(word.split("=", 1) for word in options.build_arg))
    image.follow("RUN", "ldconfig && python -m ensurepip && ln -s pip3 /usr/local/bin/pip")
    for name, rest in instructions((ROOT / "Dockerfile").read_text()):
        image.follow(name, rest)
    image.args.clear()  # ARG is for building only
    words = [*image.command["ENTRYPOINT"], *(options.command or image.command["CMD"])]
    print("Without a network:", *words, flush=True)
    return image.run(words, options.user, ("unshare", "--net"))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--python", default=sys.executable, help="stands for the base image's")
    parser.add_argument("--build-arg", action="append", default=[], help="as of docker build")
    parser.add_argument("--user", help="as of docker run; the image's user by default")
    parser.add_argument("--scratch", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("command", nargs="*", help="after --, replaces the image's command")
    options = parser.parse_args()
    if options.scratch:
        return check(options.scratch, options)
    with tempfile.TemporaryDirectory(prefix="image-") as scratch:  # mounts end with the process
        again = [sys.executable, __file__, f"--scratch={scratch}", *sys.argv[1:]]
        return subprocess.run(["unshare", "--mount", *again]).returncode


if __name__ == "__main__":
    raise SystemExit(main())
