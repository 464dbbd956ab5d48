"""Makes small faults in the code, one at a time, and prints those that the tests do not find.

    python scripts/mutants.py 30 --seed 1

A mutant is one changed comparison, operator or number, a third of them in kernels. The fast tests
of its folder are run on it, in a copy of the checkout. Libraries of this kind, mutmut and Cosmic
Ray, change Python only.
"""

import argparse
import concurrent.futures
import itertools
import os
import queue
import random
import re
import resource
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
SWAPS = {"<": "<=", "<=": "<", ">": ">=", ">=": ">", "==": "!=", "!=": "==", "+": "-", "-": "+"}
SWAPS |= {"*": "/", "/": "*", "//": "*", "%": "*", "and": "or", "or": "and", "&&": "||", "||": "&&"}
#: Formatters put blanks around binary operators, and around nothing else that looks like one.
SITE = re.compile(
    r"(?<= )(?:[<>=!]=|//|&&|\|\||and|or|[-<>+*/%])(?= )|(?<![\w.])\d+(?:\.\d+)?(?!\w)"
)
NOT_CODE = {
    ".py": re.compile(r'"""[\s\S]*?"""|"(?:\\.|[^"\\\n])*"|#.*|^(?:from|import) .*', re.M),
    ".h": re.compile(r'//.*|/\*[\s\S]*?\*/|"[^"\n]*"|^#.*', re.M),
}
#: CPU seconds, many times what a folder's tests take: a mutant may run for ever.
MAX_SECONDS = 1800


class Mutant(NamedTuple):
    path: Path  # in the checkout
    start: int
    before: str
    after: str

    def __str__(self):
        text = (ROOT / self.path).read_text()
        row = text.count("\n", 0, self.start)
        line = text.splitlines()[row].strip()
        return f"{self.path}:{row + 1}: {self.before} -> {self.after}: {line}"

    def write(self, folder):
        text = (ROOT / self.path).read_text()
        end = self.start + len(self.before)
        (folder / self.path).write_text(text[: self.start] + self.after + text[end:])


def mutants_of(path):
    """Returns all mutants of one file."""
    text = (ROOT / path).read_text()
    code = NOT_CODE[path.suffix].sub(lambda match: re.sub(r"\S", "_", match[0]), text)
    found = []
    for match in SITE.finditer(code):
        before = match[0]
        number = f"{float(before) * 2 or 1.0}" if "." in before else f"{before}1"
        number = str(int(before) + 1) if before.isdigit() else number
        found.append(Mutant(path, match.start(), before, SWAPS.get(before, number)))
    return found


def choose(n, seed):
    """Returns n mutants: a third of them of kernels, the others of Python."""
    folders = [ROOT / "megastep", ROOT / "agents"]
    chosen = []
    for suffix, share in ((".h", n // 3), (".py", n - n // 3)):
        files = sorted(path for folder in folders for path in folder.rglob(f"*{suffix}"))
        files = [path.relative_to(ROOT) for path in files if "cuda" not in path.name]
        everything = [mutant for path in files for mutant in mutants_of(path)]
        chosen += random.Random(seed).sample(everything, share)
    return chosen


def tests_of(path):
    """Returns the tests of a file's folder, the file's own first."""
    _, *folders, _ = path.parts
    if not folders:
        named = [f"tests/test_{path.stem}.py"]
        return [name for name in named if (ROOT / name).exists()] or ["tests/envs", "tests/modules"]
    room = f"tests/{folders[0]}"
    if folders[0] == "kernels" and "build" not in folders:
        room = "tests/engine"  # what the engine's kernels compute
    names = {path.stem, *folders[1:]}
    own = [p for name in sorted(names) for p in sorted((ROOT / room).glob(f"test_*{name}*.py"))]
    return [*(str(p.relative_to(ROOT)) for p in own), room]


def copied(folder):
    """Copies the files of the checkout, without what git ignores. Returns the folder."""
    listing = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    for name in subprocess.check_output(listing, cwd=ROOT, text=True).splitlines():
        if os.path.lexists(ROOT / name):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name, follow_symlinks=False)
    return folder


def tested(folder, cache, tests, *options):
    """Runs tests in a copy. Returns (whether they passed, what they wrote)."""
    process = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *options, *tests],
        cwd=folder,
        env={**os.environ, "MEGASTEP_CACHE": str(cache), "PYTHONDONTWRITEBYTECODE": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (MAX_SECONDS, MAX_SECONDS)),
    )
    return process.returncode == 0, process.stdout


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("n", type=int, help="number of mutants")
    parser.add_argument("--seed", type=int, default=1, help="of the choice")
    parser.add_argument("--jobs", type=int, default=1, help="mutants tested at a time")
    options = parser.parse_args()
    mutants = choose(options.n, options.seed)
    with tempfile.TemporaryDirectory(prefix="mutants-") as base:
        base, copies = Path(base), queue.Queue()
        for job in range(options.jobs):
            copies.put(copied(base / str(job)))
        cache = base / "cache"
        cache.mkdir(mode=0o700)
        every = sorted({*itertools.chain(*(tests_of(mutant.path) for mutant in mutants))})
        passed, output = tested(base / "0", cache, every, f"-n{options.jobs}")
        if not passed:
            sys.exit(f"The tests fail without any fault:\n{output[-3000:]}")

        def is_caught(mutant):
            folder = copies.get()
            mutant.write(folder)
            passed, _ = tested(folder, cache, tests_of(mutant.path), "-n0")
            shutil.copy2(ROOT / mutant.path, folder / mutant.path)
            copies.put(folder)
            print(f"{'SURVIVES' if passed else 'caught  '} {mutant}", flush=True)
            return not passed

        with concurrent.futures.ThreadPoolExecutor(options.jobs) as pool:
            caught = sum(pool.map(is_caught, mutants))
    print(f"{caught} of {options.n} mutants of seed {options.seed} were caught")


if __name__ == "__main__":
    main()
