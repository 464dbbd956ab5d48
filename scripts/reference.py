"""Generates the reference in docs/ from the code: public names, settings, metrics, exit codes.

A fenced block ```` ```{generated} WORDS ```` in a page stands for what `expand` puts in its place.
docs/conf.py does so when the site is built; tests/test_reference.py finds what has no description:

- a setting is an argument of a constructor, described under `Args:` of its docstring; one of a
  script is described by the comment at its key in configs/;
- a metric is described under `Metrics:` of the docstring of what reports it;
- a public name is a class or function without an underscore, described by its docstring.
"""

import dataclasses
import functools
import importlib
import inspect
import math
import operator
import pkgutil
import re
import sys
import textwrap
import types
import typing
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import ModuleType, NoneType
from typing import Any, Literal, NamedTuple

from omegaconf import OmegaConf
from pydantic import AfterValidator
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

import megastep
from megastep.agents import package
from megastep.agents.cli import blocks
from megastep.agents.errors import EXIT_CODES
from megastep.agents.factory import check, components, settings
from megastep.imports import import_object
from megastep.schedules import Scheduled
from megastep.settings import AtMost, allowed

#: The dataclasses of the scripts' settings.
SCRIPTS = {"train": settings.Train, "evaluate": settings.Evaluate, "record": settings.Record}
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
    "Evaluations in training": "megastep.agents.training.callbacks:Evaluations.on_measure",
    "Episodes": "megastep.agents.training.episode_stats:EpisodeStats.pop",
    "Self-play": "megastep.agents.selfplay.opponents:Opponents.pop_win_rates",
    "Curricula": "megastep.agents.training.curriculum:Curriculum.stats",
}
#: Megastep's own machinery, which nobody needs to import; and `cuda`, another name of `engine`.
INTERNAL = re.compile(
    r"megastep\.(__main__|adapters\.(?!vector_env)\w+|atomic_files|cache|compat|cuda|colour|demo|global_generators|hosting|imports|kernels|host_state|moments"
    r"|web|agents\.(cli|console|export|distributed\.(?!pooling)"
    r"\w+|factory|hardware|launch|package|pretrained|runs|networks\.(kernels|web|\w+_cpu)|storage\.\w*kernels"
    r"|algorithms\.kernels)|geometries\.homes\.\w+|envs\.\w+\.(?!(env|bot|tracker)\b)\w+|geodesics)\b"
)


# ---- Docstrings ----


def section(text: str | None, title: str) -> dict[str, str]:
    """Returns {name: description} of a section of a docstring, such as `Args`. Names that share a
    description each have it.
    """
    body = re.search(rf"^{title}:\n((?:    .*\n|\n)+)", f"{inspect.cleandoc(text or '')}\n", re.M)
    entries = {}
    for entry in re.findall(r"^ {4}(\S.*(?:\n {8}.*)*)", body[1] if body else "", re.M):
        names, colon, description = entry.partition(": ")
        if colon:
            words = re.sub(r":\w+:`~?([\w.]+)`", r"`\1`", " ".join(description.split()))
            words = words.replace("``", "`")
            entries |= dict.fromkeys(names.replace("`", "").split(", "), words)
    return entries


def described(one: Any, title: str) -> dict[str, str]:
    """Returns {name: description} of a section of a class, with its bases, or of a function."""
    kinds = reversed(one.__mro__) if inspect.isclass(one) else [one]
    sections = [section(kind.__doc__, title) for kind in kinds]
    return functools.reduce(operator.or_, sections)


def first_sentence(one: Any) -> str:
    paragraph = (inspect.getdoc(one) or "").partition("\n\n")[0]
    return re.split(r"(?<=\.) (?=[A-Z])", " ".join(paragraph.split()))[0]


# ---- Public names ----


def modules(root: str = "megastep") -> Iterator[ModuleType]:
    """Yields a package and the modules below it, but for `INTERNAL` ones."""
    yield (module := importlib.import_module(root))
    for found in pkgutil.iter_modules(getattr(module, "__path__", ())):
        name = f"{root}.{found.name}"
        if not (found.name.startswith("_") or INTERNAL.match(name)):
            yield from modules(name)


def public(module: ModuleType) -> dict[str, Any]:
    """Returns the public names of a module that no package above it exports."""
    names = getattr(module, "__all__", None)
    if names is None:
        own = {k: v for k, v in vars(module).items() if _is_code(v)}
        names = [k for k, v in own.items() if v.__module__ == module.__name__ and k[0] != "_"]
    above, parts = set(), module.__name__.split(".")
    for n in range(2, len(parts)):
        above |= {*getattr(importlib.import_module(".".join(parts[:n])), "__all__", ())}
    found = {name: getattr(module, name) for name in names}
    return {k: v for k, v in found.items() if k not in above and not inspect.ismodule(v)}


