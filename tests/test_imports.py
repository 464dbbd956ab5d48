"""Imports go one way.

Entry scripts, megastep.agents.api -> cli -> launch -> evaluation -> factory -> selfplay, training
-> runs -> algorithms -> networks, storage -> trees and spaces of megastep; environments -> modules,
core, plotting -> engine -> kernels. The rules read the source files without importing them. The
folder agents/ is read once, as megastep.agents.
"""

import ast
import pathlib

import pytest

ROOT = pathlib.Path(__file__).parents[1]
SCRIPTS = ("train", "evaluate", "record", "megastep.__main__")

# A module may import modules of rows above its own, and of its own part or room.
SIMULATOR = (
    ("types",),
    ("atomic_files", "global_generators"),
    (
        "cache",
        "colour",
        "dotdict",
        "read_only",
        "settings",
        "video",
        "workers",
    ),
    ("arrdict", "geometry", "imports", "kernels", "plotting", "ragged"),
    ("devices", "schedules"),
    ("coefficients",),
    ("engine", "moments", "spaces"),
    ("env_state", "recording"),
    ("capture", "contract", "geometries", "scene"),
    ("hosting",),
    ("core", "cubicasa", "toys"),
    ("cuda", "modules"),
    ("geodesics",),
    ("compat", "envs", "web", "wrappers"),
    ("adapters", "demo"),
    ("data",),
)
ENGINE = (
    ("checks", "state_tree"),
    ("objects", "resets"),
    ("agents", "scenery"),
    ("launch_params",),
    ("operations",),
    ("rendering",),
)
AGENTS = (
    ("errors", "generator", "package", "types"),
    ("distributed",),
    ("console", "networks"),
    ("storage",),
    ("algorithms",),
    ("runs",),
    ("training",),
    ("population", "selfplay"),
    ("factory",),
    ("evaluation", "pretrained"),
    ("export", "reports"),
    ("launch",),
    ("cli",),
    ("api",),
)
# Modules of the simulator that every room of the learner may import: no environment, no engine.
THREADS = "megastep.devices"
SHARED = {
    "megastep",
    "megastep.arrdict",
    "megastep.atomic_files",
    "megastep.capture",
    "megastep.coefficients",
    "megastep.data",
    "megastep.data.episodes",
    "megastep.dotdict",
    "megastep.env_state",
    "megastep.imports",
    "megastep.ragged",
    "megastep.schedules",
    "megastep.settings",
    "megastep.spaces",
    "megastep.types",
    "megastep.video",  # a logger has films
}
# Bots walk in homes, by the truth about them.
BOTS = "megastep.agents.selfplay.bots"
SHARED_WITH_BOTS = SHARED | {
    "megastep.engine",
    "megastep.geodesics",
    "megastep.modules.movement",
}
# What makes and runs a whole training also caches arguments, chooses a device and homes, checks
# environments, keeps the global generators, writes videos and starts processes.
UPPER_ROOMS = ("api", "cli", "evaluation", "export", "factory", "launch", "pretrained", "reports")
SHARED_WITH_UPPER_ROOMS = SHARED | {
    "megastep.cache",
    "megastep.contract",
    "megastep.data.formats",
    "megastep.devices",
    "megastep.engine",
    "megastep.geometries.checks",
    "megastep.geometries.files",
    "megastep.geometries.databases",
    "megastep.geometries.plans.imports",
    "megastep.geometries.plans.sheets",
    "megastep.global_generators",
    "megastep.recording",
    "megastep.scene",
    "megastep.hosting.env_error",
    "megastep.web.page",
    "megastep.web.program",
    "megastep.web.recording",
    "megastep.workers",
    "megastep.wrappers",
}
# The files that may import these modules of ours, as glob patterns.
OWN_USERS = {
    "megastep.kernels.build.launch": (
        "megastep/devices.py",
        "megastep/engine/*.py",
        "megastep/envs/common.py",
        "megastep/envs/*/*.py",
        "megastep/geodesics/__init__.py",
        "megastep/kernels/build/*.py",
        "megastep/modules/visibility.py",  # its cache depends on the kernels' sources
        "megastep/web/*.py",
        "agents/algorithms/*.py",
        "agents/algorithms/kernels/*.py",
        "agents/distributed/bucket.py",
        "agents/export/web.py",
        "agents/networks/*.py",
        "agents/networks/web/*.py",
        "agents/selfplay/opponents.py",
        "agents/storage/copies.py",
        "agents/storage/replay.py",
        "agents/storage/sum_tree.py",
        "agents/training/episode_stats.py",
    )
}
# The files that may import these packages, directly or through importlib, as glob patterns.
OUTSIDE_USERS = {
    "av": ("megastep/video.py",),
    "cuda": ("megastep/kernels/build/compile.py",),
    "gymnasium": (
        "megastep/adapters/*.py",
        "megastep/data/formats.py",
        "megastep/envs/gymnasium.py",
        "megastep/envs/minigrid/original.py",
        "megastep/envs/pettingzoo.py",
        "megastep/hosting/*.py",
    ),
    "defusedxml": ("megastep/geometries/plans/safe.py",),
    "hydra": ("agents/api.py", "agents/cli/*.py"),
    "hydra_plugins": ("agents/cli/*.py",),
    "loky": (
        "megastep/geometries/databases.py",
        "megastep/geometries/plans/imports.py",
        "megastep/hosting/processes.py",
        "megastep/workers.py",
    ),
    "minari": ("megastep/data/formats.py",),
    "omegaconf": ("agents/cli/*.py",),
    "openskill": ("agents/evaluation/evaluate_run.py",),
    "pettingzoo": ("megastep/adapters/parallel_env.py", "megastep/hosting/hosted.py"),
    "pandas": ("megastep/data/formats.py",),
    "pyarrow": ("megastep/data/formats.py",),
    "rich": ("agents/console.py", "megastep/envs/pointgoal/goals.py"),
    "rsl_rl": ("megastep/adapters/rsl_rl.py",),
    "shapely": ("megastep/geometries/plans/*.py",),
    "stable_baselines3": ("megastep/adapters/sb3.py",),
    "svgelements": ("megastep/geometries/plans/*.py",),
    "tensorboard": ("agents/training/loggers/tensorboard.py",),
    "tensordict": ("megastep/adapters/rsl_rl.py", "megastep/adapters/torchrl.py"),
    "torchrl": ("megastep/adapters/torchrl.py",),
    "wandb": ("agents/training/loggers/wandb.py",),
}


