"""Settings: arguments of constructors and functions, checked by pydantic from their annotations.

::

    @checked
    def __init__(self, n_envs: Annotated[int, Field(ge=1, le=MAX_ENVS)] = 128): ...

The command line makes a dataclass of the same arguments with `settings_of`. True is not an integer,
"3" is not a number, and numbers are finite, but for those of users' classes.
"""

import contextlib
import dataclasses
import difflib
import functools
import inspect
import math
import numbers
import re
import types
import typing
from collections import abc
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import pydantic.dataclasses
from pydantic_core import ValidationError

if TYPE_CHECKING:
    from typing_extensions import dataclass_transform

__all__ = ["MAX_ENVS", "AtMost", "checked", "closest", "frozen", "parameters_of", "settings_of"]

T = TypeVar("T")
F = TypeVar("F", bound=Callable)

#: 2**26 copies of the smallest environment fill the largest GPU there is; more is a typing error.
MAX_ENVS = 2**26
#: Types whose arguments are annotations of their own.
CONTAINERS: tuple[Any, ...] = (list, tuple, dict, set, frozenset, abc.Sequence, abc.Mapping)


@dataclasses.dataclass(frozen=True)
class AtMost:
    """Metadata of an annotation: the argument may not exceed the setting at a dotted key."""

    key: str


def _whole(value) -> object:
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _strict(hint) -> Any:
    """Returns an annotation that converts only a list into a tuple and 1e6 into an integer."""
    origin: Any = typing.get_origin(hint)
    options = typing.get_args(hint)
    if hint is int:
        return Annotated[int, pydantic.Strict(), pydantic.BeforeValidator(_whole)]
    if hint in (float, bool, str):
        return Annotated[hint, pydantic.Strict()]
    if origin is Annotated:
        return Annotated[(_strict(options[0]), *hint.__metadata__)]
    if origin in (typing.Union, types.UnionType):
        return typing.Union[tuple(map(_strict, options))]  # noqa: UP007, of any number of types
    if origin in CONTAINERS and options:
        inner = tuple(one if one is ... else _strict(one) for one in options)
        return typing.cast(Any, origin)[inner]
    return hint


def _frozen(kind: type, is_finite=True, is_strict=False) -> Any:
    """Makes a frozen dataclass of a class; a strict one converts no value."""
    if not is_strict:
        hints = typing.get_type_hints(kind, include_extras=True)
        own = inspect.get_annotations(kind)
        kind.__annotations__ = {name: _strict(hints[name]) for name in own}
    config = pydantic.ConfigDict(
        strict=is_strict, extra="forbid", allow_inf_nan=not is_finite, arbitrary_types_allowed=True
    )
    return pydantic.dataclasses.dataclass(frozen=True, kw_only=True, config=config)(kind)


if TYPE_CHECKING:

    @dataclass_transform(kw_only_default=True, frozen_default=True)
    def frozen(kind: type[T]) -> type[T]: ...

else:
    #: Class decorator: a frozen dataclass whose fields are checked against their annotations.
    frozen = _frozen


# the expected type, by the first part of pydantic's name of the error
WANTED = {
    "int": "an integer",
    "float": "a number",
    "bool": "true or false",
    "string": "a word",
    "list": "a list",
    "tuple": "a list",
    "sequence": "a list",
    "dict": "keys with values",
}
BOUNDS = {"ge": "at least {:,}", "gt": "more than {:,}", "le": "at most {:,}", "lt": "below {:,}"}


# ---- Settings from signatures ----


def settings_of(
    constructor: Callable,
    reserved: Sequence[str] = (),
    missing: Mapping | None = None,
    is_finite: bool = True,
    is_strict: bool = False,
    **more,
) -> type:
    """Returns a frozen dataclass of the arguments of a class or function (`parameters_of`): types,
    bounds, defaults. An argument without an annotation has the type of its default. Raises
    ValueError if an annotation cannot be read, or an argument is called as a field of `more`.

    Args:
        reserved: arguments to leave out.
        missing: defaults for arguments that may have none.
        is_finite: infinity and NaN are refused.
        is_strict: no value is converted. Else a list may stand for a tuple, 1e6 for an integer.
        more: fields to add: a type, or (type, default).
    """
    fields = {name: f if isinstance(f, tuple) else (f,) for name, f in more.items()}
    try:
        for function, arguments in _signatures(constructor):
            hints = typing.get_type_hints(function, include_extras=True)
            for name, argument in arguments.items():
                if name in reserved or (name in fields and name not in more):
                    continue
                if name in more:
                    raise ValueError(f"none of its arguments can be called {name}")
                default = argument.default
                if default is inspect.Parameter.empty:
                    default = (missing or {}).get(name, default)
                fields[name] = _field(hints.get(name), default)
        body: dict = {"__annotations__": {key: field[0] for key, field in fields.items()}}
        for key, (_, *defaults) in fields.items():
            for value in defaults:
                if type(value).__hash__ is None:  # it could change, such as a list
                    value = dataclasses.field(default_factory=lambda value=value: value)
                body[key] = value
        return _frozen(type(constructor.__name__, (), body), is_finite, is_strict)
    except (NameError, TypeError, pydantic.errors.PydanticUserError) as error:
        raise ValueError(f"its arguments cannot be read: {str(error).splitlines()[0]}") from None


