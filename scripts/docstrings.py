"""Public names and their docstrings, for the reference in docs/; see reference.py.

A public name is a class or function without an underscore, described by its docstring.
"""

import functools
import importlib
import inspect
import operator
import pkgutil
import re
import textwrap
import types
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import megastep

#: Megastep's own machinery, which nobody needs to import; and `cuda`, another name of `engine`.
INTERNAL = re.compile(
    r"megastep\.(__main__|adapters\.(?!vector_env)\w+|atomic_files|cache|compat|cuda|colour|demo|global_generators|hosting|imports|kernels|moments"
    r"|web|agents\.(cli|console|export|distributed\.(?!pooling)"
    r"\w+|factory|launch|package|pretrained|runs|networks\.(kernels|web|\w+_cpu)|storage\.\w*kernels"
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
    if kind in ("class", "function", "method"):
        arguments = _signature(one)
    text = markdown(comment_on(module, name) if kind == "data" else inspect.getdoc(one))
    lines = [f"{fence}{{py:{kind}}} {name}{arguments}", f":module: {module}"]
    lines += [f":value: {one!r}"] if kind == "data" and isinstance(one, (int, float)) else []
    lines += ["", text, ""]
    for key, below in methods(one).items() if inspect.isclass(one) else ():
        below = below if isinstance(below, property) else getattr(one, key)
        lines += _object(module, f"{name}.{key}", below, fence[1:])
    return [*lines, fence, ""]


def _signature(one):
    """Returns the arguments of a class or function with short defaults, without types."""
    try:
        parameters = inspect.signature(one).parameters.values()
    except (TypeError, ValueError):  # of a built-in class
        return ""
    plain = [p.replace(annotation=p.empty) for p in parameters if p.name != "self"]
    return re.sub(r"<[^<>]*>|\n", "...", str(inspect.Signature(plain)))


def markdown(text: str | None) -> str:
    """Returns a docstring as Markdown. What is indented below a line `Title:` becomes a list, if
    each of its entries begins with a name and a colon.
    """
    text = re.sub(r":\w+:`~?([^`]+)`", r"`\1`", inspect.cleandoc(text or ""))
    text = re.sub(r"``([^`]+)``", r"`\1`", re.sub(r"::$", ":", text, flags=re.M))

    def listed(match):
        title, body = match[1], textwrap.dedent(match[2]).strip()
        entries = re.findall(r"^\S.*(?:\n(?: +.*|(?=\n)))*", body, re.M)
        pairs = [re.fullmatch(r"([\w.*`(), ]+): (.*)", e, re.S) for e in entries]
        if all(pairs) and title not in ("Returns", "Yields"):
            names = [pair[1].replace("`", "") for pair in pairs]
            texts = [" ".join(pair[2].split()) for pair in pairs]
            body = "\n".join(f"- **{name}**: {words}" for name, words in zip(names, texts))
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


def source_of(module: str, name: str) -> tuple[str, int]:
    """Returns the file of a class or function in the repository, "" if none, and its line."""
    try:
        one = operator.attrgetter(name)(importlib.import_module(module))
        one = inspect.unwrap(getattr(one, "fget", one))
        path = Path(inspect.getsourcefile(one)).resolve()
        line = inspect.getsourcelines(one)[1]
    except (AttributeError, OSError, TypeError):
        return "", 0
    root = Path(__file__).resolve().parents[1]
    return (str(path.relative_to(root)), line) if path.is_relative_to(root) else ("", 0)
