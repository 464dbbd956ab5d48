"""Egomotion: a model that draws the view from where it has not been, learnt from views and motion.

The question of Eslami et al. (2018, GQN), in a flatland: a recurrent core sees what an agent sees
as it walks, and feels how it moves; a head predicts the view at a pose that is asked for. See
docs/tutorials/egomotion.md.

T time, M lanes, E episodes, Q queries, P pixels, W features.
"""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, cast

import numpy as np
import torch
from pydantic import Field
from torch import nn

from megastep import data, plotting, video
from megastep.agents.algorithms.bc import BC
from megastep.agents.algorithms.learner import ScheduledCoefficient
from megastep.agents.algorithms.masked_stats import masked_mean
from megastep.agents.algorithms.ppo import PPO
from megastep.agents.networks.policy import Policy
from megastep.agents.runs import folders, restore
from megastep.arrdict import arrdict
from megastep.colour import gamma_encode
from megastep.settings import checked

FPS, FAR = 10.0, 10.0  # steps per second; metres at which depth is 0
RADIUS = 0.15 / math.sqrt(2)  # of an agent, where depth is 1
FOV = 130.0
TURN = 45.0  # degrees that are as far apart as a metre, for the nearest view
HIDDEN, WAVES = 256, 4  # units of the head; frequencies of a pose
GRID, CELL = 16, 0.5  # cells and metres of the walls that a probe finds around the agent


# ---- The model ----


class QueryHead(nn.Module):
    """Predicts the view at a pose: depth and colour (..., 4, P), from features (..., W) and the
    pose relative to where the agent is, (..., 3): metres ahead and to the left, radians to the
    left.
    """

    def __init__(self, width: int, n_pixels: int = 64):
        super().__init__()
        self.n_pixels = n_pixels
        layers = nn.Linear(width + 2 + 4 * WAVES + 2, HIDDEN), nn.Linear(HIDDEN, HIDDEN)
        self.layers = nn.ModuleList([*layers, nn.Linear(HIDDEN, 4 * n_pixels)])

    def forward(self, features: torch.Tensor, pose: torch.Tensor) -> torch.Tensor:
        place, angle = pose[..., :2], pose[..., 2:]
        waves = torch.cat([place * (math.pi / 2**k) for k in range(WAVES)], -1)
        x = [features, place, waves.sin(), waves.cos(), angle.sin(), angle.cos()]
        first, second, last = self.layers
        x = first(torch.cat([part.to(features.dtype) for part in x], -1)).relu()
        return last(second(x).relu()).unflatten(-1, (4, self.n_pixels)).float()


def felt_poses(imu: torch.Tensor) -> torch.Tensor:
    """Returns poses (T, M, 3) in the frame of the first row: metres, radians, added up from what an
    agent feels, (T, M, 3). A row's motion is that which led there.
    """
    turns = torch.deg2rad(imu[..., 0].float() * 360 / FPS)
    angles = turns.cumsum(0) - turns[:1]
    steps = rotated(imu[..., 1:].float() * 10 / FPS, angles)
    return torch.cat([steps.cumsum(0) - steps[:1], angles[..., None]], -1)


def rotated(vectors: torch.Tensor, angles: torch.Tensor) -> torch.Tensor:
    """Returns vectors (..., 2) turned to the left by radians (...)."""
    (x, y), s, c = vectors.unbind(-1), angles.sin(), angles.cos()
    return torch.stack([c * x - s * y, s * x + c * y], -1)


def relative(here: torch.Tensor, there: torch.Tensor) -> torch.Tensor:
    """Returns poses (..., 3) in the frames of others (..., 3)."""
    place = rotated(there[..., :2] - here[..., :2], -here[..., 2])
    return torch.cat([place, there[..., 2:] - here[..., 2:]], -1)


