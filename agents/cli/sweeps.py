"""Sweeps are Hydra's own, with its launchers and sweepers. Added here: the check of all jobs before
the first starts, the GPU of each job, what a job returns, and the table of them all.
"""

import contextlib
import csv
import io
import itertools
import json
import os
import re
import shutil
import socket
import sys
import tempfile
import time
import traceback
import uuid
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.types import Override
from omegaconf import OmegaConf

from megastep.agents.cli import console, program, runs, settings, signals
from megastep.agents.cli.compose import Composer, key_of
from megastep.agents.cli.program import ConfigErrors, UserError, shortened
from megastep.agents.training.atomic_files import write_atomically

DONE, RUNNING, LOST = "done", "running", "FAILED: its process ended without an error message"
#: Columns of the table beside the job and the keys that vary.
COLUMNS = ("state", "score", "evaluated", "lower", "upper", "seconds", "folder")
#: What a search is to do, if nothing else is typed: look for high returns, and go past failed jobs.
SEARCH = {"hydra.sweeper.direction": "maximize", "hydra.sweeper.max_failure_rate": "1.0"}

OmegaConf.register_new_resolver(
    "file_name",  # of characters that shells and Hydra leave alone, and at most 255 bytes
    lambda text: (
        re.sub(r"[^\w.=-]+", "-", text).encode()[:200].decode(errors="ignore") or "default"
    ),
    replace=True,
)


# ---- Before the first job ----


def jobs_of(composer: Composer, words: list[str]) -> tuple[list[list[str]], Any]:
    """Returns (the words of each job that is known beforehand, all of them checked; the
    configuration of the first).

    Of a grid these are all jobs; of a search, the first of all values, and each other value and
    bound alone.

    Raises:
        ConfigErrors: with all that is wrong in the first wrong job.
    """
    values = {key_of(override): _values(override) for override in composer.parse(words)}
    config = composer.compose([options[0] for options in values.values() if options[0]])[1].hydra
    params = composer.parse(f"{k}={v}" for k, v in (config.sweeper.get("params") or {}).items())
    values = {key_of(override): _values(override) for override in params} | values
    jobs = [[*job] for job in itertools.product(*values.values())]
    if config.runtime.choices["hydra/sweeper"] != "basic":
        first = {key: options[0] for key, options in values.items()}
        jobs = [first, *(first | {k: word} for k, rest in values.items() for word in rest[1:])]
        jobs = [[*filter(None, job.values())] for job in jobs]
    elif wide := [key for key, options in values.items() if options[0] is None]:
        cure = "interval() needs a sweeper that searches, such as hydra/sweeper=optuna"
        raise ConfigErrors((key, cure) for key in wide)
    for job in jobs:
        composer.compose(job)
    return jobs, config


def _values(override: Override) -> list[str | None]:
    """The words that a word of a sweep may become; None where a search leaves it out."""
    key, sweep = override.get_key_element(), override.value()
    if override.is_interval_sweep():
        # a point inside that is no integer, even if the bounds are 1.0 and 4.0
        inside = sweep.start + 0.38 * (sweep.end - sweep.start)
        inside = round(inside) if isinstance(sweep.start + sweep.end, int) else inside
        return [None, *(f"{key}={value}" for value in (sweep.start, sweep.end, inside))]
    if not override.is_sweep_override():
        return [override.input_line]
    if values := [*override.sweep_string_iterator()]:
        return [f"{key}={value}" for value in values]
    raise ConfigErrors([(key, f"{override.input_line!r} has no value")])


