"""Runs every operation on small scenery, also with bad indices, for NVIDIA's compute-sanitizer:

for tool in memcheck racecheck initcheck; do
    compute-sanitizer --tool $tool python scripts/sanitize.py
done
"""

import sys
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from megastep import arrdict, core, engine, envs, scene
from megastep.geometries import sample
from megastep.modules import RandomSpawns


def out_of_range(c, spawn):
    """Runs operations with a layout that does not exist. They must set a flag and read nothing."""
    for layout in (-1, 3, 2**31 - 1):
        c.scenery.layout[4] = layout
        for operation in (engine.physics, engine.observe, engine.render):
            operation(c.scenery, c.agents)
        spawn.resample = False
        spawn(c.agent_full(True))
        try:
            engine.check(c.agents)
        except engine.EngineError:
            c.scenery.layout[4] = 0
        else:
            raise AssertionError("a bad layout was not flagged")


def main():
    homes = sample("bench", 3)
    for n_agents, res, cameras in [(1, 63, None), (4, 96, [0, 120, 240])]:
        c = core.Core(
            scene.scenery(homes, n_agents, n_envs=5, device="cuda"), res=res, cameras=cameras
        )
        spawn = RandomSpawns(homes, c, resample=True)
        words = -(-c.scenery.layouts.max_texels // 32)
        seen = torch.zeros((5, n_agents, words), dtype=torch.int32, device="cuda")
        for _ in range(3):
            spawn(c.agent_full(True))
            c.agents.velocity.fill_(3.0)
            engine.physics(c.scenery, c.agents)
            engine.observe(
                c.scenery,
                c.agents,
                3,
                imu=True,
                centre_line=True,
                seen=seen,
                clear_mask=c.agent_full(False),
            )
            engine.render(c.scenery, c.agents)
        out_of_range(c, spawn)
    for env in (envs.Explorer(7, homes, device="cuda"), envs.Minimal(7, homes, device="cuda")):
        env.reset()
        for action in range(7):
            env.step(arrdict.arrdict(actions=torch.full((7, 1), action, device="cuda")))
    for n_agents in (2, 16):
        env = envs.Deathmatch(7, homes, n_agents=n_agents, device="cuda", damage=1, privileged=True)
        env.reset()
        for action in (*range(7), 7) * 5:
            actions = torch.full((7 * n_agents, 1), action, device="cuda")
            env.step(arrdict.arrdict(actions=actions))
    for settings in (dict(), dict(self_play=True), dict(pixels=True, points=2)):
        env = envs.Pong(67, device="cuda", **settings)
        env.reset()
        for action in (*range(3), 7) * 20:
            actions = torch.full((67 * env.n_agents, 1), action, device="cuda")
            env.step(arrdict.arrdict(actions=actions))
    torch.cuda.synchronize()
    print("done")


if __name__ == "__main__":
    main()
