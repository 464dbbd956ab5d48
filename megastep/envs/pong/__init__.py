"""Pong: the environment, its step as one operation with its kernel, and a scripted policy."""

from megastep.envs.pong.pong import Pong, PongStep, pong_step
from megastep.envs.pong.tracker import Tracker

__all__ = ["Pong", "PongStep", "Tracker", "pong_step"]
