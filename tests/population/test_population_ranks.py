"""Populations whose members are spread over ranks, two processes on CPUs."""

import signal
import time
from pathlib import Path

import pytest

from megastep.agents.runs import checkpoint, json_lines, populations
from tests.helpers import ranks, tiny
from tests.helpers.processes import HUNG, ROOT, finished, start
from tests.population.test_population_runs import LONG, POPULATION, VARY, assert_equal

pytestmark = pytest.mark.usefixtures("here")
#: Three members: two of the first rank, one of the second.
WORDS = [*POPULATION, LONG, "device=cpu"]


@pytest.fixture(scope="module")
def left_alone(tmp_path_factory):
    """The folder of the population in one process."""
    folder = tmp_path_factory.mktemp("alone") / "P"
    ranks.train(*WORDS, f"folder={folder}", n_ranks=1)
    return folder


def crossings(root):
    """Returns how many copies went from one rank to the other."""
    rows = [row for rows in populations.read(root / populations.FILE) for row in rows]
    return sum(row["from"] % 2 != row["member"] % 2 for row in rows)


@pytest.mark.slow
def test_two_ranks_equal_one_process(here, left_alone):
    assert crossings(left_alone) >= 3
    first, second = ranks.train(*WORDS)
    assert "Training 3 members on 2 x cpu" in first.stdout
    assert not second.stdout and not first.stderr + second.stderr
    assert_equal(here / "P", left_alone)


def killed_once_saved(words, victims, n_saved=3):
    """Starts two ranks, kills some of them as soon as the last member has saved so often, and waits
    for the others. Returns the exit codes.
    """
    with ranks.started([ROOT / "train.py", *words]) as processes:
        folder, deadline = Path("P/member-2/checkpoints"), time.monotonic() + ranks.HUNG
        while not checkpoint.list_checkpoints(folder)[n_saved - 1 :]:
            assert time.monotonic() < deadline and not any(one.poll() for one in processes)
            time.sleep(0.005)
        for victim in victims:
            processes[victim].send_signal(signal.SIGKILL)
        return [one.returncode for one in ranks.finished(processes)]


@pytest.mark.parametrize(
    "victims",
    [pytest.param([1], marks=pytest.mark.slow), pytest.param([0], marks=pytest.mark.nightly)],
    ids=str,
)
def test_a_population_whose_rank_was_killed_has_the_same_bits(here, left_alone, victims):
    """Resumed by two ranks; killed again, by both at once, and resumed in one process."""
    codes = killed_once_saved([*WORDS, "checkpoints.seconds=1e-9", "checkpoints.keep=20"], victims)
    assert codes[victims[0]] == -signal.SIGKILL and codes[1 - victims[0]] > 0
    n_saved = len(checkpoint.list_checkpoints(here / "P/member-2/checkpoints"))
    assert killed_once_saved(["resume=P"], [0, 1], n_saved + 3) == 2 * [-signal.SIGKILL]
    ranks.train("resume=P", n_ranks=1)
    assert_equal(here / "P", left_alone)


@pytest.mark.nightly
def test_ctrl_c_saves_the_members_of_all_ranks(here, left_alone):
    process = start("train", *WORDS, "ranks=2", "checkpoints.seconds=1e-9", OMP_NUM_THREADS="1")
    while not checkpoint.list_checkpoints(here / "P/member-2/checkpoints"):
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=HUNG)
    assert process.returncode == 130 and err.count("Stopped after") == 1, (out, err)
    assert "resume=P" in err
    code, out, err = finished("train", "resume=P", OMP_NUM_THREADS="1")
    assert code == 0 and "on 2 x cpu" in out and not err, err
    assert_equal(here / "P", left_alone)


@pytest.mark.slow
def test_a_member_that_diverges_on_another_rank_is_replaced(here):
    """Rank 1 hosts members 1 and 3."""
    words = [*POPULATION[:-2], "population.vary={learner.lr: {choices: [1e-3, 1e6]}}", "seed=3"]
    words += ["population.size=4", "folder=P", "samples=10240", "population.every=4096"]
    first, second = ranks.train(*words, "device=cpu")
    generations = populations.read(here / "P" / populations.FILE)
    diverged = [row for rows in generations for row in rows if row.get("diverged")]
    assert {(row["member"], row["from"]) for row in diverged} >= {(1, 0), (3, 0)}
    assert "diverged" in first.stdout and "rank 1 on" in second.stderr


@pytest.mark.nightly
def test_a_league_over_ranks_equals_one_in_one_process(here):
    small = [word for word in tiny.TINY if not word.startswith(("env", "geometry"))]
    words = [*small, "env=pong", "env.self_play=true", "env.points=1", "env.n_envs=8"]
    words += ["opponents.league=0.5", "opponents.past=0.25", "opponents.snapshots=2"]
    words += ["opponents.every=3", "population.size=3", "population.every=240", "logger=none"]
    words += [VARY, "samples=480"]
    for n_ranks in (1, 2):
        ranks.train(*words, f"folder=of-{n_ranks}", n_ranks=n_ranks)
    assert_equal(here / "of-2", here / "of-1")
    won = [json_lines.read(here / f"of-2/member-{n}/metrics.jsonl")[-1] for n in range(3)]
    assert any("episode/return/league" in row for row in won)
