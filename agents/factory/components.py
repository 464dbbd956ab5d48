"""The members of groups that settings choose. Constructor arguments are their settings."""

import functools
import importlib
import inspect
import re
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import yaml
from pydantic import BeforeValidator, TypeAdapter, ValidationError

import megastep
from megastep.agents import package
from megastep.imports import import_object
from megastep.settings import closest, frozen, parameters_of, sentence, settings_of

POLICY = "megastep.agents.networks.policy:Policy"
#: Floor plans unless geometry= says otherwise.
BOX = "megastep.geometries.sources:box"
HOMES = "megastep.geometries.sources:homes"
SUITE = "megastep.geometries.sources:suite"
OPPONENTS = "megastep.agents.selfplay.opponents:Opponents"
#: Returns pydantic's adapter of a dataclass of settings.
adapter = functools.cache(TypeAdapter)


def _wrappers(value: Any) -> tuple[Any, ...]:
    """Returns the wrappers of an environment: names, and dicts of `name` and settings."""
    items = [value] if isinstance(value, (str, dict)) else value
    for item in items if isinstance(items, (list, tuple)) else [items]:
        name, known = item.get("name") if isinstance(item, dict) else item, members("wrapper")
        if not isinstance(name, str):
            raise ValueError(f"a wrapper is a name or {{name: ..., setting: ...}}, got {item!r}")
        if ":" not in name and name not in known:
            raise ValueError(f"{name!r} is not a wrapper; {closest(name, known)}, or module:Class")
        if name in known or isinstance(item, dict):
            wrapper_settings(item)
    return tuple(items)


def wrapper_settings(item: "str | dict") -> Any:
    """Returns the settings of a wrapper. Raises ValueError if they are not those of its class."""
    tree = {"name": item} if isinstance(item, str) else item
    label = tree["name"]
    kind = kind_of("wrapper", path := members("wrapper").get(label, label))
    try:
        return adapter(kind).validate_python(tree | {"name": path})
    except ValidationError as error:
        line, fields = error.errors()[0], kind.__pydantic_fields__
        key = str(line["loc"][0])
        if key not in fields:
            hint = closest(key, fields.keys() - {"name"})
            raise ValueError(f"{label} has no setting {key!r}; {hint}") from None
        raise ValueError(f"{label}: {key}: {sentence(line)}") from None


class Group(NamedTuple):
    """How the arguments of a group's members become settings."""

    reserved: tuple[str, ...] = ()  # arguments that megastep passes
    needed: dict[str, str] = {}  # {argument: meaning} of what a member must take
    missing: dict[str, Any] = {}  # defaults of arguments that may have none
    more: dict[str, Any] = {"name": str}  # settings beside the arguments
    methods: tuple[str, ...] = ()  # that a class must have
    where: str | None = None  # the folder of its modules, or the module of its functions
    first: str | None = None  # argument of its members, which others there do not have
    shared: tuple[str, ...] = ()  # modules there that hold no member


GROUPS = {
    "env": Group(
        # wrappers of a package are the environment's own argument, those of megastep are not
        reserved=("geometries", "seed", "device", "privileged", "films", "wrappers"),
        needed={"n_envs": "the number of environments"},
        missing={"n_envs": 128},
        more={"name": str, "wrappers": (Annotated[tuple, BeforeValidator(_wrappers)], ())},
        where="envs",
        shared=("first_person",),
    ),
    "geometry": Group(
        reserved=("split",),
        needed={"n": "the number of geometries", "split": "its split", "seed": "an integer"},
        missing={"n": 512, "seed": 1},
        where="geometries/sources.py",
        first="n",
    ),
    "learner": Group(
        reserved=("policy", "seed", "graph"),
        needed={"policy": "the policy to improve"},
        # what lr falls to 0 over; auto: samples if given, else seconds if given
        more={"name": str, "anneal": (Literal["auto", "never", "samples", "seconds"], "auto")},
        where="agents/algorithms",
        first="policy",
    ),
    "curriculum": Group(
        reserved=("env", "learner", "rollout", "sources"),
        needed={"env": "the environment", "rollout": "the rollout"},
    ),
    "logger": Group(
        reserved=("folder", "step", "run_name", "config"),
        methods=("write", "close"),
        where="agents/training/loggers",
    ),
    "wrapper": Group(reserved=("env", "seed"), needed={"env": "the environment inside"}),
    "agent": Group(reserved=("obs_space", "action_space", "privileged_space", "seed"), more={}),
    "opponents": Group(
        reserved=("env", "policy", "scripted", "seed"),
        more={"bot_class": (str | None, None)},  # None: the environment's own
    ),
}
#: Groups whose member has `name`, an import path, and decides which settings there are.
CHOSEN = ("env", "geometry", "learner", "curriculum", "logger")
#: The only member of a group.
SINGLE = {"agent": POLICY, "opponents": OPPONENTS}


