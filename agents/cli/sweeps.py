"""Sweeps by Hydra: all jobs are checked first, have GPUs of their own, and end in one table."""

import contextlib
import dataclasses
import importlib
import itertools
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import traceback
import uuid
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn, cast

import hydra
from hydra.core import global_hydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.types import Override
from omegaconf import OmegaConf

from megastep import workers
from megastep.agents import console, package
from megastep.agents.cli.compose import MAIN, Composer
from megastep.agents.cli.words import key_of
from megastep.agents.distributed import environment
from megastep.agents.errors import ConfigErrors, UserError, shortened, user_errors
from megastep.agents.factory import settings
from megastep.agents.launch import gpu_slots, signals
from megastep.agents.launch.again import AUTO
from megastep.agents.reports import runs
from megastep.agents.runs import folders, populations, scores
from megastep.agents.types import Row
from megastep.atomic_files import write_atomically
from megastep.settings import closest

DONE, RUNNING, LOST = "done", "running", "FAILED: its process ended without an error message"
#: What the score of a job is, unless `metric=` says otherwise.
EARNED = "episode/return"
#: Columns of the table beside the job and the keys that vary.
COLUMNS = ("state", "score", "evaluated", "lower", "upper", "seconds")
#: What a search is to do, if nothing else is typed: look for high returns, and go past failed jobs.
SEARCH = {"hydra.sweeper.direction": "maximize", "hydra.sweeper.max_failure_rate": "1.0"}


def _file_name(text: str) -> str:
    """Returns a name of characters that shells and Hydra leave alone, and at most 255 bytes."""
    return re.sub(r"[^\w.=-]+", "-", text).encode()[:200].decode(errors="ignore") or "default"


OmegaConf.register_new_resolver("file_name", _file_name, replace=True)


# ---- Before the first job ----


def jobs_of(composer: Composer, words: list[str]) -> tuple[list[list[str]], list, Any]:
    """Returns (words of known jobs, their settings, Hydra's configuration); of a search, bounds."""
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
    words_of_jobs = cast("list[list[str]]", jobs)
    return words_of_jobs, [composer.settings(job) for job in words_of_jobs], config


def _values(override: Override) -> list[str | None]:
    """The words that a word of a sweep may become; None where a search leaves it out."""
    key, sweep = override.get_key_element(), cast(Any, override.value())
    if override.is_interval_sweep():
        # a point inside that is not an integer, even if the bounds are 1.0 and 4.0
        inside = sweep.start + 0.38 * (sweep.end - sweep.start)
        inside = round(inside) if isinstance(sweep.start + sweep.end, int) else inside
        return [None, *(f"{key}={value}" for value in (sweep.start, sweep.end, inside))]
    if not override.is_sweep_override():
        return [override.input_line]
    if values := [*override.sweep_string_iterator()]:
        return [f"{key}={value}" for value in values]
    raise ConfigErrors([(key, f"{override.input_line!r} has no value")])


def metric_of(words: list[str]) -> tuple[str, list[str]]:
    """Returns the metric that is the score of jobs, the last `metric=`, and the other words."""
    given = [word.partition("=")[2] for word in words if word.startswith("metric=")]
    metric = [EARNED, *given][-1]
    if not re.fullmatch("(episode|eval)/.+", metric):
        text = f"{metric!r} is neither episode/NAME, of training, nor eval/NAME, of evaluations"
        raise ConfigErrors([("metric", text)])
    return metric, [word for word in words if not word.startswith("metric=")]


