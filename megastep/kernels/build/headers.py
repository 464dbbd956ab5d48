"""Reads the headers of a kernel library, so that structs, constants and operations are
declared once.

Three kinds of declarations are recognised:

* structs whose names end in ``Params``, one field per line: ``const float* positions;``, or an
  array of such structs: ``LeafParams leaves[4];``
* constants in files called ``constants.h``, one per line: ``constexpr int MAX_RES = 1024;``
* operations: ``KERNEL render(RenderParams p)`` or, for a GPU, ``INSTANCE(spawn, SpawnParams, ...)``
  in a source; in a header, for CPU and GPU, ``EACH(uniform, UniformParams, ...)``
"""

import re
import struct
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

__all__ = [
    *("Word", "constants", "early_operations", "operations", "packer", "struct_fields", "words"),
]

FORMATS = {"int": "i", "float": "f", "unsigned int": "I"}  # characters of the module struct
INT = re.compile(r"constexpr\s+int\s+(\w+)\s*=\s*(-?(?:0|[1-9]\d*));")
FLOAT = re.compile(r"constexpr\s+float\s+(\w+)\s*=\s*(-?\d+(?:\.\d*)?(?:e-?\d+)?)f?;")
DIRECTIVE = re.compile(r"#\s*(?!define)\w.*|#\s*define\s+\w+")  # include guards; no macros
OPERATION = re.compile(
    r"KERNEL\s+(?:BOUNDS\(\d+\)\s+)?(\w+)\((?:const\s+)?(\w+Params)\s*&?\s*\w+\)"
)
EACH = re.compile(r"EACH\((\w+), (\w+Params),")
INSTANCE = re.compile(r"INSTANCE\((?:BOUNDS\(\d+\) )?(\w+), (\w+Params),")
WAITS = re.compile(r"\s*\{\s*wait_for_previous\(\)\s*;")  # what follows an OPERATION
STRUCT = re.compile(r"^struct (\w+Params) \{(.*?)^\};", re.M | re.S)
FIELD = re.compile(r"([\w ]+?)\s*(\*?)\s+(\w+)(?:\[(\d+)\])?")
#: The source of a function of {field: value} that packs a struct.
PACKED = """
def packed(values):
    if len(values) == len(names):
        try:
            return pack({})
        except KeyError:
            pass
    for field in sorted(names ^ values.keys()):
        problem = "needs the field" if field in names else "has no field"
        raise TypeError(f"{{name}} {{problem}} '{{field}}'")
"""

Fields = list[tuple[str, str]]  # (name, format of the module struct)


class Word(NamedTuple):
    """A pointer or number of a struct."""

    name: str  # of the field, such as `radius`, or `scenery.radius` in a struct that is a field
    kind: str  # its format, of the module struct
    offset: int  # in bytes, with pointers of this machine


def struct_fields(sources: Mapping[str, str]) -> dict[str, Fields]:
    """Returns the fields of every struct ``...Params`` in the headers ``sources`` {name: text}. A
    struct that is a field of another must be declared before it. ValueError if a field has a type
    that cannot be packed.
    """
    return {name: fields for name, (fields, _) in _structs(sources).items()}


def words(sources: Mapping[str, str]) -> dict[str, list[Word]]:
    """Returns all pointers and numbers of every struct ``...Params``, in order, those of structs
    that are fields too. Where pointers take 4 bytes, as in WebAssembly, a struct is an array of
    them, 4 bytes each.
    """
    return {name: words for name, (_, words) in _structs(sources).items()}


