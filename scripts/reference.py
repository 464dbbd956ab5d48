"""Generates the reference in docs/ from the code: public names, settings, metrics, exit codes.

A fenced block ```` ```{generated} WORDS ```` in a page stands for what `expand` puts in its place.
docs/conf.py does so when the site is built; tests/test_reference.py finds what has no description:

- a setting is an argument of a constructor, described under `Args:` of its docstring; one of a
  script is described by the comment at its key in configs/;
- a metric is described under `Metrics:` of the docstring of what reports it.
"""

import dataclasses
import functools
import importlib
import math
import re
import sys
import types
import typing
from collections.abc import Callable, Iterable
from pathlib import Path
from types import NoneType
from typing import Any, Literal, NamedTuple

import annotated_types
from docstrings import api, described, first_sentence, markdown
from omegaconf import OmegaConf
from pydantic import AfterValidator
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from megastep.agents import package
from megastep.agents.cli import compose
from megastep.agents.errors import EXIT_CODES
from megastep.agents.factory import check, components, settings
from megastep.imports import import_object
from megastep.schedules import Scheduled
from megastep.settings import BOUNDS, AtMost

#: The dataclasses of the scripts' settings.
SCRIPTS = {
    "train": settings.Train,
    "evaluate": settings.Evaluate,
    "record": settings.Record,
    "dump": settings.Dump,
}
#: Groups with one class of settings. The others have a class or function per member.
SINGLE = {"agent": components.POLICY, "opponents": components.OPPONENTS}
#: Settings that no docstring describes, since they are not arguments of the constructor.
ADDED = {
    "env.wrappers": "wrappers around the environment, names or `{name: ..., setting: ...}`; see "
    "[wrappers](../wrappers.md)",
    "learner.anneal": "budget over which the learning rate falls linearly to 0; `auto` takes "
    "`samples` if given, else `seconds`",
    "opponents.bot_class": "name or import path of the bot; null: the environment's own",
}
#: What reports metrics, by the title of its table. Environments and learners are added.
REPORTERS = {
    "Progress": "megastep.agents.training.trainer:Trainer.report",
    "Speed": "megastep.agents.training.performance:Timing.on_report",
    "Evaluations in training": "megastep.agents.evaluation.in_training:Evaluations.on_measure",
    "Episodes": "megastep.agents.training.episode_stats:EpisodeStats.pop",
    "Self-play": "megastep.agents.selfplay.opponents:Opponents.pop_win_rates",
    "Curricula": "megastep.agents.training.curriculum:SFL.stats",
}
# ---- Settings ----


class Setting(NamedTuple):
    """A setting; each part is Markdown. `cpu` is empty where a CPU has the default."""

    key: str
    kind: str
    default: str
    cpu: str
    meaning: str


def settings_of(group: str, member: str = "") -> list[Setting]:
    """Returns the settings of a member of a group, such as learner and ppo."""
    name = SINGLE.get(group) or components.members(group)[member]
    kind = components.kind_of(group, name)
    meanings = described(import_object(name), "Args")
    prefix = f"logger.{member}" if group == "logger" else group
    gpu, cpu = (configured(group, member, device).get(group) or {} for device in ("cuda", "cpu"))
    rows = []
    for key, field in kind.__pydantic_fields__.items():
        default = field.get_default(call_default_factory=True)
        if dataclasses.is_dataclass(default):
            below = described(type(default), "Args")
            for inner, one in default.__pydantic_fields__.items():
                value = getattr(default, inner)
                inners = (tree.get(key, {}).get(inner, value) for tree in (gpu, cpu))
                rows.append(_row(f"{prefix}.{key}.{inner}", one, *inners, below.get(inner, "")))
        elif key != "name":
            values = (tree.get(key, default) for tree in (gpu, cpu))
            meaning = meanings.get(key) or ADDED.get(f"{group}.{key}", "")
            rows.append(_row(f"{prefix}.{key}", field, *values, meaning))
    return rows


def settings_of_script(script: str) -> list[Setting]:
    """Returns the settings of a script, but for those of components."""
    file = f"{script}.yaml"
    comments = _comments((package.CONFIGS / file).read_text())
    gpu, cpu = (dict(check.leaves(_merged(file, device))) for device in ("cuda", "cpu"))
    groups = {*components.GROUPS}
    rows = []
    for key, field in check.fields_of(SCRIPTS[script], {}):
        if key.split(".")[0] not in groups and not dataclasses.is_dataclass(field.annotation):
            default = field.get_default(call_default_factory=True)
            values = (tree.get(key, default) for tree in (gpu, cpu))
            meaning = re.sub(r"<(.*?)>", lambda m: m[1].upper(), comments.get(key, ""))
            meaning = re.sub(r"docs/([\w/-]+\.md)", r"[\1](../\1)", meaning)
            rows.append(_row(key, field, *values, meaning))
    return rows