def methods(kind: type) -> dict[str, Any]:
    """Returns the public methods and properties that a class defines, but for those that it
    describes under `Attributes:`.
    """
    plain = types.FunctionType, property, classmethod, staticmethod
    attributes = described(kind, "Attributes")
    found = {k: v for k, v in vars(kind).items() if k[0] != "_" and isinstance(v, plain)}
    return {name: value for name, value in found.items() if name not in attributes}


def undescribed() -> list[str]:
    """Returns the public names and methods without a docstring."""
    found = []
    for module in modules():
        for name, one in public(module).items():
            path = f"{module.__name__}.{name}"
            own = methods(one) if inspect.isclass(one) else {}
            text = inspect.getdoc(one) if callable(one) else comment_on(module.__name__, name)
            found += [] if text else [path]
            found += [f"{path}.{k}" for k in own if not inspect.getdoc(getattr(one, k))]
    return found


def _is_code(value):
    return inspect.isclass(value) or inspect.isfunction(value)


def api(root: str) -> str:
    """Returns the documentation of a module or package: a heading per module, and a directive of
    Sphinx's Python domain per public name.
    """
    lines = []
    for module in modules(root):
        if names := public(module):
            lines += [f"## {module.__name__}", "", markdown(module.__doc__), ""]
            for name, one in names.items():
                lines += _object(module.__name__, name, one, "::::")
    return "\n".join(lines)


def _object(module, name, one, fence):
    """Returns the lines about a class, with its methods, a function or a constant."""
    kind, arguments = "data", ""
    if inspect.isclass(one):
        kind = "exception" if issubclass(one, BaseException) else "class"
    elif callable(one):
        kind = "method" if "." in name else "function"
    elif isinstance(one, property):
        kind = "property"
    called = kind in ("class", "function", "method")
    arguments = _signature(one, kind == "method") if called else ""
    text = comment_on(module, name) if kind == "data" else inspect.getdoc(one)
    text = markdown(text, _hints(one) if called else {})
    lines = [f"{fence}{{py:{kind}}} {name}{arguments}", f":module: {module}"]
    lines += [f":value: {one!r}"] if kind == "data" and isinstance(one, (int, float)) else []
    lines += ["", text, ""]
    for key, below in methods(one).items() if inspect.isclass(one) else ():
        below = below if isinstance(below, property) else getattr(one, key)
        lines += _object(module, f"{name}.{key}", below, fence[1:])
    return [*lines, fence, ""]


def _signature(one, is_method):
    """Returns the arguments of a class or function with their defaults, without types."""
    try:
        parameters = [*inspect.signature(one).parameters.values()]
    except (TypeError, ValueError):  # of a built-in class
        return ""
    parameters = [p.replace(annotation=p.empty) for p in parameters if p.name != "self"]
    defaults = (p.empty if p.default is p.empty else _Plain(p.default) for p in parameters)
    return str(inspect.Signature([p.replace(default=d) for p, d in zip(parameters, defaults)]))


class _Plain:
    """A default as signatures show it."""

    def __init__(self, value):
        text = getattr(value, "__name__", None) or repr(value)
        self.text = text if len(text) <= 40 and "<" not in text and "\n" not in text else "..."

    def __repr__(self):
        return self.text


def _hints(one):
    """Returns the types of the arguments as text, without the bounds of settings."""
    function = one.__init__ if inspect.isclass(one) else one
    try:
        hints = typing.get_type_hints(function)
    except (AttributeError, NameError, TypeError):
        return {}
    texts = {name: inspect.formatannotation(hint) for name, hint in hints.items()}
    texts = {name: re.sub(r"\b(?:\w+\.)+(?=\w)", "", text) for name, text in texts.items()}
    return {name: text for name, text in texts.items() if len(text) <= 60}


def markdown(text: str | None, hints: dict[str, str] | None = None) -> str:
    """Returns a docstring as Markdown.

    Args:
        text: what is indented below a line `Title:` becomes a list, if each of its entries begins
            with a name and a colon.
        hints: the types of arguments.
    """
    text = re.sub(r":\w+:`~?([^`]+)`", r"`\1`", inspect.cleandoc(text or ""))
    text = re.sub(r"``([^`]+)``", r"`\1`", re.sub(r"::$", ":", text, flags=re.M))

    def listed(match):
        title, body = match[1], textwrap.dedent(match[2]).strip()
        entries = re.findall(r"^\S.*(?:\n(?: +.*|(?=\n)))*", body, re.M)
        pairs = [re.fullmatch(r"([\w.*`(), ]+): (.*)", e, re.S) for e in entries]
        if all(pairs) and title not in ("Returns", "Yields"):
            rows = []
            for pair in pairs:
                name = pair[1].replace("`", "")
                kind = f" (`{hints[name]}`)" if hints and name in hints else ""
                rows.append(f"- **{name}**{kind}: {' '.join(pair[2].split())}")
            body = "\n".join(rows)
        return f"\n**{title}**\n\n{body}\n"

    return re.sub(r"^(\S[^\n]*):\n((?:    .*\n|\n)+)", listed, f"{text}\n", flags=re.M).rstrip()


