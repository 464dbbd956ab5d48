"""Writes a program, and what a page draws of it, as one HTML file: floor plans, keys that drive."""

import base64
import gzip
import html
import json
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from megastep.core import AGENT_RADIUS
from megastep.kernels.build.compile import EngineError, wasm, wasm_key, wasm_keys, wasm_tools
from megastep.kernels.build.launch import ENGINE
from megastep.modules import MOVES
from megastep.plotting.styles import AGENTS, THEMES
from megastep.types import Env, n_lanes, optional
from megastep.web.program import Buffer, Launch, Leaf, Program, Ref, words

FOLDER = Path(__file__).parent
#: The module that comes with megastep; `make wasm` builds it.
SHIPPED = FOLDER / "megastep.wasm"
ALIGNMENT = 8  # bytes, of buffers in the page's data
OBJECT_BYTES = ENGINE.constants["OBJECT_BYTES"]

#: By key, in the order of two rows of buttons, the action of `megastep.modules.MOVES`.
KEYS = {"a": 1, "ArrowUp": 3, "d": 2, "ArrowLeft": 5, "ArrowDown": 4, "ArrowRight": 6}


def module(program: Program) -> bytes:
    """Returns the WebAssembly module that comes with megastep, if it has a program's operations, or
    one that clang builds now. EngineError if that fails.
    """
    shipped = SHIPPED.read_bytes() if SHIPPED.exists() else b""
    keys, operations = wasm_keys(shipped) if shipped else {}, program.operations()
    if all(keys.get(name) == wasm_key(lib) for lib, names in operations.items() for name in names):
        return shipped
    try:
        wasm_tools()
    except EngineError as error:
        own = [name for lib, names in operations.items() for name in names if name not in keys]
        which = ", ".join(own) or "kernels that have changed since"
        raise EngineError(f"The module that comes with megastep lacks {which}. {error}") from None
    return wasm(operations)


def page(program: Program, about: Mapping, code: bytes) -> str:
    """Returns an HTML page that plays a program, of a WebAssembly module, with the sections
    `reset`, `step` and those of policies. ``about`` is what it shows: `scene`, title, about,
    policies and seed.
    """
    buffers, parts, size = [], [], 0
    for buffer in program.buffers:
        packed, body = _packed(buffer)
        buffers.append([buffer.n_bytes, size, packed])
        body += bytes(-len(body) % ALIGNMENT)
        parts.append(body)
        size += len(body)
    data = json.dumps(
        {
            **{key: _plain(value) for key, value in about.items()},
            "colours": AGENTS,
            "buffers": buffers,
            "copies": program.copies,
            "world": {path: _leaf(leaf) for path, leaf in program.world.items()},
            "actions": _leaf(program.actions),
            "names": {launch.operation: [*launch.values] for launch in program.launches},
            "sections": {
                name: [[launch.operation, _values(launch)] for launch in launches]
                for name, launches in program.sections.items()
            },
        },
        separators=(",", ":"),
    ).encode()
    head = struct.pack("<III", len(data), len(code), size)
    body = gzip.compress(head + data + code + b"".join(parts), mtime=0)
    text = (FOLDER / "page.html").read_text()
    fields = {
        "title": html.escape(about["title"]),
        "themes": _themes(),
        "program": (FOLDER / "program.js").read_text(),
        "script": (FOLDER / "page.js").read_text(),
        "data": base64.b64encode(body).decode(),
    }
    for name, value in fields.items():
        text = text.replace(f"<!--{name}-->", value, 1)
    return text


def _packed(buffer: Buffer) -> tuple[int, bytes]:
    """Returns (0, nothing), (1, the bytes) or (2, floats as fp16 if that loses nothing)."""
    if buffer.contents is None or not any(buffer.contents):
        return 0, b""
    if buffer.is_float:
        numbers = np.frombuffer(buffer.contents, np.float32)
        with np.errstate(over="ignore"):
            halves = numbers.astype(np.float16)
        if (halves.astype(np.float32).view(np.uint32) == numbers.view(np.uint32)).all():
            return 2, halves.tobytes()
    return 1, buffer.contents


