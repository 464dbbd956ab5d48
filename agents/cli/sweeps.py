"""Sweeps are Hydra's own, with its launchers and sweepers. Added here: the check of all jobs before
the first starts, the GPU of each job, what a job returns, and the table of them all.
"""

import contextlib
import csv
import dataclasses
import io
import itertools
import json
import os
import re
import shutil
import socket
import sys
import time
import traceback
import uuid
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import filelock
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.types import Override
from omegaconf import OmegaConf

from megastep.agents.cli import console, program, runs, signals
from megastep.agents.cli.compose import Composer, key_of
from megastep.agents.cli.program import ConfigErrors, UserError, shortened
from megastep.agents.training import atomic_files

#: Where jobs record their state, in the folder of their sweep.
RECORDS = ".jobs"
DONE, RUNNING, LOST = "done", "running", "FAILED: its process ended without an error message"
HOST = socket.gethostname()
#: Seconds that jobs have to save once the sweep is interrupted.
GRACE = 30
#: Columns of the table beside the job and the keys that vary.
COLUMNS = ("state", "score", "evaluated", "lower", "upper", "seconds", "folder")
#: What a search is to do, if nothing else is typed: look for high returns, and go past failed jobs.
SEARCH = {"hydra.sweeper.direction": "maximize", "hydra.sweeper.max_failure_rate": "1.0"}
#: A point of an interval that is no integer where its bounds are.
INSIDE = 0.38

OmegaConf.register_new_resolver(
    "file_name",  # of characters that shells and Hydra leave alone, and at most 255 bytes
    lambda text: re.sub(r"[^\w.=-]+", "-", text).encode()[:200].decode(errors="ignore") or "default",
    replace=True,
)


# ---- Before the first job ----


def jobs_of(composer: Composer, words: list[str]) -> list[list[str]]:
    """Returns the words of each job that is known beforehand, all of them checked.

    Of a grid these are all jobs; of a search, the first of all values, and each other value and
    bound alone.

    Raises:
        ConfigErrors: with all that is wrong in the first wrong job.
    """
    values = {key_of(override): _values(override) for override in composer.parse(words)}
    _, config = composer.compose([options[0] for options in values.values() if options[0]])
    params = [f"{key}={value}" for key, value in (config.hydra.sweeper.get("params") or {}).items()]
    values = {key_of(override): _values(override) for override in composer.parse(params)} | values
    if config.hydra.runtime.choices["hydra/sweeper"] == "basic":
        if wide := [key for key, options in values.items() if options[0] is None]:
            cure = "interval() needs a sweeper that searches, such as hydra/sweeper=optuna"
            raise ConfigErrors((key, cure) for key in wide)
        jobs = [[*job] for job in itertools.product(*values.values())]
    else:
        first = {key: options[0] for key, options in values.items()}
        jobs = [first, *(first | {k: word} for k, rest in values.items() for word in rest[1:])]
        jobs = [[*filter(None, job.values())] for job in jobs]
    for job in jobs:
        composer.compose(job)
    return jobs


def _values(override: Override) -> list[str | None]:
    """Returns the words that a word of a sweep may become; None where a search leaves it out."""
    key, sweep = override.get_key_element(), override.value()
    if override.is_interval_sweep():
        inside = sweep.start + INSIDE * (sweep.end - sweep.start)
        is_int = isinstance(sweep.start, int) and isinstance(sweep.end, int)
        points = sweep.start, sweep.end, round(inside) if is_int else inside
        return [None, *(f"{key}={point}" for point in points)]
    if not override.is_sweep_override():
        return [override.input_line]
    words = [f"{key}={value}" for value in override.sweep_string_iterator()]
    if not words:
        raise ConfigErrors([(key, f"{override.input_line!r} has no value")])
    return words


