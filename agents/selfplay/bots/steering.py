"""Walking along shortest paths by the actions of an environment.

N environments of A agents, n of their N A lanes, K exits per node.
"""

import copy
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch

from megastep import spaces
from megastep.agents.selfplay.bots.plans import BLOCK, NEAR, Plans
from megastep.arrdict import arrdict
from megastep.modules.movement import to_global
from megastep.types import n_lanes

REACH = 2.5  # metres to which an agent walks straight, if it can
PROGRESS = 0.3, 0.05  # metres by which the next node is nearer to the target, if there is one
LONGER = 1.0  # metres by which the way by the next node is longer than the shortest, at most
DETOUR = 100.0  # metres that each of these is worth
AT_NODE = 0.1  # metres within which an agent has reached a node
TOUCH = 0.01  # metres to a wall that may have stopped an agent
GAIN = 3.2  # of the share of its speed that an agent loses per step: 4/s with momentum
SIGHT = 10.0  # metres to which a place is in view
BENT = 1.05, 0.2  # a way this many times as long as straight, and metres more, is in view
AHEAD = (0.02, 0.1, 0.2)  # seconds of coasting for which an agent looks out for walls
KEPT = (0.004, 100.0), (0.02, 10.0)  # metres kept from walls, and m/s that each less is worth
HORIZON = 0.3  # seconds ahead to turn for
SLACK, OFF = 10.0, 8.0  # degrees off that do not matter; degrees more that weigh as 1 m/s


class Pose(NamedTuple):
    """Where lanes are, (n, ...) each."""

    plan: torch.Tensor  # int64
    position: torch.Tensor  # (n, 2) metres
    angle: torch.Tensor  # degrees
    velocity: torch.Tensor  # (n, 2) m/s
    spin: torch.Tensor  # degrees/s