def _leaf(leaf: Leaf) -> list:
    dtype = str(leaf.dtype).removeprefix("torch.")
    return [*leaf.ref, leaf.shape, leaf.strides, dtype]


def _values(launch: Launch) -> list:
    """The words of a launch: places as [buffer, offset], numbers as their 32 bits."""
    values = []
    for word in words(launch.library, launch.operation):
        value = launch.values[word.name]
        if value is None or isinstance(value, Ref):
            values.append(value and [*value])
        else:
            value = 1 if word.name.endswith("n_threads") else value
            values.append(struct.unpack("<I", struct.pack(f"<{word.kind}", value))[0])
    return values


def _plain(value: object) -> object:
    """What JSON can hold: leaves as lists, ranges as their ends."""
    if isinstance(value, Leaf):
        return _leaf(value)
    if isinstance(value, range):
        return [value.start, value.stop]
    if isinstance(value, dict):
        return {key: _plain(child) for key, child in value.items()}
    return [*map(_plain, value)] if isinstance(value, list) else value


def _themes() -> str:
    rules = []
    for name, theme in THEMES.items():
        colours = {**vars(theme), "wall_low": theme.wall[0], "wall_high": theme.wall[1]}
        body = "".join(
            f"--{key.replace('_', '-')}:{value};" for key, value in colours.items() if key != "wall"
        )
        rule = f":root{{{body}}}"
        rules.append(rule if name == "light" else f"@media (prefers-color-scheme:{name}){{{rule}}}")
    return "".join(rules)


# ---- What is shown ----


def controls(env: Env) -> Mapping[str, object]:
    """Returns {key of a keyboard: action}: the environment's own, movement, or digits."""
    own, space, moves = optional(env, "controls"), env.action_space, hasattr(env, "movement")
    if own is not None:
        return dict(own)
    if moves and space.n_actions == len(MOVES):
        return KEYS
    return {str(digit): digit for digit in range(min(space.n_actions, 10))}


def scene(env: Env, program: Program, homes: Sequence[str] = ()) -> dict:
    """Returns what a page shows of a recorded environment with floor plans of some names, as JSON's
    types.
    """
    shown: dict = {
        "env": type(env).__name__,
        "fps": optional(env, "fps"),
        "n_lanes": n_lanes(env),
        "controls": controls(env),
        "homes": list(homes),
    }
    core = getattr(env, "core", None)
    if core is not None:
        from megastep.plotting.plans import room_outlines  # with matplotlib

        layouts = core.scenery.layouts
        shown |= {
            "fov": core.fov,
            "radius": AGENT_RADIUS,
            "goal": goal(program),
            "rooms": [
                room_outlines(layouts.lines[d].numpy(), layouts.lights[d].numpy())
                for d in range(len(layouts))
            ],
        }
    return shown


def goal(program: Program) -> dict | None:
    """Returns where in memory the place is that the agent is to go to, of the environments that
    have one: x and y are at ``base``, ``per_layout`` numbers times the layout and ``stride``
    numbers times ``index`` further, which is a number or where one is.
    """
    for launch in program.sections["step"]:
        values: dict = launch.values
        if launch.operation == "pointgoal_step":
            base, index = values["points"], values["goal_index"]
            stride, per_layout = 2, 2 * values["n_goals"]
        elif launch.operation in ("memory_step", "keys_step"):
            index = values["cue"] if "cue" in values else values["n_colours"]  # the goal's object
            base, stride, per_layout = values["objects.objects"], OBJECT_BYTES // 4, 0
        else:
            continue
        return dict(base=base, per_layout=per_layout, stride=stride, index=index, radius=0.2)
    return None
