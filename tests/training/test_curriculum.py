"""Curricula: scores by hand, draws that follow them, and what a run logs and keeps of them."""

import numpy as np
import pytest
import torch

from megastep import envs, spaces
from megastep.agents.cli import train
from megastep.agents.runs import json_lines
from megastep.agents.storage.rollout import Rollout
from megastep.agents.training.curriculum import SFL
from megastep.arrdict import arrdict
from megastep.geometries import sample
from tests.helpers.synchronisation import no_synchronisation

SMALL = [
    *("device=cpu", "env.n_envs=4", "env.res=8", "agent.width=8", "learner.n_steps=8"),
    *("learner.n_minibatches=2", "logging.every=1"),
]
BENCH = ["geometry=bench", "geometry.n=4", "samples=64"]
MIX = ["geometry=mixed", "geometry.parts={bench: 2, maze: 2}", "samples=640"]
POINTGOAL = ["env=pointgoal", "env.limit=5"]


class Homes:
    """Stands for an environment of D homes."""

    def __init__(self, n, device="cpu"):
        self.layout = torch.zeros(4, dtype=torch.int32, device=device)
        self.cumulative = torch.arange(1, n + 1, dtype=torch.int32, device=device)

    def weigh_layouts(self):
        return self.cumulative


def empty_rollout(n_steps, n_lanes, device="cpu", metrics=("success",)):
    space, action_space = spaces.MultiVector(1, 1), spaces.MultiDiscrete(1, 2)
    rollout = Rollout(n_steps, n_lanes, space, action_space, arrdict(), device)
    rollout.metrics = arrdict({name: torch.zeros_like(rollout.reward) for name in metrics})
    return rollout


def play(curriculum, rollout, homes, outcomes, name="success"):
    """One step in which each lane ends an episode."""
    rollout.terminal.fill_(True)
    rollout.layouts.copy_(torch.as_tensor(homes)[None])
    rollout.metrics[name].copy_(torch.as_tensor(outcomes)[None])
    curriculum.update(rollout)


def drawn(curriculum):
    """Returns the probability of each home in the environment's table."""
    weights = np.diff(curriculum.cumulative.cpu().numpy().astype(float), prepend=0)
    return weights / weights.sum()


def random_rollout(rollout, seed):
    """Fills a rollout with random numbers and episodes of a few steps."""
    random = torch.Generator().manual_seed(seed)
    shape = rollout.reward.shape

    def numbers(*shape):
        return torch.rand(*shape, generator=random)

    ends, kind = numbers(*shape) < 0.3, numbers(*shape) < 0.5
    rollout.terminal.copy_(ends & kind)
    rollout.truncated.copy_(ends & ~kind)
    rollout.values.copy_(numbers(*rollout.values.shape))
    rollout.reward.copy_(numbers(*shape))
    rollout.metrics.success.copy_((numbers(*shape) < 0.5).float())
    rollout.learns.copy_(numbers(*rollout.learns.shape) < 0.9)
    rollout.layouts.copy_((5 * numbers(*shape)).int())
    # an episode starts in the row after its predecessor's last
    rollout.starts.zero_()
    rollout.starts[2:] = ends[:-1].to(rollout.starts.device)


# ---- Sampling for learnability ----


def test_homes_solved_half_of_the_time_are_drawn_most():
    """Home 0 is always solved, home 1 never, home 2 every second time, home 3 nine times in ten."""
    rollout = empty_rollout(1, 4)
    sfl = SFL(Homes(4), None, rollout, uniform=0.2, lr=0.01)
    assert drawn(sfl).tolist() == 4 * [0.25]
    for n in range(1000):
        play(sfl, rollout, [0, 1, 2, 3], [1.0, 0.0, n % 2, n % 10 > 0])
    assert sfl.means.tolist() == pytest.approx([1, 0, 0.5, 0.9], abs=0.04)
    scores = np.array([0, 0, 0.25, 0.09])
    assert sfl.scores.tolist() == pytest.approx(scores.tolist(), abs=0.03)
    assert drawn(sfl) == pytest.approx(0.05 + 0.8 * scores / scores.sum(), abs=0.05)
    assert drawn(sfl)[:2] == pytest.approx([0.05, 0.05], abs=1e-6)


