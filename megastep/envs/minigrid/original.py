"""The original MiniGrid with the observations of ours, so that agents play both."""

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from megastep.envs.minigrid.tasks import LIBRARY, TASKS

VIEW, N_MISSION = LIBRARY.constants["VIEW"], LIBRARY.constants["N_MISSION"]
COLOURS = "red", "green", "blue", "purple", "yellow", "grey"
KINDS = "key", "ball", "box"


class AsHere(gymnasium.Wrapper):
    """Gives a task of the original the observations of `envs.MiniGrid` with the same id, and
    ``success`` in ``info``: ``env.wrappers=[megastep.envs.minigrid.original:AsHere]``.
    """

    def __init__(self, env: gymnasium.Env):
        super().__init__(env)
        image = spaces.Box(0, 10, (3, VIEW, VIEW), np.uint8)
        image.is_image = True  # pyright: ignore[reportAttributeAccessIssue]
        leaves: dict[str, spaces.Space] = dict(image=image, direction=spaces.Discrete(4))
        assert env.unwrapped.spec is not None
        self.has_mission = TASKS[env.unwrapped.spec.id].has_mission
        if self.has_mission:
            leaves["mission"] = spaces.Box(0.0, 1.0, (N_MISSION,), np.float32)
        self.observation_space = spaces.Dict(leaves)

    def reset(self, **options: Any) -> tuple[dict, dict]:
        obs, info = self.env.reset(**options)
        return as_here(obs, self.has_mission), info | {"success": 0.0}

    def step(self, action: Any) -> tuple[dict, Any, bool, bool, dict]:
        obs, reward, terminated, truncated, info = self.env.step(action)
        success = float(terminated and float(reward) > 0)
        obs = as_here(obs, self.has_mission)
        return obs, reward, terminated, truncated, info | {"success": success}


def as_here(obs: Mapping, has_mission: bool) -> dict[str, Any]:
    """Returns an observation of the original as ours: ``image`` (3, 7, 7), ``direction``, and
    ``mission`` (18,) if the task has missions.
    """
    image = np.ascontiguousarray(obs["image"].transpose(2, 1, 0))
    ours = dict(image=image, direction=obs["direction"])
    return ours | ({"mission": mission_of(obs["mission"])} if has_mission else {})


def mission_of(text: str) -> np.ndarray:
    """Returns a mission's one-hot colours and kinds, (18,) float32."""
    words, row = text.split(), np.zeros(N_MISSION, np.float32)
    places = [i for i, word in enumerate(words) if word in COLOURS]
    for part, place in enumerate(places):
        row[9 * part + COLOURS.index(words[place])] = 1
        if words[place + 1] in KINDS:
            row[9 * part + 6 + KINDS.index(words[place + 1])] = 1
    return row
