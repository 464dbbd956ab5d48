"""The code of the page "Concepts" of the original megastep runs as printed there, on the CPU.

The printed results are compared word by word, ignoring white space. Names that moved: `rebar` and
`megastep.demo` are `megastep`; `megastep.demo.heads` is `megastep.agents.networks.heads`. Code that
cannot run as printed is repaired minimally:

| on the page | why it cannot run | here |
| --- | --- | --- |
| `cpu_tensors.cuda()` | no GPU | `.cpu()` |
| `.starmap(float.__add__, d)` | `d` is not defined | `objs`, as two lines before |
| `r[0]` prints `array([0, 1, 2])` | the values were given as floats | `array([0., 1., 2.])` |
| `spaces.intake(env.observation_space)` | never existed | `heads.intake(env.obs_space, width)` |
| `spaces.output(env.action_space)` | never existed | `heads.output(env.action_space, width)` |
"""

import doctest
import importlib
import types

import numpy as np
import pytest
import torch

import megastep
from megastep import arrdict, core, cubicasa, cuda, geometry, scene, spaces, toys
from megastep import dotdict as dotdict_module
from megastep.agents.networks import heads
from megastep.ragged import Ragged


@pytest.fixture(autouse=True)
def _on_the_cpu(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)


def session(text, **names):
    """Runs an interactive session and compares what it prints, ignoring differences of white space.
    Returns its variables.
    """
    parsed = doctest.DocTestParser().get_doctest(text, names, "session", None, 0)
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE, verbose=False)
    failures = []
    runner.run(parsed, out=failures.append, clear_globs=False)
    assert runner.tries and not runner.failures, "".join(failures)
    return parsed.globs


MODULES = "arrdict capture contract core cubicasa cuda dotdict engine envs geometries geometry "
MODULES += "adapters modules plotting ragged recording scene spaces toys types"


@pytest.mark.parametrize("name", ["agents", "kernels", *MODULES.split()])
def test_every_module_is_an_attribute_of_the_package(name):
    assert getattr(megastep, name) is importlib.import_module(f"megastep.{name}")


@pytest.mark.parametrize("name", MODULES.split())
def test_star_import_brings_no_module_and_no_name_of_another_package(name):
    names = {}
    exec(f"from megastep.{name} import *", names)
    del names["__builtins__"]
    assert names
    for key, value in names.items():
        assert not isinstance(value, types.ModuleType), f"{key} would replace a module"
        package = getattr(value, "__module__", "megastep").split(".")[0]
        assert package in ("megastep", "typing"), key  # typing: aliases such as types.Tree


def test_an_unknown_module_is_named():
    with pytest.raises(AttributeError, match="'toy'.* toys"):
        megastep.toy  # noqa: B018, the access is the test


def test_names_of_the_original_exist():
    assert cuda.render is megastep.engine.render
    assert cuda.Agents is megastep.engine.Agents and cuda.Core is core.Core
    names = {"Agents", "Scenery", "Render", "Physics", "bake", "render", "physics", "Core"}
    assert names <= set(dir(cuda))
    assert len(cubicasa.sample(2)) == 2


def concepts():
    from megastep.arrdict import arrdict
    from megastep.dotdict import dotdict

    return session(
        """
        >>> objs = dotdict(
        ...     a=dotdict(
        ...         b=1,
        ...         c=2),
        ...     d=3)
        >>>
        >>> tensors = arrdict(
        ...     a=torch.tensor([1]),
        ...     b=arrdict(
        ...         c=torch.tensor([2])))
        """,
        torch=torch,
        dotdict=dotdict,
        arrdict=arrdict,
    )


def test_attribute_access():
    names = session(
        """
        >>> tensors['a'] is tensors.a
        True
        >>> tensors['e'] = 5
        >>> tensors.e
        5
        """,
        **concepts(),
    )
    assert set(names["tensors"]) == {"a", "b", "e"}


def test_forwarded_attributes():
    names = session(">>> gpu_tensors = cpu_tensors.cpu()", cpu_tensors=concepts()["tensors"])
    assert names["gpu_tensors"].b.c.tolist() == [2]


def test_method_chaining():
    session(
        """
        >>> objs.pipe(list)
        ['a', 'd']
        >>> objs.map(float)
        dotdict:
        a    dotdict:
             b    1.0
             c    2.0
        d    3.0
        >>> objs.starmap(int.__add__, objs)
        dotdict:
        a    dotdict:
             b    2
             c    4
        d    6
        >>> (objs
        ...     .map(float)
        ...     .starmap(float.__add__, objs)
        ...     .pipe(list))
        ['a', 'd']
        """,
        **concepts(),
    )


def test_repr():
    session(
        """
        >>> objs
        dotdict:
        a    dotdict:
             b    1
             c    2
        d    3
        >>> tensors
        arrdict:
        a    Tensor((1,), torch.int64)
        b    arrdict:
             c    Tensor((1,), torch.int64)
        """,
        **concepts(),
    )


