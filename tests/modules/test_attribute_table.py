"""The table of attributes in docs/new-environment.md: names, shapes and dtypes as they are."""

import re

import torch

from megastep import core, modules, scene, toys
from megastep.modules.objects import TENSORS
from tests.helpers import pages

SIZES = dict(N=3, A=2, B=6, D=2, C=1, R=8, n=64, K=5)


def objects():
    """One object of every class of the modules by name, on two layouts."""
    geometries = [toys.box(), toys.column()]
    scenery = scene.scenery(geometries, n_agents=SIZES["A"], n_envs=SIZES["N"], device="cpu")
    made = core.Core(scenery, res=SIZES["R"])
    classes = [kind for name, kind in vars(modules).items() if name in modules.__all__]
    arguments = {
        "FreePoints": (geometries, made, SIZES["n"]),
        "Objects": (geometries, made, {"key": SIZES["K"]}, ("red",), False, SIZES["n"]),
        "RandomSpawns": (geometries, made),
        "CounterGenerator": (SIZES["B"], 1, "cpu"),
    }
    named = {
        kind.__name__: kind(*arguments.get(kind.__name__, (made,)))
        for kind in classes
        if isinstance(kind, type) and not issubclass(kind, tuple)
    }
    kind = named["Objects"]["key"]
    return named | {"Objects[...]": kind, "Core": made, "Core.agents": made.agents}


def test_table_has_every_public_attribute_with_its_shape():
    text = (pages.ROOT / "docs" / "new-environment.md").read_text()
    text = text.partition("## Attributes of modules")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| (`.*?) \| (`.*?) \| (.*?) ?\| .*\|$", text, re.M)
    documented, present = {}, objects()
    for owners, names, shape in rows:
        for owner in re.findall(r"`(.*?)`", owners):
            for name in re.findall(r"`(.*?)`", names):
                documented.setdefault(owner, []).append(name)
                value = getattr(present[owner], name)
                assert bool(shape) == isinstance(value, torch.Tensor), (owner, name)
                if shape:
                    expected = eval(shape.rpartition(" ")[0], dict(SIZES))
                    assert tuple(value.shape) == expected, (owner, name)
                    assert str(value.dtype) == f"torch.{shape.split()[-1]}", (owner, name)
    public = {
        owner: sorted(name for name in vars(value) if not name.startswith("_"))
        for owner, value in present.items()
    }
    public["Objects[...]"] = sorted([*public["Objects[...]"], *TENSORS])
    assert {owner: sorted(names) for owner, names in documented.items()} == public