def _structs(sources) -> dict[str, tuple[Fields, list[Word]]]:
    structs, formats = {}, dict(FORMATS)
    for header, text in sources.items():
        for name, body in STRUCT.findall(_without_comments(text)):
            fields, found, before = [], [], ""
            for line in body.split(";")[:-1]:
                field, kind, inner, count = _field(line, formats, header)
                fields.append((field, kind))
                before += kind
                start = struct.calcsize(before) - struct.calcsize(kind.removeprefix("0P"))
                if inner is None:
                    found.append(Word(field, kind, start))
                for k in range(count if inner else 0):
                    title = f"{field}.{k}" if "[" in line else field
                    at = start + k * (int(kind[2:-1]) // count)
                    below = structs[inner][1]
                    found += [Word(f"{title}.{w.name}", w.kind, at + w.offset) for w in below]
            structs[name] = fields, found
            aligned = "0P" if _holds_pointer(fields) else "0i"
            formats[name] = f"{aligned}{packer(fields).size}s"
    return structs


def _field(line, formats, header) -> tuple[str, str, str | None, int]:
    """Returns a field's name, its format, its struct's name if any, and the length of an array."""
    match = FIELD.fullmatch(line.strip())
    kind = match[1].replace("const", "").strip() if match else ""
    known = formats.get(kind, "")
    if match and not match[2] and known.endswith("s"):
        count = int(match[4] or 1)
        return match[3], f"{known[:2]}{int(known[2:-1]) * count}s", kind, count
    if not match or match[4] or not (match[2] or known):
        raise ValueError(
            f"{header}: cannot pack the field '{' '.join(line.split())}'. A field is a pointer, "
            f"an int, an unsigned int, a float, or a struct ...Params declared above or an array "
            f"of them."
        )
    return match[3], "P" if match[2] else known, None, 1


def packer(fields: Fields) -> struct.Struct:
    """Returns the packer of a struct, with the memory layout that a C++ compiler gives it."""
    # "0P" at the end pads to a pointer's alignment, as a compiler does if the struct holds one.
    end = "0P" if _holds_pointer(fields) else ""
    return struct.Struct("".join(kind for _, kind in fields) + end)


def _holds_pointer(fields) -> bool:
    return any("P" in kind for _, kind in fields)


def builder(name: str, fields: Fields) -> Callable[[Mapping[str, object]], bytes]:
    """Returns a function of {field: value} that packs the struct ``name``, or raises a TypeError
    unless it gets each field, and no other. A pointer is a tensor, an address, or None for null. An
    array is the joined bytes of its structs; those that are missing at its end are zeros.
    """
    address = "x if (x := values[{!r}]).__class__ is int else 0 if x is None else x.data_ptr()"
    items = [
        address.format(field) if kind == "P" else f"values[{field!r}]" for field, kind in fields
    ]
    scope: dict = dict(name=name, names=dict(fields).keys(), pack=packer(fields).pack)
    exec(PACKED.format(", ".join(items)), scope)  # a loop over the fields would slow launches down
    return scope["packed"]


def constants(sources: Mapping[str, str]) -> dict[str, Any]:
    """Returns the constants of all files called ``constants.h``. ValueError, naming file and line,
    if one is not a plain number, has the name of another, or is no constant.
    """
    numbers = {}
    for header, text in sources.items():
        if header.rpartition("/")[2] != "constants.h":
            continue
        for number, line in enumerate(map(str.strip, _without_comments(text).splitlines()), 1):
            if not line or DIRECTIVE.fullmatch(line):
                continue
            integer, real = INT.fullmatch(line), FLOAT.fullmatch(line)
            match = integer or real
            if not match or match[1] in numbers:
                raise ValueError(
                    f"{header}:{number}: cannot read '{line}'. Write one constant per line, with a "
                    f"unique name, as a plain int or float: constexpr int MAX_RES = 1024;"
                )
            numbers[match[1]] = int(match[2]) if integer else float(match[2])
    return numbers


def operations(sources: Mapping[str, str]) -> dict[str, str]:
    """Returns {operation: name of its struct} for the KERNELs that these sources define, and for
    EACH in headers. ValueError, naming file and line, if one cannot be read.
    """
    return {match[1]: match[2] for match in _kernels(sources)}


def early_operations(sources: Mapping[str, str]) -> frozenset[str]:
    """Returns the operations whose first statement, in each definition behind ``#if``, is
    ``wait_for_previous();``, as that of EACH and INSTANCE is.
    """
    waits = [
        (match[1], match.re is not OPERATION or bool(WAITS.match(match.string, match.end())))
        for match in _kernels(sources)
    ]
    return frozenset(name for name, _ in waits) - {name for name, does in waits if not does}


def _kernels(sources) -> Iterator[re.Match[str]]:
    """Yields a match of OPERATION or INSTANCE, in a text without comments, for every line of a
    source with either, and of EACH for every such line in a header.
    """
    for source, text in sources.items():
        text = _without_comments(text)
        words = (
            dict(EACH=EACH) if source.endswith(".h") else dict(KERNEL=OPERATION, INSTANCE=INSTANCE)
        )
        for line in re.finditer(rf"^(?!#).*\b({'|'.join(words)})\b.*", text, re.M):
            match = words[line[1]].match(text, line.start())
            if not match:
                number = text.count("\n", 0, line.start()) + 1
                raise ValueError(
                    f"{source}:{number}: cannot read '{line[0].strip()}'. Start a line with KERNEL "
                    f"and give the operation one struct: KERNEL drain(const DrainParams& p) in a "
                    f".cpp file, KERNEL drain(DrainParams p) in a .cu file, EACH(drain, "
                    f"DrainParams, ...) in a header."
                )
            yield match


def _without_comments(text) -> str:
    """Returns C++ without comments. Every line keeps its number."""
    return re.sub(r"//.*|/\*[\s\S]*?\*/", lambda comment: "\n" * comment[0].count("\n"), text)
