"""A twin of Deathmatch's bot in PyTorch, which shares no code with its kernel. B lanes."""

import torch

from megastep.arrdict import arrdict

#: Actions with momentum.
NOTHING, FORWARD, LEFT, RIGHT = 0, 3, 5, 6
TURN = 18.0  # degrees per second added by an action
RETAINED = 0.875  # fraction of a velocity left after a step
STEP = 0.1  # seconds
SATURATED = 0.12  # fraction of a pixel's light in its weakest channel: agents have less, walls more
DARK = 0.01  # darker pixels are ignored
LOOK = 25  # steps it turns after it lost an agent: all round
AROUND = 10  # steps it turns away from what stopped it
SLOW = 0.05  # maximum speed at which it approaches, in tens of metres per second
MIDDLE = 8  # pixels left and right of the centre that must be free to walk
CLOSE = 0.7  # depth at 3 m, near enough to an agent
NEAR = 0.9  # depth at 1 m, too near to a wall


def act(world, state, fov=70.0):
    """Does what `Bot` does."""
    obs = world["obs"]
    rgb, depth = obs["rgb"][:, 0, :, 0].float(), obs["d"][:, 0, 0, 0].float()
    spin, ahead = 360 * obs["imu"][:, 0, 0].float(), obs["imu"][:, 0, 1]
    is_seen, pixel = _nearest_agent(rgb)
    target = _bearing(pixel, depth.shape[1], fov)
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
    fights = _fight(target, spin, approaches)
    actions = torch.where(is_seen, fights, searches)
    state = arrdict(lost=lost, side=side, around=around, pushed=actions == FORWARD)
    return arrdict(actions=actions[:, None]), state


def _nearest_agent(rgb):
    """Returns (B,) bool, true if an agent is in view, and (B,) the agent's pixel closest to the
    centre.
    """
    light = rgb.sum(1)
    is_agent = (rgb.amin(1) < SATURATED * light) & (light > DARK)
    n = rgb.shape[2]
    off = (torch.arange(n, device=rgb.device) - (n - 1) / 2).abs()
    return is_agent.any(1), torch.where(is_agent, off, float(n)).argmin(1)


def _bearing(pixel, n_pixels, fov):
    """Returns the bearing of pixels (B,) in degrees, positive to the left."""
    slope = (n_pixels - 1 - 2 * pixel) / n_pixels
    half = torch.deg2rad(torch.full_like(slope, fov / 2)).tan()
    return torch.rad2deg((slope * half).atan())


def _turn(target, spin, seconds):
    """Returns the turn (B,) that brings a bearing closest to 0 after `seconds`."""
    pushes = torch.arange(-1, 2, device=spin.device) * TURN  # right, nothing, left
    off = target[:, None] - seconds * (RETAINED * spin[:, None] + pushes)
    best = off.abs().argmin(1)
    return torch.where(best == 0, RIGHT, torch.where(best == 2, LEFT, NOTHING))


def _fight(target, spin, approaches):
    """Returns actions that turn to a target, or walk forward where no turn is needed and
    `approaches` is true.
    """
    soon, later = (_turn(target, spin, seconds) for seconds in (STEP, 3 * STEP))
    action = torch.where(target.abs() > 3, later, soon)
    return torch.where((action == NOTHING) & approaches, FORWARD, action)
