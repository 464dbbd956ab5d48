"""Odd words on the command line, drawn with a seed: a command runs, or ends with exit code 2 and
sentences, and leaves nothing behind.
"""

import os
import random
import shutil

import pytest

from megastep.agents.cli import evaluate, record, train
from megastep.agents.factory.check import as_tree, leaves
from tests.helpers import tiny

pytestmark = pytest.mark.nightly
N = 150  # words of a command, each one run
#: Words that say what is odd, or have no place in a test: other devices, processes, hours of work.
LEFT_OUT = ("device", "ranks", "restarts", "logging.profile", "seconds")
KEYS = [
    *("env", "geometry", "agent", "learner", "curriculum", "logger", "opponents", "experiment"),
    *("env.kwargs", "env.id", "geometry.parts", "geometry.path", "agent.core", "learner.buffer"),
    *("run", "split", "episodes", "steps", "home", "file", "against", "greedy", "baseline"),
    *(
        "hydra.job.name",
        "hydra.nonsense",
        "hydra",
        "name",
        "",
        ".",
        "a.b.c",
        "+new",
        "~env",
        "++x.y",
    ),
    *("hydra/launcher", "hydra.searchpath", "defaults", "_target_", "env.name", "learner.name"),
]
VALUES = [
    *("", "null", "nan", "inf", "-inf", "-1", "0", "1", "2", "1.5", "1e400", "-0.0", "1e-400"),
    *("99999999999999999999", "true", "no", "[]", "{}", "[1,[2,[3]]]", "{0: 1}", "{a: {b: nan}}"),
    *("{null: 1}", "{1: 2, '1': 3}", "'a b'", '"', "'", "\\", "ü", "\x00", "\n", "\t"),
    *(5000 * "x", 300 * "/x", 60 * "[", 60 * "{a:", "a:b", "os:path", "os:getcwd", "json:loads"),
    *(
        "megastep.envs:Minimal",
        "..",
        "../..",
        "/",
        "/dev/null",
        "/proc/self/mem",
        "latest",
        "~",
        "-",
    ),
    *("${seed}", "${nothing}", "${oc.env:HOME}", "???", "%s", "{}{}", "a=b", "a=b=c", "1,2", "x,"),
    *("range(3)", "choice(1,2)", "interval(0,1)", "glob(*)", "!!python/name:os.system", "&a"),
    *(
        "minimal",
        "explorer",
        "ppo",
        "homes",
        "none",
        "cpu",
        "auto",
        "never",
        "samples",
        "1_0",
        "0x1",
    ),
]
FLAGS = [
    "--help",
    "--cfg",
    "--cfg=job",
    "-c",
    "--odd",
    "-",
    "--",
    "=",
    "==",
    "word",
    "a b",
    "--info",
]
TRAIN = [word for word in tiny.TINY if not word.startswith("logging.every")]


@pytest.fixture
def words():
    """Returns a function that draws the odd words of a command."""
    known = [key for key, _ in leaves(as_tree(tiny.settings(*tiny.TINY)))]
    keys = [key for key in (*known, *KEYS) if key not in LEFT_OUT]

    def draw(generator):
        for _ in range(generator.choice([1, 1, 1, 2, 3])):
            if generator.random() < 0.06:
                yield generator.choice(FLAGS)
            else:
                yield f"{generator.choice(keys)}={generator.choice(VALUES)}"

    return lambda generator: [*draw(generator)]


@pytest.mark.parametrize("script", [train, evaluate, record], ids=lambda module: module.__name__)
@pytest.mark.parametrize("seed", [1, 2])
def test_odd_words(script, seed, words, here, capsys):
    if script is not train:
        assert train.main([*TRAIN, "samples=32", "folder=run"]) == 0
    base = {
        train: [*TRAIN, "samples=32", "finish.episodes=2", "finish.steps=1", "folder=new/run"],
        evaluate: ["run=run", "episodes=2", "device=cpu"],
        record: ["run=run", "steps=1", "device=cpu", "file=new/a.png"],
    }[script]
    generator = random.Random(seed)
    for _ in range(N):
        odd, before = words(generator), listed()
        capsys.readouterr()
        try:
            code = script.main([*base, *odd])
        except SystemExit as end:  # argparse's
            code = end.code
        error = capsys.readouterr().err
        assert code in (0, 2) and "Traceback" not in error, (odd, code, error)
        assert code == 0 or error.strip(), odd
        assert code == 0 or not listed() - before, (odd, listed() - before)
        shutil.rmtree("new", ignore_errors=True)


def listed():
    """Returns the paths of all files here, but for the folder that holds all runs by default."""
    return {
        os.path.join(folder, name)
        for folder, names, files in os.walk(".")
        for name in (*names, *files)
        if os.path.join(folder, name) != "./runs"
    }
