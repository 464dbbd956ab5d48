"""Makes small faults in the code, one at a time, and counts those that the tests find.

    python scripts/mutate.py --n 200 --seed 1

A mutant is one changed operator, condition, number or return value, or one dropped statement, call
or keyword; a fifth are in kernels' headers, whose mutants are compiled. On each, in a copy of the
checkout, the tests run that execute its line: first those of its folder, then others, the fastest
first, up to --seconds. So a mutant that only a long test elsewhere finds counts as survived. Which
tests execute a line is recorded once, in a run of all fast tests that must pass.

With --results FILE, results are appended to a file of JSON lines, and mutants that it says were
caught are left out: after writing tests a second call runs the survivors, and a longer sample
continues a shorter one. docs/lab/equivalent_mutants.jsonl lists mutants that no test can find, with
the reason, as two readers judged them.

Libraries of this kind, mutmut and Cosmic Ray, change Python only.
"""

import argparse
import collections
import concurrent.futures
import itertools
import json
import os
import queue
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from mutation import executed_lines, mutants

ROOT = mutants.ROOT
EQUIVALENT = ROOT / "docs" / "lab" / "equivalent_mutants.jsonl"
PYTHON = [f"agents/{name}" for name in "algorithms networks runs storage training selfplay".split()]
PYTHON += [f"megastep/{name}" for name in "capture.py modules envs geometries engine".split()]
HEADERS = ["megastep", "agents"]
#: Ends although a thread that a failed test left still runs. Modules of the current folder do not
#: come before those of Python, which a test is about.
PYTEST = (
    "import os, sys; sys.path.remove(''); import pytest; status = pytest.main(); "
    "sys.stdout.flush(); os._exit(status)"
)
#: Seconds: a mutant may run for ever. The same tests without it take a tenth.
MIN_TIMEOUT, TIMEOUT_FACTOR = 300, 10


def files_in(folders, suffix):
    """Returns the files of a kind, except those that only a GPU runs."""
    paths = [ROOT / folder for folder in folders]
    paths = [path for each in paths for path in ([each] if each.is_file() else each.rglob("*"))]
    return sorted(
        str(path.relative_to(ROOT))
        for path in paths
        if path.suffix == suffix and "cuda" not in path.name
    )


def choose(n, seed, folders):
    """Returns n mutants: four of Python, then one of a kernel, and so on."""
    python = mutants.in_order(files_in(folders or PYTHON, ".py"), seed)
    headers = mutants.in_order(files_in(folders or HEADERS, ".h"), seed)
    chosen = (next(headers if i % 5 == 4 else python, None) for i in range(n))
    return [mutant for mutant in chosen if mutant]


def tests_of(mutant, lines, seconds, limit=float("inf")):
    """Returns files of tests to run on a mutant in turn: ([near ones], [others]). The others are
    the fastest that together take `limit` seconds.
    """
    executing = lines.get(mutant.path, {})
    first, last = mutant.lines
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

    def duration(test):
        return seconds.get(test, 0.0)

    near = sorted(filter(is_near, tests), key=duration)
    others = sorted(tests - {*near}, key=duration)
    totals = itertools.accumulate(map(duration, others))
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


def record_lines(folder, into, jobs):
    """Runs all fast tests and records which lines they execute."""
    into.mkdir(parents=True)
    status, output = run_tests(
        folder, [], f"-n{jobs}", "-p", "mutation.executed_lines", f"--executed-lines={into}"
    )
    if status:
        shutil.rmtree(into)
        sys.exit(f"The tests fail without any fault:\n{output[-3000:]}")


def result_of(mutant, folder, lines, seconds, limit):
    """Returns "caught", "timeout" or "survived", and the test that failed."""
    path = folder / mutant.path
    original = path.read_text()
    path.write_text(mutant.text())
    try:
        for tests in filter(None, tests_of(mutant, lines, seconds, limit)):
            timeout = TIMEOUT_FACTOR * sum(seconds.get(test, 0.0) for test in tests)
            status, output = run_tests(folder, tests, "-n0", timeout=max(MIN_TIMEOUT, timeout))
            if status is None:
                return "timeout", ""
            if status not in (0, 5):  # 5: all of them need a GPU, or are slow
                failed = [row for row in output.splitlines() if row.startswith(("FAILED", "ERROR"))]
                return "caught", failed[0] if failed else output[-200:]
    finally:
        path.write_text(original)
    return "survived", ""


def read_rows(path):
    return [json.loads(row) for row in path.read_text().splitlines()] if path.exists() else []


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folders", nargs="*", help="files or folders to make faults in")
    parser.add_argument("--n", type=int, default=200, help="number of mutants")
    parser.add_argument("--seed", type=int, default=1, help="of the sample")
    parser.add_argument("--jobs", type=int, default=1, help="mutants tested at a time")
    parser.add_argument(
        "--seconds", type=float, default=60, help="of tests of other folders that run on a mutant"
    )
    parser.add_argument("--minutes", type=float, help="start no mutant after so many")
    parser.add_argument("--results", type=Path, help="file that keeps the results")
    parser.add_argument("--lines", type=Path, help="folder that keeps which lines tests execute")
    parser.add_argument("--list", action="store_true", help="print the sample and stop")
    options = parser.parse_args()
    sample = choose(options.n, options.seed, options.folders)
    if options.list:
        print(*sample, sep="\n")
        return
    rows = read_rows(options.results) if options.results else []
    results = {row["name"]: row["result"] for row in rows}
    results |= {row["name"]: "equivalent" for row in read_rows(EQUIVALENT)}

    with tempfile.TemporaryDirectory(prefix="mutants-") as base:
        base, copies = Path(base), queue.Queue()
        (base / "cache").mkdir(mode=0o700)
        for job in range(options.jobs):
            copies.put(copied(base / str(job)))
        record = options.lines or base / "lines"
        if not record.exists():
            record_lines(base / "0", record, options.jobs)
        seconds, lines = executed_lines.read(record)
        end = time.monotonic() + 60 * options.minutes if options.minutes else float("inf")

        def test(mutant):
            if results.get(mutant.name, "survived") != "survived" or time.monotonic() > end:
                return
            folder, start = copies.get(), time.monotonic()
            result, failed = result_of(mutant, folder, lines, seconds, options.seconds)
            copies.put(folder)
            results[mutant.name] = result
            row = dict(name=mutant.name, result=result, mutant=str(mutant), failed=failed)
            row["seconds"] = round(time.monotonic() - start, 1)
            if options.results:
                with open(options.results, "a") as file:
                    file.write(json.dumps(row) + "\n")
            print(f"{result:8} {mutant}", flush=True)

        with concurrent.futures.ThreadPoolExecutor(options.jobs) as pool:
            try:
                list(pool.map(test, sample))
            except KeyboardInterrupt:  # the mutants that are being tested are the last
                pool.shutdown(cancel_futures=True)
    report(sample, results)


def report(sample, results):
    """Prints the survivors and the counts."""
    counts = collections.Counter(results.get(mutant.name, "not run") for mutant in sample)
    for mutant in sample:
        if results.get(mutant.name) == "survived":
            print(f"SURVIVES {mutant}")
    caught = counts["caught"] + counts["timeout"]
    decided = caught + counts["survived"]
    print(", ".join(f"{count} {result}" for result, count in counts.items()))
    print(f"{caught} of {decided} mutants were caught: {caught / max(decided, 1):.1%}")


if __name__ == "__main__":
    main()
