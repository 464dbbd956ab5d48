"""Strangers' runs: nothing that a file names is imported, and an odd file is one sentence."""

import hashlib
import importlib
import json
import re
import shutil
import sys
from pathlib import Path

import pytest
import yaml

from megastep.agents.cli import compare, evaluate, export, inspect, record, report, train, web
from megastep.agents.runs import checkpoint
from tests.helpers import tiny

WORDS = [*tiny.TINY, *tiny.SHORT_EPISODES, f"samples={20 * tiny.UPDATE}", "logging.every=5"]
FILES = ["metrics.jsonl", "perf.jsonl", "provenance.jsonl", "evaluations/*.json"]
#: Values where there are others.
ODD = ["planted:Thing", 10**400, None, float("nan"), [], -1]
SLOW = [pytest.param(None, marks=pytest.mark.slow)]
SLOW += [pytest.param(value, marks=pytest.mark.nightly) for value in (float("nan"), [], -1)]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A folder with a run that has an evaluation, and a population P of two such."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(base := tmp_path_factory.mktemp("strangers"))
        assert train.main([*WORDS, "folder=run"]) == 0
        homes = ["geometry=bench", "geometry.n=4"]
        assert evaluate.main(["run=run", "episodes=8", "split=all", *homes]) == 0
        start = {"samples": 0, "command": "train.py", "commit": "0"}
        (base / "run/provenance.jsonl").write_text(json.dumps(start) + "\n")
        row = {"from": 0, "score": 1.5, "settings/lr": 1e-3, "diverged": 0}
        rows = [{"samples": n, "generation": n, "member": m, **row} for n in (0, 1) for m in (0, 1)]
        for member in (0, 1):
            shutil.copytree("run", f"P/member-{member}")
        (base / "P/population.jsonl").write_text("\n".join([*map(json.dumps, rows), ""]))
        return base