def sweep(composer: Composer, words: list[str]) -> int:
    """Checks all jobs, then hands the sweep over to Hydra, past jobs that fail. Returns the exit
    code.
    """
    overrides = {key_of(override): override for override in composer.parse(words)}
    if "folder" in overrides:
        cure = "each job of a sweep has its own folder; hydra.sweep.dir= is where they go"
        raise ConfigErrors([("folder", cure)])
    _, config = composer.compose(jobs_of(composer, words)[0])
    folder = Path(config.hydra.sweep.dir)
    options = {
        "hydra.job.name": composer.script.name,
        "hydra.job.config.override_dirname.exclude_keys": json.dumps(
            [key for key, override in overrides.items() if not override.is_sweep_override()]
        ),
    }
    if config.hydra.runtime.choices["hydra/sweeper"] == "optuna":
        options |= SEARCH
    is_new = not folder.exists()
    if "hydra.sweep.dir" not in overrides:
        folder = runs.make(folder)  # two sweeps may start in the same second
        options["hydra.sweep.dir"] = folder
    with runs.writing(folder, "choose another with hydra.sweep.dir="):
        folder.mkdir(parents=True, exist_ok=True)
    paths = [str(program.ROOT), os.getcwd(), os.environ.get("PYTHONPATH")]  # of launchers' processes
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, dict.fromkeys(paths)))
    job = Job((composer.script, composer.name, composer.folder, composer.main), folder.absolute())
    words = [f"{key}={value}" for key, value in options.items() if key not in overrides]
    words += [override.input_line for override in overrides.values()]
    error = None
    try:
        with signals.handled(job.interrupt):
            composer.call_hydra(["--multirun", *words], job)
    except Exception as raised:  # a launcher's or a sweeper's, as when a process is killed
        error = raised
    finally:
        rows = job.rows()
        if rows:
            report(folder, rows)
        elif is_new:
            shutil.rmtree(folder, ignore_errors=True)
            with contextlib.suppress(OSError):  # there are others in it
                runs.SWEEPS.rmdir()
    text = shortened(error or "no job began", 400)
    if not rows:
        raise UserError(f"The sweep cannot start: {text}")
    states = {row["state"] for row in rows}
    if error and states <= {DONE, LOST}:
        console.say(f"The sweep ended early: {text}", sys.stderr)
    return 1 if error or states != {DONE} else 0


# ---- Jobs ----


@dataclasses.dataclass(frozen=True)
class Job:
    """Runs one job, in whichever process a launcher starts, and records what became of it.

    It is what Hydra's main calls. Composes again, since `preset=auto` depends on the machine.
    """

    source: tuple  # the arguments of Composer
    folder: Path  # of the sweep
    sweep: str = dataclasses.field(default_factory=lambda: uuid.uuid4().hex[:8])
    process: int = dataclasses.field(default_factory=os.getpid)
    start: str = dataclasses.field(default_factory=os.getcwd)

    def __call__(self, config: Any) -> float | None:
        """Returns the job's score, None if it failed: a sweeper is to go on. Raises Interrupted
        alone.
        """
        hydra = HydraConfig.get()
        words, number = [*hydra.overrides.task], hydra.job.num
        os.chdir(self.start)
        if os.getpid() != self.process:  # its lines are among those of others
            warnings.showwarning, console.prefix = console.warn, f"job {number}: "
        pairs = (word.lstrip("+~").partition("=") for word in words)
        fixed = hydra.job.config.override_dirname.exclude_keys
        record = {key: value.strip("\"'") for key, _, value in pairs if key not in fixed}
        record = dict(number=number, varied=record, state=RUNNING, folder=hydra.runtime.output_dir)
        record |= dict(host=HOST, process=os.getpid())
        path, began, result = self.records / f"{self.sweep}-{number}.json", time.monotonic(), None
        self.records.mkdir(parents=True, exist_ok=True)
        with contextlib.ExitStack() as stack:
            with contextlib.suppress(OSError):  # no locks, or a full disk: the job is worth more
                stack.enter_context(filelock.FileLock(path.with_suffix(".lock"), blocking=False))
                atomic_files.replace(path, json.dumps(record).encode())
            try:
                stack.enter_context(signals.handled(signals.interrupt))
                gpu = stack.enter_context(one_gpu(self.records, number))
                result = self.source[0].run(self.settings(hydra, words, gpu))
                record["state"] = DONE
            except signals.Interrupted as stop:
                record["state"] = f"interrupted: {stop}"
                raise
            except Exception as error:  # whatever it is, the other jobs are worth running
                kind = "" if isinstance(error, UserError) else f"{type(error).__name__}: "
                record["state"] = f"FAILED: {kind}{shortened(error, 400)}"
                console.say(f"Job {number} {record['state']}", sys.stderr)
                if kind:
                    Path(record["folder"], "error.txt").write_text(traceback.format_exc())
            finally:
                record |= {"seconds": round(time.monotonic() - began, 1), **runs.outcome(result)}
                with contextlib.suppress(OSError):
                    atomic_files.replace(path, json.dumps(record).encode())
        if result and result.is_dir() and record["score"] is None:
            cure = "no episode finished, so it has no score. Train longer or shorten episodes"
            console.warn(f"job {number}: {cure}")
        return record.get("score")

    def settings(self, hydra: Any, words: list[str], gpu: int | None) -> Any:
        """Returns the job's settings: its folder, its GPU, the group of its metrics."""
        searched = [word for word in hydra.overrides.hydra if "searchpath" in word]
        settings = Composer(*self.source).settings([*searched, *words])
        changes = {"folder": os.path.relpath(hydra.runtime.output_dir)}
        if settings.device == "cuda" and gpu is not None:
            changes["device"] = f"cuda:{gpu}"
        if getattr(getattr(settings, "logger", None), "group", "") is None:
            changes["logger"] = dataclasses.replace(settings.logger, group=self.folder.name)
        known = {name: value for name, value in changes.items() if hasattr(settings, name)}
        return dataclasses.replace(settings, **known)

    @property
    def records(self) -> Path:
        return self.folder / RECORDS

    def rows(self) -> list[dict[str, Any]]:
        """Returns what the jobs of this sweep recorded, in order."""
        rows = []
        for path in self.records.glob(f"{self.sweep}-*.json"):
            is_free = False
            with contextlib.suppress(OSError), filelock.FileLock(path.with_suffix(".lock"), timeout=0):
                is_free = True
            row = json.loads(path.read_text())
            rows.append(row | {"state": LOST} if is_free and row["state"] == RUNNING else row)
        return sorted(rows, key=lambda row: row["number"])

    def interrupt(self, number: int) -> NoReturn:
        """Has jobs in other processes save and end, then raises Interrupted."""
        deadline, stopped = time.monotonic() + GRACE, {os.getpid()}
        while time.monotonic() < deadline:
            rows = [row for row in self.rows() if row["state"] == RUNNING and row["host"] == HOST]
            running = {row["process"] for row in rows} - {os.getpid()}
            for process in running - stopped:
                signals.stop(process)
            stopped |= running
            deadline = deadline if running else 0
            time.sleep(0.1)
        signals.interrupt(number)