@functools.cache
def comment_on(module: str, name: str) -> str:
    """Returns the comment at a constant, above it or behind it, in its module or another."""
    own, root = Path(importlib.import_module(module).__file__), Path(megastep.__file__).parent
    definition = re.compile(rf"((?:^#.*\n)*)^{name}(?::.*)? = .*?(?:  # (.*))?$", re.M)
    for path in (own, *sorted(root.rglob("*.py")), *sorted((root / "agents").rglob("*.py"))):
        found = definition.search(path.read_text(errors="replace"))
        if found and (text := found[2] or re.sub(r"^#:? ?", "", found[1], flags=re.M)):
            return text
    return ""


def documentation(module: str) -> str:
    """Returns the docstring of a module."""
    return markdown(importlib.import_module(module).__doc__)


def source_of(module: str, name: str) -> tuple[str, int]:
    """Returns the file of a class or function in the repository, and its first line; "" and 0 of
    what has none.
    """
    try:
        one = operator.attrgetter(name)(importlib.import_module(module))
        one = inspect.unwrap(getattr(one, "fget", one))
        path = Path(inspect.getsourcefile(one)).resolve()
        line = inspect.getsourcelines(one)[1]
    except (AttributeError, OSError, TypeError):
        return "", 0
    root = Path(__file__).resolve().parents[1]
    return (str(path.relative_to(root)), line) if path.is_relative_to(root) else ("", 0)


# ---- Settings ----


class Setting(NamedTuple):
    """A setting; each part is Markdown. `cpu` is empty where a CPU has the default."""

    key: str
    kind: str
    default: str
    cpu: str
    meaning: str


def settings_of(group: str, member: str = "") -> list[Setting]:
    """Returns the settings of a component.

    Args:
        group: env, geometry, learner, curriculum, logger, agent or opponents.
        member: what chooses the component, such as ppo.
    """
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
    """Returns {dotted key: (value on a GPU, on a CPU)} of what the file of a group's member sets of
    other groups.
    """
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
    applied = blocks.blocks_of(device, member if group == "learner" else "ppo")
    content = blocks.merged(tree, applied)
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
    names = {name for one in _validators(field) for name in one}
    if any(isinstance(one, Scheduled) for one in field.metadata):
        words = ["number", "schedule"]
    else:
        words = [_word(one, names) for one in options if one is not NoneType]
    text, bounds = " or ".join(words), re.sub(r"\d+(,\d{3}){3,}", _power, allowed(field))
    bounds = "" if bounds == "any finite number" else f", {bounds}"
    limits = [f", at most `{one.key}`" for one in field.metadata if isinstance(one, AtMost)]
    return text + bounds + "".join(limits)


def _power(match):
    """Returns a large number as a power, in which bounds are meant."""
    n = int(match[0].replace(",", ""))
    base = 2 if n & (n - 1) == 0 else 10
    return f"{base}^{round(math.log(n, base))}"


def _validators(field):
    """Yields the names that the validators of a field know."""
    for one in field.metadata:
        if isinstance(one, AfterValidator) and isinstance(one.func, functools.partial):
            yield one.func.keywords.get("names", ())


def _word(hint, names):
    """Returns a type in words."""
    if typing.get_origin(hint) is typing.Annotated:
        hint = typing.get_args(hint)[0]
    origin, inner = typing.get_origin(hint) or hint, typing.get_args(hint)
    if origin is Literal:
        return ", ".join(f"`{word}`" for word in inner)
    if names:
        return ", ".join(f"`{word}`" for word in sorted(names)) + " or `module:Class`"
    if origin in (dict, Any):
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
    """Returns {title: {metric: meaning}} of all that reports metrics."""
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
    lines = [[" ".join(cell.split()).replace("|", "\\|") for cell in line] for line in lines]
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


def _exit_codes():
    return table(["exit code", "meaning"], [[str(k), text] for k, text in EXIT_CODES.items()])


def _benchmarks():
    sys.path.append(str(Path(__file__).parent / "benchmarks"))
    import paths
    import records
    import report

    return report.page(records.read(paths.RECORDS))


#: What the words of a generated block make.
PAGES: dict[str, Callable[..., str]] = {
    "api": api,
    "module": documentation,
    "settings": _settings_page,
    "benchmarks": _benchmarks,
    "recipes": _recipes,
    "metrics": _metrics_page,
    "exit-codes": _exit_codes,
}


def expand(text: str) -> str:
    """Returns a page with its generated blocks."""

    def generated(match):
        name, *words = match[1].split()
        return PAGES[name](*words)

    return re.sub(r"^```\{generated\} (.*)\n```$", generated, text, flags=re.M)
