"""Small environments that a page can play, each with short episodes."""

import torch

from megastep import envs, geometries, modules, scene

__all__ = ["ENVS", "made"]


def pushing(geometries, **settings):
    """Explorer with crates, balls and a ramp that the agent pushes, or drives up."""
    geometries = scene.spread(geometries, settings["n_envs"])
    env = envs.Explorer(geometries=geometries, **settings)
    crate, ball = modules.Crate(6, 0.3, movable=True, width=0.2), modules.Disc(6, movable=True)
    kinds = {"crate": crate, "ball": ball, "ramp": modules.Ramp(4, 0.3, 0.3)}
    for kind in modules.Objects(geometries, env.core, kinds).kinds.values():
        kind.place(torch.ones(env.n_envs, dtype=torch.bool))
    return env


ENVS = {
    "explorer": (envs.Explorer, dict(n_envs=1, patience=20, resample=True, privileged=True)),
    "cameras": (
        envs.Explorer,
        dict(n_envs=2, patience=9, cameras=[0, 120], control="continuous", resample=True),
    ),
    "pointgoal": (envs.PointGoal, dict(n_envs=1, limit=30, resample=True)),
    "deathmatch": (
        envs.Deathmatch,
        dict(
            **dict(n_envs=1, n_agents=3, limit=25, damage=0.3, resample=True),
            **dict(search_reward=0.5, aim_reward=3.0, hearing=20.0, res=64),
        ),
    ),
    "pong": (envs.Pong, dict(n_envs=1, self_play=True)),
    "pixels": (envs.Pong, dict(n_envs=2, pixels=True)),
    "minatar": (envs.MinAtar, dict(n_envs=1, id="seaquest", limit=30)),
    "minigrid": (envs.MiniGrid, dict(n_envs=2, id="MiniGrid-KeyCorridorS3R1-v0")),
    "memory": (envs.Memory, dict(n_envs=1, limit=30, resample=True)),
    "keys": (envs.Keys, dict(n_envs=1, limit=30, resample=True)),
    "hideandseek": (envs.HideAndSeek, dict(n_envs=1, limit=30, variant="homes", resample=True)),
    "pushing": (pushing, dict(n_envs=1, patience=20)),
}


def made(name, **changes):
    """Returns an environment by its name here, always with the same seed and homes."""
    kind, settings = ENVS[name]
    if kind not in (envs.Pong, envs.MinAtar, envs.MiniGrid):
        changes = dict(geometries=geometries.sample("homes", 3, seed=7), **changes)
    return kind(**{**settings, "device": "cpu", "seed": 3, **changes})