@contextlib.contextmanager
def one_gpu(folder: Path, number: int) -> Iterator[int | None]:
    """Makes a GPU with the fewest jobs on it PyTorch's current one, which device=auto means.

    Yields its index, None where there is no choice. Jobs know of each other by locks on files in
    `folder`, one for each place on each GPU of this machine; the system drops them when a process
    ends. Where files cannot be locked, job `number` takes the GPUs in turn.
    """
    n_gpus = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if n_gpus < 2:
        yield None
        return
    gpu, before = number % n_gpus, torch.cuda.current_device()
    with contextlib.ExitStack() as stack:
        for place, index in itertools.product(range(1000), range(n_gpus)):
            lock = filelock.FileLock(folder / f"{HOST}-gpu{index}-{place}", blocking=False)
            try:
                stack.enter_context(lock)
                gpu = index
            except filelock.Timeout:
                continue
            except OSError:
                pass
            break
        torch.cuda.set_device(gpu)
        stack.callback(torch.cuda.set_device, before)
        yield gpu


# ---- The table ----


def report(folder: Path, rows: list[dict[str, Any]]) -> None:
    """Prints the table of a sweep and writes it into its folder: sweep.md as it is printed, and
    sweep.csv with all digits.
    """
    keys = dict.fromkeys(key for row in rows for key in row["varied"])
    head, text = ["job", *keys, *COLUMNS], io.StringIO()
    rows = [{**row, **row["varied"], "job": row["number"]} for row in rows]
    cells = [[_brief(row.get(name)) for name in head[:-1]] for row in rows]
    writer = csv.DictWriter(text, head, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    console.say(console.table(head[:-1], cells, title="Sweep"))
    try:
        atomic_files.replace(folder / "sweep.csv", text.getvalue().encode())
        atomic_files.replace(folder / "sweep.md", console.markdown(head[:-1], cells).encode())
        console.say(f"Table: {folder / 'sweep.md'}, with all digits in sweep.csv")
    except OSError as error:
        console.warn(f"the table cannot be written to {folder} ({error.strerror})")


def _brief(value: Any) -> str:
    """Returns a value with at most four digits; what a search tries has up to 17."""
    with contextlib.suppress(TypeError, ValueError):
        return f"{float(value):.4g}" if len(str(value)) > 6 else str(value)
    return str(value or "")
