"""Sweeps are Hydra's own, with its launchers and sweepers. Ours are the check of all jobs before
the first starts, what a job returns, and the table of them all.
"""

import contextlib
import csv
import dataclasses
import io
import json
import os
import shutil
import socket
import sys
import time
import traceback
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from megastep.agents.cli import console, run_folders
from megastep.agents.cli import overrides as words_of
from megastep.agents.cli.compose import Check, ConfigLoader
from megastep.agents.cli.console import say
from megastep.agents.cli.doors import ROOT
from megastep.agents.cli.errors import ConfigErrors, UserError, shortened
from megastep.agents.cli.gpus import one_gpu
from megastep.agents.cli.signals import Interrupted, Interruptions, interrupt, is_below, stop
from megastep.agents.training.atomic_files import write_atomically

#: Where jobs say what became of them, in the folder of their sweep.
RECORDS = ".jobs"
DONE, RUNNING = "done", "running"
HOST = socket.gethostname()
#: Seconds that jobs have to save once the sweep is interrupted.
GRACE = 30
#: Columns of sweep.csv beside the job and the keys that vary.
COLUMNS = ("state", "score", "evaluated", "lower", "upper", "seconds", "folder")


@dataclasses.dataclass(frozen=True)
class Job:
    """What Hydra runs as a job, in whichever process a launcher starts: checks the configuration,
    runs it in the job's folder, and records what became of it.
    """

    check: Check
    run: Callable[[Any], Any]
    folder: str  # of the sweep
    fixed: tuple[str, ...]  # the keys that do not vary
    sweep: str = dataclasses.field(default_factory=lambda: uuid.uuid4().hex[:8])
    process: int = dataclasses.field(default_factory=os.getpid)

    def __call__(self, config: DictConfig) -> float | None:
        """Returns the job's score; None if it failed, as there is nothing that a sweeper should
        stop for. Raises Interrupted alone.
        """
        hydra = HydraConfig.get()
        words, number = list(hydra.overrides.task), hydra.job.num
        if os.getpid() != self.process:  # its lines are among those of others
            console.warn_in_lines()
            console.prefix_lines(f"job {number}: ")
        record = dict(number=number, varied=words_of.varied(words, self.fixed), state=RUNNING)
        record |= dict(folder=hydra.runtime.output_dir, host=HOST, process=os.getpid())
        start, result = time.monotonic(), None
        self._write(record)
        try:
            with Interruptions(interrupt), one_gpu(self._records, number) as gpu:
                result = self.run(self._settings(config, words, hydra, gpu))
            record["state"] = DONE
        except Interrupted as stop:
            record["state"] = f"interrupted: {stop}"
            raise
        except Exception as error:  # whatever it is, the other jobs are worth running
            text = " ".join(str(error).split())
            if not isinstance(error, UserError):
                text = f"{type(error).__name__}: {text}"
                with contextlib.suppress(OSError):
                    trace = traceback.format_exc()
                    Path(hydra.runtime.output_dir, "error.txt").write_text(trace)
            record["state"] = f"FAILED: {shortened(text, 400)}"
            say(f"Job {number} {record['state']}", sys.stderr)
        finally:
            record["seconds"] = round(time.monotonic() - start, 1)
            record |= run_folders.outcome(result)
            self._write(record)
        if isinstance(result, Path) and result.is_dir() and record["score"] is None:
            console.warn(
                f"job {number} has no mean return, as no episode ended before its last report"
            )
        return record.get("score")

    @property
    def _records(self) -> Path:
        return Path(self.folder) / RECORDS

    def _settings(self, config, words, hydra, gpu):
        """The job's settings: its folder, its GPU if it may be any, the group of its metrics."""
        settings, its_own = self.check(config, words), {}
        if hasattr(settings, "folder"):
            its_own["folder"] = run_folders.brief(hydra.runtime.output_dir)
        if settings.device == "cuda" and gpu is not None:
            its_own["device"] = f"cuda:{gpu}"
        if getattr(getattr(settings, "logger", None), "group", "") is None:
            group = Path(self.folder).name
            its_own["logger"] = dataclasses.replace(settings.logger, group=group)
        return dataclasses.replace(settings, **its_own)

    def _write(self, record):
        with contextlib.suppress(OSError):  # a full disk: the job is worth more than its record
            self._records.mkdir(parents=True, exist_ok=True)
            path = self._records / f"{self.sweep}-{record['number']}.json"
            write_atomically(path, json.dumps(record).encode())

    def rows(self) -> list[dict[str, Any]]:
        """What the jobs of this sweep recorded, in order."""
        paths = self._records.glob(f"{self.sweep}-*.json")
        found = [json.loads(path.read_text()) for path in paths]
        for row in found:
            if row["state"] == RUNNING and row["host"] == HOST and not is_below(row["process"]):
                row["state"] = "FAILED: its process ended without a word"
        return sorted(found, key=lambda row: row["number"])

    def interrupt(self, number: int) -> NoReturn:
        """Has jobs in processes that this one started save and end, then raises Interrupted."""
        deadline = time.monotonic() + GRACE
        for process in self._started():
            stop(process)
        while self._started() and time.monotonic() < deadline:
            time.sleep(0.1)
        interrupt(number)

    def _started(self):
        """The processes that this one started and that have a job."""
        running = [row["process"] for row in self.rows() if row["state"] == RUNNING]
        return [process for process in running if process != self.process and is_below(process)]


