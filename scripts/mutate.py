"""Makes small faults in the code, one at a time, and counts those that the tests find.

    python scripts/mutate.py --n 200 --seed 1

A mutant is one changed operator, condition, number or return value, or one dropped statement or
keyword; a fifth are in kernels' headers, whose mutants are compiled. On each, in a copy of the
checkout, the tests run that execute its line: first those of its folder, then others, the fastest
first, up to --seconds. So a mutant that only a long test elsewhere finds counts as survived. Which
tests execute a line is recorded once, in a run of all fast tests that must pass.

A mutant is named by a digest of its file, its line's text and its fault, so edits elsewhere do not
change its name or its place in the seeded order. docs/lab/equivalent_mutants.jsonl lists those that
no test can find. Libraries of this kind, mutmut and Cosmic Ray, change Python only.
"""

import argparse
import ast
import collections
import concurrent.futures
import hashlib
import itertools
import json
import os
import queue
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

from mutation import executed_lines

ROOT = Path(__file__).resolve().parents[1]
EQUIVALENT = ROOT / "docs" / "lab" / "equivalent_mutants.jsonl"
PYTHON = [f"agents/{name}" for name in "algorithms networks runs storage training selfplay".split()]
PYTHON += [f"megastep/{name}" for name in "capture.py modules envs geometries engine".split()]
#: Ends although a thread that a failed test left still runs. Modules of the current folder do not
#: come before those of Python, which a test is about.
PYTEST = (
    "import os, sys; sys.path.remove(''); import pytest; status = pytest.main(); "
    "sys.stdout.flush(); os._exit(status)"
)
#: Seconds: a mutant may run for ever. The same tests without it take a tenth.
MIN_TIMEOUT, TIMEOUT_FACTOR = 300, 10

SWAPS = {"<": "<=", "<=": "<", ">": ">=", ">=": ">", "==": "!=", "!=": "==", "+": "-", "-": "+"}
SWAPS |= {"*": "/", "/": "*", "//": "*", "%": "*", "**": "*", "|": "&", "&": "|"}
SWAPS |= {"and": "or", "or": "and", "&&": "||", "||": "&&"}
SWAPS |= {"is": "is not", "is not": "is", "in": "not in", "not in": "in"}
OPERATOR = re.compile(r"is\s+not|not\s+in|\b(?:is|in|and|or)\b|<<|>>|\*\*|//|[<>=!]=|[-<>+*/%|&^@]")
#: In headers, formatters put blanks around binary operators and around nothing that looks like one.
HEADER_SITE = re.compile(
    r"(?<= )(?:[<>=!]=|&&|\|\||[-<>+*/%])(?= )|(?<![\w.])\d+(?:\.\d*f)?(?![\w.])"
)
HEADER_NOT_CODE = re.compile(r'//.*|/\*[\s\S]*?\*/|"[^"\n]*"|^#.*', re.M)


# ---- Mutants ----


class Mutant(NamedTuple):
    """A fault: in the file at `path`, `after` replaces `before` at `start`.

    `lines` are the first and last of the statement, from 1. The name of equal faults in equal lines
    is the same but for their number.
    """

    path: str
    start: int
    before: str
    after: str
    lines: tuple[int, int]
    name: str
    fault: str

    def __str__(self):
        return f"{self.name} {self.path}:{self.lines[0]}: {self.fault}"

    def text(self, original: str) -> str:
        """Returns the file's text with the fault."""
        return original[: self.start] + self.after + original[self.start + len(self.before) :]


def mutants_of(path: str, text: str) -> list[Mutant]:
    """Returns all mutants of a file."""
    sites = _Sites(text).found if path.endswith(".py") else _header_sites(text)
    mutants, copies, rows = [], collections.Counter(), text.splitlines()
    for start, before, after, lines in sites:
        line = rows[text.count("\n", 0, start)].strip()
        fault = " ".join(f"{before} -> {after or 'nothing'}: {line}".split())
        name = hashlib.sha256(f"{path}: {fault}: {copies[fault]}".encode()).hexdigest()[:12]
        copies[fault] += 1
        mutants.append(Mutant(path, start, before, after, lines, name, fault))
    return mutants


def _header_sites(text):
    code = HEADER_NOT_CODE.sub(lambda match: re.sub(r"\S", "_", match[0]), text)
    for match in HEADER_SITE.finditer(code):
        before, line = match[0], code.count("\n", 0, match.start()) + 1
        is_float = before.endswith("f")
        other = f"{2 * float(before[:-1]) or 1.0}f" if is_float else f"{before}+1"
        yield match.start(), before, SWAPS.get(before) or other, (line, line)