@pytest.fixture
def here(trained, tmp_path, monkeypatch):
    """A copy of it, beside a module that leaves a file where it is imported."""
    shutil.copytree(trained, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    (tmp_path / "planted.py").write_text(f"open({str(tmp_path / 'imported')!r}, 'w').close()\n")
    importlib.invalidate_caches()
    yield tmp_path
    assert not (tmp_path / "imported").exists() and "planted" not in sys.modules


def ends_well(main, words, capsys):
    """Whether a command has a result, or ends with one sentence."""
    code, text = main(words), capsys.readouterr().err
    lines = [line for line in text.splitlines() if "warning: " not in line]
    assert (code, len(lines)) in ((0, 0), (1, 0), (2, 1)), text  # 1: inspect, of what is damaged
    return code


@pytest.mark.parametrize("value", [*ODD[:2], *SLOW], ids=[repr(value)[:14] for value in ODD])
@pytest.mark.parametrize("name", [*(f"P/member-0/{name}" for name in FILES), "P/population.jsonl"])
def test_values_of_other_types(here, name, value, capsys):
    (file,) = here.glob(name)
    words = [f"run={name[: name.rindex('/')].removesuffix('/evaluations')}", "file=x.html"]
    text = file.read_text()
    start = 0 if file.suffix == ".json" else text.rfind("\n", 0, -1) + 1  # of lines, the last
    for match in re.compile(r'(?<=": )("[^"]*"|[^\s,{}[\]]+)').finditer(text, start):
        file.write_text(f"{text[: match.start()]}{json.dumps(value)}{text[match.end() :]}")
        ends_well(report.main, words, capsys)
    assert start < match.start()


def test_what_files_name_is_not_imported(here, capsys):
    (file,) = here.glob("P/member-0/evaluations/*.json")
    file.write_text(re.sub(r'"[\w.]+:bench"', '"planted:Thing"', file.read_text()))
    file = Path("P/member-0/config.yaml")
    file.write_text(re.sub(r"(?<!score): [a-z].*", ": planted:Thing", file.read_text()))
    Path("P/member-0/provenance.jsonl").unlink()
    to_export = ["run=P", "format=safetensors", "file=x.safetensors"]
    assert ends_well(report.main, ["run=P/member-0", "file=x.html"], capsys) == 0
    assert "not drawn: An evaluation would import planted:Thing" in Path("x.html").read_text()
    assert ends_well(compare.main, ["run=P"], capsys) == 0
    assert ends_well(evaluate.main, ["run=P", "episodes=2"], capsys) == 0
    assert ends_well(record.main, ["run=P", "steps=2", "file=x.png"], capsys) == 0
    assert ends_well(inspect.main, ["P"], capsys) == 0
    assert ends_well(export.main, to_export, capsys) == 0, "without provenance"
    assert ends_well(web.main, ["run=P", "file=x.html"], capsys) == 2, "which needs another task"


COMMANDS = {
    "report": (report.main, ["run=[P/member-0,P/member-1]", "file=x.html"]),
    "compare": (compare.main, ["run=P"]),
    "evaluate": (evaluate.main, ["run=P", "episodes=2", "max_steps=2"]),
    "record": (record.main, ["run=P", "steps=2", "file=x.png"]),
    "inspect": (inspect.main, ["P"]),
    "export": (export.main, ["run=P", "format=safetensors", "file=x.safetensors"]),
    "web": (web.main, ["run=P", "file=x.html"]),
    "init": (train.main, ["init=P", "samples=1", "folder=new"]),
    "resume": (train.main, ["resume=P", "more_samples=1"]),
    "rerun": (train.main, ["rerun=P", "folder=new"]),
}


def planted(text, read, dump):
    """Yields a text with the marker in place of each string in it, one after the other."""

    def strings(node):
        for key, value in node.items() if isinstance(node, dict) else enumerate(node):
            if isinstance(value, (dict, list)):
                yield from strings(value)
            elif isinstance(value, str):
                yield node, key

    tree = read(text)
    for node, key in [*strings(tree)]:
        value, node[key] = node[key], ODD[0]
        yield dump(tree)
        node[key] = value


def lines(text):
    return [*map(json.loads, text.splitlines())]


def variants(folder):
    """Yields a population in turn with the marker in each string of each of its files; those of a
    checkpoint are sealed anew, as a stranger can.
    """
    for file in sorted(folder.rglob("*.*")):
        read, dump = {
            ".json": (json.loads, json.dumps),
            ".jsonl": (lines, lambda rows: "".join(json.dumps(row) + "\n" for row in rows)),
            ".yaml": (yaml.safe_load, yaml.safe_dump),
        }.get(file.suffix, (None, None))
        text, manifest = read and file.read_text(), file.with_name("manifest.json")
        seal = manifest.read_bytes() if read and manifest.exists() else None
        for other in planted(text, read, dump) if read else ():
            file.write_text(other)
            if seal is not None:
                tree = {k: v for k, v in json.loads(manifest.read_text()).items() if k != "sha256"}
                if file != manifest:
                    digest = hashlib.sha256(other.encode()).hexdigest()
                    tree["files"][file.name] = {"sha256": digest, "bytes": len(other)}
                manifest.write_bytes(checkpoint.sealed(tree))
            yield file
            if seal is not None:
                manifest.write_bytes(seal)
        if read:
            file.write_text(text)


@pytest.mark.parametrize(
    "every", [pytest.param(100, marks=pytest.mark.slow), pytest.param(1, marks=pytest.mark.nightly)]
)
@pytest.mark.parametrize("name", COMMANDS)
def test_no_string_of_a_population_is_imported(here, name, every, capsys):
    """In each string of each file a marker: nothing runs, and each end is a sentence."""
    (main, words), n = COMMANDS[name], 0
    for n, file in enumerate(variants(here / "P")):
        if (n + len(name)) % every == 0:
            ends_well(main, words, capsys)
            shutil.rmtree("new", ignore_errors=True)
            assert not Path("imported").exists(), file
    assert n > 150


CONFIGS = {
    "merges": "a: &a {x: 1}\nenv: &b {<<: [*a, *a]}",
    "date": "env: {name: 2023-99-99}",
    "depth": "env: " + 30_000 * "[",
    "digits": f"env: {{name: {5000 * '9'}}}",
    "hexadecimal": f"env: {{name: 0x{5000 * 'f'}}}",
    "large": "env: {}\n" + 200_000 * "#",
}


@pytest.mark.parametrize("text", CONFIGS.values(), ids=CONFIGS)
def test_a_config_is_read_within_limits(here, text, capsys):
    Path("P/member-0/config.yaml").write_text(text)
    assert ends_well(report.main, ["run=P/member-0"], capsys) == 2
    assert ends_well(inspect.main, ["P"], capsys) == 2, "which asks for the best"


def test_a_path_longer_than_the_system_allows(here, capsys):
    name = 2000 * "abc/"
    for main in (report.main, evaluate.main):
        assert ends_well(main, [f"run={name}"], capsys) == 2
    for words in ([f"resume={name}"], [*WORDS, f"folder={name}"]):
        assert ends_well(train.main, words, capsys) == 2
    assert ends_well(report.main, ["run=run", f"file={name}.html"], capsys) == 2
