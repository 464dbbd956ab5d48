"""The shape of the house: imports go one way, files stay small. Read from the sources, not from
what is loaded.
"""

import ast
import pathlib
import tokenize

import pytest

ROOT = pathlib.Path(__file__).parents[1]
PACKAGES = ("megastep", "agents", "configs")
SOURCES = sorted(
    [*ROOT.glob("*.py"), *(path for name in PACKAGES for path in (ROOT / name).rglob("*.py"))]
)
KERNELS = sorted(
    path for path in (ROOT / "megastep").rglob("*") if path.suffix in (".h", ".cu", ".cpp")
)
TESTS_AND_TOOLS = sorted([*(ROOT / "tests").glob("*.py"), *(ROOT / "scripts").glob("*.py")])
MAX_FILE, MAX_TOTAL = 350, 5000

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
    "hydra": ("configs/", "train.py", "evaluate.py", "record.py"),
    "omegaconf": ("configs/", "train.py", "evaluate.py", "record.py"),
    "wandb": ("agents/metrics.py",),
    "tensorboard": ("agents/metrics.py",),
    "rich": ("configs/", "train.py", "evaluate.py", "record.py"),
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


def code_lines(path):
    """How many lines hold code: not blank, not a comment, not a docstring."""
    if path.suffix != ".py":
        lines = [line.strip() for line in path.read_text().splitlines()]
        return sum(bool(line) and not line.startswith(("//", "/*", "*")) for line in lines)
    nothing = (
        tokenize.COMMENT,
        tokenize.NL,
        tokenize.NEWLINE,
        tokenize.INDENT,
        tokenize.DEDENT,
        tokenize.ENCODING,
        tokenize.ENDMARKER,
    )
    with tokenize.open(path) as file:
        tokens = [
            token for token in tokenize.generate_tokens(file.readline) if token.type not in nothing
        ]
    lines = {line for token in tokens for line in range(token.start[0], token.end[0] + 1)}
    for node in ast.walk(ast.parse(path.read_text())):
        if (
            isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef))
            and ast.get_docstring(node) is not None
        ):
            lines -= set(range(node.body[0].lineno, node.body[0].end_lineno + 1))
    return len(lines)


def floor(name):
    """The floor of a module of the simulator, or None for the package itself, which imports its
    modules lazily.
    """
    parts = name.split(".")
    return FLOOR[parts[1]] if len(parts) > 1 else None


def test_the_reader_sees_imports_and_counts_lines(tmp_path, monkeypatch):
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
    assert code_lines(path) == 8


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


@pytest.mark.parametrize("name", [name for name in MODULES if name.split(".")[0] == "agents"])
def test_the_learner_knows_trees_and_spaces_and_no_environment(name):
    for target in GRAPH[name]:
        if target.split(".")[0] in {*PACKAGES, "train", "evaluate", "record"}:
            assert target.split(".")[0] == "agents" or target in SHARED, (
                f"{name} must not import {target}"
            )


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


@pytest.mark.parametrize(
    "path", [*SOURCES, *KERNELS, *TESTS_AND_TOOLS], ids=lambda path: str(path.relative_to(ROOT))
)
def test_files_are_small(path):
    assert code_lines(path) <= MAX_FILE


def test_the_house_is_small():
    """The simulator, its kernels, the learner and the entry scripts; not the settings and command
    line in configs/.
    """
    counts = {
        path: code_lines(path)
        for path in [*SOURCES, *KERNELS]
        if "configs" not in path.relative_to(ROOT).parts
    }
    assert sum(counts.values()) <= MAX_TOTAL
