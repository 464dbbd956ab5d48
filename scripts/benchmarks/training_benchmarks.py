"""Benchmarks that train: `train`, `worlds`, `duels`, `ablation`, `learners`, `curricula`.

The titles of what is trained are part of the records' names, which join old and new measurements.
"""

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from timing import measurement
from training_runs import (
    evaluate,
    evaluate_all,
    learning_curve,
    metric_mean,
    newest_evaluation,
    rating,
    ratings,
    reports,
    share_of_duels_won,
    trained,
    training_rate,
)

BUDGETS = 6, 30  # seconds of training
SEEDS = 1, 2, 3
NO_FINISH = "finish.evaluate=false", "finish.record=false"
EXPLORER = "geometry=bench", "finish.evaluate=true"  # overrides of `train`

# ---- worlds: a recipe per environment ----

#: Overrides of an evaluation in several kinds of floor plans.
SUITE = "geometry=suite episodes=1024"
TRAINED_IN = {"homes": "geometry=homes", "mazes": "geometry=maze geometry.braid=0.3"}
AGENTS = {"Explorer": "env=explorer", "PointGoal, metres charged": "experiment=pointgoal"}
#: Title: (overrides of training, overrides of the evaluation). Those that take equally long are
#: neighbours, as several GPUs train several at a time.
RECIPES = {
    "Pong from features": ("experiment=pong", ""),
    "Pong, self-play": ("experiment=pong env.self_play=true seconds=25", "env=pong"),
    "Pong from pictures": ("experiment=pong_pixels", ""),
    "PointGoal, metres charged, continuous actions, trained in homes": (
        "experiment=pointgoal env.control=continuous seconds=60",
        SUITE,
    ),
    **{
        f"{name}, trained in {place}": (f"{overrides} {homes} geometry.n=2000 seconds=60", SUITE)
        for name, overrides in AGENTS.items()
        for place, homes in TRAINED_IN.items()
    },
}
#: The metric that learning curves show.
METRICS = {"Pong": "points_won", "Explorer": "coverage", "PointGoal": "spl"}

# ---- duels and ablation: Deathmatch ----

DEATHMATCH = "experiment=deathmatch", "seconds=null", *NO_FINISH
#: Title: overrides of the recipe.
ABLATIONS = {
    "the recipe": "",
    "hits less wounds alone": "env.aim_reward=0 env.search_reward=0",
    "aim not paid": "env.aim_reward=0",
    "searching not paid": "env.search_reward=0",
    "wounds at half the cost": "env.wound_cost=0.5",
    "self-play against now alone": "opponents.past=0 opponents.bot=0",
    "past selves, no bot": "opponents.past=0.8 opponents.bot=0",
    "a drain of 0.01 per second": "env.drain=0.01",
    "fov 130": "env.fov=130",
}
N_SNAPSHOTS = 5  # rated per run
N_DUELS = 1024  # of two policies; a quarter of that for each pair that is rated

# ---- learners: a comparison ----

ASYNC = "V-trace, an update behind"  # compared in Explorer only, with one seed
#: Title: overrides.
LEARNERS = {
    "PPO": "learner=ppo",
    "V-trace": "learner=vtrace",
    ASYNC: "learner=vtrace learner.lag=1",
    "V-trace with replay": (
        "learner=vtrace learner.buffer=replay learner.replay.capacity={capacity}"
    ),
    "R2D2": "learner=r2d2",
}
REPLAY_CAPACITY = {"cuda": 8_000_000, "cpu": 100_000}  # observations, of V-trace with replay
#: Environment: (overrides, metric that is compared, seconds of training).
COMPARED = {
    "Explorer": ("env=explorer geometry=bench", "return", 25),
    "Pong": ("env=pong agent.core=none learner.gamma=0.99", "points_won", 12),
    "PointGoal": ("env=pointgoal geometry=homes geometry.n=2000 learner.gamma=0.99", "spl", 30),
}

# ---- curricula: a comparison ----

