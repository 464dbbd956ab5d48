"""Bots that walk along shortest paths, that explore, and that hunt, or run from who hunts.

n lanes, A agents per environment, L landmarks per plan, R agents of other teams.
"""

import math
from typing import Any

import torch

from megastep.agents.selfplay.bots.plans import BLOCKED
from megastep.agents.selfplay.bots.steering import HORIZON, SIGHT, SLACK, Pose, SteeredBot, Steering
from megastep.agents.selfplay.mixed_policy import teams_of
from megastep.arrdict import arrdict

ARRIVED = 0.3  # metres
PATIENCE, PER_METRE = 20, 20  # steps after which it gives up a target, and more per metre
NEAR = 0.4  # metres to which a landmark is seen without looking
AROUND = 0.01  # metres that a degree away from the heading is worth in choosing where to go
EXPLORER_PATIENCE = 15  # PATIENCE and PER_METRE of an Explorer

# of a Hunter
BEHIND = 0.3  # metres by which the wall that a pixel shows may be nearer than the agent there
LEAD = 0.1  # seconds by which it aims ahead of where an agent is
APART = 1.0  # metres to which it approaches an agent
HALF_WIDTH = 0.06  # metres beside the middle of an agent that it aims at
AIMING = 4.0  # how much aiming counts beside walking
FINE, STEP = 3.0, 0.1  # degrees off within which it turns for the next step, in seconds
SEARCHED = 3.0  # metres of floor around an agent lost from sight that it searches again
CHASE = 60  # steps that it goes after an agent lost from sight

# of a Runner
UNSEEN = 20.0  # metres of a lead that it is worth that no hunter sees a landmark
COST = 0.3  # metres of a lead that a metre of the way is worth
LINE = 64  # points of a line of sight: no wall is missed on 9 m


class Walker(SteeredBot):
    """Walks along shortest paths: to the goals of PointGoal, elsewhere to one landmark after the
    other, drawn at random. It knows the floor plans, its pose and the goals.
    """

    goal_index = None

    def __init__(self, env: Any):
        if hasattr(env, "goal_index"):
            self.goal_index, self.steering = env.goal_index, Steering(env, env.goals.points)
        else:
            super().__init__(env)

    def _act(self, world, state, pose, near, generator) -> tuple[arrdict, arrdict]:
        steering, patience, target = self.steering, state["patience"] - 1, state["target"]
        if self.goal_index is not None:
            target = self.goal_index[steering.lanes].long()
        else:
            goal = steering.plans.targets[pose.plan, target]
            is_over = (goal - pose.position).norm(dim=-1) < ARRIVED
            is_over |= world["reset"] | (patience <= 0)
            lengths = steering.lengths(near)
            draws = torch.rand(lengths.shape, generator=generator, device=target.device)
            drawn = (draws * lengths.isfinite()).argmax(1)
            steps = PATIENCE + PER_METRE * lengths.gather(1, drawn[:, None])[:, 0].clamp(max=1e3)
            target = torch.where(is_over, drawn, target)
            patience = torch.where(is_over, steps.long(), patience)
        aim = steering.aim(pose, near, target)
        decision = steering.decide(pose, aim, aim, turning=0.0)
        return decision, arrdict(target=target, patience=patience)


