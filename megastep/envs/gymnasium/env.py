"""Gymnasium: N copies of any environment of Gymnasium, one agent each, so B = N lanes.

They step on the CPU, even if the learner is on a GPU.
"""

from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import Field

from megastep.envs.gymnasium.make import vector_env
from megastep.envs.on_host.env import VectorizedEnv
from megastep.settings import checked

__all__ = ["Gymnasium"]

#: Environments that step on the host are counted in hundreds; more is a typing error.
MAX_ENVS = 2**16


class Gymnasium(VectorizedEnv):
    """Any environment of Gymnasium, or of a package that registers its own with it.

    They step on the CPU: one after the other in this process (sync), in worker processes, one per
    core (async), or together, by the environment's own vector class (own).
    With a learner on a GPU, observations and actions cross through pinned memory.

    Observation:
        Box: (B, 1, n) float32, flattened, or an image (B, 1, C, H, W), uint8 or float32, if it has
        8 rows and columns or more and up to 4 channels. Discrete: (B, 1) integers from 0.
        MultiDiscrete: (B, k) integers, or a dict of its numbers if their ranges differ.
        MultiBinary: (B, 1, n) float32. Tuple and Dict: a dict.

    Actions:
        Discrete: (B, 1) integers from 0. MultiDiscrete: (B, k), or a dict if the ranges differ.
        MultiBinary: (B, k), 0 or 1. Box with bounds: (B, 1, n) float32 within them. Tuple and Dict:
        a dict. A mask in ``info["action_mask"]``, a number per action of a Discrete space, becomes
        ``world.mask``: actions with 0 are not taken.

    Reward:
        The environment's own.

    Episode end:
        Terminal and truncated as the environment says. If it says both, terminal.

    Metrics:
        The numbers in the last ``info`` of an episode, such as ``is_success``, at most 16.

    Args:
        n_envs: number of environments, N.
        id: name of the environment, such as CartPole-v1; with a colon, ``package:Name-v0``, of a
            package that is imported first.
        kwargs: arguments of the environment's constructor.
        wrappers: import paths of Gymnasium's wrappers, ``package.module:Wrapper``, put around every
            environment in this order.
        vectorization: how environments are stepped: sync, one after the other in this process;
            async, divided among processes, one per core; own, the environment's own vector
            environment.
        restart_failed: how often each environment is made anew after an error of its own. The
            episode is then truncated. Not with own.
        seed: each environment is reset with a seed of its own, which derives from this one.
        films: renders images from the start, if it can. Some environments make their renderer in
            the constructor, and some step more slowly with it.
        check: refuses, in the first steps of each environment, observations that are not in their
            space and results of another form than Gymnasium's, and at any time actions that are
            not finite. Numbers beyond the bounds of a Box are a warning.
        device: where worlds and actions are. Default: a GPU if there is one.
    """

    @checked
    def __init__(
        self,
        n_envs: Annotated[int, Field(ge=1, le=MAX_ENVS)] = 32,
        *,
        id: str | None = None,
        kwargs: dict[str, Any] | None = None,
        wrappers: tuple[str, ...] = (),
        vectorization: Literal["sync", "async", "own"] = "sync",
        restart_failed: Annotated[int, Field(ge=0, le=1_000_000)] = 0,
        seed: int = 1,
        films: bool = False,
        check: bool = True,
        device: torch.device | str | None = None,
    ):
        vector = vector_env(
            id, n_envs, kwargs or {}, wrappers, vectorization, restart_failed, films, seed, check
        )
        # one seed for each, or one for all
        seeds = np.random.SeedSequence(seed).generate_state(n_envs).tolist()
        seeds = seeds[0] if vectorization == "own" else seeds
        super().__init__(id, vector, n_envs, 1, seeds, device, check)
