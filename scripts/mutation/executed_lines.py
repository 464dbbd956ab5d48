"""A pytest plugin that records which files of tests execute which lines:

    python -m pytest -p mutation.executed_lines --executed-lines FOLDER

Each process writes FOLDER/<process id>.json, {"seconds": {tests: s}, "lines": {path: {line:
[tests]}}}. A file's tests share fixtures, so a line belongs to files, and not to single tests.
Processes that tests start are not recorded.
"""

import collections
import json
import os
import time
from pathlib import Path

import coverage
import pytest

#: Of the contexts, the name of what runs outside of tests: imports.
OUTSIDE = ""


class Recorder:
    def __init__(self, root):
        self.root, self.seconds = root, collections.Counter()
        # modules that are already imported ran their first lines outside of tests anyway
        self.coverage = coverage.Coverage(
            data_file=None, source=[str(root / "megastep"), str(root / "agents")], config_file=False
        )
        self.coverage.start()

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_protocol(self, item):
        tests, start = str(item.path.relative_to(self.root)), time.perf_counter()
        self.coverage.switch_context(tests)
        yield
        self.coverage.switch_context(OUTSIDE)
        self.seconds[tests] += time.perf_counter() - start

    def pytest_sessionfinish(self, session):
        self.coverage.stop()
        data, lines = self.coverage.get_data(), {}
        for path in map(Path, data.measured_files()):
            contexts = data.contexts_by_lineno(str(path))
            lines[str(path.resolve().relative_to(self.root))] = {
                line: sorted({*names} - {OUTSIDE}) for line, names in contexts.items()
            }
        record = dict(seconds=self.seconds, lines=lines)
        folder = Path(session.config.getoption("executed_lines"))
        (folder / f"{os.getpid()}.json").write_text(json.dumps(record))


def pytest_addoption(parser):
    parser.addoption("--executed-lines", help="folder for the record")


def pytest_configure(config):
    config.pluginmanager.register(Recorder(config.rootpath.resolve()))


def read(folder):
    """Returns ({tests: seconds}, {path: {line: tests}}) from the files of all processes."""
    seconds, lines = collections.Counter(), {}
    for path in sorted(Path(folder).glob("*.json")):
        record = json.loads(path.read_text())
        seconds.update(record["seconds"])
        for name, tests_by_line in record["lines"].items():
            for line, tests in tests_by_line.items():
                lines.setdefault(name, {}).setdefault(int(line), set()).update(tests)
    return seconds, lines