def sweep(composer: Composer, words: list[str]) -> int:
    """Checks all jobs, then hands the sweep over to Hydra, past jobs that fail. Returns the exit
    code.
    """
    overrides = {key_of(override): override for override in composer.parse(words)}
    if "folder" in overrides:
        raise ConfigErrors([("folder", "each job has its own; hydra.sweep.dir= is where they go")])
    config = jobs_of(composer, words)[1]
    folder = Path(config.sweep.dir)
    is_new = not folder.exists()
    with program.errors(f"{folder} cannot be made; choose another with hydra.sweep.dir=: "):
        if "hydra.sweep.dir" not in overrides:
            folder = runs.make(folder)  # another sweep may start in the same second
        folder.mkdir(parents=True, exist_ok=True)
    options = SEARCH if config.runtime.choices["hydra/sweeper"] == "optuna" else {}
    options = options | {
        "hydra.job.name": composer.script.name,
        "hydra.sweep.dir": json.dumps(str(folder), ensure_ascii=False),
        "hydra.job.config.override_dirname.exclude_keys": json.dumps(
            [key for key, override in overrides.items() if not override.is_sweep_override()]
        ),
    }
    words = [f"{key}={value}" for key, value in options.items() if key not in overrides]
    words += [override.input_line for override in overrides.values()]
    # processes of launchers find megastep, in a checkout too; a job's settings find modules of the
    # current folder
    if (program.ROOT / "train.py").exists():
        os.environ["PYTHONPATH"] = os.pathsep.join(
            filter(None, [str(program.ROOT), os.environ.get("PYTHONPATH")])
        )
    job, problem = Job(composer, folder), ""
    try:
        with signals.interrupting(job.interrupt):
            composer.call_hydra(["--multirun", *words], job)
    except Exception as error:  # a launcher's or a sweeper's, as when a process is killed
        problem = shortened(error, 400)
    finally:
        if rows := job.rows():
            report(folder, rows)
        elif is_new:
            shutil.rmtree(folder, ignore_errors=True)
            with contextlib.suppress(OSError):  # there are others in it
                runs.SWEEPS.rmdir()
    if not rows:
        raise UserError(f"The sweep cannot start: {problem}")
    if problem and all(row["state"] in (DONE, LOST) for row in rows):
        console.say(f"The sweep ended early: {problem}", sys.stderr)
    return 1 if problem or any(row["state"] != DONE for row in rows) else 0


# ---- Jobs ----


class Job:
    """Runs one job, in whichever process a launcher starts, and records what became of it.

    It is what Hydra's main calls. Composes again, since `preset=auto` depends on the machine.
    """

    def __init__(self, composer: Composer, folder: Path):
        self.source = composer.script, composer.name, composer.folder, composer.main
        self.group, self.process, self.start = folder.absolute().name, os.getpid(), os.getcwd()
        self.records = folder.absolute() / ".jobs" / uuid.uuid4().hex[:8]
        self.records.mkdir(parents=True)

    def __call__(self, config: Any) -> float | None:
        """Returns the job's score, None if it failed: a sweeper is to go on. Raises Interrupted
        alone.
        """
        import filelock  # which takes a while

        hydra, began, result = HydraConfig.get(), time.monotonic(), None
        words, number = [*hydra.overrides.task], hydra.job.num
        os.chdir(self.start)  # where paths are relative to, whatever hydra.job.chdir says
        if os.getpid() != self.process:  # its lines are among those of others
            warnings.showwarning, console.prefix = console.warn, f"job {number}: "
        pairs = (word.lstrip("+~").partition("=") for word in words)
        fixed, path = (
            hydra.job.config.override_dirname.exclude_keys,
            self.records / f"{number}.json",
        )
        row = dict(
            number=number,
            varied={key: value.strip("\"'") for key, _, value in pairs if key not in fixed},
            state=RUNNING,
            folder=hydra.runtime.output_dir,
            host=socket.gethostname(),
            process=os.getpid(),
        )
        with contextlib.ExitStack() as stack:
            with contextlib.suppress(OSError):  # no locks, or a full disk: the job is worth more
                stack.enter_context(filelock.FileLock(path.with_suffix(".lock"), blocking=False))
                write_atomically(path, json.dumps(row).encode())
            try:
                with signals.interrupting(), one_gpu() as gpu:
                    words += [word for word in hydra.overrides.hydra if "searchpath" in word]
                    cfg = Composer(*self.source).settings(words)
                    cfg = settings.changed(cfg, folder=os.path.relpath(row["folder"]))
                    if cfg.device == "cuda" and gpu is not None:
                        cfg = settings.changed(cfg, device=f"cuda:{gpu}")
                    logger = getattr(cfg, "logger", None)
                    if getattr(logger, "group", "") is None:
                        logger = settings.changed(logger, group=self.group)
                        cfg = settings.changed(cfg, logger=logger)
                    result = self.source[0].run(cfg)
                    row |= {"state": DONE, **(runs.outcome(result) if result else {})}
            except signals.Interrupted as stop:
                row["state"] = f"interrupted: {stop.args[1]}"
                raise
            except Exception as error:  # whatever it is, the other jobs are worth running
                kind = "" if isinstance(error, UserError) else f"{type(error).__name__}: "
                row["state"] = f"FAILED: {kind}{shortened(error, 400)}"
                console.say(f"Job {number} {row['state']}", sys.stderr)
                os.makedirs(row["folder"], exist_ok=True)
                Path(row["folder"], "error.txt").write_text(traceback.format_exc())
            finally:
                row["seconds"] = round(time.monotonic() - began, 1)
                with contextlib.suppress(OSError):
                    write_atomically(path, json.dumps(row).encode())
        if result and result.is_dir() and row["score"] is None:
            console.warn(f"job {number}: no episode finished, so it has no score; train longer")
        return row.get("score")

    def rows(self) -> list[dict[str, Any]]:
        """Returns what the jobs of this sweep recorded, in order."""
        import filelock

        rows = []
        for path in self.records.glob("*.json"):
            state = RUNNING
            with (
                contextlib.suppress(OSError),
                filelock.FileLock(path.with_suffix(".lock"), timeout=0),
            ):
                state = LOST  # if it says that it is running, for no process holds its lock
            row = json.loads(path.read_text())
            rows.append(row | {"state": state} if row["state"] == RUNNING else row)
        return sorted(rows, key=lambda row: row["number"])

    def interrupt(self, number: int) -> NoReturn:
        """Has jobs in other processes save and end, then raises Interrupted."""
        deadline = time.monotonic() + 30  # seconds, for jobs to save
        for process in self.running():
            signals.stop(process)
        while self.running() and time.monotonic() < deadline:
            time.sleep(0.1)
        signals.interrupt(number)

    def running(self) -> list[int]:
        here = RUNNING, socket.gethostname()
        pids = [row["process"] for row in self.rows() if (row["state"], row["host"]) == here]
        return [pid for pid in pids if pid != os.getpid()]


