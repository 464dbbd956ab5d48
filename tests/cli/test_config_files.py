"""Files of --config-dir that are bombs, nest deeply, never end or are odd: refused at once."""

import os
import time

import pytest
import yaml

from megastep.agents import package
from megastep.agents.cli import config_files, train


def bomb(n):
    """Returns a text that stands for 10^n values."""
    lines = [f"a{i}: &a{i} [{','.join(10 * [f'*a{i - 1}'])}]" for i in range(1, n)]
    return "\n".join(["a0: &a0 [0,0,0,0,0,0,0,0,0,0]", *lines])


FILES = {
    "bomb": (bomb(9), "more than 20,000 values"),
    "list": (f"a: [{'1,' * 30_000}]", "more than 20,000 values"),
    "brackets": ("a: " + 3000 * "[" + 3000 * "]", "more than 40 levels"),
    "levels": ("\n".join(f"{i * ' '}k:" for i in range(500)), "more than 40 levels"),
    "alias": ("a: &a [*a]", "'a' contains itself"),
    "merged alias": ("a: &a\n  b: 1\n  <<: *a", "'a' contains itself"),
    "interpolations": ("folder: '" + 3000 * "${" + 3000 * "}" + "'", "interpolations"),
    "code": ("a: !!python/object/apply:os.getcwd []", "python/object/apply:os.getcwd"),
    "bytes": ("a: !!binary AAAA", "tag"),
    "large": ("#" * 2**20, "more than 262,144 bytes"),
    "encoding": (b"a: \xff", "codec"),
    "digits": (f"samples: {'9' * 5000}", "4300 digits"),
    "defaults": ("defaults: 3", "defaults must be a list"),
    "own defaults": ("defaults: [/env: x]", "recursion"),
    "package": (f"# @package {'a.' * 2000}b\nx: 1", "recursion"),
}


@pytest.mark.parametrize("content, text", FILES.values(), ids=FILES)
def test_a_hostile_file_is_refused_in_one_sentence(content, text, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    os.makedirs("conf/env")
    with open("conf/env/x.yaml", "wb") as file:
        file.write(content if isinstance(content, bytes) else content.encode())
    began = time.process_time()
    assert train.main(["--config-dir", "conf", "env=x", "device=cpu"]) == 2
    assert time.process_time() - began < 2
    err = capsys.readouterr().err
    assert text in err and err.count("\n") == 2 and "Traceback" not in err and len(err) < 600
    assert os.listdir() == ["conf"]


@pytest.mark.parametrize("loader", [yaml.BaseLoader, config_files.LOADER])
def test_ordinary_files_pass(loader, monkeypatch, tmp_path):
    monkeypatch.setattr(config_files, "LOADER", loader)
    for path in package.CONFIGS.rglob("*.yaml"):
        config_files.check(str(path))
    path = tmp_path / "a.yaml"
    path.write_text("a: &a {b: [1, 2]}\nc: *a\nd: {<<: *a, e: !!str 3}\n")
    (tmp_path / "link.yaml").symlink_to(path)
    config_files.check(str(tmp_path / "link.yaml"))
