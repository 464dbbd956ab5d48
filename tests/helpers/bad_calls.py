"""Calls of public engine functions with one wrong argument or buffer each: dtype, shape, memory
layout, device, None, other types, numbers out of range, buffers that were replaced.

Run as a script, it makes them all and prints each first, so a crash of the interpreter shows its
call:

    python tests/helpers/bad_calls.py cpu

N environments, A agents, D layouts.
"""

import json
import math
import sys
from types import SimpleNamespace

import torch

from megastep import core, cuda, engine, modules, scene, toys
from megastep.engine.scenery import Layouts
from megastep.ragged import Ragged

ALLOWED = (ValueError, TypeError, AttributeError, IndexError, engine.EngineError)
N, A, D = 3, 2, 2


def fixture(device):
    """Small environments in which every call below succeeds with its right arguments."""
    scenery = scene.scenery([toys.box(), toys.column()], A, N, device=device)
    c = core.Core(scenery, res=16, cameras=[0, 180])
    c.agents.positions[:] = torch.tensor([[2.0, 3.0], [3.0, 2.0]])
    words = -(-scenery.layouts.max_texels // 32)
    return SimpleNamespace(
        core=c,
        scenery=scenery,
        agents=c.agents,
        layouts=scenery.layouts,
        device=scenery.device,
        lanes=torch.ones((N, A), dtype=torch.int64, device=device),
        mask=torch.ones((N, A), dtype=torch.bool, device=device),
        counts=torch.zeros((N, A), dtype=torch.int32, device=device),
        cumulative=torch.arange(1, D + 1, dtype=torch.int32, device=device),
        seen=torch.zeros((N, A, words), dtype=torch.int32, device=device),
        moves=torch.zeros((7, 3), device=device),
        weights=torch.zeros((N, A, 7), device=device),
        points=torch.full((D, 4, 2), 3.0, device=device),
        out=torch.zeros((N * A, 4), device=device),
    )


# ---- Wrong values, (label, value) each, for a right value ----


def not_tensors(good):
    yield from [("None", None), ("a string", "text"), ("a number", 3.5), ("a list", good.tolist())]


def wrong_tensors(good):
    """Tensors that are not contiguous, or differ in dtype, shape or device."""
    for name in ("float64", "float16", "float32", "int64", "int32", "bool"):
        dtype = getattr(torch, name)
        if dtype != good.dtype:
            yield f"of {dtype}", good.to(dtype)
    yield "an axis more", good[None]
    yield "flat", good.flatten() if good.ndim > 1 else good[0]
    yield "a row less", good[1:].clone()
    yield "a row more", torch.cat([good, good[:1]])
    yield "empty", good[:0].clone()
    yield "a column less", good[..., 1:].contiguous()
    yield "not contiguous", torch.stack([good, good], -1)[..., 0]
    yield "on another device", good.to("cpu" if good.device.type == "cuda" else "meta")
    yield "sparse", good.to_sparse()


def tensors(good):
    yield from not_tensors(good)
    yield from wrong_tensors(good)


def of_any_length(good):
    yield from (case for case in tensors(good) if case[0] not in ("a row less", "a row more"))


def optional_tensors(good):
    yield from [*not_tensors(good)][1:]
    yield from wrong_tensors(good)


def arrays(good):
    """Values that are not an array of finite real numbers of that shape. Any real dtype is fine."""
    yield from [("None", None), ("a string", "text"), ("a number", 3.5), ("words", ["a", "b"])]
    yield "an axis more", good[None]
    yield "an axis less", good[0]
    yield "a column less", good[..., 1:]
    if good.numel():
        yield "NaN", good * math.nan
        yield "infinite", good + math.inf
        yield "too large", good + 1e12


def raggeds(good):
    yield from [("None", None), ("a string", "text"), ("a tensor", good.vals), ("a list", [1.0])]
    yield "an axis more", Ragged(good.vals[..., None], good.widths)
    yield "a column less", Ragged(good.vals[..., 1:], good.widths)
    yield "NaN", Ragged(good.vals * math.nan, good.widths)
    yield "a subarray less", good[1:]


def integers(min, max=None):
    def wrong(good):
        yield from [("None", None), ("a string", "3"), ("a half", 2.5), ("NaN", math.nan)]
        yield from [("a list", [1]), ("true", True), ("too small", min - 1), ("two", torch.ones(2))]
        if max is not None:
            yield "too large", max + 1

    return wrong


def seeds(good):
    return [*integers(0)(good)][:6]


def numbers(*more):
    def wrong(good):
        yield from [("None", None), ("a string", "1"), ("NaN", math.nan), ("infinite", math.inf)]
        yield from [("a list", [1.0]), ("two", torch.ones(2)), ("minus infinite", -math.inf)]
        yield from [(str(value), value) for value in more]

    return wrong


def flags(good):
    yield from [("a string", "yes"), ("two", torch.ones(2)), ("a list", []), ("numbers", (0, 1))]


def objects(good):
    yield from [("None", None), ("a number", 3), ("a string", "x"), ("another", SimpleNamespace())]


# ---- The calls: function, right arguments, and the wrong values of each ----

OPERANDS = dict(scenery=objects, agents=objects)


def operations(f):
    both = dict(scenery=f.scenery, agents=f.agents)
    yield (
        engine.physics,
        dict(both, actions=f.lanes, moves=f.moves, damping=0.5),
        dict(OPERANDS, actions=tensors, moves=of_any_length, damping=numbers()),
    )
    yield engine.physics, dict(both, actions=f.weights, moves=f.moves), dict(actions=tensors)
    yield engine.render, both, OPERANDS
    yield engine.update_agent_geometry, dict(both, lit=True), dict(OPERANDS, lit=flags)
    yield (
        engine.observe,
        dict(
            both,
            subsample=4,
            seen=f.seen,
            clear_mask=f.mask,
            max_depth=10.0,
            imu=True,
            only=f.mask,
            out=engine.observe(f.scenery, f.agents, 4, imu=True, seen=f.seen),
        ),
        dict(
            OPERANDS,
            subsample=integers(1, 32),
            seen=tensors,
            clear_mask=optional_tensors,
            max_depth=numbers(0, -1),
            only=optional_tensors,
            out=objects,
            **dict.fromkeys(("imu", "rgb", "depth", "centre_line", "agent_ray"), flags),
        ),
    )
    yield (
        engine.spawn,
        dict(
            both, mask=f.mask, points=f.points, counts=f.counts, seed=1, resample=True,
            point_index=f.counts, cumulative=f.cumulative,
        ),
        dict(
            OPERANDS,
            **dict.fromkeys(("mask", "points", "counts"), tensors),
            seed=seeds,
            resample=flags,
            hidden=flags,
            **dict.fromkeys(("point_index", "cumulative"), optional_tensors),
        ),
    )  # fmt: skip
    yield (
        engine.uniform,
        dict(counts=f.counts.view(-1), mask=f.mask.view(-1), seed=1, out=f.out),
        dict(counts=tensors, mask=tensors, seed=seeds, out=tensors),
    )
    yield (
        modules.visible_texels,
        dict(scenery=f.scenery, points=f.points),
        dict(scenery=objects, points=arrays),
    )
    yield engine.bake, dict(scenery=f.scenery), dict(scenery=objects)
    yield engine.check, dict(agents=f.agents), dict(agents=objects)


def constructors(f):
    names = "lines", "textures", "lights", "agent_textures"
    layouts = {name: getattr(f.layouts, name) for name in names} | dict(device=f.device)
    device = lambda good: [("a string", "tpu"), ("a half", 0.5), ("a list", [])]  # noqa: E731
    parts = dict(lines=raggeds, textures=raggeds, lights=raggeds, device=device)
    yield Layouts, layouts, dict(parts, agent_textures=arrays)
    yield (
        engine.Agents,
        dict(
            n_envs=N, n_agents=A, res=16, fov=90.0, fps=10.0, cameras=[0, 90], radius=0.1,
            device=f.device,
        ),
        dict(
            n_envs=integers(1),
            n_agents=integers(0),
            res=integers(1, 1024),
            fov=numbers(0, 180),
            fps=numbers(0, -1),
            cameras=lambda good: [
                ("a string", "ahead"), ("a number", 3.0), ("none", []), ("NaN", [math.nan]),
                ("2d", [[0.0, 1.0]]),
            ],
            radius=numbers(0, -1),
            device=device,
        ),
    )  # fmt: skip
    yield (
        scene.scenery,
        dict(geometries=[toys.box()], n_agents=A, n_envs=N, seed=1, device=f.device),
        dict(
            geometries=lambda good: [
                ("None", None), ("a number", 3), ("none", []), ("of None", [None]),
                ("one", toys.box()), ("without walls", [dict(lights=[])]),
                ("walls of one end", [toys.box() | dict(walls=torch.zeros(4, 2).numpy())]),
                ("a wall of NaN", [toys.box() | dict(walls=toys.box().walls * math.nan)]),
                ("lights of three", [toys.box() | dict(lights=torch.ones(1, 4).numpy())]),
            ],
            n_agents=integers(0),
            n_envs=lambda good: [*integers(1)(good)][1:],
            seed=integers(0),
            device=device,
        ),
    )  # fmt: skip
    yield engine.set_threads, dict(n=None), dict(n=lambda good: [*integers(1, 10**6 - 1)(1)][1:])
    yield f.scenery.env, dict(e=0), dict(e=integers(-N, N - 1))


# ---- Buffers that were replaced before a call ----

CALLS = {
    "render": lambda f: engine.render(f.scenery, f.agents),
    "physics": lambda f: engine.physics(f.scenery, f.agents),
    "observe": lambda f: engine.observe(f.scenery, f.agents, imu=True),
}
STATE = "positions", "angles", "velocity", "angvelocity"
SETTINGS = dict(res=10**6, fov=0.0, fps=0.0, radius=-1.0)
OF_AGENTS = "yaws", "ray_lengths", "error_flag"


def replacements(device):
    """(label, name, act): sets an attribute to a wrong value and makes a call."""
    f = fixture(device)
    for name in STATE:
        for label, value in tensors(getattr(f.agents, name)):
            for call in CALLS:
                if call == "physics" or name in ("positions", "angles"):
                    yield f"{call}, agents.{name} {label}", name, _set("agents", name, value, call)
    for name, value in SETTINGS.items():
        yield f"agents.{name} = {value}", name, _set("agents", name, value, "render")
    for name in OF_AGENTS:
        yield f"agents.{name} = None", name, _set("agents", name, None, "render")
    for owner in ("scenery", "layouts"):
        for name in vars(getattr(f, owner)):
            if not name.startswith("_"):
                yield f"{owner}.{name} = None", name, _set(owner, name, None, "render")
    for name in ("lines", "textures", "baked", "lights"):
        act = lambda f, name=name: setattr(getattr(f.layouts, name), "vals", None)  # noqa: E731
        yield f"layouts.{name}.vals = None", "vals", act
        act = lambda f, name=name: setattr(f.scenery, name, None)  # noqa: E731
        yield f"scenery.{name} = None", name, act


def _set(owner, name, value, call):
    def act(f):
        setattr(getattr(f, owner), name, value)
        CALLS[call](f)

    return act


def others(device):
    def spawn(f, points):
        engine.spawn(f.scenery, f.agents, f.mask, points, f.counts, 1)

    def observe(**settings):
        return lambda f: engine.observe(f.scenery, f.agents, **settings)

    def of_fewer(f):
        engine.render(f.scenery, engine.Agents(N - 1, A, device=f.device))

    mask = torch.ones((N, A), dtype=torch.bool, device=device)
    yield "observe without seen", "clear_mask", observe(clear_mask=mask)
    yield "observe only some without out", "only", observe(only=mask)
    yield "subsample no divisor", "subsample", observe(subsample=3)
    yield "too few points", "points", lambda f: spawn(f, f.points[:, :1].contiguous())
    yield "agents of fewer environments", "positions", of_fewer
    for name in ("lines", "lights", "textures", "baked"):
        yield f"scenery.{name}[99]", "99", lambda f, name=name: getattr(f.scenery, name)[999]
        yield f"scenery.{name}['a']", "str", lambda f, name=name: getattr(f.scenery, name)["a"]
    yield "device tpu", "device", lambda f: engine.device("tpu")
    yield "device None", "device", lambda f: engine.device(None)
    yield "Core of no scenery", "scenery", lambda f: cuda.Core(None)
    for name, value in dict(res=0, fov=200.0, fps=-1.0, cameras=[], seed=0.5).items():
        make = lambda f, name=name, value=value: cuda.Core(f.scenery, **{name: value})  # noqa: E731
        yield f"Core({name}={value})", "camera" if name == "cameras" else name, make


def wrong_arguments(device):
    """(label, name, act) of every call with every wrong value of every argument."""
    for table in (operations, constructors):
        for i, (function, right, wrong) in enumerate(table(fixture(device))):
            title = function.__qualname__
            yield f"{title} as it is", None, _call(table, i, None, None)
            for name, kinds in wrong.items():
                for label, value in kinds(right.get(name)):
                    yield f"{title}({name}: {label})", name, _call(table, i, name, value)


def _call(table, i, name, value):
    def act(f):
        function, right, _ = [*table(f)][i]
        return function(**(right if name is None else {**right, name: value}))

    return act


def cases(device):
    """(label, name, act, environments) of every call. Refused arguments change no environment, so
    those calls share one; the others get their own.
    """
    for label, name, act in wrong_arguments(device):
        if name is None:
            shared = fixture(device)
        yield label, name, act, shared
    for source in (replacements, others):
        yield from ((*case, fixture(device)) for case in source(device))


def verdict(name, act, f):
    """Returns what is wrong with a call's outcome, or None.

    The call must raise an error that names the argument `name`, and leave the agents unchanged.
    Without a name, it must succeed. `uniform` compares counts and mask and may name either.
    """
    before = [getattr(f.agents, state).clone() for state in STATE]
    tensors_before = [getattr(f.agents, state) for state in STATE]
    try:
        act(f)
    except ALLOWED as error:
        if name is None:
            return f"refused: {error}"
        if name not in str(error) and not (name == "counts" and "mask" in str(error)):
            return f"{type(error).__name__} does not name {name}: {error}"
        if not all(map(torch.equal, before, tensors_before)):
            return "refused, but the agents have changed"
        return None
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return None if name is None else "accepted"


def main(device):
    torch.set_num_threads(1)
    for label, name, act, environments in cases(device):
        print(json.dumps(dict(call=label)), flush=True)
        problem = verdict(name, act, environments)
        if device != "cpu":
            torch.cuda.synchronize()
        print(json.dumps(dict(call=label, wrong=problem)), flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