def sweep(composer: Composer, words: list[str]) -> int:
    """Checks all jobs, then has Hydra run them, past those that fail. Returns the exit code."""
    if environment.rank_info():
        cure = "leave torchrun out, and add ranks="
        problem = UserError(f"The jobs of a sweep start their own ranks; {cure}")
        raise problem if environment.rank() == 0 else SystemExit(problem.code)
    metric, words = metric_of(words)
    overrides = {key_of(override): override for override in composer.parse(words)}
    if "folder" in overrides:
        raise ConfigErrors([("folder", "each job has its own; hydra.sweep.dir= is where they go")])
    _, jobs, config = jobs_of(composer, words)
    gpu_slots.check(jobs, config)
    trainings = [cfg for cfg in jobs if isinstance(cfg, settings.Train)]
    has_evaluations = all(cfg.finish.evaluate or cfg.evaluation.every for cfg in trainings)
    if metric.startswith("eval/") and not has_evaluations:
        cure = "needs evaluations: finish.evaluate=true, or evaluation.every=1M"
        raise ConfigErrors([("metric", cure)])
    folder = Path(config.sweep.dir)
    is_new, is_search = not folder.exists(), config.runtime.choices["hydra/sweeper"] == "optuna"
    with user_errors(f"{folder} cannot be made; choose another with hydra.sweep.dir=: "):
        if "hydra.sweep.dir" not in overrides:
            folder = folders.make(folder)  # another sweep may start in the same second
        folder.mkdir(parents=True, exist_ok=True)
    seeds = []
    if is_search and "seed" in overrides and overrides["seed"].is_sweep_override():
        seeds = [*filter(None, _values(overrides.pop("seed")))]  # of each trial
    once = [key for key, override in overrides.items() if not override.is_sweep_override()]
    options = (SEARCH if is_search else {}) | {
        "hydra.job.name": composer.command.name,
        "hydra.sweep.dir": json.dumps(str(folder), ensure_ascii=False),
        "hydra.job.config.override_dirname.exclude_keys": json.dumps(once),
    }
    words = [f"{key}={value}" for key, value in options.items() if key not in overrides]
    for text in (str(override.input_line) for override in overrides.values()):
        # Hydra itself would refuse new keys in {}, such as population.vary's
        words.append(f"++{text}" if re.match(r"[^+~=]+=\{", text) else text)
    if (package.ROOT / "train.py").exists():  # processes of launchers find a checkout, too
        paths = str(package.ROOT), os.environ.get("PYTHONPATH")
        os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, paths))
    job, problem = new_job(composer, folder, metric, seeds), ""
    # its errors are raised; it sets sys.argv
    os.environ["HYDRA_FULL_ERROR"], sys.argv[1:] = "1", ["--multirun", *words]
    global_hydra.GlobalHydra.instance().clear()
    main = hydra.main(config_path=MAIN, config_name=composer.name, version_base="1.3")(job)
    try:
        with signals.interrupting(job.interrupt):
            main()
    except Exception as error:  # a launcher's or a sweeper's
        problem = shortened(error, 400)
    finally:
        rows = [*job.rows().values()]
        rows = [row | {"state": LOST} if row["state"] == RUNNING else row for row in rows]
        if rows:
            with console.warned(f"{folder} cannot be written: "):
                write_table(folder, rows, is_printed=True)
        elif is_new:
            shutil.rmtree(folder, ignore_errors=True)
            with contextlib.suppress(OSError):  # there are others in it
                folders.SWEEPS.rmdir()
    if not rows:
        raise UserError(f"The sweep cannot start: {problem}")
    scored = [row for row in rows if row["state"] == DONE and "score" in row]
    if scored and all(row["score"] is None for row in scored):
        cause = "no episode finished; train longer"
        if metric != EARNED:
            cure = job.cure(Path(scored[0]["folder"])) if trainings else "name another metric="
            cause = f"none has {metric}; {cure}"
        console.say(f"No job has a score, so none is the best, as {cause}", sys.stderr)
    elif problem and all(row["state"] in (DONE, LOST) for row in rows):
        console.say(f"The launcher failed: {problem}", sys.stderr)
    return 1 if problem or any(row["state"] != DONE for row in rows) else 0


# ---- Jobs ----

#: Runs a job in a process of its own.
ALONE = "import sys; from megastep.agents.cli import sweeps; sweeps.run_job(sys.argv[1])"


def new_job(
    composer: Composer, folder: Path, metric: str = EARNED, seeds: Sequence[str] = ()
) -> "Job":
    """Returns what Hydra is to call for the jobs of a sweep."""
    records = folder.absolute() / ".jobs" / uuid.uuid4().hex[:8]
    records.mkdir(parents=True)
    source = composer.command.name, composer.name, composer.folder
    where = str(folder.absolute()), str(records), os.getpid(), os.getcwd()
    return Job(source, *where, metric, tuple(seeds))