def test_indexing():
    session(
        """
        >>> tensors[0]
        arrdict:
        a    Tensor((), torch.int64)
        b    arrdict:
             c    Tensor((), torch.int64)
        >>> tensors[0].item() # the .item() call is needed to get it to print nicely
        arrdict:
        a    1
        b    arrdict:
             c    2
        """,
        **concepts(),
    )


def test_binary_operations():
    session(
        """
        >>> tensors + tensors
        arrdict:
        a    Tensor((1,), torch.int64)
        b    arrdict:
             c    Tensor((1,), torch.int64)
        >>> (tensors + tensors)[0].item() # the [0].item() call is needed to get it to print nicely
        arrdict:
        a    2
        b    arrdict:
             c    4
        >>> {'__add__', '__rsub__', '__matmul__', '__and__', '__lt__'} <= set(dir(arrdict))
        True
        """,
        **concepts(),
    )


def test_ragged():
    # Subarrays are [0., 1., 2.], [3.], [4., 5.]
    vals = np.array([0.0, 1.0, 2.0, 3.0, 4.0, 5.0])
    widths = np.array([3, 1, 2])
    r = Ragged(vals, widths)
    names = session(
        """
        >>> r[0]
        array([0., 1., 2.])
        >>> r[1]
        array([3.])
        >>> r[2]
        array([4., 5.])
        >>> r[:2]
        RaggedNumpy([3 1])
        >>> there = r.torchify()
        >>> back = r.torchify().numpyify()
        >>> r.vals # the backing array
        array([0., 1., 2., 3., 4., 5.])
        >>> r.widths # the subarray widths
        array([3, 1, 2])
        >>> r.starts # indices of the start of each subarray
        array([0, 3, 4])
        >>> r.ends # indices of the end of each subarray
        array([3, 4, 6])
        >>> r.inverse
        array([0, 0, 0, 1, 2, 2])
        """,
        r=r,
    )
    assert isinstance(names["there"][2], torch.Tensor)
    assert names["back"][2].tolist() == [4, 5]


def test_geometries():
    g = toys.box()
    assert geometry.display(g).get_xlabel() == "x, m"
    assert isinstance(g.id, int) and isinstance(g.res, float)
    assert g.walls.shape == (4, 2, 2) and g.lights.shape == (1, 2) and g.masks.ndim == 2
    assert (g.walls > 0).all() and (g.lights > 0).all()
    middle = geometry.indices(np.array([3.5, 3.5]), g.masks.shape, g.res)
    on_a_wall = geometry.indices([1.0, 3.5], g.masks.shape, g.res)
    assert g.masks[tuple(middle)] == 1 and g.masks[tuple(on_a_wall)] == -1
    assert np.abs(geometry.centers(middle, g.masks.shape, g.res) - 3.5).max() <= g.res / 2 + 1e-6


def test_scenery():
    scenery = scene.scenery(3 * [toys.box()], n_agents=2)
    n_model = 2 * len(scenery.model)
    lines = scenery.lines[1]
    assert lines.shape == (n_model + 4, 2, 2)  # the agents' lines come first
    assert sorted(lines[n_model:].tolist()) == sorted(toys.box().walls.tolist())
    wall = int(scenery.lines.starts[1]) + n_model
    assert scenery.textures[wall].shape == (100, 3)  # 5 m of 5 cm texels
    assert scenery.baked[wall].shape == (100,) and (scenery.baked[wall] > 0).all()


def test_decision_and_world():
    dotdict = dotdict_module
    action_space = dotdict.dotdict(
        movement=spaces.MultiDiscrete(2, 7), fire=spaces.MultiDiscrete(2, 2)
    )

    decision = arrdict.arrdict(
        actions=arrdict.arrdict(movement=torch.as_tensor([[5, 6]]), fire=torch.as_tensor([[0, 1]]))
    )

    for name, space in action_space.items():
        actions = decision.actions[name]
        assert actions.shape == (1, *space.shape) and (actions < space.n_actions).all()
    sampled = heads.output(action_space, 8)
    sampled = sampled.sample(sampled(torch.zeros(1, 8)))
    assert sampled.shape == decision.actions.shape


def test_spaces_and_heads():
    env, width = megastep.envs.Minimal(2), 16
    intake = heads.intake(env.obs_space, width)
    output = heads.output(env.action_space, width)
    world = env.reset()
    assert intake(world.obs).shape == (2, width)
    assert output(intake(world.obs)).exp().sum(-1).allclose(torch.ones(2, 1))


def test_the_experience_loop():
    env = megastep.envs.Minimal(2)

    def agent(world):
        return arrdict.arrdict(actions=torch.full((len(world.reset), 1), 5))

    world = env.reset()
    angles = env.core.agents.angles.clone()
    for _ in range(64):
        decision = agent(world)
        world = env.step(decision)
    # 64 turns of 18 degrees to the left: 180 degrees per second at 10 steps per second
    turned = (env.core.agents.angles - angles - 64 * 18 + 180) % 360 - 180
    assert turned.abs().max() < 0.01 and not world.reset.any()
