"""Deathmatch: the environment, its step as one operation (with its kernel), and a scripted bot."""

from megastep.envs.deathmatch.bot import Bot as Bot
from megastep.envs.deathmatch.env import Deathmatch

__all__ = ["Deathmatch"]