@dataclasses.dataclass(frozen=True)
class Job:
    """What Hydra calls for a job, in whichever process. It composes again, for the device there."""

    source: tuple  # the script's name, and the other arguments of the Composer
    folder: str  # that of the sweep
    records: str  # a folder of files about the jobs
    process: int  # that of the sweep
    start: str  # the folder it was started in
    metric: str  # whose value is the score
    seeds: tuple[str, ...]  # `seed=1` and so on of the runs of which each job is the mean

    def __call__(self, config: object) -> float | None:
        """Returns the job's score, None if it failed: a sweeper is to go on."""
        hydra = HydraConfig.get()
        os.chdir(self.start)  # where paths are relative to, whatever hydra.job.chdir says
        fixed = hydra.job.config.override_dirname.exclude_keys
        searched = [word for word in hydra.overrides.hydra if "searchpath" in word]
        rows = []
        for i, seed in enumerate(self.seeds or ("",)):
            words, folder = [*hydra.overrides.task], hydra.runtime.output_dir
            if seed:
                words, folder = [*words, seed], f"{folder}_{seed}"
            pairs = (word.lstrip("+~").partition("=") for word in words)
            row: Row = dict(
                number=hydra.job.num * max(1, len(self.seeds)) + i,
                varied={key: _unquoted(value) for key, _, value in pairs if key not in fixed},
                state=RUNNING,
                folder=folder,
            )
            is_joblib = hydra.runtime.choices["hydra/launcher"] == "joblib"
            rows.append(self.run_once(row, words + searched, is_joblib))
        scores = [row.get("score") for row in rows]
        return None if None in scores else sum(scores) / len(scores)

    def run_once(self, row: Row, words: list[str], is_joblib: bool) -> Row:
        """Runs a job, with joblib in its own process, unless a cluster repeats one that is done."""
        number = row["number"]
        if earlier := self.rows().get(number):
            return earlier if earlier["state"] == DONE else self.run(row, words, is_again=True)
        if not is_joblib:
            return self.run(row, words)
        if Path(self.records, "stopped").exists():
            return row
        workers.end_with_parent(self.process)
        self.record(row)
        job = json.dumps([dataclasses.asdict(self), row, words])
        process = subprocess.Popen([sys.executable, "-c", ALONE, job])
        with workers.terminal_signals_blocked():
            process.wait()
        ended = self.rows().get(number, row)
        if ended["state"] == RUNNING:
            ended["state"] = LOST
            self.record(ended)
            console.say(f"Job {number} {LOST}", sys.stderr)
        return ended

    def run(self, row: Row, words: list[str], is_again: bool = False) -> Row:
        """Runs a job in this process, from its checkpoint if it is started again."""
        began, number, result = time.monotonic(), row["number"], None
        if os.getpid() != self.process:  # its lines are among those of others
            warnings.showwarning, console.prefix = console.warn, f"job {number}: "
        row |= dict(host=socket.gethostname(), process=os.getpid())
        self.record(row)
        try:
            with signals.interrupting():
                name, *rest = self.source
                module = importlib.import_module(f"megastep.agents.cli.{name}")
                composer = Composer(module.COMMAND, *rest)
                cfg = composer.settings(words)
                if isinstance(cfg, settings.Train):
                    cfg = self.own_settings(cfg, row["folder"], is_again)
                with gpu_slots.taken(cfg, number) as cfg:
                    result = composer.command.run(cfg)
                row["state"] = DONE
                if result and (best := populations.best(result)) is not None:
                    result = populations.folder_of(result, best)
                if result:
                    row |= scores.outcome(result, self.metric)
                    if result.is_dir() and row["score"] is None:
                        text = f"job {number}: it has no {self.metric}, and so no score"
                        console.warn(f"{text}; {self.cure(result)}")
        except signals.Interrupted as stop:
            row["state"] = f"interrupted: {stop.args[1]}"
            if stop.args[0] in signals.ANNOUNCING and "SUBMITIT_EXECUTOR" in os.environ:
                self.record(row)
                signal.raise_signal(stop.args[0])  # submitit has the saved job started again
            raise
        except Exception as error:  # whatever it is, the other jobs are worth running
            kind = "" if isinstance(error, UserError) else f"{type(error).__name__}: "
            row["state"] = f"FAILED: {kind}{shortened(error, 400)}"
            console.say(f"Job {number} {row['state']}", sys.stderr)
            os.makedirs(row["folder"], exist_ok=True)
            Path(row["folder"], "error.txt").write_text(traceback.format_exc())
        finally:
            row["seconds"] = round(time.monotonic() - began, 1)
            self.record(row)
        return row

    def cure(self, folder: Path) -> str:
        """Returns what gives a run the score that it lacks."""
        kind = self.metric.partition("/")[0]
        with contextlib.suppress(UserError):  # it has no metrics at all
            names = [name for name in runs.read(folder).names() if name.startswith(f"{kind}/")]
            if f"{kind}/return" in names and self.metric not in names:
                return closest(self.metric, names)
        return "train longer"

    def own_settings(self, cfg: settings.Train, folder: str, is_again: bool) -> settings.Train:
        """Returns the settings of a training with what differs for a job of a sweep."""
        loggers = dict(cfg.logger)
        for label, one in loggers.items():
            if getattr(one, "group", "") is None:
                loggers[label] = settings.changed(one, group=Path(self.folder).name)
        resume, folder = AUTO if is_again else cfg.resume, os.path.relpath(folder)
        return settings.changed(cfg, logger=loggers, folder=folder, resume=resume)

    def record(self, row: Row) -> None:
        """Writes what is known of a job, and the table of all jobs so far."""
        with contextlib.suppress(OSError):  # a full disk: the job is worth more
            path = Path(self.records, f"{row['number']}.json")
            write_atomically(path, json.dumps(row).encode())
            write_table(Path(self.folder), [*self.rows().values()])

    def rows(self) -> dict[int, Row]:
        """Returns what the jobs of this sweep recorded, by number, in order."""
        rows = [json.loads(path.read_text()) for path in Path(self.records).glob("*.json")]
        return {row["number"]: row for row in sorted(rows, key=lambda row: row["number"])}

    def interrupt(self, number: int) -> NoReturn:
        """Has jobs in other processes save and end, then raises Interrupted."""
        with contextlib.suppress(OSError):
            Path(self.records, "stopped").touch()
        deadline = time.monotonic() + 30  # seconds, for jobs to save
        for process in self.running():
            signals.stop(process)
        while self.running() and time.monotonic() < deadline:
            time.sleep(0.1)
        signals.interrupt(number)

    def running(self) -> list[int]:
        here = RUNNING, socket.gethostname()
        rows = [one for one in self.rows().values() if (one["state"], one.get("host")) == here]
        return [row["process"] for row in rows if row["process"] != os.getpid()]


