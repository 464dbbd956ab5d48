"""Deathmatch: agents in one home hit whoever stands in the middle of their view.

N environments of A agents, each a lane, so B = N A.
"""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import torch
from pydantic import Field

from megastep import engine, modules, plotting, spaces
from megastep import geometries as sources
from megastep.arrdict import arrdict
from megastep.core import Core
from megastep.dotdict import dotdict
from megastep.envs.common import SceneryEnv
from megastep.envs.deathmatch.step import MAX_AGENTS, deathmatch_step
from megastep.scene import scenery
from megastep.settings import MAX_ENVS, checked

__all__ = ["Deathmatch"]

METRICS = "kills", "deaths", "damage", "accuracy"
MIN_SPAWNS = 128  # points per layout, as many as other environments have
SPAWNS = 16  # points per agent at least, to find one out of sight

Share = Annotated[float, Field(ge=0, le=1)]
Price = Annotated[float, Field(ge=-1000, le=1000)]


class Deathmatch(SceneryEnv):
    """A reward of 1 for each step with another agent in the middle of the view, a hit, and -1 for
    each hit by another, a wound.

    Observation: RGB and depth of 128 pixels over 70 degrees, each the mean of 4 rays; IMU; and
    ``health``, three numbers: health from 1 to 0, whether the last step hit somebody, how many hit
    the agent. All are fp16. Agents have saturated colours of their own and a red front; walls are
    paler. Seven actions, with momentum; there is no trigger.

    Terminal at death, when no health is left; the agent respawns at the next step, out of the
    others' sight where it can. Truncated after ``limit`` steps. On its first observation an agent
    neither hits nor is hit. Metrics: ``kills``, shared among those who hit last, ``deaths``,
    ``damage``, health taken from others, and ``accuracy``, the share of steps that hit.

    Args: ``geometries`` to live in, generated homes by default; ``n_agents`` per home. Of health,
    1 in all, ``damage`` is what a hit takes, ``spoils`` what it gives whoever scored it,
    ``recovery`` what a second without a wound gives back, ``drain`` what any second takes. A reward
    adds up ``hit_reward`` per hit, ``-wound_cost`` per wound, ``kill_reward`` per kill,
    ``-death_cost`` at death, ``aim_reward`` for another agent in the middle of the view, which
    falls to 0 at its edge, and ``search_reward`` per 64 texels of the walls that the agent sees for
    the first time in its episode, as Explorer pays. ``res`` rays and ``subsample`` rays per pixel;
    ``fov`` degrees; ``fps`` steps per second; ``privileged``: worlds also tell a critic everyone's
    health and place.
    """

    @checked
    def __init__(
        self,
        n_envs: Annotated[int, Field(ge=1, le=MAX_ENVS)] = 128,
        geometries: Sequence[Any] | None = None,
        *,
        n_agents: Annotated[int, Field(ge=2, le=MAX_AGENTS)] = 4,
        seed: int = 1,
        device: torch.device | str | None = None,
        damage: Share = 0.1,
        recovery: Share = 0.0,
        drain: Share = 0.0,
        spoils: Share = 0.0,
        limit: Annotated[int, Field(ge=1, le=10**6)] = 500,
        hit_reward: Price = 1.0,
        wound_cost: Price = 1.0,
        kill_reward: Price = 0.0,
        death_cost: Price = 0.0,
        aim_reward: Price = 0.0,
        search_reward: Price = 0.0,
        res: Annotated[int, Field(ge=1, le=1024)] = 512,
        subsample: Annotated[int, Field(ge=1, le=32)] = 4,
        fov: Annotated[float, Field(gt=0, lt=180)] = 70.0,
        fps: Annotated[float, Field(ge=1, le=1000)] = 10.0,
        privileged: bool = False,
    ):
        if geometries is None:
            geometries = sources.sample("homes", min(n_envs, 512), seed=seed)
        geometries = geometries[:n_envs]
        made = scenery(geometries, n_agents, n_envs=n_envs, seed=seed, device=device)
        self.core = Core(made, res, fov, fps, seed=seed)
        self.n_envs, self.n_agents = n_envs, n_agents
        self.device, self.fps, self.subsample = self.core.device, self.core.fps, subsample
        self.spawner = modules.RandomSpawns(
            geometries, self.core, max(MIN_SPAWNS, SPAWNS * n_agents), hidden=True
        )
        self.movement = modules.MomentumMovement(self.core)
        pixels, told = res // subsample, 1 + 5 * (n_agents - 1)
        self.obs_space = dotdict(
            rgb=spaces.MultiImage(1, 3, 1, pixels),
            d=spaces.MultiImage(1, 1, 1, pixels),
            imu=spaces.MultiVector(1, 3),
            health=spaces.MultiVector(1, 3),
        )
        self.action_space = spaces.MultiDiscrete(1, len(modules.MOVES))
        self.privileged_space = spaces.MultiVector(1, told) if privileged else None
        self.rules = dict(
            damage=damage,
            recovery=recovery / fps,
            drain=drain / fps,
            spoils=spoils,
            limit=limit,
            hit_reward=hit_reward,
            wound_cost=wound_cost,
            kill_reward=kill_reward,
            death_cost=death_cost,
            aim_reward=aim_reward,
        )
        words = -(-made.layouts.max_texels // 32) if search_reward else 0
        each = 8 * pixels + 4 * told * privileged + 4 * words + 128
        engine.fit(n_envs, n_agents * each, self.device)
        self.search_reward, self.seen = search_reward, None
        if search_reward:
            on = dict(dtype=torch.int32, device=self.device)
            self.seen = torch.zeros((n_envs, n_agents, words), **on)
        n_lanes, on = n_envs * n_agents, dict(device=self.device)
        self.health = torch.ones(n_lanes, **on)
        self.tally = torch.zeros((3, n_lanes), **on)
        self.ages = torch.zeros(n_lanes, dtype=torch.int32, **on)
        self.ended = torch.zeros(n_lanes, dtype=torch.bool, **on)

    def reset(self) -> arrdict:
        """Starts every episode anew. Returns a world."""
        self.ended.fill_(True)
        return self._world()

    def step(self, decision: Mapping) -> arrdict:
        """One step by ``decision.actions`` (B, 1). Returns a world."""
        actions = decision["actions"].masked_fill(self.ended[:, None], 0)
        self.movement(dict(actions=actions))
        return self._world()

    def _world(self):
        """Respawns who ended an episode, looks, and shoots."""
        self.spawner(self.ended)
        view = self._view(**self._search())
        shots = deathmatch_step(
            self.core.scenery,
            self.core.agents,
            view,
            self.health,
            self.tally,
            self.ages,
            self.ended,
            told=self.privileged_space is not None,
            **self.rules,
        )
        reward = shots.reward
        if self.seen is not None:
            found = view.newly_seen.flatten() * (self.search_reward / modules.TEXELS_PER_POINT)
            reward = reward + found.masked_fill_(shots.reset, 0.0)
        world = arrdict(
            obs=arrdict(self._shown(view), health=shots.vitals),
            reward=reward,
            reset=shots.reset,
            terminal=shots.terminal,
            truncated=shots.truncated,
            metrics=arrdict(zip(METRICS, shots.metrics.unbind())),
        )
        if shots.told is not None:
            world["privileged"] = shots.told
        return world

    def _search(self):
        """What counts the texels that are seen for the first time, if they are paid for."""
        if self.seen is None:
            return {}
        starts = self.ended.view(self.n_envs, self.n_agents)
        return dict(seen=self.seen, clear_mask=starts)

    def _view(self, **search):
        return engine.observe(
            self.core.scenery,
            self.core.agents,
            self.subsample,
            imu=True,
            centre_line=True,
            agent_ray=self.rules["aim_reward"] != 0,
            **search,
        )

    def _shown(self, view):
        """What of a view each lane is shown, (B, 1, ...)."""
        lanes = self.n_envs * self.n_agents
        return arrdict(
            rgb=view.rgb.view(lanes, *self.obs_space.rgb.shape),
            d=view.depth.view(lanes, *self.obs_space.d.shape),
            imu=view.imu.view(lanes, 1, 3),
        )

    def state(self, e: int = 0) -> arrdict:
        """What :meth:`plot_state` draws of environment ``e``, (A, ...) each; ``target`` is the
        agent in the middle of another's view, or -1, and ``kills`` those of the episodes under way.
        """
        lanes = slice(e * self.n_agents, (e + 1) * self.n_agents)
        view, n_model = self._view(), len(self.core.scenery.model)
        line = view.centre_line[e]
        is_agent = (line >= 0) & (line < self.n_agents * n_model)
        shown = self._shown(view)
        return arrdict(
            core=self.core.state(e),
            rgb=shown.rgb[lanes, 0],
            d=shown.d[lanes, 0],
            health=self.health[lanes].clone(),
            kills=self.tally[0, lanes].clone(),
            age=self.ages[lanes].clone(),
            target=torch.where(is_agent, line // n_model, -1),
        )

    @classmethod
    def plot_state(cls, state: arrdict) -> Any:
        """A matplotlib figure of a numpyified :meth:`state`: the plan, with a line to whoever is in
        the middle of a view, and beside it each agent's health and what it sees.
        """
        title = f"step {state.age.max()}, {state.kills.sum():.3g} kills"
        figure, plan, rows = plotting.panels_beside(len(state.health), 2, title=title)
        Core.plot_state(state.core, plan)
        for agent, target in enumerate(state.target):
            if target >= 0:
                plan.plot(*state.core.positions[[agent, target]].T, color="r", linewidth=1)
        for agent, (colour, depth) in enumerate(rows):
            modules.RGB.plot_state(state.rgb[agent : agent + 1], [colour])
            modules.Depth.plot_state(state.d[agent : agent + 1], [depth])
            told = f"{agent}: health {state.health[agent]:.2f}, step {state.age[agent]}"
            colour.set_title(told, fontsize="small", loc="left", pad=7)
            depth.set_title("", loc="left")
            for strip in (colour, depth):
                strip.set(xlabel="", xticks=[], box_aspect=None)
            plotting.plot_level(colour, state.health[agent])
        return figure
