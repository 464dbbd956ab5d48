"""Reports and comparisons of small runs: what the page says, and what is refused."""

import csv
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import pytest

from megastep.agents.cli import compare, evaluate, report, train
from megastep.agents.reports import report as page_of
from megastep.agents.reports import runs
from megastep.agents.reports.compare import write as write_plot
from megastep.agents.runs import json_lines
from tests.helpers import tiny

WORDS = [*tiny.TINY, *tiny.SHORT_EPISODES, "samples=800", "logging.every=2"]
CHROMIUM = shutil.which("chromium")


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A folder with a run of Explorer, evaluated in four homes, and three of Minimal."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(base := tmp_path_factory.mktemp("reports"))
        explorer = ["env=explorer", "env.n_envs=4", "env.res=4", "env.subsample=1", "agent.width=8"]
        explorer += ["env.patience=3", "learner.n_minibatches=1", "learner.n_steps=8"]
        homes = ["geometry=bench", "geometry.n=4"]
        assert train.main([*explorer, *homes, "samples=600", "folder=e", "device=cpu"]) == 0
        command = {"samples": 0, "command": "train.py env=explorer geometry.n=4"}
        (base / "e/provenance.jsonl").write_text(json.dumps(command) + "\n")  # not of this process
        assert evaluate.main(["run=e", "episodes=8", "split=all", "device=cpu"]) == 0
        for name, words in {"a": [], "b": ["seed=2"], "c": ["learner.lr=1e-4"]}.items():
            assert train.main([*WORDS, f"folder={name}", *words]) == 0
        return base


@pytest.fixture
def here(trained, monkeypatch):
    monkeypatch.chdir(trained)
    return trained


class Page(HTMLParser):
    """What a page shows: its headings, rows of tables and captions, and what it would load."""

    def __init__(self, path):
        super().__init__()
        self.open, self.heads, self.rows, self.captions, self.loads = [], [], [], [], []
        self.text = path.read_text()
        self.feed(self.text)
        (charts,) = re.findall(r'id="charts">(.*?)</script>', self.text, re.S)
        self.charts = json.loads(charts)

    def handle_starttag(self, tag, attributes):
        self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        self.loads += [value for name, value in attributes if name in ("src", "href")]

    def handle_data(self, data):
        tag = self.open[-1] if self.open else ""
        if tag in ("td", "th"):
            self.rows[-1].append(data)
        if tag in ("h1", "h2"):
            self.heads.append(data)
        if tag == "figcaption":
            self.captions.append(data)

    def handle_endtag(self, tag):
        while self.open and self.open.pop() != tag:
            pass