def _comments(text):
    """Returns {dotted key: comment} of a file of configs/."""
    found, group = {}, ""
    for indent, key, comment in re.findall(r"^( *)(\w+):[^#\n]*(?:# (.*))?$", text, re.M):
        group = group if indent else key
        found[f"{group}.{key}" if indent else key] = comment
    return found


def configured(group: str, member: str, device: str) -> dict[str, Any]:
    """Returns what train.yaml and the file of a group's member set on a device, nested."""
    files = [f"{group}/{member or 'lstm'}.yaml"]
    files = ["train.yaml", *(file for file in files if (package.CONFIGS / file).exists())]
    return _laid(_merged(file, device) for file in files)


def also_set(group: str, member: str) -> dict[str, tuple[Any, Any]]:
    """Returns {dotted key: (value on a GPU, on a CPU)} that a member sets of other groups."""
    file, both = f"{group}/{member}.yaml", []
    for device in ("cuda", "cpu"):
        content = _merged(file, device) if (package.CONFIGS / file).exists() else {}
        both.append({k: v for k, v in check.leaves(content) if k.split(".")[0] != group})
    return {key: tuple(one.get(key) for one in both) for key in both[0] | both[1]}


def _laid(trees: Iterable[dict[str, Any]]) -> dict[str, Any]:
    return OmegaConf.to_container(OmegaConf.merge(*trees))


@functools.cache
def _merged(file, device):
    """Returns the content of a file of configs/, with the blocks of a device and of its learner."""
    group, _, member = file.removesuffix(".yaml").rpartition("/")
    text = (package.CONFIGS / file).read_text()
    tree = OmegaConf.to_container(OmegaConf.create(text))
    applied = compose.blocks_of(device, member if group == "learner" else "ppo")
    content = compose.merged(tree, applied)
    defaults = content.pop("defaults", []) if group else []
    bases = [one for one in defaults if isinstance(one, str)]
    if group and "@package _global_" not in text:
        content = {group: content}
    return _laid([*(_merged(f"{group}/{base}.yaml", device) for base in bases), content])


def _row(key, field, gpu, cpu, meaning):
    texts = ["required" if one is PydanticUndefined else value_text(one) for one in (gpu, cpu)]
    return Setting(f"`{key}`", kind_of(field), texts[0], texts[1] * (cpu != gpu), meaning)


def value_text(value: Any) -> str:
    """Returns a value as it is typed on the command line."""
    if isinstance(value, str):
        return f"`{value}`"
    if isinstance(value, dict):
        inner = ", ".join(f"{k}: {value_text(v)}" for k, v in value.items())
        return f"`{{{inner.replace('`', '')}}}`"
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(value_text, value))}]"
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "null"}[value]
    return f"{value:,}" if isinstance(value, int) else f"{value:g}"


def kind_of(field: FieldInfo) -> str:
    """Returns the type of a setting and its bounds in words."""
    options = [field.annotation]
    if typing.get_origin(field.annotation) in (typing.Union, types.UnionType):
        options = typing.get_args(field.annotation)
    names = _known_names(field)
    if any(isinstance(one, Scheduled) for one in field.metadata):
        words = ["number", "schedule"]
    else:
        words = [_word(one, names) for one in options if one is not NoneType]
    text, bounds = " or ".join(words), re.sub(r"\d+(,\d{3}){3,}", _power, _bounds(field))
    bounds = bounds and f", {bounds}"
    limits = [f", at most `{one.key}`" for one in field.metadata if isinstance(one, AtMost)]
    return text + bounds + "".join(limits)


def _bounds(field):
    """Returns the bounds of a number in words."""
    extras = [*field.metadata]
    for option in typing.get_args(field.annotation):  # of `X | None`
        for extra in getattr(option, "__metadata__", ()):
            extras += extra.metadata if isinstance(extra, FieldInfo) else [extra]
    extras = [extra for extra in extras if isinstance(extra, annotated_types.BaseMetadata)]
    bounds = {key: getattr(one, key, None) for one in extras for key in BOUNDS if hasattr(one, key)}
    bounds = {key: bound for key, bound in bounds.items() if bound is not None}
    words = {"ge": "from {:,}", "gt": "above {:,}", "le": "to {:,}", "lt": "and below {:,}"}
    words = words if len(bounds) == 2 else BOUNDS
    return " ".join(words[key].format(bounds[key]) for key in BOUNDS if key in bounds)


def _power(match):
    """Returns a large number as a power, in which bounds are meant."""
    n = int(match[0].replace(",", ""))
    base = 2 if n & (n - 1) == 0 else 10
    return f"{base}^{round(math.log(n, base))}"


def _known_names(field):
    """Returns the names that the validators of a field know."""
    functions = [one.func for one in field.metadata if isinstance(one, AfterValidator)]
    partials = [one for one in functions if isinstance(one, functools.partial)]
    return {name for one in partials for name in one.keywords.get("names", ())}