CURRICULA = "none", "plr", "sfl"
CURRICULUM_RECIPE = "experiment=pointgoal_anywhere", "seconds=null", *NO_FINISH
EVALUATED_IN = "geometry=suite", "episodes=1024", "baseline=false"
LEARNABILITY = "env=pointgoal", "geometry.n=4096", "curriculum=sfl", "logging.every=4", *NO_FINISH
LEARNABILITY_SECONDS = 10
N_EPISODES = 10  # in each home: the standard error of a success rate is at most 0.16


def curve_metric(title: str) -> str:
    """Returns the metric that the learning curve of a recipe in RECIPES shows."""
    return METRICS[title.split(",")[0].split()[0]]


def train(
    device: torch.device, seeds: Sequence[int] = SEEDS, budgets: Sequence[int] = BUDGETS
) -> Iterator[dict]:
    """Training of Explorer in the benchmark's homes for 6 and 30 seconds after compilation, three
    seeds each, and an evaluation in unseen homes.
    """
    for budget, seed in itertools.product(budgets, seeds):
        what = f"training, {budget} s, seed {seed}"
        with trained(device, (*EXPLORER, f"seconds={budget}", f"seed={seed}")) as (run,):
            rows, curve = newest_evaluation(run), learning_curve(run)
        for agent, row in zip(("return", "return of random actions"), rows):
            yield metric_mean(f"{what}, {agent} in unseen homes", row, "return")
        if len(curve) > 1:
            yield training_rate(what, curve)


def worlds(device: torch.device, envs: Sequence[str] = tuple(COMPARED)) -> Iterator[dict]:
    """Each environment's recipe, one seed, each on a GPU of its own: metrics of first episodes, of
    the trained agent and of random actions; where there are homes, in each source of the suite.
    """
    chosen = {title: recipe for title, recipe in RECIPES.items() if title.startswith(tuple(envs))}
    titles, devices = [*chosen], _devices(device)
    for first in range(0, len(titles), len(devices)):
        batch = titles[first : first + len(devices)]
        runs = [
            (*chosen[title][0].split(), *NO_FINISH, f"device={one}")
            for title, one in zip(batch, devices)
        ]
        with trained(device, *runs) as folders:
            tables = evaluate_all(folders, devices, *(chosen[title][1].split() for title in batch))
            for title, folder, rows in zip(batch, folders, tables):
                curve = learning_curve(folder, curve_metric(title))
                seconds, samples, _ = curve[-1]
                yield training_rate(title, curve)
                what = f"{title}, {seconds:.0f} s, {samples / 1e6:.0f} M samples"
                for row in rows:
                    place = f", in {_part(row)}" if "source" in row else ""
                    for metric in ("return", *row["metrics"]):
                        name = f"{what}{place}: {metric}, {row['agent']}"
                        yield metric_mean(name, row, metric)


