"""A policy from `megastep export format=onnx`, by onnxruntime and NumPy alone."""

import json
from pathlib import Path

import numpy as np


class RobotPolicy:
    """Drives a robot to a goal by ranges and odometry. Remembers by its hidden state. It draws
    actions as in training, since one that always repeats the best action stays where it is stuck.

    Args:
        path: the .onnx file. The description, .json, lies beside it.
    """

    def __init__(self, path: str | Path):
        import onnxruntime

        path = Path(path)
        self.about = json.loads(path.with_suffix(".json").read_text())
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        self.session = onnxruntime.InferenceSession(path, options, ["CPUExecutionProvider"])
        shapes = {port["name"]: port["shape"] for port in self.about["inputs"]}
        known = {"obs.scan", "obs.rgb", "obs.odom", "obs.goal", "reset"}
        others = [name for name in shapes if name not in known and not name.startswith("state")]
        if others or not {"obs.odom", "obs.goal"} <= shapes.keys():
            raise ValueError(
                f"{path} takes {', '.join(shapes)}; a robot's policy takes obs.scan, obs.odom and "
                "obs.goal, as experiment=robot trains"
            )
        self.feeds = {
            name: np.zeros((1, *shape), np.float32)
            for name, shape in shapes.items()
            if name != "reset"
        }
        self.seen = "obs.rgb" if "obs.rgb" in shapes else "obs.scan"
        self.scan = self.about["observations"].get("scan")
        outputs = {port["name"]: port for port in self.about["outputs"]}
        self.is_beta = outputs["logits"].get("distribution") == "beta"
        self.limits = np.array(self.about["actions"]["high"])
        self.begin()

    def begin(self, seed: int | None = 1) -> None:
        """Forgets, at the start of an episode. A seed is that of the actions, which are drawn from
        a Beta distribution; None: takes its mean.
        """
        self.random = None if seed is None else np.random.default_rng(seed)
        for name, value in self.feeds.items():
            if name.startswith("state"):
                value[:] = 0
        self.feeds["reset"] = np.ones(1, bool)

    def resampled(self, ranges: np.ndarray, angle_min: float, increment: float) -> np.ndarray:
        """Returns the policy's rays, (n,), from a scan in metres with rays of any angles: the
        nearest of each; inf where the scan has none within half a turn of its own increment.
        """
        wanted = self.scan["angle_min"] + self.scan["angle_increment"] * np.arange(
            self.scan["n_rays"]
        )
        turns = (wanted - angle_min) / increment
        period = 2 * np.pi / abs(increment)
        nearest = np.round(turns % period).astype(int) % max(round(period), 1)
        is_there = nearest < len(ranges)
        return np.where(is_there, ranges[np.minimum(nearest, len(ranges) - 1)], np.inf)

    def act(self, ranges: np.ndarray, twist: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """Returns (m/s ahead, rad/s to the left).

        Args:
            ranges: (n,) metres of the policy's rays; inf, or NaN, without a return. Of a policy
                that sees, (3, W) linear RGB.
            twist: (2,) m/s ahead, rad/s to the left.
            goal: (2,) metres ahead and to the left.
        """
        feeds, distance = self.feeds, float(np.hypot(*goal))
        if self.seen == "obs.scan":
            near = 1 - np.clip(ranges / self.scan["range_max"], 0, 1)
            near = np.where(np.isnan(ranges), 0, near)
            feeds["obs.scan"][0, 0, 0, 0] = near
        else:
            feeds["obs.rgb"][0, 0, :, 0] = ranges
        feeds["obs.odom"][0, 0] = twist / self.limits
        direction = goal / distance if distance else np.array([1.0, 0.0])
        feeds["obs.goal"][0, 0] = distance / 10, *direction
        action, logits, *state = self.session.run(None, feeds)
        for k, leaf in enumerate(state):
            feeds[f"state.{k}"] = leaf
        feeds["reset"] = np.zeros(1, bool)
        if self.random is None or not self.is_beta:
            return action[0, 0]
        alpha, beta = np.split(logits[0, 0].astype(float), 2)
        return self.limits * (2 * self.random.beta(alpha, beta) - 1)
