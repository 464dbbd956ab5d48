"""What a page shows of an environment beside its numbers: floor plans, keys that drive an agent."""

from collections.abc import Sequence

from megastep import spaces
from megastep.core import AGENT_RADIUS
from megastep.kernels.build.launch import ENGINE
from megastep.modules import MOVES
from megastep.plotting.plans import room_outlines
from megastep.types import Env, n_lanes, optional
from megastep.web.program import Program

__all__ = ["controls", "scene"]

OBJECT_BYTES = ENGINE.constants["OBJECT_BYTES"]

#: Actions of `megastep.modules.MOVES` by key, in the order of two rows of buttons.
MOVE_KEYS = {
    "a": 1,
    "ArrowUp": 3,
    "d": 2,
    "ArrowLeft": 5,
    "ArrowDown": 4,
    "ArrowRight": 6,
}
#: The same for continuous actions: ahead, left, turn left.
PUSH_KEYS = {
    "a": [0, 1, 0],
    "ArrowUp": [1, 0, 0],
    "d": [0, -1, 0],
    "ArrowLeft": [0, 0, 1],
    "ArrowDown": [-1, 0, 0],
    "ArrowRight": [0, 0, -1],
}


def controls(env: Env) -> dict[str, object]:
    """Returns {key of a keyboard: action} of one lane: the environment's ``controls``, movement by
    arrow keys, or digits.
    """
    space = env.action_space
    own = optional(env, "controls")
    if own is not None:
        return dict(own)
    if isinstance(space, spaces.MultiContinuous):
        return {**PUSH_KEYS} if hasattr(env, "movement") and space.dim == 3 else {}
    if hasattr(env, "movement") and space.n_actions == len(MOVES):
        return {**MOVE_KEYS}
    return {str(digit): digit for digit in range(min(space.n_actions, 10))}


def scene(env: Env, program: Program, homes: Sequence[str] = ()) -> dict:
    """Returns what a page shows of an environment: JSON's types.

    Args:
        program: the recorded environment.
        homes: names of the floor plans, in the order of the layouts.
    """
    space = env.action_space
    is_discrete = isinstance(space, spaces.MultiDiscrete)
    shown: dict = {
        "env": type(env).__name__,
        "fps": optional(env, "fps"),
        "n_lanes": n_lanes(env),
        "controls": controls(env),
        "rest": 0 if is_discrete else [0] * space.dim,
        "bounds": None if is_discrete else [list(space.low), list(space.high)],
        "homes": list(homes),
    }
    core = getattr(env, "core", None)
    if core is not None:
        layouts = core.scenery.layouts
        shown |= {
            "fov": core.fov,
            "radius": AGENT_RADIUS,
            "goal": goal(program),
            "rooms": [
                room_outlines(layouts.lines[d].numpy(), layouts.lights[d].numpy())
                for d in range(len(layouts))
            ],
        }
    return shown


def goal(program: Program) -> dict | None:
    """Returns where in memory the place is that the agent is to go to, of the environments that
    have one: x and y are at ``base``, ``per_layout`` numbers times the layout and ``stride``
    numbers times ``index`` further, which is a number or where one is.
    """
    for launch in program.sections["step"]:
        values: dict = launch.values
        if launch.operation == "pointgoal_step":
            base, index = values["points"], values["goal_index"]
            stride, per_layout = 2, 2 * values["n_goals"]
        elif launch.operation in ("memory_step", "keys_step"):
            index = values["cue"] if "cue" in values else values["n_colours"]  # the goal's object
            base, stride, per_layout = values["objects.objects"], OBJECT_BYTES // 4, 0
        else:
            continue
        return dict(base=base, per_layout=per_layout, stride=stride, index=index, radius=0.2)
    return None