def duels(
    device: torch.device, seeds: Sequence[int] = SEEDS, samples: int = 600_000_000
) -> Iterator[dict]:
    """Deathmatch's recipe, all seeds side by side on one device: the share of duels that each wins
    in unseen homes, a draw being half, and ratings of its snapshots and of the scripted bot.
    """
    runs = [
        (*DEATHMATCH, f"samples={samples}", f"seed={seed}", f"checkpoints.snapshots={N_SNAPSHOTS}")
        for seed in seeds
    ]
    with trained(device, *runs) as folders:
        for seed, run in zip(seeds, folders):
            what = f"deathmatch, {samples / 1e6:.0f} M samples, seed {seed}"
            yield training_rate(what, learning_curve(run, "accuracy"))
            yield from duels_of(what, run, device)
            for row in ratings(run, device, N_DUELS // 4):
                yield rating(what, row)


def duels_of(what: str, run: Path, device: torch.device) -> Iterator[dict]:
    """Measures a run's duels against the scripted bot and against random actions."""
    for row in evaluate(run, device, "against=[bot,random]", f"episodes={N_DUELS}"):
        yield share_of_duels_won(what, row)


def ablation(device: torch.device, samples: int = 60_000_000) -> Iterator[dict]:
    """Deathmatch's recipe with one change each, all side by side on one device, one seed: the share
    of duels that each wins in unseen homes, a draw being half.
    """
    runs = [
        (*DEATHMATCH, f"samples={samples}", *overrides.split()) for overrides in ABLATIONS.values()
    ]
    with trained(device, *runs) as folders:
        for title, run in zip(ABLATIONS, folders):
            yield from duels_of(f"deathmatch, {samples / 1e6:.0f} M samples, {title}", run, device)


def learners(
    device: torch.device,
    seeds: Sequence[int] = SEEDS,
    budgets: Sequence[int] | None = None,
    envs: Sequence[str] = tuple(COMPARED),
) -> Iterator[dict]:
    """A comparison of learners that train for equally long, one at a time, with learning curves and
    an evaluation in unseen homes. Three seeds in Explorer; one in the other environments, and one
    for acting an update behind.
    """
    for env in envs:
        env_overrides, metric, default_budget = COMPARED[env]
        env_seeds = seeds if env == "Explorer" else seeds[:1]
        for seed, budget in itertools.product(env_seeds, budgets or [default_budget]):
            for title, overrides in LEARNERS.items():
                if title == ASYNC and (env != "Explorer" or seed != seeds[0]):
                    continue
                what = f"{env}, {title}, {budget} s, seed {seed}"
                overrides = overrides.format(capacity=REPLAY_CAPACITY[device.type])
                words = f"logging.every=10 {env_overrides} {overrides} seconds={budget} seed={seed}"
                with trained(device, (*words.split(), *NO_FINISH)) as (run,):
                    curve = learning_curve(run, metric)
                    row = evaluate(run, device)[0]
                if len(curve) > 1:
                    yield training_rate(what, curve)
                place = "in unseen homes" if row["homes"] else "in first episodes"
                yield metric_mean(f"{what}: {metric} {place}", row, metric)


def curricula(
    device: torch.device, seeds: Sequence[int] = SEEDS, samples: int = 1_000_000_000
) -> Iterator[dict]:
    """PointGoal in several kinds of floor plans, with each curriculum and equally many samples, all
    side by side on all GPUs: success and SPL in each source of the suite, in the worst and in the
    worst dense homes, a sample per seed. Then how soon 10 episodes have ended in each of 4,096
    homes, so that their learnability is known.
    """
    pairs = [(curriculum, seed) for curriculum in CURRICULA for seed in seeds]
    devices = [*itertools.islice(itertools.cycle(_devices(device)), len(pairs))]
    runs = [
        (*CURRICULUM_RECIPE, f"curriculum={name}", f"seed={seed}", f"samples={samples}", word)
        for (name, seed), word in zip(pairs, [f"device={one}" for one in devices])
    ]
    found = {}
    with trained(device, *runs) as folders:
        tables = evaluate_all(folders, devices, *[EVALUATED_IN] * len(runs))
        for (name, _), rows in zip(pairs, tables):
            for row, metric in itertools.product(rows, ("success", "spl")):
                key = f"{name}, {_part(row)}: {metric}"
                found.setdefault(key, []).append(row["metrics"][metric]["mean"])
    for key, values in found.items():
        yield measurement(f"pointgoal, {samples / 1e6:.0f} M samples, curriculum {key}", "", values)
    with trained(device, (*LEARNABILITY, f"seconds={LEARNABILITY_SECONDS}")) as (run,):
        known = [
            row["perf/seconds"]
            for row in reports(run)
            if row.get("curriculum/fewest_episodes", 0) >= N_EPISODES
        ]
    if known:
        what = f"seconds of training until {N_EPISODES} episodes have ended in each of 4,096 homes"
        yield measurement(what, "s", known[:1])


def _devices(device):
    """Returns all GPUs, or the CPU."""
    if device.type == "cpu":
        return [device]
    return [torch.device("cuda", i) for i in range(torch.cuda.device_count())]


def _part(row):
    if row.get("is_worst"):
        return "worst source"
    return f"{row['source']}, worst 5 % of homes" if "tail" in row else row["source"]
