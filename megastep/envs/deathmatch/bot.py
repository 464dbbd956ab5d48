"""A scripted policy for Deathmatch that acts on observations alone. B lanes, R pixels."""

import math
from collections.abc import Mapping

import torch

from megastep.arrdict import arrdict
from megastep.envs.deathmatch.step import PROGRAM
from megastep.kernels.build.launch import WARP, launch

#: Actions with momentum.
NOTHING, FORWARD, LEFT, RIGHT = map(PROGRAM.constants.get, ("NOTHING", "FORWARD", "LEFT", "RIGHT"))
TURN, RETAINED, STEP = map(PROGRAM.constants.get, ("TURN", "RETAINED", "STEP"))
SATURATED, DARK = map(PROGRAM.constants.get, ("SATURATED", "DARK"))
LOOK, AROUND, SLOW = map(PROGRAM.constants.get, ("LOOK", "AROUND", "SLOW"))
MIDDLE, CLOSE, NEAR = map(PROGRAM.constants.get, ("MIDDLE", "CLOSE", "NEAR"))


class Bot:
    """Plays Deathmatch: turns until another agent is at the centre of its view, keeps it there and
    approaches. If it sees no agent, it walks about and turns away from walls.

    It uses a world's `obs` (`rgb`, `d`, `imu`) and `reset` only, recognises agents by their
    saturated colours, and has no weights. It expects ten steps per second.

    Args:
        fov: the camera's field of view in degrees.
    """

    def __init__(self, fov: float = 70.0):
        self.fov = fov

    def initial(self, n_lanes: int, device: torch.device | str | None = None) -> arrdict:
        """Returns the initial state, (B,) each.

        `lost`: steps since an agent was in view. `side`: direction to turn, 1 left or -1 right.
        `around`: steps left to turn away from a wall. `pushed`: the last action was forward.
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
        """Chooses actions for all lanes.

        Args:
            world: of Deathmatch.
            state: of the last step, or :meth:`initial`.
            sample, generator: ignored; the bot is deterministic.

        Returns:
            (arrdict(actions (B, 1) int64), new state).

        Raises:
            ValueError: if the observations are not Deathmatch's.
        """
        obs = world["obs"]
        if not isinstance(obs, Mapping) or not {"rgb", "d", "imu"} <= obs.keys():
            raise ValueError("the bot needs observations rgb, d and imu, as Deathmatch has them")
        if _is_fused(**obs):
            return self._act_on_gpu(obs["rgb"], obs["d"], obs["imu"], world["reset"], state)
        rgb, depth = obs["rgb"][:, 0, :, 0].float(), obs["d"][:, 0, 0, 0].float()
        spin, ahead = (obs["imu"][:, 0, i].float() for i in range(2))
        spin = 360 * spin
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
        approaches = (depth.gather(1, pixel[:, None])[:, 0] < CLOSE) & (ahead < SLOW)
        fights = self._fight(target, spin, approaches)
        actions = torch.where(is_seen, fights, searches)
        state = arrdict(lost=lost, side=side, around=around, pushed=actions == FORWARD)
        return arrdict(actions=actions[:, None]), state

    def _act_on_gpu(self, rgb, depth, imu, reset, state):
        """Does the same in one kernel."""
        n_lanes, n_pixels = len(reset), rgb.shape[-1]
        rgb, depth, imu, reset = (leaf.contiguous() for leaf in (rgb, depth, imu, reset.bool()))
        state = {name: leaf.contiguous() for name, leaf in state.items()}
        after = arrdict({name: torch.empty_like(leaf) for name, leaf in state.items()})
        actions = torch.empty(n_lanes, 1, dtype=torch.int64, device=rgb.device)
        observed = dict(rgb=rgb, depth=depth, imu=imu, reset=reset)
        next_state = {f"next_{name}": leaf for name, leaf in after.items()}
        tensors = dict(**observed, **state, actions=actions, **next_state)
        packed = PROGRAM.params.BotParams(
            **{name: leaf.data_ptr() for name, leaf in tensors.items()},
            slope=math.tan(math.radians(self.fov / 2)),
            n_lanes=n_lanes,
            n_pixels=n_pixels,
        )
        launch(PROGRAM, "bot", packed, rgb.device, threads=WARP * n_lanes)
        return arrdict(actions=actions), after

    def _nearest_agent(self, rgb):
        """Returns (B,) bool, true if an agent is in view, and (B,) the agent's pixel closest to the
        centre.
        """
        light = rgb.sum(1)
        is_agent = (rgb.amin(1) < SATURATED * light) & (light > DARK)
        n = rgb.shape[2]
        off = (torch.arange(n, device=rgb.device) - (n - 1) / 2).abs()
        return is_agent.any(1), torch.where(is_agent, off, float(n)).argmin(1)

    def _bearing(self, pixel, n_pixels):
        """Returns the bearing of pixels (B,) in degrees, positive to the left."""
        slope = (n_pixels - 1 - 2 * pixel) / n_pixels
        half = torch.deg2rad(torch.full_like(slope, self.fov / 2)).tan()
        return torch.rad2deg((slope * half).atan())

    def _turn(self, target, spin, seconds):
        """Returns the turn (B,) that brings a bearing closest to 0 after `seconds`."""
        pushes = torch.arange(-1, 2, device=spin.device) * TURN  # right, nothing, left
        off = target[:, None] - seconds * (RETAINED * spin[:, None] + pushes)
        best = off.abs().argmin(1)
        return torch.where(best == 0, RIGHT, torch.where(best == 2, LEFT, NOTHING))

    def _fight(self, target, spin, approaches):
        """Returns actions that turn to a target, or walk forward where no turn is needed and
        `approaches` is true.
        """
        soon, later = (self._turn(target, spin, seconds) for seconds in (STEP, 3 * STEP))
        action = torch.where(target.abs() > 3, later, soon)
        return torch.where((action == NOTHING) & approaches, FORWARD, action)


def _is_fused(rgb, d, imu, **_):
    n_pixels = rgb.shape[-1]
    shapes = {(1, 3, 1, n_pixels): rgb, (1, 1, 1, n_pixels): d, (1, 3): imu}
    return all(
        leaf.is_cuda and leaf.dtype == torch.float16 and leaf.shape[1:] == shape
        for shape, leaf in shapes.items()
    )
