"""Wrappers around any environment, on its device: `env.wrappers=[sticky_actions]`."""

from megastep.wrappers.actions import ActionRepeat, StickyActions, TimeLimit
from megastep.wrappers.base import Wrapper
from megastep.wrappers.worlds import (
    ClipReward,
    FrameStack,
    NoisySensor,
    ScaleReward,
    ShapeReward,
)

__all__ = [
    "WRAPPERS",
    "ActionRepeat",
    "ClipReward",
    "FrameStack",
    "NoisySensor",
    "ScaleReward",
    "ShapeReward",
    "StickyActions",
    "TimeLimit",
    "Wrapper",
]

#: Wrappers by their names in settings.
WRAPPERS = {
    "action_repeat": ActionRepeat,
    "clip_reward": ClipReward,
    "frame_stack": FrameStack,
    "noisy_sensor": NoisySensor,
    "scale_reward": ScaleReward,
    "shape_reward": ShapeReward,
    "sticky_actions": StickyActions,
    "time_limit": TimeLimit,
}
