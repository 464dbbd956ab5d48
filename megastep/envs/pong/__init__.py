"""Pong: the environment, with the kernel of its step, and a scripted policy."""

from megastep.envs.pong.pong import Pong
from megastep.envs.pong.tracker import Tracker

__all__ = ["Pong", "Tracker"]
