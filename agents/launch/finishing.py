"""What follows training: evaluation, video, report, loggers' last word, comparison."""

import itertools
import json
from pathlib import Path

from megastep.agents import console
from megastep.agents.distributed import process_group
from megastep.agents.errors import UserError, user_errors
from megastep.agents.evaluation import evaluate_run, filming, tables
from megastep.agents.factory import settings
from megastep.agents.factory.trainer import make_loggers
from megastep.agents.runs import folders, populations, provenance, scores
from megastep.agents.types import RunResult
from megastep.imports import import_object

METRICS = "metrics.jsonl"


def finish(cfg: settings.Train, folder: Path, samples: int) -> None:
    """Does what `cfg.finish` asks for with the run in a folder. All ranks call it."""
    # trust: its modules have just been imported
    common: dict = dict(split="test", greedy=False, seed=cfg.seed, device=cfg.device, trust=True)
    common["run"], table, film = str(folder), None, None
    if cfg.finish.evaluate:
        options = dict(episodes=cfg.finish.episodes, baseline=("random",))
        table = evaluate_run.run(settings.Evaluate(**options, **common))
    if process_group.rank() > 0:
        return
    if cfg.finish.record:
        with console.warned():
            options = dict(steps=cfg.finish.steps, home=None, file=None)
            film = filming.run(settings.Record(**options, **common))
    if cfg.finish.report:
        from megastep.agents.reports import report

        with console.warned():
            console.say(f"Report: {report.write([folder], folder / 'report.html')}")
    if any(hasattr(import_object(one.name), "finish") for one in cfg.logger.values()):
        numbers = {name: x for name, x in scores.outcome(folder).items() if x is not None}
        rows = [] if table is None else json.loads(table.read_text())["rows"]
        result = RunResult({"samples": samples, **numbers}, film, [*map(tables.cells, rows)])
        with console.warned():
            logger = make_loggers(cfg, folder, samples)
            logger.finish(samples, result)
            logger.close()


def next_command(cfg: settings.Train, folder: Path) -> str:
    """Returns what people do next with a run that has ended: evaluate it, film it, or continue."""
    if not cfg.finish.evaluate:
        return f"To evaluate it: {folders.command_of('evaluate', 'run', folder)}"
    if not cfg.finish.record:
        return f"To film it: {folders.command_of('record', 'run', folder)}"
    return f"To train it further: {folders.resume_command(folder)} more_seconds=10min"


def compare(folder: Path, original: Path) -> None:
    """Checks that two runs, or populations, have the same metrics. UserError if not."""
    members, what = populations.members(original), f"{METRICS} equals that"
    names = [METRICS]
    if members:
        names = [*(f"{member.name}/{METRICS}" for member in members), populations.FILE]
        what = f"{populations.FILE} and {METRICS} of all {len(members)} members equal those"
    cause = f"equal bits need the same versions, device and threads: see {provenance.FILE} of both"
    if generation := populations.first_copy(original):
        cause = (
            f"in generation {generation} it copied another member, which a run of its own cannot: "
            f"rerun={original.parent} repeats the whole population"
        )
    for name in names:
        with user_errors("The runs cannot be compared: "):
            ours, theirs = ((one / name).read_bytes().split(b"\n") for one in (folder, original))
        pairs = enumerate(itertools.zip_longest(ours, theirs), 1)
        if number := next((number for number, (one, other) in pairs if one != other), None):
            text = f"{name} differs from that of {original} from line {number} on; {cause}"
            raise UserError(text, 1)
    console.say(f"{what} of {original}, byte for byte.")
