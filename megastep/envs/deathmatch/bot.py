"""Scripted policies, which act on observations as any other does. B lanes, R pixels."""

from collections.abc import Mapping

import torch

from megastep.arrdict import arrdict

#: Actions of agents that walk about.
NOTHING, FORWARD, LEFT, RIGHT = 0, 3, 5, 6
TURN = 18.0  # degrees per second that an action adds
KEPT = 0.875  # of a velocity, from step to step
STEP = 0.1  # seconds
SATURATED = 0.12  # share of a pixel's light in its weakest channel: agents have less, walls more
DARK = 0.01  # light below which a pixel tells nothing
LOOK = 25  # steps to turn to where somebody was last seen: all round
AROUND = 10  # steps to turn away from what stopped a walk
SLOW = 0.05  # tens of metres per second at which it approaches
MIDDLE = 8  # pixels either way that a walk needs clear
CLOSE, NEAR = 0.7, 0.9  # depth of somebody three metres away, near enough; of a wall at one metre


class Bot:
    """Fights in deathmatch: turns until another agent is in the middle of its view, holds it there,
    and approaches. Who sees nobody walks about, and turns where a wall comes near.

    It acts on a world's `obs` (`rgb`, `d`, `imu`) and `reset` alone, tells agents from walls by
    their saturated colours, and has no weights. `fov` degrees, of its camera; it expects ten steps
    per second.
    """

    def __init__(self, fov: float = 70.0):
        self.fov = fov

    def initial(self, n_lanes: int, device: torch.device | str | None = None) -> arrdict:
        """The state of B lanes, (B,) each: `lost`, steps since anybody was in view; `side`, which
        way to turn, 1 left or -1 right; `around`, steps still to turn away from a wall; `pushed`,
        whether the last action was a push ahead.
        """
        zeros = torch.zeros(n_lanes, dtype=torch.int64, device=device)
        return arrdict(
            lost=zeros + LOOK, side=zeros + 1, around=zeros, pushed=torch.zeros_like(zeros).bool()
        )

    def __call__(
        self,
        world: Mapping,
        state: Mapping,
        sample: bool = True,
        generator: torch.Generator | None = None,
    ) -> tuple[arrdict, arrdict]:
        """One step for all lanes: (arrdict(actions (B, 1) int64), state). Nothing is drawn, so
        `sample` and `generator` change nothing. ValueError for worlds of another kind.
        """
        obs = world["obs"]
        if not isinstance(obs, Mapping) or not {"rgb", "d", "imu"} <= obs.keys():
            raise ValueError("it acts on observations of rgb, d and imu, as deathmatch's are")
        rgb, depth = obs["rgb"][:, 0, :, 0].float(), obs["d"][:, 0, 0, 0].float()
        spin, ahead = 360 * obs["imu"][:, 0, 0].float(), obs["imu"][:, 0, 1]
        is_seen, pixel = self._nearest_agent(rgb)
        target = self._bearing(pixel, depth.shape[1])
        half = depth.shape[1] // 2
        wider = torch.where(depth[:, :half].mean(1) < depth[:, half:].mean(1), 1, -1)
        stopped = state["pushed"] & (ahead == 0) & ~world["reset"]
        side = torch.where(stopped, wider, state["side"])
        side = torch.where(is_seen, torch.where(target > 0, 1, -1), side)
        around = torch.where(stopped, AROUND, (state["around"] - 1).clamp(min=0))
        lost = torch.where(world["reset"], LOOK, state["lost"] + 1).masked_fill(is_seen, 0)
        clear = depth[:, half - MIDDLE : half + MIDDLE].amax(1) < NEAR
        walks = clear & (around == 0) & (lost > LOOK)
        searches = torch.where(walks, FORWARD, torch.where(side > 0, LEFT, RIGHT))
        comes = (depth.gather(1, pixel[:, None])[:, 0] < CLOSE) & (ahead < SLOW)
        fights = self._fight(target, spin, comes)
        actions = torch.where(is_seen, fights, searches)
        state = arrdict(lost=lost, side=side, around=around, pushed=actions == FORWARD)
        return arrdict(actions=actions[:, None]), state

    def _nearest_agent(self, rgb):
        """Whether an agent is in view (B,), and its pixel nearest to the middle (B,)."""
        light = rgb.sum(1)
        is_agent = (rgb.amin(1) < SATURATED * light) & (light > DARK)
        n = rgb.shape[2]
        off = (torch.arange(n, device=rgb.device) - (n - 1) / 2).abs()
        return is_agent.any(1), torch.where(is_agent, off, float(n)).argmin(1)

    def _bearing(self, pixel, n_pixels):
        """Degrees to the left of the middle at which pixels (B,) look."""
        slope = (n_pixels - 1 - 2 * pixel) / n_pixels
        half = torch.deg2rad(torch.full_like(slope, self.fov / 2)).tan()
        return torch.rad2deg((slope * half).atan())

    def _turn(self, target, spin, seconds):
        """Left, right or nothing (B,), whichever brings a bearing nearest to the middle by then."""
        pushes = torch.arange(-1, 2, device=spin.device) * TURN  # right, nothing, left
        off = target[:, None] - seconds * (KEPT * spin[:, None] + pushes)
        best = off.abs().argmin(1)
        return torch.where(best == 0, RIGHT, torch.where(best == 2, LEFT, NOTHING))

    def _fight(self, target, spin, comes):
        """Turns to a target, and where that takes no turn, comes nearer, where it `comes`."""
        soon, later = (self._turn(target, spin, seconds) for seconds in (STEP, 3 * STEP))
        action = torch.where(target.abs() > 3, later, soon)
        return torch.where((action == NOTHING) & comes, FORWARD, action)
