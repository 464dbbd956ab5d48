"""What follows training: an evaluation, a video, a report, and the loggers' last word."""

import json
from pathlib import Path

from megastep.agents import console
from megastep.agents.distributed import process_group
from megastep.agents.evaluation import evaluate_run, filming, tables
from megastep.agents.factory import settings
from megastep.agents.factory.trainer import make_loggers
from megastep.agents.runs import scores
from megastep.agents.types import RunResult
from megastep.imports import import_object


def finish(cfg: settings.Train, folder: Path, samples: int) -> None:
    """Does what `cfg.finish` asks for with the run in a folder. All ranks call it."""
    common: dict = dict(
        run=str(folder), split="test", greedy=False, seed=cfg.seed, device=cfg.device
    )
    common["trust"] = True  # its modules have just been imported
    table, film, is_first = None, None, process_group.rank() == 0
    if cfg.finish.evaluate:
        with process_group.unhurried():
            episodes = cfg.finish.episodes
            table = evaluate_run.run(
                settings.Evaluate(episodes=episodes, baseline=("random",), **common)
            )
    if cfg.finish.record and is_first:
        with console.warned():
            film = filming.run(
                settings.Record(steps=cfg.finish.steps, home=None, file=None, **common)
            )
    if cfg.finish.report and is_first:
        from megastep.agents.reports import report

        with console.warned():
            console.say(f"Report: {report.write([folder], folder / 'report.html')}")
    if is_first:
        tell_loggers(cfg, folder, samples, table, film)


def tell_loggers(
    cfg: settings.Train, folder: Path, samples: int, table: Path | None, film: Path | None
) -> None:
    """Gives the result of a run to those of its loggers that have a method `finish`.

    Args:
        table: the .json of its evaluation.
        film: its video.
    """
    if not any(hasattr(import_object(one.name), "finish") for one in cfg.logger.values()):
        return
    numbers = {name: x for name, x in scores.outcome(folder).items() if x is not None}
    cells = []
    if table is not None:
        cells = [tables.cells(row) for row in json.loads(table.read_text())["rows"]]
    with console.warned(), process_group.unhurried():
        logger = make_loggers(cfg, folder, samples)
        logger.finish(samples, RunResult({"samples": samples, **numbers}, film, cells))
        logger.close()