class _Sites(ast.NodeVisitor):
    """Lists (start, before, after, lines) of a Python file's faults.

    Imports, annotations, decorators, texts and asserts have none.
    """

    def __init__(self, text):
        self.text, self.found, self.lines = text, [], (1, 1)
        rows = text.splitlines(keepends=True)
        starts = [0, *itertools.accumulate(map(len, rows))]
        # ast counts bytes
        self.offset = lambda line, n: starts[line - 1] + len(rows[line - 1].encode()[:n].decode())
        self.visit(ast.parse(text))

    def add(self, node, after, end=None):
        start = self.offset(node.lineno, node.col_offset)
        end = end or self.offset(node.end_lineno, node.end_col_offset)
        self.found.append((start, self.text[start:end], after, self.lines))

    def swap(self, left, right):
        """Swaps the operator between two nodes."""
        start = self.offset(left.end_lineno, left.end_col_offset)
        match = OPERATOR.search(self.text, start, self.offset(right.lineno, right.col_offset))
        if match and (after := SWAPS.get(" ".join(match[0].split()))):
            self.found.append((match.start(), match[0], after, self.lines))

    def visit(self, node):
        if isinstance(node, ast.stmt):
            body = getattr(node, "body", None)
            last = max(node.lineno, body[0].lineno - 1) if body else node.end_lineno
            self.lines = node.lineno, last
        super().visit(node)

    def visit_FunctionDef(self, node):
        for part in (*node.args.defaults, *filter(None, node.args.kw_defaults), *node.body):
            self.visit(part)

    def visit_Import(self, node):
        pass

    visit_ImportFrom = visit_Assert = visit_JoinedStr = visit_Import

    def visit_AnnAssign(self, node):
        if node.value:
            self.visit(node.value)

    def visit_Raise(self, node):
        self.add(node, "pass")

    def visit_Expr(self, node):
        if not isinstance(node.value, ast.Constant):
            self.add(node, "pass")
            self.visit(node.value)

    def visit_AugAssign(self, node):
        self.add(node, "pass")
        self.visit(node.value)

    def visit_Return(self, node):
        if node.value:
            self.add(node.value, "None")
            self.visit(node.value)

    def visit_If(self, node):
        if "TYPE_CHECKING" not in ast.unparse(node.test):
            self.add(node.test, "True")
            self.add(node.test, "False")
            self.generic_visit(node)

    visit_IfExp = visit_If

    def visit_Compare(self, node):
        for left, right in zip([node.left, *node.comparators], node.comparators):
            self.swap(left, right)
        self.generic_visit(node)

    def visit_BoolOp(self, node):
        for left, right in itertools.pairwise(node.values):
            self.swap(left, right)
        self.generic_visit(node)

    def visit_BinOp(self, node):
        self.swap(node.left, node.right)
        self.generic_visit(node)

    def visit_Constant(self, node):
        if isinstance(node.value, bool):
            self.add(node, str(not node.value))
        elif isinstance(node.value, int):
            self.add(node, str(node.value + 1))
        elif isinstance(node.value, float) and not 0 < node.value < 1e-4:  # which guards a divisor
            self.add(node, str(2 * node.value or 1.0))

    def visit_Call(self, node):
        for keyword in node.keywords:
            if keyword.arg:
                end = self.offset(keyword.end_lineno, keyword.end_col_offset)
                self.add(keyword, "", re.compile(r",?\s*").match(self.text, end).end())
        self.generic_visit(node)


def in_order(files: dict[str, str], seed: int):
    """Yields one mutant of each line that has any, in an order of which each start is a sample."""

    def order(mutant):
        return hashlib.sha256(f"{seed} {mutant.name}".encode()).digest()

    by_line = collections.defaultdict(list)
    for path, text in files.items():
        for mutant in mutants_of(path, text):
            by_line[path, text.count("\n", 0, mutant.start)].append(mutant)
    for mutant in sorted((min(mutants, key=order) for mutants in by_line.values()), key=order):
        if not mutant.path.endswith(".py") or _is_another_program(mutant, files[mutant.path]):
            yield mutant


def _is_another_program(mutant, original):
    try:
        return ast.dump(ast.parse(mutant.text(original))) != ast.dump(ast.parse(original))
    except SyntaxError:
        return False


def choose(n: int, seed: int, folders: list[str]) -> list[Mutant]:
    """Returns n mutants: four of Python, then one of a kernel, and so on."""

    def files_in(parts, suffix):
        """Those of a kind, except those that only a GPU runs."""
        paths = [ROOT / part for part in parts]
        paths = [path for one in paths for path in ([one] if one.is_file() else one.rglob("*"))]
        return {
            str(path.relative_to(ROOT)): path.read_text()
            for path in sorted(paths)
            if path.suffix == suffix and "cuda" not in path.name
        }

    python = in_order(files_in(folders or PYTHON, ".py"), seed)
    headers = in_order(files_in(folders or ["megastep", "agents"], ".h"), seed)
    chosen = (next(headers if i % 5 == 4 else python, None) for i in range(n))
    return [mutant for mutant in chosen if mutant]


# ---- Tests ----