@contextlib.contextmanager
def one_gpu() -> Iterator[int | None]:
    """Makes a GPU with the fewest jobs on it PyTorch's current one, which device=auto means.

    Yields its index, None where there is no choice. Jobs know of each other by locks on temporary
    files, one for each place on each GPU of this machine; the system drops them when a process
    ends.
    """
    import filelock
    import torch

    n_gpus = torch.cuda.device_count() if torch.cuda.is_available() else 0
    with contextlib.ExitStack() as stack:
        for place in itertools.count() if n_gpus > 1 else ():
            path = Path(tempfile.gettempdir(), f"megastep-{os.getuid()}-gpu-{place}.lock")
            with contextlib.suppress(filelock.Timeout):
                stack.enter_context(filelock.FileLock(path, blocking=False))
                stack.callback(torch.cuda.set_device, torch.cuda.current_device())
                torch.cuda.set_device(place % n_gpus)
                break
        yield place % n_gpus if n_gpus > 1 else None


# ---- The table ----


def report(folder: Path, rows: list[dict[str, Any]]) -> None:
    """Prints the table of a sweep and writes it into its folder: sweep.md as it is printed, and
    sweep.csv with all digits.
    """
    head, text = ["job", *dict.fromkeys(k for row in rows for k in row["varied"])], io.StringIO()
    head += COLUMNS
    rows = [{**row, **row["varied"], "job": row["number"]} for row in rows]
    csv.writer(text).writerows([head, *([row.get(name) for name in head] for row in rows)])
    cells = [[_brief(row.get(name)) for name in head[:-1]] for row in rows]
    console.say(f"Sweep\n{console.table(head[:-1], cells)}")
    with console.warned(f"{folder} cannot be written: "):
        write_atomically(folder / "sweep.csv", text.getvalue().encode())
        table = console.table(head[:-1], cells, is_markdown=True)
        write_atomically(folder / "sweep.md", table.encode())
        console.say(f"Table: {folder / 'sweep.md'}, with all digits in sweep.csv")


def _brief(value: Any) -> str:
    # with at most four digits: what a search tries has up to 17
    text = "" if value is None else str(value)
    return f"{float(text):.4g}" if re.fullmatch(r"-?\d*\.\d{5,}(e-?\d+)?", text) else text
