"""Pong: the environment, its scripted bot, and its step as one operation (with its kernel)."""

from megastep.envs.pong.bot import Tracker as Tracker
from megastep.envs.pong.env import Pong

__all__ = ["Pong"]
