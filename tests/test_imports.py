"""The shape of the house: imports go one way. Read from the sources, not from
what is loaded.
"""

import ast
import pathlib

import pytest

ROOT = pathlib.Path(__file__).parents[1]
PACKAGES = ("megastep", "agents")
SOURCES = sorted(
    [*ROOT.glob("*.py"), *(path for name in PACKAGES for path in (ROOT / name).rglob("*.py"))]
)

# Each module of the simulator may import modules of the rows above its own only.
FLOORS = (
    ("dotdict", "colour", "spaces", "ragged"),
    ("arrdict",),
    ("geometry", "capture", "plotting", "kernels"),
    ("geometries", "scenery", "recording"),
    ("engine", "toys", "cubicasa"),
    ("scene",),
    ("core",),
    ("modules", "cuda"),
    ("envs",),
)
FLOOR = {name: floor for floor, names in enumerate(FLOORS) for name in names}
# What the learner may know of the simulator: trees, spaces, and how to capture a step. No
# environment, no engine.
SHARED = {
    "megastep",
    "megastep.arrdict",
    "megastep.dotdict",
    "megastep.ragged",
    "megastep.spaces",
    "megastep.capture",
}
# Packages that only some files may import, directly or through importlib.
HOMES = {
    "hydra": ("agents/cli/",),
    "omegaconf": ("agents/cli/",),
    "wandb": ("agents/metrics.py",),
    "tensorboard": ("agents/metrics.py",),
    "rich": ("agents/cli/",),
    "loky": ("megastep/recording.py",),
    "IPython": ("megastep/recording.py",),
}


def name_of(path):
    """The dotted name of a source file."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {name_of(path): path for path in SOURCES}


def imports(path):
    """The dotted names that a file imports, wherever in it; `from a import b` is a.b if that is a
    module, else a.
    """
    found, package = set(), name_of(path).split(".")
    package = package if path.name == "__init__.py" else package[:-1]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(
                [
                    *(package[: len(package) - node.level + 1] if node.level else []),
                    *filter(None, [node.module]),
                ]
            )
            for alias in node.names:
                full = f"{base}.{alias.name}"
                found.add(full if full in MODULES else base)
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module"):
            found.update(arg.value for arg in node.args if isinstance(arg, ast.Constant))
    return found


GRAPH = {name: imports(path) for name, path in MODULES.items()}


def floor(name):
    """The floor of a module of the simulator, or None for the package itself, which imports its
    modules lazily.
    """
    parts = name.split(".")
    return FLOOR[parts[1]] if len(parts) > 1 else None


def test_the_reader_sees_imports(tmp_path, monkeypatch):
    path = tmp_path / "megastep" / "envs" / "sample.py"
    path.parent.mkdir(parents=True)
    path.write_text(
        '"""Two\nlines."""\nimport os  # why\n\n# nothing\nfrom .. import engine\n'
        "from ..core import (\n"
        '    Core)\n\n\ndef f():\n    """One."""\n    import importlib\n'
        '    return importlib.import_module("wandb"), """a\n    b"""\n'
    )
    monkeypatch.setitem(globals(), "ROOT", tmp_path)
    assert imports(path) == {"os", "megastep.engine", "megastep.core", "importlib", "wandb"}


def test_every_module_of_the_simulator_has_a_floor():
    assert {name.split(".")[1] for name in MODULES if name.startswith("megastep.")} <= set(FLOOR)


@pytest.mark.parametrize("name", [name for name in MODULES if name.split(".")[0] == "megastep"])
def test_the_simulator_imports_downwards_and_knows_no_learner(name):
    for target in GRAPH[name]:
        assert target.split(".")[0] not in {*PACKAGES, *(n for n in MODULES if "." not in n)} - {
            "megastep"
        }, target
        if target.startswith("megastep.") and target.split(".")[:2] != name.split(".")[:2]:
            assert floor(target) < floor(name), f"{name} must not import {target}"


@pytest.mark.parametrize("name", [name for name in MODULES if name.startswith("megastep.envs.")])
def test_an_environment_is_one_file(name):
    assert not [target for target in GRAPH[name] if target.startswith("megastep.envs.")]


@pytest.mark.parametrize(
    "name",
    [
        name
        for name in MODULES
        if name.split(".")[0] == "agents" and not name.startswith("agents.cli")
    ],
)
def test_the_learner_knows_trees_and_spaces_and_no_environment(name):
    for target in GRAPH[name]:
        if target.split(".")[0] in {*PACKAGES, "train", "evaluate", "record"}:
            allowed = target.split(".")[0] == "agents" and not target.startswith("agents.cli")
            assert allowed or target in SHARED, f"{name} must not import {target}"


def test_configs_holds_yaml_only():
    others = [p for p in (ROOT / "configs").rglob("*") if p.is_file() and p.suffix != ".yaml"]
    assert not [p for p in others if "__pycache__" not in p.parts]


@pytest.mark.parametrize("script", ["train", "evaluate", "record"])
def test_the_entry_scripts_open_the_command_line_and_no_more(script):
    assert GRAPH[script] == {"sys", f"agents.cli.{script}"}


@pytest.mark.parametrize("package", HOMES)
def test_outside_packages_stay_where_they_belong(package):
    users = {
        str(MODULES[name].relative_to(ROOT))
        for name, targets in GRAPH.items()
        if any(target.split(".")[0] == package for target in targets)
    }
    assert not [user for user in users if not user.startswith(HOMES[package])]


def test_no_module_imports_itself_in_a_circle():
    below = {
        name: {
            target
            for target in targets
            if target in MODULES and target != name and not name.startswith(f"{target}.")
        }
        for name, targets in GRAPH.items()
    }
    while below:
        free = {name for name, targets in below.items() if not targets & set(below)}
        assert free, f"these import each other in a circle: {sorted(below)}"
        below = {name: targets for name, targets in below.items() if name not in free}