class Steering:
    """Steers lanes of an environment whose agents walk. It knows the floor plans and poses.

    Args:
        env: an environment with `core`, `movement` and `spawner`, as megastep's have.
        goals: (D, L, 2) metres, where ways lead. Default: landmarks, see :mod:`plans`.
        block: squares of 0.3 m per side of the block that has a landmark.
    """

    def __init__(self, env: Any, goals: torch.Tensor | None = None, block: int = BLOCK):
        missing = {"core", "movement", "spawner"} - {*dir(env)}
        if missing:
            raise ValueError(
                "it walks by env.core, env.movement and env.spawner, and "
                f"{type(env).__name__} has no {' or '.join(sorted(missing))}"
            )
        self.core, self.lanes = env.core, torch.arange(n_lanes(env), device=env.device)
        moves = env.movement.moves
        if isinstance(env.action_space, spaces.MultiContinuous):
            one = torch.eye(len(moves), device=moves.device)
            self.actions = torch.cat([torch.zeros_like(one[:1]), one, -one])
            moves = self.actions @ moves
        else:
            self.actions = torch.arange(len(moves), device=moves.device)
        self.moves, self.retained = moves, 1 - env.movement.damping
        self.turn = self.actions[moves[:, 2].argmax()]
        self.plans = Plans(
            env.core.scenery, env.spawner.points, env.core.agents.radius, goals, block
        )

    def in_lanes(self, lanes: torch.Tensor) -> "Steering":
        """Returns one that steers lanes (n,) int64 of the environment."""
        steering = copy.copy(self)
        steering.lanes = lanes
        return steering

    def pose(self, lanes: torch.Tensor | None = None) -> Pose:
        """Returns the pose of lanes, by default of its own."""
        lanes = self.lanes if lanes is None else lanes
        agents, layout = self.core.agents, self.core.scenery.layout
        return Pose(
            self.plans.of_layout[layout[lanes // self.core.n_agents].long()],
            agents.positions.view(-1, 2)[lanes],
            agents.angles.view(-1)[lanes],
            agents.velocity.view(-1, 2)[lanes],
            agents.angvelocity.view(-1)[lanes],
        )

    def near(self, pose: Pose) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns the nodes (n, k) around lanes, and the lengths (n, k) of straight ways there."""
        nodes = self.plans.around(pose.plan, pose.position[:, None] + self.plans.beside)
        metres = self.plans.straight(pose.plan, pose.position, self.plans.nodes[nodes], NEAR)
        return nodes.clamp(min=0), torch.where(nodes < 0, torch.inf, metres)

    def lengths(self, near: tuple) -> torch.Tensor:
        """Returns the metres (n, L) from the nearest node to each target."""
        nodes, metres = near
        return self.plans.lengths[nodes.gather(1, metres.argmin(1, True))[:, 0]].float()

    def bearings(self, pose: Pose, offsets: torch.Tensor) -> torch.Tensor:
        """Returns the degrees (n, k) from the heading to offsets (n, k, 2), left positive."""
        angles = torch.rad2deg(torch.atan2(offsets[..., 1], offsets[..., 0]))
        return (angles - pose.angle[:, None] + 180) % 360 - 180

    def aim(self, pose: Pose, near: tuple, target: torch.Tensor) -> torch.Tensor:
        """Returns the points (n, 2) to walk straight to, on the way to targets (n,)."""
        nodes, metres = near
        best = (metres + self.plans.lengths[nodes, target[:, None]]).argmin(1, True)
        node = nodes.gather(1, best)[:, 0]
        plans, exits = self.plans, self.plans.exits[node].long()
        left = plans.lengths[exits, target[:, None]]
        lengths = left + plans.metres[node]
        # a node on the way that is too near brings an agent that stands on it nowhere, and one that
        # is far behind leads it past nodes from which the next node is this one
        here = plans.lengths[node, target][:, None]
        is_near, is_nowhere = (left > here - metres for metres in PROGRESS)
        is_behind = lengths > here + LONGER
        lengths = lengths + DETOUR * (is_near | is_behind) + DETOUR * is_nowhere
        following = plans.nodes[exits.gather(1, lengths.argmin(1, True))[:, 0]]
        end = plans.targets[pose.plan, target]
        straight = plans.straight(pose.plan, pose.position, torch.stack([following, end], 1))
        to_following, to_end = (straight < REACH).unbind(1)
        to_following |= (plans.nodes[node] - pose.position).norm(dim=-1) < AT_NODE
        aim = torch.where(to_following[:, None], following, plans.nodes[node])
        return torch.where((to_end | here.isinf()[:, 0])[:, None], end, aim)

    def decide(
        self,
        pose: Pose,
        aim: torch.Tensor,
        gaze: torch.Tensor,
        turning: float | torch.Tensor = 1.0,
        slack: float | torch.Tensor = SLACK,
        horizon: float | torch.Tensor = HORIZON,
    ) -> arrdict:
        """Returns the decision that walks towards points and turns to others, (n, 2) each.

        Args, numbers or (n, 1) each:
            turning: how much turning counts beside walking.
            slack: degrees off that do not matter.
            horizon: seconds ahead to turn for.
        """
        agents, damping = self.core.agents, 1 - self.retained
        pushes = to_global(pose.angle[:, None], self.moves[:, :2])
        velocities = self.retained * pose.velocity[:, None] + pushes  # (n, 7, 2)
        spins = self.retained * pose.spin[:, None] + self.moves[:, 2]
        offset = aim - pose.position
        away = offset.norm(dim=-1, keepdim=True)
        top = self.moves[:, :2].norm(dim=-1).amax() / damping
        speed = (GAIN * damping * agents.fps * away).minimum(top)
        wanted = speed * offset / away.clamp(min=1e-6)
        cost = (velocities - wanted[:, None]).norm(dim=-1)
        coasting = [pose.position[:, None] + seconds * velocities for seconds in AHEAD]
        room = self.plans.smooth_clearances(pose.plan, torch.stack(coasting, 1))
        for metres, weight in KEPT:
            cost = cost + weight * (agents.radius + metres - room).clamp(min=0).sum(1)
        bearing = self.bearings(pose, (gaze - pose.position)[:, None])
        error = ((bearing - horizon * spins + 180) % 360 - 180).abs()
        cost = cost + turning * (error - slack).clamp(min=0) / OFF
        here = self.plans.smooth_clearances(pose.plan, pose.position)
        is_stopped = (pose.velocity == 0).all(1) & (here < agents.radius + TOUCH)
        cost = torch.where(is_stopped[:, None], -room[:, 0], cost)
        return arrdict(actions=self.actions[cost.argmin(1)].unsqueeze(1))


class SteeredBot:
    """A bot that is steered: a policy, whose subclasses have `initial`, and `_act`, which gets the
    poses of its lanes and the nodes near them.
    """

    block = BLOCK

    def __init__(self, env: Any):
        self.steering = Steering(env, block=self.block)

    def in_lanes(self, lanes: torch.Tensor) -> "SteeredBot":
        """Returns one that plays in lanes (n,) int64 of the environment."""
        bot = copy.copy(self)
        bot.steering = self.steering.in_lanes(lanes)
        return bot

    def initial(self, n_lanes: int, device: torch.device | str | None = None) -> arrdict:
        """Returns, (n,) int64 each, the target, and steps of `patience` until it is given up."""
        target, patience = torch.zeros(2, n_lanes, dtype=torch.int64, device=device).unbind()
        return arrdict(target=target, patience=patience)

    def __call__(
        self,
        world: Mapping,
        state: Mapping,
        sample: bool = True,
        generator: torch.Generator | None = None,
    ) -> tuple[arrdict, arrdict]:
        """Returns (arrdict(actions (n, 1)), next state)."""
        pose = self.steering.pose()
        return self._act(world, state, pose, self.steering.near(pose), generator)

    def _act(self, world, state, pose, near, generator) -> tuple[arrdict, arrdict]:
        raise NotImplementedError

    def _sees(self, lengths, away, bearing) -> torch.Tensor:
        """Returns whether places are in view, (n, K) bool, at `lengths` of the way there, `away`
        metres straight and degrees from the heading: the way is straight.
        """
        is_straight = (lengths < BENT[0] * away + BENT[1]) & (away < SIGHT)
        off = (bearing[..., None] - self.steering.core.agents.yaws + 180) % 360 - 180
        return is_straight & (off.abs() < self.steering.core.fov / 2).any(-1)
