"""Imports go one way: entry scripts -> megastep.agents.cli -> agents -> trees and spaces of megastep;
environments -> modules, core, plotting -> engine -> kernels. Hydra stays in agents/cli, wandb in
metrics.py. Read from the sources, not from what is loaded.
"""

import ast
import pathlib

import pytest

ROOT = pathlib.Path(__file__).parents[1]
PACKAGES = ("megastep", "agents")
SCRIPTS = ("train", "evaluate", "record")
SOURCES = sorted(
    [*ROOT.glob("*.py"), *(path for name in PACKAGES for path in (ROOT / name).rglob("*.py"))]
)

# A module of the simulator may import modules of the layers above its own row only.
LAYERS = (
    ("colour", "dotdict", "outputs", "read_only", "settings", "spaces", "workers"),
    ("arrdict", "ragged", "state"),
    ("checks", "geometry", "capture", "contract", "plotting", "kernels"),
    ("devices", "goal_fields", "scenery_views", "recording"),
    ("geometries", "scenery", "agents"),
    ("launch_params",),
    ("games",),
    ("engine", "toys", "cubicasa"),
    ("scene",),
    ("core",),
    ("modules", "cuda"),
    ("envs",),
)
LAYER = {name: layer for layer, names in enumerate(LAYERS) for name in names}
# What the learner may know of the simulator: trees, spaces, how to capture a step and how to build
# and launch kernels. No environment, no engine.
SHARED = {
    "megastep",
    "megastep.arrdict",
    "megastep.dotdict",
    "megastep.ragged",
    "megastep.settings",
    "megastep.spaces",
    "megastep.capture",
    "megastep.kernels.compile",
    "megastep.kernels.launch",
}
# Packages from outside that only some files may import, directly or through importlib.
USERS = {
    "hydra": ("agents/cli/",),
    "omegaconf": ("agents/cli/",),
    "wandb": ("agents/metrics.py",),
    "tensorboard": ("agents/metrics.py",),
    "rich": ("agents/cli/", "megastep/workers.py"),
    "openskill": ("agents/ratings.py",),
    "loky": ("megastep/recording.py", "megastep/workers.py"),
    "scipy": ("megastep/envs/pointgoal/geodesics.py",),
    "IPython": ("megastep/recording.py",),
}


# ---- Reading ----


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


def package_of(name):
    return name.split(".")[0]


def edges(graph, *packages):
    """(module, what it imports of ours) for the modules of some packages or scripts."""
    for name in sorted(graph):
        if package_of(name) in packages:
            for target in sorted(graph[name]):
                if package_of(target) in (*PACKAGES, *SCRIPTS) and target != name:
                    yield name, target


# ---- The rules: each gives a sentence per violation ----


def part_of(name):
    """The part of the simulator that a module belongs to: `envs` of megastep.envs.minimal."""
    return (*name.split("."), "")[1]


def the_simulator_imports_downwards(graph):
    """From part to part; inside a part (envs, geometries, kernels) any order will do."""
    for name in graph:
        if name.startswith("megastep.") and part_of(name) not in LAYER:
            yield f"{name} has no layer"
    for name, target in edges(graph, "megastep"):
        source, sink = part_of(name), part_of(target)
        if source in LAYER and sink in LAYER and source != sink and LAYER[sink] >= LAYER[source]:
            yield f"{name} must not import {target}"


def the_simulator_knows_no_learner(graph):
    for name, target in edges(graph, "megastep"):
        if package_of(target) != "megastep":
            yield f"{name} must not import {target}"


def an_environment_is_one_file(graph):
    for name, target in edges(graph, "megastep"):
        if name.startswith("megastep.envs.") and target.startswith("megastep.envs"):
            yield f"{name} must not import {target}"


def is_command_line(name):
    return name == "megastep.agents.cli" or name.startswith("megastep.agents.cli.")


def the_learner_knows_trees_and_spaces_only(graph):
    for name, target in edges(graph, "agents"):
        ours = package_of(target) == "agents" and not is_command_line(target)
        if not is_command_line(name) and not ours and target not in SHARED:
            yield f"{name} must not import {target}"


def the_command_line_imports_no_entry_script(graph):
    for name, target in edges(graph, "agents"):
        if target in SCRIPTS:
            yield f"{name} must not import {target}"


