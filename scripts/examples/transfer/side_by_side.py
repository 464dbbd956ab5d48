"""Films an episode in several simulators: side_by_side.py homes.npz robot.onnx 3 film.mp4

Also records the messages of IR-SIM for robot_node.py: --messages messages.jsonl
"""

import argparse
import json
import math
from pathlib import Path

import matplotlib
import numpy as np
from controllers import Trained
from episodes import read
from robot_policy import RobotPolicy
from transfer import SIMULATORS, play, simulator

from megastep.video import GifWriter, Mp4Writer

matplotlib.use("Agg")
from matplotlib import pyplot

WRITERS = {".mp4": Mp4Writer, ".gif": GifWriter}


def record(name, policy, episode):
    """Plays an episode. Returns (poses, scans, camera images or None, messages, outcome)."""
    world, poses, scans, views, messages = simulator(name, policy.about), [], [], [], []

    def keep(world, pose, ranges):
        poses.append(pose)
        scans.append(ranges)
        if name == "mujoco":
            views.append(above(world))
        if name == "irsim":
            scan, odometry = world.messages()
            messages.append(dict(scan=scan, odometry=odometry))

    outcome = play(world, Trained(policy), episode, policy.about, keep)
    return np.array(poses), scans, views, messages, outcome


def above(world):
    """Returns an image of a MuJoCo world, (400, 400, 3), from above and behind."""
    import mujoco

    if not hasattr(world, "film"):
        world.film = mujoco.Renderer(world.model, 400, 400), mujoco.MjvCamera()
    renderer, camera = world.film
    x, y, yaw = world.pose()
    camera.lookat[:] = x, y, 0.2
    camera.distance, camera.elevation, camera.azimuth = 3.5, -55, math.degrees(yaw)
    options = mujoco.MjvOption()
    options.flags[mujoco.mjtVisFlag.mjVIS_RANGEFINDER] = False
    renderer.update_scene(world.data, camera, options)
    return renderer.render()


def draw(axes, name, episode, poses, scan, radius, step):
    """Draws a floor plan with the way so far, and what the lidar measures."""
    axes.clear()
    for wall in episode.walls:
        axes.plot(*wall.T, color="#333333", lw=1.2)
    x, y, yaw = poses[min(step, len(poses) - 1)]
    angles = yaw + 2 * np.pi * np.arange(len(scan)) / len(scan)
    far = np.where(np.isfinite(scan), scan, 0.0)
    axes.fill(x + far * np.cos(angles), y + far * np.sin(angles), color="#f3b61f", alpha=0.25)
    axes.plot(*poses[: step + 1, :2].T, color="#2f6fd0", lw=1.5)
    axes.add_patch(pyplot.Circle((x, y), radius, color="#2f6fd0"))
    axes.plot([x, x + 0.3 * math.cos(yaw)], [y, y + 0.3 * math.sin(yaw)], color="white", lw=1.2)
    axes.add_patch(pyplot.Circle(episode.goal, 0.2, color="#1fa94c"))
    axes.set_title(f"{name} · {min(step, len(poses) - 1) / 10:.1f} s", fontsize=10)
    axes.set_aspect("equal")
    axes.axis("off")


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("episodes")
    parser.add_argument("policy")
    parser.add_argument("number", type=int)
    parser.add_argument("film")
    parser.add_argument("--simulators", nargs="+", default=[*SIMULATORS], choices=[*SIMULATORS])
    parser.add_argument("--messages")
    parser.add_argument("--every", type=int, default=1, help="steps from frame to frame")
    words = parser.parse_args()
    policy, episode = RobotPolicy(words.policy), read(words.episodes)[words.number]
    runs = {name: record(name, policy, episode) for name in words.simulators}
    if words.messages:
        lines = [json.dumps(message) + "\n" for message in runs["irsim"][3]]
        Path(words.messages).write_text("".join(lines))
    views = runs["mujoco"][2] if "mujoco" in runs else []
    n_panels = len(runs) + bool(views)
    figure, panels = pyplot.subplots(
        1, n_panels, figsize=(3.2 * n_panels, 3.6), dpi=100, layout="constrained", squeeze=False
    )
    writer = WRITERS[Path(words.film).suffix](policy.about["steps_per_second"])
    for step in range(0, max(len(run[0]) for run in runs.values()) + 5, words.every):
        for axes, (name, (poses, scans, _, _, _)) in zip(panels[0], runs.items()):
            scan, radius = scans[min(step, len(scans) - 1)], policy.about["robot"]["radius"]
            draw(axes, name, episode, poses, scan, radius, step)
        if views:
            panels[0][-1].clear()
            panels[0][-1].imshow(views[min(step, len(views) - 1)])
            panels[0][-1].set_title("mujoco, its camera", fontsize=10)
            panels[0][-1].axis("off")
        figure.canvas.draw()
        writer.add(np.asarray(figure.canvas.buffer_rgba())[..., :3].copy())
    Path(words.film).write_bytes(writer.close())
    for name, run in runs.items():
        print(name, {key: round(value, 2) for key, value in run[4].items()})


if __name__ == "__main__":
    main()
