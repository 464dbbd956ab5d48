"""Runs of two ranks: equal weights, exact resume, another number of ranks, an evaluation."""

import json
import os
import re
import signal
import time

import pytest
import torch

from megastep.agents.cli import train
from megastep.agents.distributed import process_group
from megastep.agents.launch import run as launch_run
from megastep.agents.runs import checkpoint, json_lines
from megastep.agents.training import budget
from tests.cli.test_exact_resume import CASES, EVERY_UPDATE, differences
from tests.helpers import ranks, tiny

pytestmark = pytest.mark.slow
LEARNERS = "ppo", "vtrace", "r2d2", "opponents"
NO_FINISH = "finish.evaluate=false", "finish.record=false"
PPO = [*tiny.TINY, *tiny.SHORT_EPISODES]


def trained(*words):
    """Trains in this rank. Returns what it learnt, and a copy of its state."""
    trainers, make_trainer = [], launch_run.make_trainer

    def remember(*arguments, **options):
        trainers.append(make_trainer(*arguments, **options))
        return trainers[-1]

    launch_run.make_trainer = remember
    try:
        assert train.main([*words]) == 0
    finally:
        launch_run.make_trainer = make_trainer
    (trainer,) = trainers
    state = trainer.run_state.state_dict()
    return dict(
        policy=state["policy"],
        optimizer=state["learner"]["optimizer"],
        actions=trainer.rollout.actions,
        generators=[state["learner"][name] for name in ("generator", "policy_generator")],
        n=(trainer.samples, trainer.updates, trainer.episodes.stats.windows),
        parts=trainer.saver.rank,
    )


def run_and_resume():
    """Trains each learner, resumes it after a checkpoint in the middle, and returns by name what it
    learnt, and what differs when it was resumed.
    """
    results = {}
    for name in LEARNERS:
        words = [*CASES[name], "samples=512", "logging.every=2", f"folder={name}"]
        learnt = trained(*words, *EVERY_UPDATE)
        folder = f"{name}/checkpoints"
        alone = whole(checkpoint.list_checkpoints(folder)[-1])
        metrics = open(f"{name}/metrics.jsonl", "rb").read()
        paths = process_group.gather_objects(checkpoint.list_checkpoints(folder))[0]
        trained(f"resume={paths[len(paths) // 2]}")
        again = whole(checkpoint.list_checkpoints(folder)[-1])
        is_same = open(f"{name}/metrics.jsonl", "rb").read() == metrics
        results[name] = learnt, len(paths), differences(alone, again), is_same
        process_group.exchange([0])  # before either goes on
    return results


def whole(path):
    """Returns the state of both ranks in a checkpoint, without the seconds."""
    states = {str(rank): checkpoint.load_latest(path, rank=rank).state for rank in range(2)}
    return {rank: state | {"seconds": 0} for rank, state in states.items()}


