"""Deathmatch: agents in one home hit whoever is at the centre of their view.

N environments of A agents. Each agent is a lane: B = N A.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated

import torch
from pydantic import Field

from megastep import engine, modules, plotting, spaces
from megastep.arrdict import arrdict
from megastep.coefficients import Coefficients
from megastep.core import Core
from megastep.devices import threads
from megastep.engine import checks
from megastep.engine.launch_params import state_params
from megastep.envs.common import step_outputs, world_of
from megastep.envs.deathmatch.bot import LIBRARY, Bot
from megastep.envs.first_person import FirstPerson, images
from megastep.kernels.build.launch import launch
from megastep.schedules import Number, Scheduled
from megastep.settings import MAX_ENVS, checked
from megastep.types import Geometries

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Deathmatch", "Bot"]

METRICS = "kills", "deaths", "damage", "accuracy"
MIN_SPAWNS = 128  # spawn points per layout, as in other environments
MAX_AGENTS = LIBRARY.constants["MAX_AGENTS"]  # per environment
#: Rows of ``tally``: kills, damage and hits of the episode so far; aim in the last step.
TALLY_ROWS = LIBRARY.constants["TALLY_ROWS"]
SPAWNS_PER_AGENT = 16  # at least, so that one is likely hidden from the other agents

Fraction = Annotated[float, Field(ge=0, le=1)]
Reward = Annotated[float, Field(ge=-1000, le=1000)]
ScheduledReward = Annotated[Number, Scheduled(ge=-1000, le=1000)]


class Deathmatch(FirstPerson):
    """Agents in one home hit each other by looking at each other.

    In each step, an agent hits whoever is at the centre of its view; there is no trigger. A hit
    costs the target health. An agent on its first observation neither hits nor is hit. Agents whose
    episode ended respawn in the next step, out of the other agents' sight if possible.

    Observation:
        A dict of float16, W = ``res / subsample`` pixels (128).

        - ``rgb``: (B, 1, 3, 1, W), linear light. A pixel is the mean of ``subsample`` rays. Agents
          have saturated colours and a red front; walls are paler.
        - ``d``: (B, 1, 1, 1, W), depth: 1 at the agent's edge, 0 at 10 m and beyond.
        - ``imu``: (B, 1, 3), angular velocity / 360 deg/s, velocity forward and left / 10 m/s.
        - ``health``: (B, 1, 3), the agent's health from 0 to 1, whether it hit another agent in the
          last step, how many agents hit it.
        - ``sound``: (B, 1, 3), if ``hearing`` is not 0: the loudness of the nearest other agent, 1
          where it is and 0 at ``hearing`` metres and beyond, and the cosine and sine of its
          bearing, left positive. Walls do not muffle it.

    Actions:
        (B, 1) integers: 0 nothing, 1 left, 2 right, 3 forward, 4 back, 5 turn left, 6 turn right.
        They accelerate the agent (:class:`~megastep.modules.MomentumMovement`).

    Reward:
        The sum of the rewards and costs below; by default hits - wounds.

    Episode end:
        Terminal at health 0, for that agent alone. Truncated after ``limit`` steps.

    Metrics:
        ``kills``: kills, each shared among the agents that hit the target in its last step.
        ``deaths``: 1 if the episode ended by death, else 0.
        ``damage``: health taken from others.
        ``accuracy``: fraction of steps with a hit.

    Args:
        n_agents: agents per environment.
        damage: health that a hit costs its target.
        recovery: health regained per second without a wound.
        drain: health lost per second.
        health_per_hit: health gained by an agent that hits.
        limit: steps after which an episode is truncated.
        hit_reward: reward per hit, a step with another agent at the middle ray of the view. As the
            next four it is a number or a schedule.
        wound_cost: cost per wound, a hit received.
        kill_reward: reward per kill.
        death_cost: cost of a death, also of one by drain.
        aim_reward: reward for bringing another agent from the edge of the view to its centre. What
            an agent gains as its target nears the centre, it loses as it leaves, so that watching a
            target without killing it pays nothing (after Ng, Harada and Russell 1999, "Policy
            invariance under reward transformations", but without discount).
        search_reward: reward per 64 wall texels seen for the first time in the episode, as in
            Explorer.
        hearing: metres at which the sound of another agent fades. 0: agents are deaf.
        resample: play in rounds of ``limit`` steps. At their end every episode in the environment
            is truncated, and the next round is in a randomly drawn home. Otherwise an environment
            keeps its own.
        privileged: worlds hold ``privileged`` for a critic: every agent's health and pose.
    """

    bot = Bot

    @checked
    def __init__(
        self,
        n_envs: Annotated[int, Field(ge=1, le=MAX_ENVS)] = 128,
        geometries: Geometries | None = None,
        *,
        n_agents: Annotated[int, Field(ge=2, le=MAX_AGENTS)] = 4,
        seed: int = 1,
        device: torch.device | str | None = None,
        damage: Fraction = 0.1,
        recovery: Fraction = 0.0,
        drain: Fraction = 0.0,
        health_per_hit: Fraction = 0.0,
        limit: Annotated[int, Field(ge=1, le=10**6)] = 500,
        hit_reward: ScheduledReward = 1.0,
        wound_cost: ScheduledReward = 1.0,
        kill_reward: ScheduledReward = 0.0,
        death_cost: ScheduledReward = 0.0,
        aim_reward: ScheduledReward = 0.0,
        search_reward: Reward = 0.0,
        hearing: Annotated[float, Field(ge=0, le=1000)] = 0.0,
        res: Annotated[int, Field(ge=1, le=1024)] = 512,
        subsample: Annotated[int, Field(ge=1, le=32)] = 4,
        fov: Annotated[float, Field(gt=0, lt=180)] = 70.0,
        fps: Annotated[float, Field(ge=1, le=1000)] = 10.0,
        resample: bool = False,
        privileged: bool = False,
    ):
        self.n_agents, self.limit = n_agents, limit
        lens: dict = dict(res=res, subsample=subsample, fov=fov, fps=fps)
        super().__init__(n_envs, geometries, seed=seed, device=device, resample=resample, **lens)
        n_privileged = 1 + LIBRARY.constants["PRIVILEGED_PER_OPPONENT"] * (n_agents - 1)
        self.obs_space["health"] = spaces.MultiVector(1, 3, low=0, high=(1, 1, n_agents - 1))
        if hearing:
            self.obs_space["sound"] = spaces.MultiVector(1, 3, low=(0, -1, -1), high=1)
        self.action_space = spaces.MultiDiscrete(1, len(modules.MOVES))
        self.privileged_space = spaces.MultiVector(1, n_privileged) if privileged else None
        self.rules: dict = dict(
            damage=damage,
            recovery=recovery / fps,
            drain=drain / fps,
            health_per_hit=health_per_hit,
            limit=limit,
            search_reward=search_reward / modules.TEXELS_PER_POINT,
            hearing=hearing,
        )
        self.weights = Coefficients(
            self.device,
            hit_reward=hit_reward,
            wound_cost=wound_cost,
            kill_reward=kill_reward,
            death_cost=death_cost,
            aim_reward=aim_reward,
        )
        self.coefficients, self.has_aim = (self.weights,), aim_reward != 0
        words = -(-self.core.scenery.layouts.max_texels // 32) if search_reward else 0
        bytes_per_lane = 4 * n_privileged * privileged + 4 * words + 64
        engine.fit(n_envs, n_agents * bytes_per_lane, self.device)
        shape = n_envs, n_agents, words
        self.seen = torch.zeros(shape, dtype=torch.int32, device=self.device) if words else None
        self.health = torch.ones_like(self.ages, dtype=torch.float32)
        self.tally = torch.zeros((TALLY_ROWS, n_envs * n_agents), device=self.device)
        # steps of the round, -1 if the next begins one
        self.round_ages = self.ages[::n_agents].clone() if resample else None
        self._resets = engine.Resets(lanes_last=("tally",))

    def _furnish(self, geometries, resample) -> modules.RandomSpawns:
        n_spawns = max(MIN_SPAWNS, SPAWNS_PER_AGENT * self.n_agents)
        return modules.RandomSpawns(geometries, self.core, n_spawns, resample, hidden=True)

    def _begin(self, mask) -> arrdict:
        self.ended.copy_(mask)
        if self.round_ages is not None:  # a round goes on, at its age, unless all agents begin
            begins = mask.view(self.n_envs, -1).all(1)
            self.round_ages.sub_(1).masked_fill_(begins, -1)
        return self._world(damage=0.0, recovery=0.0, drain=0.0, health_per_hit=0.0)

    @property
    def game_over(self) -> torch.Tensor | None:
        """(N,) bool: whether the round ended with the last world; None without rounds."""
        return None if self.round_ages is None else self.round_ages < 0

    def desync(self) -> None:
        """Gives every lane a random age, from the seed, so that episodes do not end together."""
        super().desync()
        if self.round_ages is not None:
            self.round_ages.copy_(self.ages.view(self.n_envs, -1).amax(1))

    def step(self, decision: Mapping) -> arrdict:
        """Takes one step with ``decision.actions`` (B, 1). Returns a world."""
        n_lanes, device = len(self.ended), self.device
        actions = checks.lanes("actions", decision["actions"], n_lanes, device)
        live = torch.empty((n_lanes, 1), dtype=torch.int64, device=device)
        launch(
            *(LIBRARY, "actions_of_live", device, n_lanes),
            actions=actions.reshape(-1).long().contiguous(),
            ended=self.ended,
            out=live,  # 0 where an episode has ended
            n_lanes=n_lanes,
        )
        self.movement(dict(actions=live))
        return self._resets.keep(self._world())

    def _world(self, **rules) -> arrdict:
        """Respawns agents whose episode has ended, renders, and lets the agents hit each other."""
        self.spawner(self.ended)
        search: dict = {}
        if self.seen is not None:  # counts newly seen texels
            search = dict(seen=self.seen, clear_mask=self.ended.view(self.n_envs, self.n_agents))
        view = self._view(centre_line=True, agent_ray=self.has_aim, **search)
        out = self._judge(view, rules)
        obs = arrdict(images(view), health=out["health_obs"])
        if out["sound"] is not None:
            obs["sound"] = out["sound"]
        world = world_of(out, obs, METRICS)
        if out["privileged"] is not None:
            world["privileged"] = out["privileged"]
        return world

    def _judge(self, view, rules) -> dict:
        """Lets each agent hit whoever is at the centre of its view."""
        core, n_privileged = self.core, 0
        if self.privileged_space is not None:
            n_privileged = self.privileged_space.dim
        hears = self.rules["hearing"] > 0
        sizes = dict(health_obs=3, sound=3 * hears), dict(privileged=n_privileged)
        outputs, poses = step_outputs(self, len(METRICS), *sizes), dict(positions=0, angles=0)
        if hears or n_privileged:
            poses = state_params(core.scenery, core.agents, "positions", "angles")
        launch(
            *(LIBRARY, "deathmatch_step", self.device, self.n_envs),
            centre_line=view.centre_line,
            agent_ray=view.agent_ray,
            newly_seen=view.newly_seen,
            **poses,
            health=self.health,
            tally=self.tally,
            ages=self.ages,
            ended=self.ended,
            round_ages=self.round_ages,
            **outputs,
            **self.rules | rules,
            **self.weights.tensors,
            res=core.res,
            n_envs=self.n_envs,
            n_agents=self.n_agents,
            n_model=len(core.scenery.model),
            n_threads=threads(),
        )
        return outputs

    def state(self, e: int = 0) -> arrdict:
        """Returns environment ``e`` for :meth:`plot_state`, (A, ...) each.

        ``target`` is the agent at the centre of each agent's view, or -1. ``kills`` counts the
        current episode's.
        """
        lanes = slice(e * self.n_agents, (e + 1) * self.n_agents)
        view = self._view(self.core.alone(e), centre_line=True)
        n_model = len(self.core.scenery.model)
        assert view.centre_line is not None
        line = view.centre_line[0]
        is_agent = (line >= 0) & (line < self.n_agents * n_model)
        return arrdict(
            images(view).map(lambda leaf: leaf.squeeze(1)),
            core=self.core.state(e),
            health=self.health[lanes].clone(),
            kills=self.tally[0, lanes].clone(),
            age=self.ages[lanes].clone(),
            target=torch.where(is_agent, line // n_model, -1),
        )

    @classmethod
    def plot_state(cls, state: arrdict) -> "Figure":
        """Draws a numpyified :meth:`state`: floor plan, targets, health, RGB and depth."""
        title = f"step {state.age.max()} · kills {state.kills.sum():.3g}"
        agents = range(len(state.health))
        figure, plan, strips = plotting.panels(4 * -(-len(agents) // 2), title=title, columns=2)
        Core.plot_state(state.core, plan)
        colours, positions = plotting.camera_colours(len(agents)), state.core.positions
        for agent, target in enumerate(state.target):
            if target >= 0:
                plotting.plot_shot(plan, positions[agent], positions[target], colours[agent])
        above = [strips[2 * agent - agent % 2] for agent in agents]  # two agents in two rows
        modules.RGB.plot_state(state.rgb, above)
        modules.Depth.plot_state(state.d, [strips[2 * agent - agent % 2 + 2] for agent in agents])
        for strip, health in zip(above, state.health, strict=True):
            plotting.plot_level(strip, health)
        return figure
