"""The logger of docs/loggers.md: it is trained with, resumed, and dropped when it fails."""

import sqlite3

from megastep.agents.cli import train
from megastep.agents.runs import json_lines
from tests.helpers import pages, tiny

PAGE = (pages.ROOT / "docs" / "loggers.md").read_text()
PATH = "logger=my_sqlite:SQLite"


def write_file(folder):
    assert "This is `my_sqlite.py`" in PAGE
    (folder / "my_sqlite.py").write_text(pages.code(PAGE)[0])


def test_commands_of_page_log_to_the_database(tmp_path, monkeypatch):
    write_file(tmp_path)
    section = PAGE.partition("## Writing a logger")[2]
    assert pages.type_all(section, tmp_path, monkeypatch) == ["train.py", "train.py"]
    (run,) = (path for path in tmp_path.glob("runs/*") if path.is_dir())
    rows = json_lines.read(run / "metrics.jsonl")
    query = "SELECT run, samples, value FROM metrics WHERE name='updates' ORDER BY samples"
    logged = sqlite3.connect(tmp_path / "all.db").execute(query).fetchall()
    assert logged == [(run.name, row["samples"], row["updates"]) for row in rows]
    assert rows and (run / "tensorboard").is_dir()


def test_logger_that_cannot_start_is_one_warning(tmp_path, monkeypatch, capsys):
    write_file(tmp_path)
    words = [PATH, "logger.sqlite.file=no/folder.db", "samples=64", "folder=run"]
    with pages.inside(tmp_path, monkeypatch):
        assert train.main([*tiny.TINY, *words]) == 0
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and "logger=sqlite skipped: unable to open database file" in err
    assert json_lines.read(tmp_path / "run/metrics.jsonl") and not (tmp_path / "all.db").exists()