@pytest.fixture(scope="module")
def here(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        yield folder


def test_ranks_learn_the_same_from_different_samples_and_resume_with_the_same_bits(here):
    on_ranks = ranks.call(run_and_resume)
    for name in LEARNERS:
        (first, *_), (second, *_) = (results[name] for results in on_ranks)
        assert differences(first["policy"], second["policy"]) == [], name
        assert differences(first["optimizer"], second["optimizer"]) == [], name
        assert first["n"] == second["n"] and first["n"][0] >= 512, name
        assert differences(first["generators"], second["generators"]), name
        assert differences(first["actions"], second["actions"]), name
        for _, n_checkpoints, differing, has_same_metrics in (
            results[name] for results in on_ranks
        ):
            assert differing == [] and has_same_metrics and n_checkpoints >= 4, name


@pytest.fixture(scope="module")
def alone(here):
    """A run of two ranks in processes of their own, with its output."""
    words = *PPO, "samples=1280", "logging.every=2", "folder=alone", "checkpoints.snapshots=2"
    finish = "finish.evaluate=true", "finish.episodes=9", "finish.record=true", "finish.steps=2"
    return ranks.train(*words, *finish)


def test_rank_0_writes_and_speaks(alone, here):
    first, second = alone
    assert not (second.stdout + second.stderr + first.stderr).strip()
    assert re.search("trained .* 9 ", first.stdout)
    samples = [row["samples"] for row in json_lines.read("alone/metrics.jsonl")]
    assert samples == [*range(128, 1281, 128)]  # of both ranks
    assert len(budget.read_record("alone")) == 20
    (row,) = json_lines.read("alone/provenance.jsonl")
    assert row["ranks"] == 2 and row["hosts"]
    assert len(checkpoint.list_checkpoints("alone/snapshots")) == 2
    assert (here / "alone/video.mp4").exists()
    left = {path.name for path in (here / "alone/checkpoints").iterdir()}
    assert left == {"step_1280"}
    (table,) = (here / "alone/evaluations").glob("*.json")
    assert [row["lanes"] for row in json.loads(table.read_text())["rows"]] == [9, 9]


def test_killed_ranks_go_on_bit_for_bit(alone, here):
    words = *PPO, "samples=1280", "logging.every=2", "folder=killed", *EVERY_UPDATE
    with ranks.started([ranks.ROOT / "train.py", *words]) as processes:
        deadline = time.monotonic() + ranks.HUNG
        while not checkpoint.list_checkpoints("killed/checkpoints"):
            assert time.monotonic() < deadline
            time.sleep(0.01)
        for process in processes:
            os.kill(process.pid, signal.SIGKILL)
    assert not (here / "killed/checkpoints/step_1280").exists()
    resumed, _ = ranks.train("resume=killed")
    assert "bit for bit" not in resumed.stdout
    for name in "metrics.jsonl", "annealing.f64":
        assert (here / "killed" / name).read_bytes() == (here / "alone" / name).read_bytes()
    paths = (f"{name}/checkpoints/step_1280" for name in ("killed", "alone"))
    assert differences(*map(whole, paths)) == []
    assert not [*(here / "killed/checkpoints").glob(".rank*")]


def test_another_number_of_ranks_goes_on(alone, here, capsys):
    assert train.main(["resume=alone", "samples=1408", "ranks=1", *NO_FINISH]) == 0
    line = "Resuming, but not bit for bit: ranks was 2 and is 1."
    assert line in capsys.readouterr().out
    assert not (here / "alone/checkpoints/step_1408/rank1.pt").exists()
    first, _ = ranks.train("resume=alone", "samples=1536", *NO_FINISH)
    assert "ranks was 1 and is 2; added ranks start new episodes." in first.stdout
    assert checkpoint.load_latest("alone/checkpoints/step_1536").n_ranks == 2
    states = whole(checkpoint.list_checkpoints("alone/checkpoints")[-1])
    generators = [state["learner"]["policy_generator"] for state in states.values()]
    assert not torch.equal(*(generator["generator"] for generator in generators))


def test_ranks_share_duels_and_evaluations(here):
    """Together they play what one process plays: as often in each home and from each slot."""
    words = ["env=tests.helpers.games:Matrix", "env.n_agents=2", "env.n_envs=4", "geometry=homes"]
    words += ["geometry.n=7", "samples=1", "folder=games", "agent.width=8"]
    device = "device=cpu"
    assert train.main([*words, device, *NO_FINISH, "learner.n_minibatches=2"]) == 0
    counts, script = [], ranks.ROOT / "evaluate.py"
    for n_ranks in 1, 2:
        for against in (), ("against=tests.helpers.games:High",):
            results = ranks.run(
                [script, "run=games", "episodes=41", device, *against], n_ranks=n_ranks
            )
            assert not any(one.returncode for one in results), [one.stderr for one in results]
            assert not any(one.stdout for one in results[1:])
        tables = sorted((here / "games/evaluations").glob("*.json"))
        rows = [json.loads(path.read_text())["rows"][0] for path in tables]
        names = "lanes", "duels", "homes", "unfinished"
        counts.append([[row.get(name) for name in names] for row in rows])
    assert counts[0] == counts[1] and len(counts[0]) == 2
