"""What a learner is: the class behind `learner=module:Class`.

    learner = Class(policy, seed=1, **settings)    # settings are its own arguments
    collect = learner.collector(env)               # owns what is stored
    for ever:
        rollout = collect()
        losses = learner.update(rollout)

`collect()` acts in the environment and returns what it stored of the steps just taken, a
`rollout.Rollout` or what has the same:

n_steps, n_lanes   how many there were, T steps of B lanes
reward, reset, terminal, truncated   (T, B), of the worlds that followed; metrics, by name
learns             (T+1, B) bool, whether the learner learns from the lane then
learners           which of the environment's lanes these B are, a bool for each, or None for all
numbers()          all that may stop being finite, by name: what the learner's `check` looked over

`collect.rollout` is the one returned last, before the first call an empty one. A replay memory
belongs to the learner, which fills it in `update`, or to its collector. One that acts ahead on a
stream of its own returns an earlier rollout, and has a method `wait()`, called before anybody else
uses the environment, which waits until nobody acts there. An environment with opponents in it has
`learners`: only those lanes need to be acted in and stored. Neither call synchronises host and
device. A constructor that takes `graph` is told to capture its update. A learner with a replay
memory tells its size before there is one, by a method `replay_size(env)`: how many observations it
holds, and bytes for each, of an environment like this one.

What ours are made of serves others, too: `rollout.make_rollout` and `rollout.Collector`,
`rollout.bytes_per_step`, `gradient_steps.GradientSteps`, `captured.CudaGraphUpdate`, `masked`, and
`own_state` here.
"""

from typing import Annotated, Any

from pydantic import Field

#: Of settings that learners have in common.
Coefficient = Annotated[float, Field(ge=0, le=10**6)]
Positive = Annotated[float, Field(gt=0, le=10**6)]
Fraction = Annotated[float, Field(ge=0, le=1)]

ATTRIBUTES = {
    "collector": "a method that takes an environment and returns what acts in it and stores",
    "update": "a method that learns from a rollout and returns a dict of tensors ()",
    "bytes_per_env": "a method that says how many bytes it needs for each environment like a given "
    "one, what its collector stores included",
    "check": "a finite.NonFiniteCheck, which its update calls",
    "lr": "its learning rate, the one that annealing begins with",
    "set_lr": "a method that changes the learning rate",
    "state_dict": "a method that returns all that changes beside the policy's weights",
    "load_state_dict": "a method that goes on from there",
}


def check_minibatches(n_minibatches: int, n_lanes: int) -> None:
    """ValueError unless so many lanes can be cut into so many minibatches."""
    if n_lanes < n_minibatches:
        raise ValueError(
            f"{n_lanes} lanes cannot be cut into {n_minibatches} minibatches of whole lanes; use "
            "fewer minibatches or more lanes"
        )


def check_state(learner: Any, state: dict[str, Any]) -> None:
    """ValueError unless a `state_dict` is of this kind of learner, as far as it says: `learner` in
    it is the name of the class.
    """
    own = type(learner).__name__
    if state.get("learner", own) != own:
        raise ValueError(
            f"the state of a {state['learner']} learner cannot be that of {own}: go on with the "
            "learner that it is from, or start from the policy's weights alone (init=RUN)"
        )


def own_state(learner: Any) -> dict[str, Any]:
    """The `state_dict` of a learner with `steps`, `random`, `policy` and `captured`: all that an
    update changes beside the policy's weights, and where the policy's random stream is.
    """
    return dict(
        learner=type(learner).__name__,
        **learner.steps.state_dict(),
        random=learner.random.state_dict(),
        policy_random=learner.policy.random.state_dict(),
    )


def load_own_state(learner: Any, state: dict[str, Any]) -> None:
    """Goes on from an `own_state`, taken on this device or another. ValueError if it is that of
    another kind of learner.
    """
    check_state(learner, state)
    learner.steps.load_state_dict(state)
    learner.random.load_state_dict(state["random"], learner.device)
    learner.policy.random.load_state_dict(state["policy_random"], learner.device)
    learner.cuda_graph.restart()


class LearnerError(AssertionError):
    """A class is no learner. The message names what it lacks."""


def check_learner(learner: Any) -> None:
    """LearnerError unless it has all that a learner has."""
    for name, meaning in ATTRIBUTES.items():
        if not hasattr(learner, name):
            raise LearnerError(f"it has no {name}: {meaning}")