def sweep(loader: ConfigLoader, run: Callable[[Any], Any], words: list[str]) -> int:
    """Hands a sweep over to Hydra once all jobs that can be told beforehand are checked. Goes past
    jobs that fail. Returns the exit code.
    """
    parsed = words_of.parse(words, loader.loader, multirun=True)
    words = [override.input_line for override in parsed]
    if "folder" in map(words_of.key_of, parsed):
        cure = "each job of a sweep has a folder of its own; hydra.sweep.dir= says in which"
        raise ConfigErrors([("folder", cure)])
    loader.jobs(words)
    folder, words = _folder(loader, words)
    job = Job(loader.check, run, str(folder.resolve()), tuple(words_of.fixed_keys(words)))
    _share_modules()
    error = None
    try:
        with Interruptions(job.interrupt):
            loader.hydra.multirun(loader.name, job, words)
    except (Interrupted, UserError):
        raise
    except Exception as raised:  # a launcher's or a sweeper's, as when a process is killed
        error = raised
    finally:
        rows = job.rows()
        if rows:
            report(folder, rows)
        else:
            _remove(folder)
    if error:
        text = shortened(" ".join(str(error).split()) or type(error).__name__, 400)
        if not rows:
            raise UserError(f"The sweep cannot start: {text}")
        if all(row["state"] == DONE for row in rows) or "ended without" in str(rows):
            say(f"The sweep ended early: {text}", sys.stderr)
    return 1 if error or not rows or any(row["state"] != DONE for row in rows) else 0


def _folder(loader, words):
    """The folder of a sweep, made, and its words with that folder among them: one that is named
    after the time is no other sweep's.
    """
    master = loader.compose(words, RunMode.MULTIRUN)
    path = Path(str(master.hydra.sweep.dir))
    raw = OmegaConf.to_container(master.hydra.sweep, resolve=False)["dir"]
    if "${now" in raw:
        path = run_folders.make(path)
        name = str(path).replace('"', '\\"')
        words = [*words, f'hydra.sweep.dir="{name}"']
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        cure = f"({error.strerror}); choose another with hydra.sweep.dir="
        raise UserError(f"The folder {shortened(path)} cannot be made {cure}") from None
    return path, words


def _remove(folder):
    """Deletes the folder of a sweep none of whose jobs began, if nothing else is in it."""
    shutil.rmtree(folder / RECORDS, ignore_errors=True)
    (folder / "multirun.yaml").unlink(missing_ok=True)
    for place in (folder, run_folders.SWEEPS):
        with contextlib.suppress(OSError):  # there are others in it
            place.rmdir()


def _share_modules():
    """Processes that launchers start find the modules that this one finds."""
    paths = [str(ROOT), os.getcwd(), os.environ.get("PYTHONPATH", "")]
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, dict.fromkeys(paths)))


# ---- The table ----


def report(folder: Path, rows: list[dict[str, Any]]) -> None:
    """Prints the table of a sweep, and writes it into its folder: sweep.md as it is printed,
    sweep.csv with plain numbers.
    """
    keys = list(dict.fromkeys(key for row in rows for key in row["varied"]))
    head = ["job", *keys, "state", "mean return", "evaluated", "95 % interval", "time"]
    cells = [_cells(row, keys) for row in rows]
    say(console.table(head, cells, title="Sweep"))
    numbers = [
        {"job": row["number"], **row["varied"], **{name: row.get(name) for name in COLUMNS}}
        for row in rows
    ]
    text = io.StringIO()
    writer = csv.DictWriter(text, ["job", *keys, *COLUMNS], lineterminator="\n")
    writer.writeheader()
    writer.writerows(numbers)
    try:
        write_atomically(folder / "sweep.csv", text.getvalue().encode())
        write_atomically(folder / "sweep.md", console.markdown(head, cells).encode())
        say(f"The table is in {folder / 'sweep.md'}, and its numbers in sweep.csv")
    except OSError as error:
        console.warn(f"the table cannot be written to {folder} ({error.strerror})")


def _cells(row, keys):
    """A row of the table, as text."""

    def shown(name):
        return "" if row.get(name) is None else f"{row[name]:.2f}"

    interval = f"{shown('lower')} to {shown('upper')}" if shown("lower") else ""
    varied = [_brief(row["varied"].get(key, "")) for key in keys]
    numbers = [shown("score"), shown("evaluated"), interval]
    time = console.duration(row["seconds"]) if "seconds" in row else ""
    return [str(row["number"]), *varied, row["state"], *numbers, time]


def _brief(value):
    """A value as text; what a search tries has up to 17 digits."""
    try:
        return value if len(value) < 7 else f"{float(value):.4g}"
    except ValueError:
        return value
