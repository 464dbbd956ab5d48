"""Drives a robot through the same episodes in several simulators, and compares.

    python train.py experiment=robot folder=robot
    megastep export run=robot format=onnx file=robot.onnx
    python episodes.py homes homes.npz
    python transfer.py homes.npz --policy robot.onnx --simulators megastep irsim mujoco
    python transfer.py homes.npz --policy robot.onnx --controllers random scripted planner
    python transfer.py homes.npz --table

Needs onnxruntime, and `ir-sim` or `mujoco` for these simulators. Outcomes are added to HOMES.jsonl;
what is in there already is left out. `means` is the policy that takes the means of its actions;
--label names another one than `trained`.
"""

import argparse
import collections
import importlib
import json
import sys
import time
from pathlib import Path

import controllers
import numpy as np
from episodes import read, to_robot
from robot_policy import RobotPolicy

#: Simulators: module, class, what to install.
SIMULATORS = {
    "megastep": ("in_megastep", "InMegastep", "megastep-flatland"),
    "irsim": ("in_irsim", "InIrsim", "ir-sim"),
    "mujoco": ("in_mujoco", "InMujoco", "mujoco"),
}


def simulator(name, about):
    """Returns a simulator by name. SystemExit names what is not installed."""
    module, kind, package = SIMULATORS[name]
    try:
        found = importlib.import_module(module)
    except ImportError as error:
        fail(f"{name} is not installed ({error.name} is missing): pip install {package}")
    return getattr(found, kind)(about["robot"], about["steps_per_second"])


def controller(name, policy):
    """Returns what drives, by name."""
    robot = policy.about["robot"]
    if name in ("trained", "means"):
        return controllers.Trained(policy, draws=name == "trained")
    if name == "planner":
        from in_irsim import plan

        return controllers.FollowPath(robot, lambda episode: plan(episode, robot["radius"]))
    return {"random": controllers.Random, "scripted": controllers.Scripted}[name](robot)


def play(world, driver, episode, about, keep=None):
    """Plays one episode, to the reach and within the limit of a description. Returns {metric:
    number}; seconds are those to the goal, or of all steps.
    ``keep(world, pose, ranges)`` is called before each step.
    """
    world.begin(episode)
    driver.begin(episode)
    walked, collisions, thought, step, pose = 0.0, 0, 0.0, 0, world.pose()
    while step < about["limit"]:
        step += 1
        ranges = world.sense()
        if keep is not None:
            keep(world, pose, ranges)
        start = time.perf_counter()
        command = driver.act(ranges, world.twist(), pose, to_robot(pose, episode.goal))
        thought += time.perf_counter() - start
        collisions += world.drive(command)
        before, pose = pose, world.pose()
        walked += float(np.hypot(*(pose - before)[:2]))
        success = float(np.hypot(*(pose[:2] - episode.goal))) <= about["reach"]
        if success:
            break
    return dict(
        success=float(success),
        spl=success * episode.shortest / max(episode.shortest, walked, 1e-6),
        collisions=int(collisions),
        seconds=step / about["steps_per_second"],
        ms=1000 * thought / step,
    )


# ---- Tables ----


def interval(values, homes, n=2000, seed=1):
    """Returns (mean, low, high): a 95 % bootstrap interval over homes."""
    random, values, homes = np.random.default_rng(seed), np.asarray(values), np.asarray(homes)
    _, groups = np.unique(homes, return_inverse=True)
    sums = np.bincount(groups, values)
    counts = np.bincount(groups)
    draws = random.integers(len(sums), size=(n, len(sums)))
    means = sums[draws].sum(1) / counts[draws].sum(1)
    return float(values.mean()), *np.quantile(means, [0.025, 0.975]).tolist()


def table(rows):
    """Returns a table in Markdown: each driver and simulator, and the paired difference of success
    to megastep's.
    """
    runs = collections.defaultdict(dict)
    for row in rows:
        runs[row["driver"], row["simulator"]][row["episode"]] = row
    lines = [
        "| driver | simulator | episodes | success | SPL | steps in contact | seconds to the goal "
        "| success, paired with megastep | ms a step |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for (driver, name), found in runs.items():
        homes = [row["home"] for row in found.values()]
        cells = []
        for metric in ("success", "spl", "collisions"):
            mean, low, high = interval([row[metric] for row in found.values()], homes)
            cells.append(f"{mean:.3g} ({low:.3g} to {high:.3g})")
        times = [row["seconds"] for row in found.values() if row["success"]]
        cells.append(f"{np.mean(times):.1f}" if times else "")
        own, paired = runs.get((driver, "megastep"), {}), ""
        both = [i for i in found if i in own]
        if name != "megastep" and both:
            gaps = [found[i]["success"] - own[i]["success"] for i in both]
            mean, low, high = interval(gaps, [found[i]["home"] for i in both])
            paired = f"{100 * mean:+.1f} ({100 * low:+.1f} to {100 * high:+.1f}) points"
        ms = float(np.mean([row["ms"] for row in found.values()]))
        cells += [paired, f"{ms:.2f}"]
        lines.append(f"| {driver} | {name} | {len(found):,} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def fail(text):
    print(f"transfer.py: {text}", file=sys.stderr)
    sys.exit(2)


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("episodes")
    parser.add_argument("--policy")
    parser.add_argument("--label", default="trained")
    names = ["trained", "means", "random", "scripted", "planner"]
    parser.add_argument("--controllers", nargs="+", default=["trained"], choices=names)
    parser.add_argument("--simulators", nargs="+", default=["megastep"], choices=[*SIMULATORS])
    parser.add_argument("--first", type=int, default=0, help="of the episodes")
    parser.add_argument("--n", type=int, default=10**9)
    parser.add_argument("--table", action="store_true")
    words = parser.parse_args()
    path = Path(words.episodes)
    log = path.with_suffix(".jsonl")
    rows = [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []
    if not words.table:
        if words.policy is None:
            fail("--policy is missing: the .onnx file of megastep export, whose robot is driven")
        try:
            policy = RobotPolicy(words.policy)
            episodes = read(path)[words.first : words.first + words.n]
        except (ValueError, OSError) as error:
            fail(str(error))
        known = {(row["driver"], row["simulator"], row["episode"]) for row in rows}
        for kind in words.controllers:
            driver, label = controller(kind, policy), words.label if kind == "trained" else kind
            for name in words.simulators:
                world = simulator(name, policy.about)
                for episode in episodes:
                    if (label, name, episode.number) in known:
                        continue
                    names = dict(driver=label, simulator=name, episode=episode.number)
                    outcome = play(world, driver, episode, policy.about)
                    rows.append(row := dict(names, home=episode.home, **outcome))
                    with log.open("a") as file:
                        file.write(json.dumps(row) + "\n")
    print(table(rows))


if __name__ == "__main__":
    main()