@frozen
class NoCurriculum:
    """Every home is drawn alike."""

    name: str


@functools.cache
def kind_of(group: str, name: str) -> type:
    """Returns the dataclass of a member's settings. ValueError if it cannot be one of the group."""
    if (group, name) == ("curriculum", "none"):
        return NoCurriculum
    constructor, spec = import_object(name), GROUPS[group]
    try:
        taken = parameters_of(constructor)
        if missing := [f"{k}, {text}" for k, text in spec.needed.items() if k not in taken]:
            raise ValueError(f"it has no argument {missing[0]}")
        methods = spec.methods if inspect.isclass(constructor) else ()
        if absent := [method for method in methods if not hasattr(constructor, method)]:
            raise ValueError(f"it has no method {absent[0]}")
        is_finite = name.startswith("megastep.")
        return settings_of(constructor, spec.reserved, spec.missing, is_finite, **spec.more)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{name} cannot be used: {error}") from error


def settings_for(group: str, name: str | None = None, **values: Any) -> Any:
    """Returns the settings of a group's member, by its import path if there are several."""
    kind = kind_of(group, name or SINGLE[group])
    return kind(**values) if name is None else kind(name=name, **values)


@functools.cache
def members(group: str) -> dict[str, str]:
    """Returns {member: its `name`} of a group, from modules and files in configs/."""
    if group == "wrapper":
        wrappers = importlib.import_module("megastep.wrappers").WRAPPERS  # with PyTorch
        return {label: f"megastep.wrappers:{kind.__name__}" for label, kind in wrappers.items()}
    found = _modules(GROUPS[group])
    for path in sorted((package.CONFIGS / group).glob("*.yaml")):
        tree = yaml.safe_load(path.read_text()) or {}
        tree = tree.get(group, tree)
        if "name" in tree:
            found[path.stem] = tree["name"]
    return found


def _modules(group) -> dict[str, str]:
    """Returns the members in a group's modules, which are read and not imported."""
    if group.where is None:
        return {}
    path, found = Path(megastep.__file__).parent / group.where, {}
    module = f"megastep.{group.where.removesuffix('.py').replace('/', '.')}"
    if path.is_file():
        functions = re.findall(rf"^def ([a-z]\w*)\(\s*{group.first}\b", path.read_text(), re.M)
        return {name: f"{module}:{name}" for name in functions}
    for file in sorted([*path.glob("[a-z]*.py"), *path.glob("[a-z]*/__init__.py")]):
        stem = file.parent.name if file.name == "__init__.py" else file.stem
        text = file.read_text()
        # a class that is called like its module, but for capitals
        name = rf"^(?:class|from [\w.]+ import) ({stem.replace('_', '')})\b"
        match = re.search(name, text, re.I | re.M)
        is_taken = not group.first or re.search(rf"self,\s*{group.first}\b", text)
        if match and is_taken and stem not in group.shared:
            found[stem] = f"{module}.{stem}:{match[1]}"
    return found


@functools.cache
def takes_geometries(env: str) -> bool:
    """Returns whether the environment of an import path takes floor plans."""
    return "geometries" in parameters_of(import_object(env))


def label(name: str) -> str:
    """`explorer` for megastep.envs.explorer:Explorer."""
    return name.rpartition(":")[2].rpartition(".")[2].lower()


def env_name(env: Any) -> str:
    """What an environment is called in titles: `explorer`, or the id that it has, `CartPole-v1`."""
    return getattr(env, "id", None) or label(env.name)
