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
        with (progress := console.Progress()).bar:
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
