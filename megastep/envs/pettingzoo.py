"""PettingZoo: N copies of any parallel environment of PettingZoo, whose A agents are lanes.

They step on the CPU, one after the other, even if the learner is on a GPU. B = N A lanes.
"""

from typing import Annotated, Any

import torch
from pydantic import Field

from megastep.hosting.vectorized import VectorizedEnv, one_sentence
from megastep.imports import import_object
from megastep.settings import checked

__all__ = ["PettingZoo"]

INSTALL = "pip install 'megastep-flatland[gymnasium]'"


class PettingZoo(VectorizedEnv):
    """Any parallel environment of PettingZoo whose agents have the same spaces.

    Spaces are those of :class:`~megastep.envs.gymnasium.Gymnasium`, for each agent. One that is not
    there has its last observation and the reward 0, and begins anew in each step without learning,
    until no agent is left and the environment is reset. There are no metrics.

    Args:
        n_envs: number of environments, N.
        id: import path of the function that makes one, such as
            ``pettingzoo.sisl.multiwalker_v9:parallel_env``.
        kwargs: arguments of that function.
        wrappers: import paths of PettingZoo's parallel wrappers, ``package.module:Wrapper``, put
            around every environment in this order.
        seed: each environment is reset with a seed of its own, which derives from this one.
        check: as for Gymnasium.
        device: where worlds and actions are. Default: a GPU if there is one.
    """

    @checked
    def __init__(
        self,
        n_envs: Annotated[int, Field(ge=1, le=2**16)] = 16,
        *,
        id: str | None = None,
        kwargs: dict[str, Any] | None = None,
        wrappers: tuple[str, ...] = (),
        seed: int = 1,
        check: bool = True,
        device: torch.device | str | None = None,
    ):
        if id is None:
            raise ValueError(
                "env.id is missing; name a function that makes an environment, such as "
                "env.id=pettingzoo.sisl.multiwalker_v9:parallel_env"
            )
        try:
            from megastep.hosting.hosted import ParallelEnvs
        except ImportError:
            raise ValueError(f"Gymnasium is not installed: {INSTALL}") from None
        make, functions = import_object(id), [import_object(name) for name in wrappers]
        with one_sentence(id, kwargs):
            vector = ParallelEnvs(make, n_envs, kwargs or {}, functions)
        super().__init__(id, vector, n_envs, len(vector.agents), seed, device, check)
