"""What is known of runs that have been trained: read from their folders, nothing imported."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from megastep.agents.errors import UserError
from megastep.agents.factory.check import leaves
from megastep.agents.factory.components import label
from megastep.agents.runs import config_yaml, folders, json_lines, scores, typed_json
from megastep.agents.types import Config, Row

#: Settings that differ between seeds of one experiment, or do not change what is learnt.
OF_A_SEED = "seed", "folder", "resume", "rerun", "ranks", "device", "finish", "logger", "dry_run"


class Run(NamedTuple):
    """A run that has been trained, or is being trained."""

    folder: Path
    config: Config  # its settings as nested dicts
    metrics: list[Row]  # the rows of its files
    perf: list[Row]
    provenance: list[Row]
    evaluations: list[Row]  # the contents of `evaluations/*.json`, in the order of names

    @property
    def task(self) -> str:
        """Environment and source of homes."""
        names = [self.config[group] for group in ("env", "geometry") if group in self.config]
        return ", ".join(label(str(group.get("name"))) for group in names)

    def settings(self) -> Row:
        """Returns {dotted key: value} of all settings but those of a seed."""
        return {k: v for k, v in leaves(self.config) if k.split(".")[0] not in OF_A_SEED}

    def score(self, metric: str = "episode/return") -> float | None:
        """Returns a metric's mean over the last reports; of evaluations the last."""
        if metric == "episode/return":
            return scores.mean(self.metrics)
        values = self.curve(metric)[1][-1 if metric.startswith("eval/") else -10 :]
        return sum(values) / len(values) if values else None

    @property
    def is_interrupted(self) -> bool:
        """Whether less than 90 % of each budget was spent, and nothing else ended the run."""
        done = []
        for name, rows in {"samples": self.metrics, "perf/seconds": self.perf}.items():
            budget, spent = self.config.get(name.removeprefix("perf/")), rows and rows[-1].get(name)
            if isinstance(budget, (int, float)) and budget > 0 and isinstance(spent, (int, float)):
                done.append(spent / budget)
        has_stop = any(key.startswith("evaluation.stop.") for key, _ in leaves(self.config))
        return bool(done) and max(done) < 0.9 and not has_stop

    def curve(self, metric: str) -> tuple[list[float], list[float]]:
        """Returns the samples and values of a metric of `metrics.jsonl` or `perf.jsonl`, `eval/` of
        `evaluations/` as well: in the run's own environment and unseen homes, actions sampled.
        """
        rows = self.perf if metric.startswith("perf/") else self.metrics
        points = {row["samples"]: row[metric] for row in rows if row.get(metric) is not None}
        for step, means in self._evaluated() if metric.startswith("eval/") else ():
            if (value := means.get(metric)) is not None:
                points[step] = value
        return [*sorted(points)], [points[x] for x in sorted(points)]

    def names(self) -> list[str]:
        """Returns the names of the numbers that it reports."""
        cells = [cell for row in self.metrics + self.perf for cell in row.items()]
        texts = {"samples", *(key for key, value in cells if isinstance(value, str))}
        cells += [cell for _, means in self._evaluated() for cell in means.items()]
        return [key for key in dict(cells) if key not in texts]

    def _evaluated(self) -> list[tuple[int, Row]]:
        """Returns the samples, and the means by metric, of evaluations as in training."""
        found = []
        for table in self.evaluations:
            row, how = table["rows"][0], table.get("evaluation", {})
            is_alike = how.get("split") == "test" and not any(map(how.get, scores.OTHERWISE))
            if is_alike and "return" in row and "step" in table:
                means = {name: one.get("mean") for name, one in row.get("metrics", {}).items()}
                means |= {"return": row["return"], "length": row.get("length")}
                found.append((table["step"], {f"eval/{name}": x for name, x in means.items()}))
        return found


def read(folder: Path) -> Run:
    """Returns what a run's folder holds. Raises UserError if it is not a run, or odd."""
    folder = folders.folder_of(folders.find(str(folder)))
    if not (folder / "config.yaml").exists():
        raise UserError(f"{folder} is not a run: it has no config.yaml")
    config = config_yaml.read(folder / "config.yaml")
    names, kind = ("metrics.jsonl", "perf.jsonl"), typed_json.Metrics
    metrics, perf = (json_lines.read(folder / name, kind) for name in names)
    if not metrics:
        raise UserError(f"{folder} has no metrics yet; its first report writes metrics.jsonl")
    starts = json_lines.read(folder / "provenance.jsonl", typed_json.Start)
    tables = [*map(scores.evaluation, sorted((folder / "evaluations").glob("*.json")))]
    return Run(folder, config, metrics, perf, starts, tables)


def expanded(names: Sequence[str]) -> list[Path]:
    """Returns the run folders of names: runs, `latest`, sweeps with all jobs. UserError if not."""
    if not names:
        raise UserError("run=[] names no run; give their folders, or latest")
    paths = []
    for name in names:
        jobs = sorted(file.parent for file in Path(name).glob("*/metrics.jsonl"))
        is_run = (Path(name) / "metrics.jsonl").exists()
        paths += jobs if jobs and not is_run else [folders.folder_of(folders.find(name))]
    return [*dict.fromkeys(paths)]


def groups_of(runs: Sequence[Run]) -> dict[str, list[Run]]:
    """Returns {what differs between groups: the runs that differ in their seeds alone}."""
    by_settings: dict[str, list[Run]] = {}
    for run in runs:
        by_settings.setdefault(repr(sorted(run.settings().items())), []).append(run)
    keys = differing([group[0] for group in by_settings.values()])
    named: dict[str, list[Run]] = {}
    is_population = len({run.folder.parent for run in runs}) == 1
    for group in by_settings.values():
        text = ", ".join(f"{key}={group[0].settings().get(key)}" for key in keys[:4])
        if is_population and (member := group[0].settings().get("population.member")) is not None:
            text = f"member {member}"
        for more in ("", group[0].folder.name, str(group[0].folder)):
            name = f"{text} {more}".strip()
            if name and name not in named:
                break
        named[name] = group
    return named


def without_interrupted(groups: dict[str, list[Run]]) -> tuple[dict[str, list[Run]], list[str]]:
    """Returns groups without interrupted runs, unless all are, and a sentence for each left out."""
    kept, sentences = {}, []
    for name, group in groups.items():
        kept[name] = [run for run in group if not run.is_interrupted] or group
        sentences += [
            f"{run.folder} is left out: it was interrupted after "
            f"{run.metrics[-1]['samples']:,} samples"
            for run in group
            if run not in kept[name]
        ]
    return kept, sentences


def differing(runs: Iterable[Run]) -> list[str]:
    """Returns the dotted keys whose values are not the same in all runs."""
    trees = [run.settings() for run in runs]
    keys = dict.fromkeys(key for tree in trees for key in tree)
    return [key for key in keys if len({repr(tree.get(key)) for tree in trees}) > 1]


def metrics_of(runs: Sequence[Run]) -> list[str]:
    """Returns the names of numbers that all runs report, in the order of the first run."""
    names = [run.names() for run in runs]
    return [name for name in names[0] if all(name in other for other in names[1:])]