def run_job(text: str) -> None:
    """Runs a job of `Job.run_once`, and ends with the process that started it."""
    fields, row, words = json.loads(text)
    job = Job(**fields)
    signals.exit_on_signals(job.source[0])
    console.open_streams()
    workers.end_with_parent(os.getppid())
    with contextlib.suppress(signals.Interrupted):
        job.run(row, words)


# ---- The table ----


def write_table(folder: Path, rows: list[Row], is_printed: bool = False) -> None:
    """Writes sweep.md, the table as it is printed, and sweep.csv, with all digits and folders."""
    rows = [row | row["varied"] | {"job": row["number"]} for row in rows]
    head = ["job", *dict.fromkeys(key for row in rows for key in row["varied"]), *COLUMNS]
    cells = [[_brief(row.get(name)) for name in head] for row in rows]
    if is_printed:
        console.say(f"Sweep\n{console.table(head, cells, width=console.terminal_width())}")
    write_atomically(folder / "sweep.md", console.table(head, cells, is_markdown=True).encode())
    names = [*head, "folder"]
    text = console.as_csv(names, ([row.get(name) for name in names] for row in rows))
    write_atomically(folder / "sweep.csv", text.encode())
    if is_printed:
        console.say(f"Table: {folder / 'sweep.md'}, with all digits in sweep.csv")


def _unquoted(value: str) -> str:
    # as it was typed: Hydra puts a \ before what its grammar knows
    return re.sub(r"\\([\\()\[\]{}:=, \t'\"])", r"\1", value.strip("\"'"))


def _brief(value: object) -> str:
    # with at most four digits: what a search tries has up to 17
    text = "" if value is None else str(value)
    return f"{float(text):.4g}" if re.fullmatch(r"-?\d*\.\d{5,}(e-?\d+)?", text) else text