def views(obs: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """Returns depth and colour (..., 4, P) of observations."""
    parts = [obs[name].squeeze(-4).squeeze(-2) for name in ("d", "rgb")]
    return torch.cat(parts, -2).float()


class Egomotion(BC):
    """Learns to draw views at poses of other steps of the same rollout, before and after, from a
    dataset of any agent. Poses are added up from the agent's own motion; nothing else tells them.

    Args:
        queries: poses per step.
        policy_coef: weight of cloning, besides.

    Metrics:
        loss/depth_error: mean absolute error of depth, metres.
        loss/colour_error: mean absolute error of colour, linear light.

    Other arguments and metrics are those of `BC`.
    """

    @checked
    def __init__(
        self,
        policy: Policy,
        *,
        queries: Annotated[int, Field(ge=1, le=64)] = 2,
        policy_coef: ScheduledCoefficient = 0.0,
        **settings: Any,
    ):
        self.queries = queries
        super().__init__(policy, policy_coef=policy_coef, **settings)

    def extra_parameters(self) -> Any:
        space: Any = self.policy.obs_space
        self.head = QueryHead(self.policy.width, space["d"].W)
        return self.head.parameters()

    def extra_loss(
        self, features: torch.Tensor, batch: arrdict
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        n_steps, n_lanes = features.shape[:2]
        poses = felt_poses(batch.obs["imu"][:, :, 0])
        episode, target = batch.starts.long().cumsum(0), views(batch.obs)
        depth = colour = features.new_zeros((), dtype=torch.float32)
        lanes = torch.arange(n_lanes, device=features.device).expand(n_steps, -1)
        for _ in range(self.queries):
            shape, draws = (n_steps, n_lanes), self.generator.on(self.device)
            rows = torch.randint(n_steps + 1, shape, generator=draws, device=self.device)
            valid = episode[rows, lanes] == episode[:-1]
            drawn = self.head(features, relative(poses[:-1], poses[rows, lanes]))
            error = (drawn - target[rows, lanes]).abs().mean(-1)
            depth = depth + masked_mean(error[..., 0], valid) / self.queries
            colour = colour + masked_mean(error[..., 1:].mean(-1), valid) / self.queries
        metrics = dict(depth_error=FAR * depth, colour_error=colour)
        return 10 * (depth + colour), metrics


class Frozen(PPO):
    """PPO that leaves the encoder and the core as they are, and learns what reads them."""

    def __init__(self, policy: Policy, **settings: Any):
        super().__init__(policy, **settings)
        for name, parameter in policy.named_parameters():
            if name.startswith(("intake.", "core.")):
                parameter.register_hook(torch.zeros_like)


# ---- Measuring ----


class Model:
    """A run's core, and the head that draws. `untrained`: the core before training."""

    def __init__(self, run: str, untrained: bool = False):
        loaded = folders.load_checkpoint(folders.find(run), True, "cpu", is_whole=True)
        self.policy, state = restore.policy_of(loaded), cast(Any, loaded.state)
        space: Any = self.policy.obs_space
        self.draw = QueryHead(self.policy.width, space["d"].W).requires_grad_(False)
        for parameter, saved in zip(self.draw.parameters(), state["learner"]["extra"]):
            parameter.data.copy_(saved)
        if untrained:
            kinds: Any = self.policy.settings
            new = Policy(self.policy.obs_space, self.policy.action_space, **kinds, seed=99)
            statistics = dict(self.policy.named_buffers())
            new.load_state_dict({**new.state_dict(), **statistics})
            self.policy = new

    @torch.no_grad()
    def features(self, one: arrdict) -> torch.Tensor:
        """Returns the features (T + 1, W) of an episode."""
        starts = torch.zeros(len(one.obs["d"]), 1, dtype=torch.bool)
        starts[0] = True
        obs = one.obs.map(lambda leaf: leaf[:, None])
        return self.policy.unroll(obs, starts, self.policy.initial(1))["features"][:, 0].float()


def true_poses(one: arrdict) -> torch.Tensor:
    """Returns poses (T + 1, 3), metres and radians, from a dataset with truth=true."""
    corner, cell = frame(one)
    x, y = one["agent_dir"].unbind(-1)
    return torch.cat([corner + cell * one["agent_pos"], torch.atan2(y, x)[:, None]], -1)


def frame(one: arrdict) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the corner and the side, in metres, of the cells in which places of a maze are."""
    numbers = one.get("maze_frame", torch.tensor([0.0, 0.0, 1.0]))
    return numbers[:2], numbers[2]


def raycast(walls: torch.Tensor, poses: torch.Tensor, n_pixels: int = 64) -> torch.Tensor:
    """Returns the depth (Q, P) of a floor plan (M, 2, 2), as observations have it, at poses."""
    slopes = 1 - (2 * torch.arange(n_pixels) + 1) / n_pixels
    angles = (slopes * math.tan(math.radians(FOV / 2))).atan() + poses[:, 2:]
    rays = torch.stack([angles.cos(), angles.sin()], -1)[:, :, None]
    start, along = walls[:, 0] - poses[:, None, None, :2], walls[:, 1] - walls[:, 0]

    def cross(a, b) -> torch.Tensor:
        return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]

    across = cross(rays, along)
    metres, part = cross(start, along) / across, cross(start, rays) / across
    hit = (metres > 0) & (part >= 0) & (part <= 1) & (across != 0)
    metres = torch.where(hit, metres, torch.inf).min(-1).values
    return 1 - ((metres - RADIUS) / FAR).clamp(0, 1)


def queries(one: arrdict, generator: torch.Generator, every: int = 8, ahead: int = 40) -> tuple:
    """Returns steps `now` (Q,) of an episode, and later ones to ask about, at most `ahead`."""
    n = len(one.reward)
    now = torch.arange(every, max(n - 1, every), every)
    gap = 1 + (torch.rand(len(now), generator=generator) * ahead).long()
    return now, (now + gap).clamp(max=n)


def draw_errors(model: Model, episodes: Sequence[arrdict]) -> dict[str, tuple[float, float]]:
    """Returns the mean absolute error of depth, metres, and of colour, linear light, of views that
    an agent has later: by the model, and by what draws without one. An oracle has the floor plan.
    """
    generator, sums = torch.Generator().manual_seed(1), {}
    mean_colour = torch.stack([views(one.obs)[:, 1:].mean((0, 2)) for one in episodes]).mean(0)
    for one in episodes:
        now, then = queries(one, generator)
        if not len(now):
            continue
        poses, seen, features = true_poses(one), views(one.obs), model.features(one)
        apart = relative(poses[None, :], poses[then][:, None])
        turn = torch.atan2(apart[..., 2].sin(), apart[..., 2].cos()).abs().rad2deg() / TURN
        unseen = torch.arange(len(poses)) > now[:, None]
        apart = (apart[..., :2].norm(dim=-1) + turn).masked_fill(unseen, torch.inf)
        depth = raycast(one["walls"], poses[then], seen.shape[-1])[:, None]
        plan = torch.cat([depth, mean_colour[:, None].expand(len(now), 3, depth.shape[-1])], 1)
        drawn = {
            "model": model.draw(features[now], relative(poses[now], poses[then])),
            "repeat last view": seen[now],
            "nearest seen view": seen[apart.argmin(1)],
            "oracle with the floor plan": plan,
        }
        for name, view in drawn.items():
            error = (view - seen[then]).abs().mean(-1)
            row = torch.stack([FAR * error[:, 0].sum(), error[:, 1:].mean(1).sum()])
            total, n = sums.get(name, (torch.zeros(2), 0))
            sums[name] = total + row, n + len(now)
    return {name: tuple((total / n).tolist()) for name, (total, n) in sums.items()}


def wall_cells(one: arrdict, poses: torch.Tensor) -> torch.Tensor:
    """Returns which cells around poses (Q, 3) have a wall, (Q, GRID * GRID) bool."""
    pieces = []
    for start, end in one["walls"]:
        n = 2 + int((end - start).norm() / 0.1)
        pieces.append(torch.lerp(start, end, torch.linspace(0, 1, n)[:, None]))
    points = torch.cat(pieces)
    local = rotated(points - poses[:, None, :2], -poses[:, None, 2])
    cells = (local / CELL + GRID / 2).floor().long()
    inside = ((cells >= 0) & (cells < GRID)).all(-1)
    index = torch.where(inside, cells[..., 0] * GRID + cells[..., 1], GRID * GRID)
    found = torch.zeros(len(poses), GRID * GRID + 1, dtype=torch.bool)
    return found.scatter(1, index, True)[:, :-1]


def probe(model: Model, episodes: Sequence[arrdict], every: int = 5) -> dict[str, float]:
    """Returns what linear maps of the features tell in episodes that they were not fitted to: the
    error of the pose since the start, metres and degrees; F1 of walls around; metres to objects.
    """
    parts = []
    for one in episodes:
        rows = torch.arange(0, len(one.reward), every)
        poses = true_poses(one)
        since = relative(poses[:1], poses[rows])
        since = torch.cat([since[:, :2], since[:, 2:].cos(), since[:, 2:].sin()], -1)
        target = [since, wall_cells(one, poses[rows]).float()]
        if "targets_vec" in one:
            target.append(frame(one)[1] * one["targets_vec"][rows].flatten(1))
        parts.append((model.features(one)[rows], torch.cat(target, 1)))
    half = len(parts) // 2
    halves = parts[:half], parts[half:]
    (x, y), (x_test, y_test) = ([torch.cat(p).double() for p in zip(*some)] for some in halves)
    mean, scale = x.mean(0), x.std(0) + 1e-3
    x, x_test = ((torch.cat([(z - mean) / scale, z.new_ones(len(z), 1)], 1)) for z in (x, x_test))
    ridge = 1e-3 * len(x) * torch.eye(x.shape[1]).double()
    solved = torch.linalg.solve(x.T @ x + ridge, x.T @ y)
    fitted, found, n_cells = x @ solved, x_test @ solved, GRID * GRID
    turn = torch.atan2(found[:, 3], found[:, 2]) - torch.atan2(y_test[:, 3], y_test[:, 2])
    cells = slice(4, 4 + n_cells)
    limits = torch.linspace(0.1, 0.6, 11)
    best = max(limits, key=lambda limit: _f1(fitted[:, cells] > limit, y[:, cells] > 0))
    result = {
        "position, m": (found[:, :2] - y_test[:, :2]).norm(dim=1).mean(),
        "heading, degrees": torch.atan2(turn.sin(), turn.cos()).abs().rad2deg().mean(),
        "walls, F1": _f1(found[:, cells] > best, y_test[:, cells] > 0),
    }
    if found.shape[1] > cells.stop:
        apart = (found - y_test)[:, cells.stop :].unflatten(1, (-1, 2))
        result["objects, m"] = apart.norm(dim=-1).mean()
    return {name: float(value) for name, value in result.items()}


def _f1(found, true) -> float:
    return float(2 * (found & true).sum() / (found.sum() + true.sum()).clamp(min=1))


def measure(runs: Sequence[str], folder: str, n: int = 200) -> dict[str, Any]:
    """Returns and prints draw errors and probes of runs, in n episodes of a dataset with truth."""
    stored = data.load(folder)
    episodes = [stored[i] for i in range(min(n, len(stored)))]
    result: dict[str, Any] = {}
    for run in runs:
        model = Model(run)
        result[run] = draw_errors(model, episodes), probe(model, episodes)
    result[f"{runs[0]}, untrained"] = {}, probe(Model(runs[0], untrained=True), episodes)
    print(json.dumps(result, indent=1))
    return result


# ---- A film ----


def points(view: torch.Tensor, pose: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Returns where the pixels of views (Q, 4, P) from poses (Q, 3) are, (n, 2), in metres, and
    their colours (n, 3), without those that are far away.
    """
    slopes = 1 - (2 * torch.arange(view.shape[-1]) + 1) / view.shape[-1]
    angles = (slopes * math.tan(math.radians(FOV / 2))).atan() + pose[:, 2:]
    metres = RADIUS + FAR * (1 - view[:, 0])
    places = pose[:, None, :2] + metres[..., None] * torch.stack([angles.cos(), angles.sin()], -1)
    near = view[:, 0] > 0.05
    colours = gamma_encode(view[:, 1:].clamp(0, 1).movedim(1, -1))
    return places[near].numpy(), colours[near].numpy()


def film(run: str, folder: str, file: str, number: int = 0, every: int = 4) -> None:
    """Films an episode: the home with the way so far, what the agent has seen, and what the model
    draws from eight directions at its place and a metre around it.
    """
    from matplotlib import pyplot as plt

    model, one = Model(run), data.load(folder)[number]
    poses, seen, features = true_poses(one), views(one.obs), model.features(one)
    writer = video.WRITERS[file.rpartition(".")[2]][0](FPS / every * 2)
    around = torch.tensor([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)]).float()
    turns = torch.arange(8) * (math.pi / 4)
    asked = torch.cat([around.repeat_interleave(8, 0), turns.repeat(5)[:, None]], 1)
    low, high = one["walls"].amin((0, 1)).numpy(), one["walls"].amax((0, 1)).numpy()
    for t in range(every, len(poses), every):
        figure, axes = plt.subplots(1, 3, figsize=(12, 4.4), dpi=80)
        here = poses[t].expand(len(asked), 3)
        there = torch.cat([here[:, :2] + rotated(asked[:, :2], here[:, 2]), here[:, 2:]], 1)
        there[:, 2] += asked[:, 2]
        shown = [points(seen[: t + 1 : 2], poses[: t + 1 : 2])]
        shown.append(points(model.draw(features[t].expand(len(asked), -1), asked), there))
        for axis, title in zip(axes, ("the home", "what it has seen", "what the model draws")):
            axis.set(title=title, xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
            axis.axis("off")
            axis.plot(*poses[: t + 1, :2].T, color="tab:orange", lw=1)
        axes[0].plot(*one["walls"].permute(2, 1, 0).numpy(), color="k", lw=1.5)
        for axis, (places, colours) in zip(axes[1:], shown):
            axis.scatter(*places.T, c=colours, s=2)
        writer.add(plotting.rasterise(figure))
        plt.close(figure)
    Path(file).write_bytes(writer.close())