class Explorer(SteeredBot):
    """Explores by frontiers (Yamauchi, "A frontier-based approach for autonomous exploration",
    1997): goes to the nearest floor that it has not seen in the episode, over floor that it has.

    It knows its pose, and how long the way over floor is that it has seen. Once everything is seen,
    it begins anew. It sees floor to which the way is straight, in its field of view.
    """

    def initial(self, n_lanes: int, device: torch.device | str | None = None) -> arrdict:
        """Returns that of any bot, and landmarks `seen` (n, L) bool."""
        n_landmarks = self.steering.plans.targets.shape[1]
        seen = torch.zeros(n_lanes, n_landmarks, dtype=torch.bool, device=device)
        return arrdict(seen=seen, **super().initial(n_lanes, device))

    def _act(self, world, state, pose, near, generator) -> tuple[arrdict, arrdict]:
        state = self._explore(world["reset"], state, pose, near)
        aim = self.steering.aim(pose, near, state["target"])
        return self.steering.decide(pose, aim, aim), state

    def _explore(self, reset, state, pose, near) -> arrdict:
        """Returns the next state, with where to go."""
        plans, lengths = self.steering.plans, self.steering.lengths(near)
        offsets = plans.targets[pose.plan] - pose.position[:, None]
        away = offsets.norm(dim=-1)
        bearing = self.steering.bearings(pose, offsets)
        seen = (
            (state["seen"] & ~reset[:, None]) | self._sees(lengths, away, bearing) | (away < NEAR)
        )
        target, patience = state["target"][:, None], state["patience"] - 1
        seen = seen.scatter(1, target, seen.gather(1, target) | (patience <= 0)[:, None])
        reached = lengths.isfinite()
        seen &= (reached & ~seen).any(1, True)  # when all is seen, it forgets
        is_over = reset | seen.gather(1, target)[:, 0]
        costs = torch.where(reached & ~seen, lengths + AROUND * bearing.abs(), torch.inf)
        nearest = costs.argmin(1)
        length = lengths.gather(1, nearest[:, None])[:, 0].clamp(max=1e3)
        steps = EXPLORER_PATIENCE + EXPLORER_PATIENCE * length
        return arrdict(
            seen=seen,
            target=torch.where(is_over, nearest, target[:, 0]),
            patience=torch.where(is_over, steps.long(), patience),
        )


class Hunter(Explorer):
    """Explores until it sees an agent of another team, then aims at it and approaches. It searches
    around where it lost one from sight. If it observes its health, it turns to the nearest when it
    is hit.

    It knows what an `Explorer` knows, and the pose and velocity of the agents that it sees. Agents
    of one of several `roles` are a team, in Deathmatch everybody is.
    """

    def __init__(self, env: Any):
        super().__init__(env)
        if "d" not in {*env.obs_space} or env.n_agents < 2:
            raise ValueError("it hunts others by the observation d, as Deathmatch has them")
        teams = teams_of(env)
        rivals = [(teams != team).nonzero()[:, 0].tolist() for team in teams]
        most = max(map(len, rivals))  # smaller teams' last ones are repeated
        rivals = [(part * most)[:most] for part in rivals]
        self.rivals = torch.tensor(rivals, device=env.device)  # (A, R) of each agent

    def _act(self, world, state, pose, near, generator) -> tuple[arrdict, arrdict]:
        steering, obs = self.steering, world["obs"]
        state = self._explore(world["reset"], state, pose, near)
        other, sees = self._nearest(pose, obs["d"])
        # where to search for the other once it is lost from sight
        lengths = steering.lengths(steering.near(other))
        around = (lengths < SEARCHED) & sees[:, None]
        state = arrdict(
            seen=state["seen"] & ~around,
            target=torch.where(sees, lengths.argmin(1), state["target"]),
            patience=torch.where(sees, CHASE, state["patience"]),
        )
        fights = sees[:, None]
        if "health" in obs:
            fights = fights | (obs["health"][:, 0, 2:] > 0)
        away = (other.position - pose.position).norm(dim=-1, keepdim=True)
        aim = steering.aim(pose, near, state["target"])
        aim = torch.where(fights & (away < APART), pose.position, aim)
        gaze = other.position + LEAD * (other.velocity - pose.velocity)
        off = steering.bearings(pose, (gaze - pose.position)[:, None]).abs()
        slack = torch.rad2deg(torch.atan(HALF_WIDTH / away.clamp(min=0.1)))
        decision = steering.decide(
            pose,
            aim,
            torch.where(fights, gaze, aim),
            turning=torch.where(fights, AIMING, 1.0),
            slack=torch.where(fights, slack, SLACK),
            horizon=torch.where(fights & (off < FINE), STEP, HORIZON),
        )
        return decision, state

    def _nearest(self, pose: Pose, depth: torch.Tensor) -> tuple[Pose, torch.Tensor]:
        """Of those in view first; and whether it is in view (n,)."""
        steering = self.steering
        core, n_pixels = steering.core, depth.shape[-1]
        others = self._rivals()
        offsets = core.agents.positions.view(-1, 2)[others] - pose.position[:, None]
        away, bearing = offsets.norm(dim=-1), steering.bearings(pose, offsets)
        sideways = torch.tan(torch.deg2rad(bearing)) / math.tan(math.radians(core.fov / 2))
        pixel = (0.5 * n_pixels * (1 - sideways)).clamp(0, n_pixels - 1).long()
        depth = depth.reshape(len(depth), -1)
        wall = core.agents.radius + SIGHT * (1 - depth.gather(1, pixel))
        sees = (bearing.abs() < core.fov / 2) & (away < SIGHT) & (wall > away - BEHIND)
        sees &= depth.any(1, True)  # it is not blind
        nearest = torch.where(sees, away, away + 1e3).argmin(1, True)
        return steering.pose(others.gather(1, nearest)[:, 0]), sees.any(1)

    def _rivals(self) -> torch.Tensor:
        """Returns the lanes (n, R) of the agents of other teams, for each of its own."""
        lanes, n_agents = self.steering.lanes[:, None], self.steering.core.n_agents
        return lanes - lanes % n_agents + self.rivals[self.steering.lanes % n_agents]


