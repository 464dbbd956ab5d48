"""Progress on terminals of any kind."""

import fcntl
import os
import pty
import struct
import sys
import termios

import pytest

from megastep.agents import console


def shown(monkeypatch, kind):
    """Returns what progress shows on a terminal of one line and three columns."""
    screen, keyboard = pty.openpty()
    fcntl.ioctl(keyboard, termios.TIOCSWINSZ, struct.pack("HHHH", 1, 3, 0, 0))
    with os.fdopen(keyboard, "w", encoding="ascii") as stdout, monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", stdout)
        patch.delenv("COLUMNS", raising=False)
        patch.setenv("TERM", kind)
        with console.Progress() as progress:
            progress.show(0.5, ["582M samples", "5 s left"])
            progress.show(None, ["583M samples"])
        stdout.flush()
        text = os.read(screen, 100_000).decode()
    os.close(screen)
    return text


def test_dumb_terminal_gets_plain_lines(monkeypatch):
    text = shown(monkeypatch, "dumb")
    assert text == "582M samples  5 s left\r\n", "and the next line ten seconds later"


def test_tiny_terminal_gets_a_bar(monkeypatch):
    text = shown(monkeypatch, "xterm")
    assert "\x1b[" in text and text.isascii()


@pytest.mark.parametrize("cell", ["[csv,wandb]", "[red]", ":smile:"])
def test_table_shows_cells_as_they_are(cell):
    for is_markdown in (False, True):
        assert cell in console.table(["key"], [[cell]], is_markdown)


@pytest.mark.parametrize("width, n_columns", [(1000, 4), (40, 3), (30, 2), (20, 2)])
def test_a_table_fits_the_terminal(width, n_columns):
    head, rows = (
        ["agent", "return", "95 % interval", "length"],
        [["trained", "1.0", "0.5 to 1.5", "9"]],
    )
    text = console.table(head, rows, width=width)
    assert all((name in text.splitlines()[1]) == (i < n_columns) for i, name in enumerate(head))
    assert [name for name in head[n_columns:] if name not in text.splitlines()[-1]] == []
    assert max(map(len, text.splitlines()[:5])) <= width


def test_cells_of_a_narrow_terminal_are_broken():
    head, rows = ["runs", "IQM of episode/return", "x"], [["learner.lr=0.001, env.n_envs=64", "1"]]
    lines = console.table(head, [[*rows[0], "2"]], width=40).splitlines()
    assert max(map(len, lines[:-1])) <= 40 and lines[-1].endswith("in the file: x")
    assert "learner.lr=0.001," in "\n".join(lines), "no text is lost"