def test_report_of_a_run(here, capsys):
    assert report.main(["run=e"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "Report: e/report.html"
    page = Page(here / "e/report.html")
    assert len(page.text) < 5_000_000 and page.loads == []
    assert page.heads[0] == "e" and "Homes, worst first" in page.heads
    facts = {row[0]: row[1] for row in page.rows if len(row) == 2}
    assert "geometry.n=4" in facts["command"] and facts["geometry.n"] == "4"
    (table,) = (here / "e/evaluations").glob("*.json")
    table = json.loads(table.read_text())
    returns = [row[1] for row in page.rows if row and row[0] in ("trained", "random")]
    assert returns == [f"{row['return']:.2f}" for row in table["rows"]]
    _, by_home = page_of.score_by_home(table["episodes"])
    shown = [int(caption.partition(":")[0]) for caption in page.captions]
    assert shown == sorted(by_home, key=by_home.__getitem__) and len(shown) == 4
    titles = [chart["title"] for chart in page.charts]
    assert titles[0] == "episode/return" and "perf/rate" in titles
    rows = json_lines.read(here / "e/metrics.jsonl")
    (y,) = (chart["series"][0]["y"] for chart in page.charts if chart["title"] == "loss/entropy")
    assert y == pytest.approx([row["loss/entropy"] for row in rows], rel=1e-4)


def test_runs_that_differ_in_seeds_are_averaged(here):
    assert report.main(["run=[a,b,c]", "file=all.html"]) == 0
    page = Page(here / "all.html")
    (results,) = (page.rows[1:3],)
    assert [row[:2] for row in results] == [["learner.lr=0.003", "2"], ["learner.lr=0.0001", "1"]]
    assert ["learner.lr", "0.003", "0.0001"] in page.rows
    (chart,) = (chart for chart in page.charts if chart["title"] == "loss/entropy")
    lines = [series["y"][-1] for series in chart["series"] if not series["is_bound"]]
    last = [json_lines.read(here / name / "metrics.jsonl")[-1]["loss/entropy"] for name in "abc"]
    assert lines == pytest.approx([(last[0] + last[1]) / 2, last[2]], rel=1e-4)
    assert chart["bands"] == [[2, 3, 0], [5, 6, 1]]


def test_runs_of_a_population_are_called_by_their_numbers(here):
    one = runs.read(here / "a")
    members = [
        one._replace(
            folder=Path(f"P/member-{n}"),
            config={**one.config, "population": {"member": n}, "learner": {"lr": n}},
        )
        for n in (0, 1)
    ]
    assert [*runs.groups_of(members)] == ["member 0", "member 1"]


def test_folder_of_a_sweep_stands_for_its_jobs(here, tmp_path):
    for name in "ac":
        shutil.copytree(here / name, tmp_path / "sweep" / name)
    assert [path.name for path in runs.expanded([str(tmp_path / "sweep")])] == ["a", "c"]
    assert report.main([f"run={tmp_path / 'sweep'}"]) == 0
    assert Page(tmp_path / "sweep/report.html").heads[0] == "2 runs"


def test_comparison_is_a_plot_and_its_numbers(here, capsys):
    assert compare.main(["run=a,b,c", "metric=loss/entropy", "file=plot.svg"]) == 0
    assert "IQM of loss/entropy" in capsys.readouterr().out
    assert (here / "plot.svg").read_text().startswith("<?xml")
    with open(here / "plot.csv", newline="") as file:
        rows = [*csv.DictReader(file)]
    assert {row["runs"] for row in rows} == {"learner.lr=0.003", "learner.lr=0.0001"}
    first = [float(row["mean"]) for row in rows if row["runs"] == "learner.lr=0.0001"]
    values = [row["loss/entropy"] for row in json_lines.read(here / "c/metrics.jsonl")]
    assert (first[0], first[-1]) == pytest.approx((values[0], values[-1]))


def test_comparison_of_evaluations_with_words_of_ones_own(here):
    """Two runs, each evaluated once: points at their numbers of samples."""
    for name in "ac":
        assert evaluate.main([f"run={name}", "episodes=8", "device=cpu"]) == 0
    words = ["run=a,c", "metric=eval/length", "file=own.svg", "labels=[$_one_$,two]", "legend=none"]
    assert compare.main([*words, "title=Who lasts?", "xlabel=steps", "ylabel=length"]) == 0
    plot = (here / "own.svg").read_text()
    assert all(f"<!-- {text} -->" in plot for text in ("Who lasts?", "steps", "length"))
    assert "two (1)" not in plot, "no legend"
    with open(here / "own.csv", newline="") as file:
        first, *_, last = csv.DictReader(file)
    for row, name, run in (first, "$_one_$", "a"), (last, "two", "c"):
        (table,) = map(json.loads, (f.read_text() for f in (here / run).glob("evaluations/*.json")))
        point = float(row["samples"]), float(row["mean"])
        assert (row["runs"], *point) == (name, table["step"], table["rows"][0]["length"])
    assert compare.main(["run=a,c", "labels=[one]", "file=own.svg"]) == 2


def test_an_interrupted_seed_is_left_out_and_named(here, tmp_path, capsys):
    for name in "ab":
        shutil.copytree(here / name, tmp_path / f"${name}$_")
    path = tmp_path / "$b$_/metrics.jsonl"
    path.write_text(path.read_text().splitlines(keepends=True)[0].replace("entropy", "other"))
    samples = json_lines.read(path)[0]["samples"]
    names = [str(tmp_path / f"${name}$_") for name in "ab"]
    plot = write_plot([*map(Path, names)], tmp_path / "plot.svg", "loss/entropy")
    assert f"b$_ is left out: it was interrupted after {samples} samples" in capsys.readouterr().out
    with open(plot.with_suffix(".csv"), newline="") as file:
        rows = [*csv.DictReader(file)]
    assert float(rows[-1]["samples"]) >= 800 and rows[-1]["lower"] == rows[-1]["upper"] == ""
    assert "Oblique" not in plot.read_text()  # as in a formula


def test_page_of_a_resumed_run_names_the_command_that_made_it(here, tmp_path):
    run = shutil.copytree(here / "e", tmp_path / "e")
    row = {"samples": 512, "command": "train.py resume=e more_samples=88"}
    with open(run / "provenance.jsonl", "a") as file:
        file.write(json.dumps(row) + "\n")
    assert report.main([f"run={run}"]) == 0
    facts = {row[0]: row[1] for row in Page(run / "report.html").rows if len(row) == 2}
    assert facts["command"] == "train.py env=explorer geometry.n=4"
    assert facts["resumed"] == "1 times, last after 512 samples"
    assert facts["last command"] == row["command"]


@pytest.mark.parametrize(
    "main, words, sentence",
    [
        (report.main, ["file=x.html"], "run: is missing"),
        (report.main, ["run=a", "file=x.pdf"], "not a page; its name ends with .html"),
        (report.main, ["run=nowhere"], "is neither a run folder nor a pretrained agent"),
        (report.main, ["run=[]"], "run=[] names no run"),
        (compare.main, ["run=[]"], "run=[] names no run"),
        (report.main, ["run=a", "fiel=x.html"], "did you mean file?"),
        (report.main, ["run=a", "run=b"], "run: is given twice"),
        (report.main, ["run=a", "file=/proc/x/y.html"], "cannot be written"),
        (compare.main, ["run=a", "file=x.mp4"], "is not a plot; its name ends with"),
        (compare.main, ["run=[a,b]", "metric=loss/entropi"], "did you mean loss/entropy?"),
        (compare.main, ["run=a", "metric=x,y"], "metric: takes one value"),
    ],
)
def test_refused(here, main, words, sentence, capsys):
    before = {*here.rglob("*")}
    assert main(words) == 2
    assert sentence in capsys.readouterr().err
    assert {*here.rglob("*")} == before


def test_runs_that_share_no_metric(here, tmp_path, capsys):
    odd = shutil.copytree(here / "a", tmp_path / "odd")
    (odd / "perf.jsonl").unlink()
    shutil.rmtree(odd / "evaluations", ignore_errors=True)  # of other tests
    last = json.loads((odd / "metrics.jsonl").read_text().splitlines()[-1])
    row = dict(samples=last["samples"], x=1.0)  # an interrupted run would be left out
    (odd / "metrics.jsonl").write_text(json.dumps(row) + "\n")
    words = f"run=[{here / 'a'},{odd}]", f"file={tmp_path / 'plot.pdf'}"
    assert compare.main([*words]) == 2
    assert "share no metric, so they cannot be compared" in capsys.readouterr().err
    assert not [*tmp_path.glob("plot*")]


def test_training_can_end_with_a_report(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert train.main([*WORDS, "folder=r", "finish.report=true"]) == 0
    assert "Report: r/report.html" in capsys.readouterr().out
    assert Page(tmp_path / "r/report.html").heads[0] == "r"


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
@pytest.mark.parametrize("words", [["run=e"], ["run=[a,b,c]"]])
def test_a_browser_draws_every_chart(here, words):
    assert report.main([*words, "file=page.html"]) == 0
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=5000"]
    page = f"file://{here / 'page.html'}"
    result = subprocess.run([CHROMIUM, *flags, "--dump-dom", page], capture_output=True, text=True)
    n_charts = len(Page(here / "page.html").charts)
    assert n_charts > 5 and f'data-charts="{n_charts}"' in result.stdout
    assert result.stdout.count('class="uplot ') == n_charts