def test_learnability_of_a_coverage_is_its_variance():
    """Home 0 is always covered to 0.8; home 1 wholly in 80 % of its episodes, else not at all."""
    rollout = empty_rollout(1, 2, metrics=["coverage"])
    sfl = SFL(Homes(2), None, rollout, uniform=0.0, lr=0.01)
    for n in range(1000):
        play(sfl, rollout, [0, 1], [0.8, float(n % 5 > 0)], "coverage")
    assert sfl.scores.tolist() == pytest.approx([0, 0.16], abs=0.02)
    assert drawn(sfl) == pytest.approx([0, 1], abs=1e-3)


def test_running_means_by_hand():
    """The first outcomes are their mean; n later ones weigh 1 - (1 - lr)^n together."""
    rollout = empty_rollout(1, 3)
    sfl = SFL(Homes(2), None, rollout, lr=0.5)
    play(sfl, rollout, [0, 0, 0], [1.0, 0.0, 0.0])
    assert sfl.means.tolist() == pytest.approx([1 / 3, 0]) and sfl.scores[1] == 0.25
    play(sfl, rollout, [0, 0, 1], [1.0, 1.0, 1.0])
    assert sfl.means.tolist() == pytest.approx([1 / 3 + 0.75 * 2 / 3, 1])
    assert sfl.n_episodes.tolist() == [5, 1]


def test_duels_count_as_decided_by_kills_or_deaths():
    rollout = empty_rollout(1, 3, metrics=["kills", "deaths"])
    sfl = SFL(Homes(3), None, rollout)
    rollout.metrics.deaths[0, 0] = 1.0
    play(sfl, rollout, [0, 1, 2], [0.0, 2.0, 0.0], "kills")
    assert sfl.means.tolist() == [1, 1, 0]


def test_lanes_that_do_not_learn_and_outcomes_of_nan_count_for_nothing():
    rollout = empty_rollout(1, 2)
    sfl = SFL(Homes(2), None, rollout)
    rollout.learns[0, 1] = False
    play(sfl, rollout, [0, 1], [torch.nan, 1.0])
    assert sfl.n_episodes.tolist() == [1, 0] and sfl.means.tolist() == [0, 0]


def test_probabilities_change_every_so_many_updates():
    rollout = empty_rollout(1, 2)
    sfl = SFL(Homes(2), None, rollout, every=2)
    play(sfl, rollout, [0, 0], [1.0, 1.0])
    assert drawn(sfl).tolist() == [0.5, 0.5]
    play(sfl, rollout, [0, 0], [1.0, 1.0])
    assert drawn(sfl) == pytest.approx([0.25, 0.75])


# ---- On both devices ----


def scored(device):
    rollout = empty_rollout(6, 8, device)
    curriculum = SFL(Homes(5, device), None, rollout)
    for seed in range(5):
        random_rollout(rollout, seed)
        curriculum.update(rollout)
    return {k: torch.as_tensor(v).cpu() for k, v in curriculum.state_dict().items()}


@pytest.mark.cuda
def test_cpu_and_gpu_agree_and_a_gpu_repeats_its_bits():
    once, again, on_cpu = scored("cuda"), scored("cuda"), scored("cpu")
    for name, value in once.items():
        assert torch.equal(value, again[name]), name
        torch.testing.assert_close(value.double(), on_cpu[name].double(), rtol=1e-4, atol=8)
    assert torch.equal(once["n_episodes"], on_cpu["n_episodes"])


@pytest.mark.cuda
def test_an_update_does_not_synchronise():
    rollout = empty_rollout(6, 8, "cuda")
    curriculum = SFL(Homes(5, "cuda"), None, rollout)
    curriculum.update(rollout)
    torch.cuda.synchronize()
    with no_synchronisation():
        curriculum.update(rollout)


# ---- In environments ----


@pytest.mark.parametrize("name", ["Explorer", "PointGoal", "Deathmatch"])
def test_episodes_begin_in_the_homes_that_are_drawn(name, device):
    homes = sample("bench", 3)
    settings = dict(limit=4) if name != "Explorer" else dict(patience=1)
    env = getattr(envs, name)(6, homes, device=device, res=16, resample=True, **settings)
    cumulative = env.weigh_layouts()
    assert cumulative.tolist() == [1, 2, 3] and env.layout.tolist() == [0, 1, 2, 0, 1, 2]
    cumulative.copy_(torch.tensor([0, 7, 7]))
    world = env.reset()
    n_lanes = len(world.reset)
    assert env.layout.tolist() == 6 * [1]
    cumulative.copy_(torch.tensor([0, 0, 7]))
    still = arrdict(actions=torch.zeros(n_lanes, 1, dtype=torch.int64, device=device))
    while not (world.terminal | world.truncated).any():
        world = env.step(still)
    env.step(still)
    env.check()
    assert 2 in env.layout.tolist()