def _word(hint, names):
    """Returns a type in words."""
    if typing.get_origin(hint) is typing.Annotated:
        hint = typing.get_args(hint)[0]
    origin, inner = typing.get_origin(hint) or hint, typing.get_args(hint)
    if origin is Literal:
        return ", ".join(f"`{word}`" for word in inner)
    if names:
        return ", ".join(f"`{word}`" for word in sorted(names)) + " or `module:Class`"
    if origin in (dict, Any) or dataclasses.is_dataclass(origin):
        return "keys with values"
    if inner:
        return f"list of {_word(inner[0], ())}s"
    words = {bool: "true or false", int: "integer", float: "number", str: "word", tuple: "list"}
    return words[origin]


def unexplained() -> list[str]:
    """Returns the settings without a meaning."""
    members = {group: components.members(group) for group in components.CHOSEN}
    pairs = [(group, m) for group, all_ in members.items() for m in all_ if all_[m] != "none"]
    pairs += [(group, "") for group in SINGLE]
    rows = [row for pair in pairs for row in settings_of(*pair)]
    rows += [row for script in SCRIPTS for row in settings_of_script(script)]
    return [row.key for row in rows if not row.meaning]


# ---- Metrics ----


@functools.cache
def metrics() -> dict[str, dict[str, str]]:
    """Returns {title: {metric: meaning}}."""
    tables = {k: described(import_object(path), "Metrics") for k, path in REPORTERS.items()}
    for group, prefix in (("env", "episode/"), ("learner", "")):
        for path in components.members(group).values():
            found = described(import_object(path), "Metrics")
            kind = import_object(path).__name__
            if found:
                tables[kind] = {prefix + key: text for key, text in found.items()}
    return tables


def has_metric(name: str) -> bool:
    """Returns whether the reference explains a metric. Capitals in its names stand for any word."""
    known = (key for table in metrics().values() for key in table)
    patterns = (re.sub(r"[A-Z]+", r"[^/]+", re.escape(key)) for key in known)
    return any(re.fullmatch(pattern, name) for pattern in patterns)


# ---- Pages ----


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    lines = [head, ["---"] * len([*head]), *rows]
    lines = [[" ".join(str(cell).split()).replace("|", "\\|") for cell in line] for line in lines]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _settings_table(rows):
    has_cpu = any(row.cpu for row in rows)
    head = ["setting", "meaning", "type", "default", "CPU"][: 4 + has_cpu]
    cells = [[row.key, row.meaning, row.kind, row.default, row.cpu][: 4 + has_cpu] for row in rows]
    return table(head, cells) if rows else "It has no settings."


def _settings_page(group):
    """Returns a section per member of a group, or the one table there is."""
    if group in SCRIPTS:
        return _settings_table(settings_of_script(group))
    if group in SINGLE:
        return _settings_table(settings_of(group))
    lines = []
    for member, path in components.members(group).items():
        if path != "none":
            lines += [f"### {member}", "", first_sentence(import_object(path)), ""]
            lines += [_settings_table(settings_of(group, member)), ""]
            others = also_set(group, member).items()
            if others := [f"`{k}={_unquoted(a)}`" for k, (a, _) in others]:
                lines += [f"`{group}={member}` also sets {', '.join(others)}.", ""]
    return "\n".join(lines)


def _unquoted(value):
    return value_text(value).strip("`")


def _recipes():
    rows = []
    for path in sorted((package.CONFIGS / "experiment").glob("*.yaml")):
        rows.append([f"`{path.stem}`", re.findall(r"^# (?!@)(.*)", path.read_text(), re.M)[0]])
    return table(["`experiment=`", "what it trains"], rows)


def _metrics_page():
    lines = []
    for title, entries in metrics().items():
        rows = [[f"`{key}`", text] for key, text in entries.items()]
        lines += [f"## {title}", "", table(["metric", "meaning"], rows), ""]
    return "\n".join(lines)


def _benchmarks():
    sys.path.append(str(Path(__file__).parent / "benchmarks"))
    import records
    import report

    return report.page(records.read(records.RECORDS))


#: What the words of a generated block make.
PAGES: dict[str, Callable[..., str]] = {
    "api": api,
    "module": lambda module: markdown(importlib.import_module(module).__doc__),
    "settings": _settings_page,
    "benchmarks": _benchmarks,
    "recipes": _recipes,
    "metrics": _metrics_page,
    "exit-codes": lambda: table(
        ["exit code", "meaning"], [[str(k), v] for k, v in EXIT_CODES.items()]
    ),
}


def expand(text: str) -> str:
    """Returns a page with its generated blocks."""

    def generated(match):
        name, *words = match[1].split()
        return PAGES[name](*words)

    return re.sub(r"^```\{generated\} (.*)\n```$", generated, text, flags=re.M)