def entry_scripts_open_the_command_line_and_no_more(graph):
    for script in SCRIPTS:
        for target in sorted(graph[script] ^ {"sys", "megastep.agents.cli.entry"}):
            yield f"{script} must import sys and megastep.agents.cli.entry alone: {target}"


def outside_packages_stay_with_their_users(graph):
    for name, targets in graph.items():
        file = str(MODULES[name].relative_to(ROOT))
        for package in sorted({package_of(target) for target in targets} & USERS.keys()):
            if not file.startswith(USERS[package]):
                yield f"{name} must not import {package}"


def no_module_imports_itself_in_a_circle(graph):
    below = {
        name: {
            target
            for target in targets
            if target in graph and target != name and not name.startswith(f"{target}.")
        }
        for name, targets in graph.items()
    }
    while below:
        free = {name for name, targets in below.items() if not targets & set(below)}
        if not free:
            yield f"these import each other in a circle: {', '.join(sorted(below))}"
            return
        below = {name: targets for name, targets in below.items() if name not in free}


RULES = (
    the_simulator_imports_downwards,
    the_simulator_knows_no_learner,
    an_environment_is_one_file,
    the_learner_knows_trees_and_spaces_only,
    the_command_line_imports_no_entry_script,
    entry_scripts_open_the_command_line_and_no_more,
    outside_packages_stay_with_their_users,
    no_module_imports_itself_in_a_circle,
)


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_the_sources_keep_the_rule(rule):
    assert not list(rule(GRAPH))


PLANTED = [
    (the_simulator_imports_downwards, "megastep.engine", "megastep.modules"),
    (the_simulator_imports_downwards, "megastep.plotting", "megastep.scenery"),
    (the_simulator_imports_downwards, "megastep.kernels.compile", "megastep.engine"),
    (the_simulator_imports_downwards, "megastep.scenery_views", "megastep.geometries.toys"),
    (the_simulator_knows_no_learner, "megastep.envs.minimal", "megastep.agents.networks.heads"),
    (the_simulator_knows_no_learner, "megastep.core", "train"),
    (an_environment_is_one_file, "megastep.envs.minimal", "megastep.envs.explorer"),
    (the_learner_knows_trees_and_spaces_only, "megastep.agents.algorithms.ppo", "megastep.engine"),
    (the_learner_knows_trees_and_spaces_only, "megastep.agents.networks.policy", "megastep.envs"),
    (
        the_learner_knows_trees_and_spaces_only,
        "megastep.agents.storage.rollout",
        "megastep.agents.cli.settings",
    ),
    (the_learner_knows_trees_and_spaces_only, "megastep.agents.training.loggers", "train"),
    (the_command_line_imports_no_entry_script, "megastep.agents.cli.sweep", "train"),
    (entry_scripts_open_the_command_line_and_no_more, "train", "torch"),
    (entry_scripts_open_the_command_line_and_no_more, "record", "megastep.agents.cli.train"),
    (outside_packages_stay_with_their_users, "megastep.agents.algorithms.ppo", "hydra.core"),
    (outside_packages_stay_with_their_users, "megastep.agents.cli.train", "wandb"),
    (outside_packages_stay_with_their_users, "megastep.core", "loky"),
]


@pytest.mark.parametrize("rule, name, target", PLANTED)
def test_a_planted_import_is_named(rule, name, target):
    planted = {**GRAPH, name: GRAPH[name] | {target}}
    (sentence,) = rule(planted)
    assert name in sentence and target.removesuffix(".core") in sentence


def test_a_planted_circle_is_named():
    planted = {**GRAPH, "megastep.dotdict": GRAPH["megastep.dotdict"] | {"megastep.arrdict"}}
    (sentence,) = no_module_imports_itself_in_a_circle(planted)
    assert "megastep.arrdict" in sentence and "megastep.dotdict" in sentence


def test_a_module_without_a_layer_is_named(monkeypatch):
    assert "megastep.new has no layer" in the_simulator_imports_downwards(
        {**GRAPH, "megastep.new": set()}
    )


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


def test_configs_holds_yaml_only():
    others = [p for p in (ROOT / "configs").rglob("*") if p.is_file() and p.suffix != ".yaml"]
    assert not [p for p in others if "__pycache__" not in p.parts]
