"""Deathmatch: the environment, its step as one operation with its kernel, and a scripted bot."""

from megastep.envs.deathmatch.bot import Bot
from megastep.envs.deathmatch.deathmatch import Deathmatch
from megastep.envs.deathmatch.deathmatch_step import (
    DeathmatchStep,
    actions_of_live,
    deathmatch_step,
)

__all__ = ["Deathmatch", "Bot", "DeathmatchStep", "actions_of_live", "deathmatch_step"]
