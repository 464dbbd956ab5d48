"""Network layers built from spaces: an *intake* turns observations into a vector, an *output* turns
a vector into actions.

    intake = heads.intake(env.obs_space, width)     # (..., A, C, H, W), (..., A, D) -> (..., width)
    output = heads.output(env.action_space, width)  # (..., width) -> log-probabilities (..., A, n)
    logits = nn.Sequential(intake, output)(world.obs)
    actions = output.sample(logits)                 # (..., A) integers, or numbers within bounds

Nested dicts of spaces give nested dicts of logits and actions. Nothing here synchronises. `...` are
any leading axes, such as (B,) lanes or (T, B) time and lanes; A agents that one lane controls.
"""

from megastep import spaces
from megastep.agents.networks.intakes import ConcatIntake
from megastep.agents.networks.outputs import DictOutput, MultiDiscreteOutput, Output
from megastep.types import Space

intake = ConcatIntake


def output(space: Space, width: int, kind: str = "softmax", continuous: str = "gaussian") -> Output:
    """Returns a module from vectors (..., width) to logits of an action space.

    Its methods are `sample`, `greedy`, `logprob`, and `entropy` ("softmax") or `action_value`
    ("duelling").

    Args:
        space: action space, a MultiDiscrete, a MultiContinuous or nested dicts.
        width: number of features.
        kind: of integers: "softmax" samples by probability, "duelling" by value.
        continuous: a name in `CONTINUOUS_OUTPUTS`, for continuous actions.

    Raises:
        ValueError: if a space is of an unknown kind, or actions that need values are continuous.
    """
    if isinstance(space, dict) and space:
        return DictOutput({key: output(s, width, kind, continuous) for key, s in space.items()})
    if isinstance(space, spaces.MultiDiscrete):
        if kind == "softmax":
            return MultiDiscreteOutput(space, width)
        from megastep.agents.networks.duelling_output import DuellingOutput

        return DuellingOutput(space, width)
    if isinstance(space, spaces.MultiContinuous):
        if kind == "duelling":
            raise ValueError(
                f"action values (agent.output=duelling, which R2D2 learns) need discrete actions, "
                f"not {space!r}: use learner=ppo or learner=vtrace with agent.output=softmax"
            )
        from megastep.agents.networks.continuous_outputs import CONTINUOUS_OUTPUTS

        return CONTINUOUS_OUTPUTS[continuous](space, width)
    raise ValueError(
        f"no output is known for the action space {space!r}: use MultiDiscrete, MultiContinuous or "
        "dicts of them"
    )