# ---- Reading the sources ----


def source_files(*folders):
    """The Python files of some folders. rglob skips links, and so megastep/agents."""
    return [path for folder in folders for path in sorted((ROOT / folder).rglob("*.py"))]


def module_name(path):
    """The name that a source file is imported by."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    parts = ("megastep", *parts) if parts[0] == "agents" else parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


SOURCES = [*sorted(ROOT.glob("*.py")), *source_files("megastep", "agents")]
MODULES = {module_name(path): path for path in SOURCES}


def running_nodes(tree):
    """All nodes of a syntax tree, without the bodies of `if TYPE_CHECKING:`."""
    nodes = [tree]
    while nodes:
        for node in ast.iter_child_nodes(nodes.pop()):
            if isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
                continue
            yield node
            nodes.append(node)


def called(node):
    """The name of a called function or method."""
    return getattr(node.func, "attr", getattr(node.func, "id", None))


def imports(path):
    """The dotted names that a file imports when it runs, anywhere in it. `from a import b` is a.b
    if that is a module, else a. Imports for type checkers alone (`if TYPE_CHECKING:`) do not count.
    """
    names, package = set(), module_name(path).split(".")
    package = package if path.name == "__init__.py" else package[:-1]
    for node in running_nodes(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parents = package[: len(package) - node.level + 1] if node.level else []
            base = ".".join([*parents, *filter(None, [node.module])])
            for alias in node.names:
                submodule = f"{base}.{alias.name}"
                names.add(submodule if submodule in MODULES else base)
        elif isinstance(node, ast.Call) and called(node) == "import_module":
            names.update(arg.value for arg in node.args if isinstance(arg, ast.Constant))
    return names


@pytest.fixture(scope="module")
def graph():
    """What each module imports."""
    return {name: imports(path) for name, path in MODULES.items()}


def top_level(name):
    return name.split(".")[0]


def is_below(name, package):
    return name == package or name.startswith(f"{package}.")


def is_agents(name):
    return is_below(name, "megastep.agents")


def is_simulator(name):
    return is_below(name, "megastep") and not is_agents(name) and name not in SCRIPTS


def is_own(name):
    return top_level(name) in ("megastep", *SCRIPTS)


def edges(graph, selected):
    """(module, a module of ours that it imports) for the modules that `selected` accepts."""
    for name in filter(selected, sorted(graph)):
        yield from ((name, target) for target in sorted(graph[name]) if is_own(target))


def part_of(name, package):
    """The part of a package that a module lies in: `envs` of megastep.envs.minimal in megastep."""
    return name.removeprefix(package).strip(".").split(".")[0]


def matches(name, patterns):
    return any(MODULES[name].relative_to(ROOT).match(pattern) for pattern in patterns)


# ---- The rules: each yields one sentence per violation ----


def rows_import_upwards(graph, package, rows, selected):
    """Modules of `package` import modules of rows above their own."""
    row_of = {part: row for row, parts in enumerate(rows) for part in parts}
    for name in filter(selected, graph):
        if name != package and part_of(name, package) not in row_of:
            yield f"{name} has no row in the rules"
    for name, target in edges(graph, selected):
        if not selected(target):
            continue
        source, sink = part_of(name, package), part_of(target, package)
        if (
            source in row_of
            and sink in row_of
            and source != sink
            and row_of[sink] >= row_of[source]
        ):
            yield f"{name} must not import {target}"


def simulator_rows(graph):
    return rows_import_upwards(graph, "megastep", SIMULATOR, is_simulator)


def engine_rows(graph):
    def is_engine(name):
        return is_below(name, "megastep.engine")

    return rows_import_upwards(graph, "megastep.engine", ENGINE, is_engine)


def agents_rows(graph):
    return rows_import_upwards(graph, "megastep.agents", AGENTS, is_agents)


def simulator_knows_no_learner(graph):
    for name, target in edges(graph, is_simulator):
        if not is_simulator(target):
            yield f"{name} must not import {target}"


def environments_are_independent(graph):
    """An environment is a file, or a folder with its own operation. All share envs.common
    and envs.first_person alone.
    """
    envs, shared = "megastep.envs", ("common", "first_person")
    for name, target in edges(graph, lambda name: name.startswith(f"{envs}.")):
        if is_below(target, envs) and part_of(target, envs) not in (part_of(name, envs), *shared):
            yield f"{name} must not import {target}"


def learner_knows_trees_and_spaces_only(graph):
    for name, target in edges(graph, is_agents):
        shared = SHARED_WITH_BOTS if is_below(name, BOTS) else SHARED
        if part_of(name, "megastep.agents") == "population":
            shared = SHARED | {"megastep.global_generators"}
        if part_of(name, "megastep.agents") in UPPER_ROOMS:
            shared = SHARED_WITH_UPPER_ROOMS
        launches = matches(name, OWN_USERS["megastep.kernels.build.launch"])
        allowed = is_agents(target) or target in shared
        # the number of CPU threads is the engine's
        of_launches = is_below(target, "megastep.kernels.build") or target == THREADS
        if not allowed and not (launches and of_launches):
            yield f"{name} must not import {target}"


def entry_scripts_only_start_the_command_line(graph):
    for script in SCRIPTS:
        for target in sorted(graph[script] ^ {"sys", "megastep.agents.cli.entry"}):
            yield f"{script} must import sys and megastep.agents.cli.entry alone: {target}"


def modules_stay_with_their_users(graph):
    for name, targets in graph.items():
        for target in sorted(targets & OWN_USERS.keys()):
            if not matches(name, OWN_USERS[target]):
                yield f"{name} must not import {target}"


def outside_packages_stay_with_their_users(graph):
    for name, targets in graph.items():
        for package in sorted({top_level(target) for target in targets} & OUTSIDE_USERS.keys()):
            if not matches(name, OUTSIDE_USERS[package]):
                yield f"{name} must not import {package}"


def agents_is_imported_as_megastep_agents(graph):
    for name, targets in graph.items():
        if any(is_below(target, "agents") for target in targets):
            yield f"{name} must not import agents: the name is megastep.agents"


def no_import_cycles(graph):
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
            yield f"these import each other in a cycle: {', '.join(sorted(below))}"
            return
        below = {name: targets for name, targets in below.items() if name not in free}


RULES = (
    simulator_rows,
    engine_rows,
    agents_rows,
    simulator_knows_no_learner,
    environments_are_independent,
    learner_knows_trees_and_spaces_only,
    entry_scripts_only_start_the_command_line,
    modules_stay_with_their_users,
    outside_packages_stay_with_their_users,
    agents_is_imported_as_megastep_agents,
    no_import_cycles,
)


# ---- The tests ----


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_sources_keep_the_rule(rule, graph):
    assert not list(rule(graph))


def test_tests_and_scripts_import_megastep_agents():
    graph = {str(path): imports(path) for path in source_files("tests", "scripts")}
    assert not list(agents_is_imported_as_megastep_agents(graph))


PLANTED = [
    (simulator_rows, "megastep.engine.scenery", "megastep.geometries.toys"),
    (engine_rows, "megastep.engine.checks", "megastep.engine.agents"),
    (agents_rows, "megastep.agents.networks.policy", "megastep.agents.storage.rollout"),
    (simulator_knows_no_learner, "megastep.envs.minimal", "megastep.agents.networks.heads"),
    (environments_are_independent, "megastep.envs.minimal", "megastep.envs.explorer"),
    (learner_knows_trees_and_spaces_only, "megastep.agents.algorithms.ppo", "megastep.engine"),
    (entry_scripts_only_start_the_command_line, "train", "torch"),
    (modules_stay_with_their_users, "megastep.envs.minimal", "megastep.kernels.build.launch"),
    (outside_packages_stay_with_their_users, "megastep.agents.algorithms.ppo", "hydra.core"),
    (agents_is_imported_as_megastep_agents, "train", "agents"),
]


@pytest.mark.parametrize("rule, name, target", PLANTED)
def test_a_planted_import_is_named(rule, name, target, graph):
    assert name in graph and target not in graph[name]
    planted = {**graph, name: graph[name] | {target}}
    (sentence,) = rule(planted)
    assert name in sentence
    assert target in sentence or f"import {top_level(target)}" in sentence
