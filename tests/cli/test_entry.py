"""The command `megastep`, also as `python -m megastep`."""

import runpy
import sys

import pytest

from megastep.agents import package
from megastep.agents.cli import entry


def test_python_m_megastep_lists_the_scripts(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["megastep"])
    with pytest.raises(SystemExit) as end:
        runpy.run_module("megastep", run_name="__main__", alter_sys=True)
    assert end.value.code == 0
    shown = capsys.readouterr().out
    assert all(f"python -m megastep {name}  " in shown for name in entry.COMMANDS)


def test_name_under_python_m(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["/somewhere/megastep/__main__.py", "train"])
    assert package.command("train") == "megastep train"
    assert package.command("train", "python ") == "python -m megastep train"


@pytest.mark.parametrize(
    "word, text", [("trian", "did you mean train?"), ("zzz", "there are check, compare")]
)
def test_words_that_are_no_script(monkeypatch, capsys, word, text):
    monkeypatch.setattr(sys, "argv", ["megastep", word])
    assert entry.main() == 2
    (sentence,) = capsys.readouterr().err.splitlines()
    assert text in sentence
