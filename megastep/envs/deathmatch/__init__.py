"""Deathmatch: the environment, with the kernel of its step, and a scripted bot."""

from megastep.envs.deathmatch.bot import Bot
from megastep.envs.deathmatch.deathmatch import Deathmatch

__all__ = ["Deathmatch", "Bot"]