def parameters_of(constructor: Callable) -> dict[str, inspect.Parameter]:
    """Returns the named arguments of a class or function, and of the bases that get **kwargs."""
    found = {}
    for _, arguments in _signatures(constructor):
        found |= {name: one for name, one in arguments.items() if name not in found}
    return found


def _signatures(constructor) -> Iterator[tuple[Callable, dict[str, inspect.Parameter]]]:
    """Yields (function, {name: parameter}) of a callable, and of bases that get its **kwargs."""
    bases = constructor.__mro__[1:-1] if inspect.isclass(constructor) else ()
    for one in (constructor, *(base for base in bases if "__init__" in vars(base))):
        try:
            arguments = inspect.signature(one).parameters
        except ValueError:  # of a built-in class
            if one is constructor:
                raise
            return
        named = {
            k: a for k, a in arguments.items() if a.kind not in (a.VAR_POSITIONAL, a.VAR_KEYWORD)
        }
        yield (one.__init__ if inspect.isclass(one) else one), named
        if not any(a.kind is a.VAR_KEYWORD for a in arguments.values()):
            return


def _field(hint, default) -> tuple:
    """Returns (type,) or (type, default) of an argument."""
    if inspect.isclass(hint) and getattr(hint, "_is_protocol", False):
        hint = Annotated[Any, pydantic.AfterValidator(functools.partial(_has_members, hint))]
    if default is inspect.Parameter.empty:
        return (Any if hint is None else hint,)
    if default is None:
        return (Any if hint is None else typing.Optional[hint]), None  # noqa: UP045
    return (type(default) if hint is None else hint), default


def _has_members(protocol, value) -> object:
    """Returns a value that has the members of a protocol, also by `__getattr__`, or ValueError."""
    members = {**protocol.__annotations__, **vars(protocol)}
    absent = [name for name in members if not name.startswith("_") and not hasattr(value, name)]
    if absent:
        name = type(value).__name__
        raise ValueError(f"{name} is not an {protocol.__name__}: it has no {', '.join(absent)}")
    return value


_is_checking = True


@contextlib.contextmanager
def already_checked(are_checked: bool = True) -> Iterator[None]:
    """Inside, `checked` functions take arguments as they are: they are fields of settings."""
    global _is_checking
    before, _is_checking = _is_checking, _is_checking and not are_checked
    try:
        yield
    finally:
        _is_checking = before


def checked(function: F) -> F:
    """Decorator: checks a function's arguments against its annotations. The function gets its
    arguments as they are, not copies, unlike with `pydantic.validate_call`. Raises ValueError
    naming every argument that is wrong, and what is allowed.
    """
    signature = inspect.signature(function)
    settings = functools.cache(lambda: settings_of(function, ("self",), is_strict=True))

    @functools.wraps(function)
    def wrapped(*args, **kwargs) -> object:
        if not _is_checking:
            return function(*args, **kwargs)
        arguments = signature.bind(*args, **kwargs).arguments
        fields = settings().__pydantic_fields__
        values = {name: plain(value) for name, value in arguments.items() if name in fields}
        try:
            settings()(**values)
        except ValidationError as error:
            errors = {}
            for line in error.errors():
                name = str(line["loc"][0])
                errors.setdefault(name, sentence(line))
            raise ValueError("; ".join(f"{k}: {text}" for k, text in errors.items())) from None
        return function(*args, **kwargs)

    return typing.cast(F, wrapped)


def plain(value: Any) -> Any:
    """Returns a number of NumPy, or any other, as Python's; other values as they are."""
    if isinstance(value, numbers.Real) and not isinstance(value, (bool, int, float)):
        return int(value) if isinstance(value, numbers.Integral) else float(value)
    return value


# ---- What is wrong, in words ----


def sentence(error: Mapping) -> str:
    """Returns what is allowed, and what was given, from an error of pydantic."""
    kind, value, facts = error["type"], error["input"], error.get("ctx", {})
    got = "nothing" if value is None else repr(value)
    if kind == "missing":
        return "is missing"
    if kind == "value_error":
        return str(facts["error"])
    if isinstance(value, Mapping) and value.keys() == {"from", "to"}:
        return f"is one value, not a schedule, got {got}"
    if isinstance(value, float) and not math.isfinite(value):
        return f"{value} is out of range: allowed is any finite number"
    for key in BOUNDS.keys() & facts.keys():
        return f"{value} is out of range: allowed is {BOUNDS[key].format(_whole(facts[key]))}"
    if kind in ("too_short", "too_long"):
        bound = "at least {min_length}" if kind == "too_short" else "at most {max_length}"
        return f"has {facts['actual_length']} values: allowed is {bound.format(**facts)}"
    if kind == "literal_error":
        words = re.findall("'([^']*)'", facts["expected"])
        return f"{value!r} is unknown; {closest(value, words)}"
    if kind == "tuple_type" and isinstance(value, list):
        return f"expected a tuple, got the list {got}"
    if wanted := WANTED.get(kind.split("_")[0]):
        return f"expected {wanted}, got {got}"
    if kind.startswith("dataclass"):
        return f"is a group of keys, got {got}"
    return f"{error['msg'][0].lower()}{error['msg'][1:]}, got {got}"


def closest(word: object, words: Iterable[object]) -> str:
    """Returns a hint that names the nearest of `words`, or lists all if none is near."""
    names = sorted(str(w) for w in words)
    near = difflib.get_close_matches(str(word), names, n=1, cutoff=0.5)
    return f"did you mean {near[0]}?" if near else f"there are {', '.join(names)}"