def tests_of(mutant, lines, seconds, limit=float("inf")):
    """Returns files of tests to run on a mutant in turn: ([near ones], [others]). The others are
    the fastest that together take `limit` seconds.
    """
    executing, (first, last) = lines.get(mutant.path, {}), mutant.lines
    tests = {test for line in range(first, last + 1) for test in executing.get(line, ())}
    if not tests and any(line in executing for line in range(first, last + 1)):
        tests = {test for each in executing.values() for test in each}  # it runs at import
    _, *folders, name = Path(mutant.path).parts
    rooms = [Path("tests", *folders[:1])]
    if folders[:1] == ["kernels"] and folders[1:2] != ["build"]:
        rooms.append(Path("tests/engine"))  # what the engine's kernels compute
    if not tests:  # a kernel, or nothing executes it in the tests' own process
        paths = [path for room in rooms for path in (ROOT / room).glob("test_*.py")]
        tests = {str(path.relative_to(ROOT)) for path in paths}
    names = {Path(name).stem, *folders[1:]}

    def is_near(test):
        is_named = any(part in Path(test).stem for part in names)
        return is_named or bool(executing) and Path(test).parent in rooms

    near = sorted(filter(is_near, tests), key=lambda test: seconds.get(test, 0.0))
    others = sorted(tests - {*near}, key=lambda test: seconds.get(test, 0.0))
    totals = itertools.accumulate(seconds.get(test, 0.0) for test in others)
    return near, [test for test, total in zip(others, totals) if total <= limit]


def copied(folder):
    """Copies the files of the checkout, without what git ignores. Returns the folder."""
    listing = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    for name in subprocess.check_output(listing, cwd=ROOT, text=True).splitlines():
        if os.path.lexists(ROOT / name):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name, follow_symlinks=False)
    return folder


def run_tests(folder, tests, *options, timeout=None):
    """Runs tests in a copy. Returns (status, output); the status is None after a timeout."""
    paths = [str(folder), str(folder / "scripts"), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    environment |= {"PYTHONDONTWRITEBYTECODE": "1"}
    environment |= {"MEGASTEP_CACHE": str(folder.parent / "cache"), "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(
        [sys.executable, "-c", PYTEST, "-q", "-x", "-p", "no:cacheprovider", *options, *tests],
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    try:
        output, _ = process.communicate(timeout=timeout)
    except subprocess.TimeoutExpired:
        output = None
    try:
        os.killpg(process.pid, signal.SIGKILL)  # also what its tests left running
    except ProcessLookupError:
        pass
    process.wait()
    return (None, "") if output is None else (process.returncode, output)


def result_of(mutant, folder, lines, seconds, limit):
    """Returns "caught", "timeout" or "survived"."""
    path = folder / mutant.path
    original = path.read_text()
    path.write_text(mutant.text(original))
    try:
        for tests in filter(None, tests_of(mutant, lines, seconds, limit)):
            timeout = TIMEOUT_FACTOR * sum(seconds.get(test, 0.0) for test in tests)
            status, _ = run_tests(folder, tests, "-n0", timeout=max(MIN_TIMEOUT, timeout))
            if status is None:
                return "timeout"
            if status not in (0, 5):  # 5: all of them need a GPU, or are slow
                return "caught"
    finally:
        path.write_text(original)
    return "survived"


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folders", nargs="*", help="files or folders to make faults in")
    parser.add_argument("--n", type=int, default=200, help="number of mutants")
    parser.add_argument("--seed", type=int, default=1, help="of the sample")
    parser.add_argument("--jobs", type=int, default=1, help="mutants tested at a time")
    parser.add_argument("--seconds", type=float, default=60, help="of tests of other folders")
    parser.add_argument("--lines", type=Path, help="folder that keeps which lines tests execute")
    options = parser.parse_args()
    sample = choose(options.n, options.seed, options.folders)
    rows = EQUIVALENT.read_text().splitlines() if EQUIVALENT.exists() else []
    equivalent, counts = {json.loads(row)["name"] for row in rows}, collections.Counter()

    with tempfile.TemporaryDirectory(prefix="mutants-") as base:
        base, copies = Path(base), queue.Queue()
        (base / "cache").mkdir(mode=0o700)
        for job in range(options.jobs):
            copies.put(copied(base / str(job)))
        record = options.lines or base / "lines"
        if not record.exists():
            record.mkdir(parents=True)
            plugin = "-p", "mutation.executed_lines", f"--executed-lines={record}"
            status, output = run_tests(base / "0", [], f"-n{options.jobs}", *plugin)
            if status:
                shutil.rmtree(record)
                sys.exit(f"The tests fail without any fault:\n{output[-3000:]}")
        seconds, lines = executed_lines.read(record)

        def test(mutant):
            folder = copies.get()
            result = result_of(mutant, folder, lines, seconds, options.seconds)
            copies.put(folder)
            counts[result] += 1
            print(f"{result:8} {mutant}", flush=True)

        with concurrent.futures.ThreadPoolExecutor(options.jobs) as pool:
            [*pool.map(test, [mutant for mutant in sample if mutant.name not in equivalent])]
    caught = counts["caught"] + counts["timeout"]
    decided = caught + counts["survived"]
    print(f"{caught} of {decided} mutants were caught: {caught / max(decided, 1):.1%}")


if __name__ == "__main__":
    main()
