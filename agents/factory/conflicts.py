"""Settings that contradict each other, or name what is not there: (dotted key, sentence) each."""

import operator
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from megastep.agents.factory import components
from megastep.agents.factory.components import env_name
from megastep.schedules import Scheduled
from megastep.settings import AtMost, closest

if TYPE_CHECKING:
    from megastep.agents.factory.settings import Dump, Env, Learner, Record, Train

#: Endings of what record.py can write.
FILMS = ".mp4", ".gif", ".png", ".svg", ".pdf"


def of_training(cfg: "Train") -> Iterator[tuple[str, str]]:
    """Yields what is wrong with the settings of a training."""
    env, learner, over = cfg.env, cfg.learner, cfg.learner.anneal
    # classes of users are asked when they are made
    draws = getattr(env, "resample", not env.name.startswith("megastep."))
    if cfg.curriculum.name != "none" and not draws:
        cure = "use env.resample=true" if hasattr(env, "resample") else "use curriculum=none"
        yield "curriculum", f"env={env_name(env)} draws no home for each episode; {cure}"
    for key, field, value in _fields(cfg):
        for limit in (extra for extra in field.metadata if isinstance(extra, AtMost)):
            if value > (most := operator.attrgetter(limit.key)(cfg)):
                yield key, f"{value} is more than {limit.key}={most}"
    if cfg.opponents.league and cfg.population.size == 1:
        text = "are other members of a population, which needs population.size=2 or more"
        yield "opponents.league", text
    if over in ("samples", "seconds") and getattr(cfg, over) is None:
        text = f"is {over}, and no {over}= is given for the learning rate to fall over"
        yield "learner.anneal", text
    elif over in ("samples", "seconds") and changes_lr(learner):
        text = "but learner.lr is a schedule or follows learner.desired_kl"
        yield "learner.anneal", f"is {over}, {text}; leave learner.anneal out"
    if (cfg.samples, cfg.seconds, cfg.rerun, cfg.resume) == (None,) * 4:
        for key in dict.fromkeys(schedules_of(cfg)):
            yield key, "is a schedule over the budget; give samples= or seconds="
    for name in ("samples", "seconds"):
        if cfg.resume is None and getattr(cfg, f"more_{name}") is not None:
            text = f"extends a resumed run; give resume=RUN, or {name}= for a new run"
            yield f"more_{name}", text
    yield from _population_conflicts(cfg)
    if cfg.member is not None and cfg.init is None:
        yield "member", "is of a population whose weights start a run; give init=RUN"
    if cfg.evaluation.stop and cfg.evaluation.every is None:
        text = "needs evaluations in training to reach it: give evaluation.every=60s, or 1M"
        yield "evaluation.stop", text
    has_budget = any((cfg.samples, cfg.seconds, cfg.more_samples, cfg.more_seconds))
    if cfg.checkpoints.snapshots and not has_budget:
        yield "checkpoints.snapshots", "are spread over the budget; give samples= or seconds="


def of_recording(cfg: "Record") -> Iterator[tuple[str, str]]:
    """Yields what is wrong with the settings of a film."""
    has_run, has_env = cfg.run is not None or cfg.runs is not None, cfg.env is not None
    if not (has_run or has_env):
        yield "run", "is missing; without a run, env=explorer records random actions"
    if has_run and has_env:
        yield "env", "cannot be combined with run, which has its own"
    if cfg.runs is not None and cfg.run is not None:
        yield "runs", "cannot be combined with run; list all runs in runs"
    elif cfg.runs is not None and cfg.homes is not None:
        yield "runs", "cannot be combined with homes; choose one home="
    if cfg.file is not None and not cfg.file.endswith(FILMS):
        text = "is neither a film, .mp4 or .gif, nor its last frame, .png, .svg or .pdf"
        yield "file", f"{cfg.file!r} {text}"
    if cfg.against is not None and cfg.run is None:
        yield "against", "needs run=, the agent that plays against it"