# ---- Runs ----


def test_run_logs_outcomes_by_source(here):
    words = "geometry=mixed", "geometry.parts={bench: 3, maze: 1}", "curriculum=sfl", "samples=320"
    assert train.main([*SMALL, *POINTGOAL, *words, "folder=run"]) == 0
    row = json_lines.read("run/metrics.jsonl")[-1]
    shares = [row[f"curriculum/drawn/{source}"] for source in ("bench", "maze")]
    assert sum(shares) == pytest.approx(1) and row["curriculum/fewest_episodes"] >= 1
    assert row["curriculum/unseen"] == 0 and 1 <= row["curriculum/effective_homes"] <= 4.001
    assert 0 <= row["curriculum/worst"] <= row["curriculum/outcome"] <= 1


@pytest.mark.parametrize(
    "words",
    [
        [*POINTGOAL, "learner=vtrace", "env.resample=false", "env.n_envs=2"],
        ["env=deathmatch", "env.n_agents=2", "env.limit=5", "opponents.bot=0.5"],
    ],
    ids=["fewer environments than homes", "opponents"],
)
def test_run_in_a_mix_logs_episodes_by_source(words, here):
    """Also without a curriculum. Every episode is one of its source's."""
    assert train.main([*SMALL, *MIX, *words, "logging.every=4", "desync=false", "folder=run"]) == 0
    row = json_lines.read("run/metrics.jsonl")[-1]
    names = [f"episode/{{}}/{source}" for source in ("bench", "maze")]
    counts = [row[name.format("count")] for name in names]
    assert sum(counts) == row["episode/count"] and min(counts) > 0
    metric = "success" if "env=pointgoal" in words else "kills"
    for key in ("return", "length", metric):
        windows = [row[name.format("window")] for name in names]
        mean = np.average([row[name.format(key)] for name in names], weights=windows)
        if sum(windows) == row["episode/window"]:
            assert mean == pytest.approx(row[f"episode/{key}"])


def test_statistics_by_source_are_exact_under_resume(here):
    words = [*SMALL, *POINTGOAL, *MIX, "logging.every=3", "learner.anneal=never"]
    assert train.main([*words, "folder=whole"]) == 0
    assert train.main([*words, "samples=256", "folder=cut"]) == 0
    assert train.main(["resume=cut", "samples=640"]) == 0
    whole, cut = (json_lines.read(f"{name}/metrics.jsonl") for name in ("whole", "cut"))
    assert cut == whole and "episode/spl/maze" in cut[-1]


def test_without_a_curriculum_nothing_is_stored_or_logged(here, trainers):
    assert train.main([*SMALL, *BENCH, *POINTGOAL, "logging.every=2", "folder=run"]) == 0
    (made,) = trainers
    assert made.rollout.layouts is None and made.env.spawner.cumulative is None
    (row,) = json_lines.read("run/metrics.jsonl")
    assert not [key for key in row if key.startswith("curriculum")]


@pytest.mark.parametrize(
    "words, text",
    [
        (["env=pong"], "env=pong draws no home for each episode; use curriculum=none"),
        (["env=pointgoal", "env.resample=false"], "use env.resample=true"),
        (["env=pointgoal", "geometry=box"], "there is one home only"),
        (["env=explorer", "env.metrics=false"], "none of the metrics that tell the outcome"),
        (["env=tests.cli.test_exact_resume:Steered"], "Steered has no homes to draw"),
    ],
    ids=lambda value: value if isinstance(value, str) else None,
)
def test_bad_input_is_one_sentence(here, capsys, words, text):
    small = [word for word in SMALL if not word.startswith("env.res")]
    has_homes = not {"geometry=box", "env=tests.cli.test_exact_resume:Steered"} & {*words}
    homes = BENCH if has_homes else []
    chosen = [] if any(word.startswith("curriculum=") for word in words) else ["curriculum=sfl"]
    assert train.main([*small, *homes, *words, *chosen, "folder=run"]) == 2
    error = capsys.readouterr().err
    assert text in error and "Traceback" not in error
    assert not (here / "run").exists()