class Runner(Hunter):
    """Plays both sides of hide and seek: a hider runs, a seeker is a `Hunter`.

    A hider that a straight way leads to from a seeker runs to a landmark that no way leads straight
    to, preferring those that it reaches before any seeker. There it stays. It knows the poses of
    all seekers; bodies are in its way as in anybody's.
    """

    def __init__(self, env: Any):
        super().__init__(env)
        if not hasattr(env, "is_hider"):
            raise ValueError(f"env.is_hider says who runs, and {type(env).__name__} has none")
        self.is_hider = env.is_hider

    def _act(self, world, state, pose, near, generator) -> tuple[arrdict, arrdict]:
        steering, plans = self.steering, self.steering.plans
        hunting, hunts = super()._act(world, state, pose, near, generator)
        goals, own = plans.targets[pose.plan], steering.lengths(near)
        theirs, watched = torch.full_like(own, torch.inf), torch.zeros_like(own, dtype=torch.bool)
        found = torch.zeros_like(world["reset"])
        for rivals in self._rivals().unbind(1):
            other = steering.pose(rivals)
            theirs = theirs.minimum(steering.lengths(steering.near(other)))
            ends = torch.cat([goals, pose.position[:, None]], 1)
            is_clear = plans.straight(pose.plan, other.position, ends, LINE) < BLOCKED
            watched, found = watched | is_clear[:, :-1], found | is_clear[:, -1]
        target, patience = state["target"][:, None], state["patience"] - 1
        lead = (theirs - own).clamp(-UNSEEN, UNSEEN / 4) - COST * own
        value = torch.where(own.isfinite(), lead - UNSEEN * watched, -torch.inf)
        is_late = (patience <= 0)[:, None]  # something is in the way
        best = value.scatter(1, target, value.gather(1, target) - 1e3 * is_late).argmax(1)
        is_over = world["reset"] | (found & watched.gather(1, target)[:, 0]) | is_late[:, 0]
        goal = goals.gather(1, target[..., None].expand(-1, 1, 2))[:, 0]
        has_arrived = (goal - pose.position).norm(dim=-1) < ARRIVED
        best = torch.where(is_over, best, target[:, 0])
        steps = (PATIENCE + PER_METRE * own.gather(1, best[:, None])[:, 0].clamp(max=1e3)).long()
        runs = arrdict(
            state, target=best, patience=torch.where(is_over | has_arrived, steps, patience)
        )
        aim = torch.where(has_arrived[:, None], pose.position, steering.aim(pose, near, best))
        running = steering.decide(pose, aim, aim, turning=0.0)
        is_hider = self.is_hider[steering.lanes % steering.core.n_agents]

        def chosen(a, b) -> torch.Tensor:
            return torch.where(is_hider.view(-1, *[1] * (a.ndim - 1)), a, b)

        actions = chosen(running["actions"], hunting["actions"])
        return arrdict(actions=actions), arrdict(
            {key: chosen(runs[key], hunts[key]) for key in hunts}
        )