def of_dumping(cfg: "Dump") -> Iterator[tuple[str, str]]:
    """Yields what is wrong with the settings of a dataset."""
    if (cfg.run is None) == (cfg.bot is None):
        yield "run", "or bot= is needed, one of both: who plays"
    elif cfg.bot is not None and cfg.env is None:
        yield "env", f"is missing; bot={cfg.bot} env=explorer says where the bot plays"


def _fields(cfg: "Train") -> Iterator[tuple[str, Any, Any]]:
    """Yields (key, field, value) of the settings of the learner and the environment."""
    for prefix, part in (("learner", cfg.learner), ("env", cfg.env)):
        for name, field in part.__pydantic_fields__.items():
            yield f"{prefix}.{name}", field, getattr(part, name)


def _bounds(field) -> Scheduled | None:
    """Returns the bounds of a setting that may be a schedule, None of any other."""
    return next((extra for extra in field.metadata if isinstance(extra, Scheduled)), None)


def schedules_of(cfg: "Train") -> list[str]:
    """Returns the keys of settings that have a schedule."""
    fields = [*_fields(cfg)]
    for wrapper in cfg.env.wrappers:
        if isinstance(wrapper, dict):
            item = components.wrapper_settings(wrapper)
            own = item.__pydantic_fields__.items()
            fields += [("env.wrappers", field, getattr(item, name)) for name, field in own]
    return [k for k, field, value in fields if _bounds(field) and not isinstance(value, float)]


def _population_conflicts(cfg: "Train") -> Iterator[tuple[str, str]]:
    chosen, is_many = cfg.population, cfg.population.size > 1
    for key, one in chosen.vary.items():
        if problem := _problem_of_variation(cfg, key, one):
            yield "population.vary", f"{key} {problem}"
            break
    if not is_many:
        if chosen.vary:
            text = "is 1, and population.vary needs several members: population.size=8"
            yield "population.size", text
        return
    if chosen.score == "evaluated" and not isinstance(cfg.evaluation.every, int):
        text = "is evaluated, which needs evaluations every so many samples: evaluation.every=10M"
        yield "population.score", text
    if isinstance(cfg.ranks, int) and cfg.ranks > chosen.size:
        text = f"is more than population.size={chosen.size}; each rank needs a member"
        yield "ranks", f"{cfg.ranks} {text}"
    if cfg.resume == "auto":
        yield "resume", "cannot be auto for a population yet; give resume=RUN, its folder"


def _problem_of_variation(cfg, key, one) -> str | None:
    """Returns why a setting cannot vary between members of a population, None if it can."""
    bounds = {name: limits for name, field, _ in _fields(cfg) if (limits := _bounds(field))}
    if key not in bounds:
        return f"cannot vary; {closest(key, bounds)}"
    if key in schedules_of(cfg):
        return f"is a schedule, {getattr(cfg.learner, key[8:], '')}, and so cannot vary"
    if key == "learner.lr" and getattr(cfg.learner, "desired_kl", None) is not None:
        return "follows learner.desired_kl, and so cannot vary"
    if problem := one.problem():
        return problem
    try:
        for number in one.ends():
            bounds[key].check(number)
    except ValueError as error:
        return str(error)


def changes_lr(learner: "Learner") -> bool:
    """Returns whether the learning rate has a schedule, or follows the KL divergence."""
    is_constant = isinstance(getattr(learner, "lr", 0.0), (int, float))
    return not is_constant or getattr(learner, "desired_kl", None) is not None


def ignored_geometry(env: "Env | None", typed: list[str]) -> list[tuple[str, str]]:
    """Returns what is wrong with a typed geometry, if the environment takes none."""
    keys = [key for key in typed if key.split(".")[0] == "geometry"]
    if not keys or env is None or components.takes_geometries(env.name):
        return []
    return [(keys[0], f"env={env_name(env)} takes no floor plans; leave geometry out")]
