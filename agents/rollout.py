"""What happened: T steps of B lanes on the device, and how they come about.

Axes: T time, B lanes, M lanes of a minibatch. Row t of a rollout is what was seen and decided at
time t; `reward`, `reset`, `terminal` and `truncated` at row t are those of the world that followed,
t+1. So row t is a valid transition unless its `reset` is set.
"""

import torch

from megastep import spaces
from megastep.arrdict import arrdict, clone
from megastep.dotdict import leaves, mapping


def _room(space, lead, device, dtype):
    """Zeros for values of a tree of spaces, after `lead` axes. Whole numbers are int64 whatever the
    dtype.
    """
    if isinstance(space, dict):
        return arrdict({key: _room(child, lead, device, dtype) for key, child in space.items()})
    dtype = torch.int64 if isinstance(space, spaces.MultiDiscrete) else dtype
    return torch.zeros(*lead, *space.shape, dtype=dtype, device=device)


class Rollout:
    """T steps of B lanes, in memory taken once and written over by every `collect`.

    obs              (T+1, B, ...) the last row is the observation that the next rollout starts from
    starts           (T+1, B) bool, whether that observation is its episode's first
    actions          (T, B, ...) int64
    logprobs         (T, B) of those actions, under the policy that took them
    values           (T+1, B) as judged then
    reward           (T, B), and `terminal`, `truncated` (T, B) bool: what followed
    state            what the policy remembered before row 0, leaves (B, ...); None until the first
    `collect`
    """

    def __init__(
        self, n_steps, n_lanes, obs_space, action_space, device=None, obs_dtype=torch.float16
    ):
        if n_steps < 1 or n_lanes < 1:
            raise ValueError(
                f"a rollout needs at least one step and one lane, not {n_steps} and {n_lanes}"
            )
        self.n_steps, self.n_lanes = n_steps, n_lanes
        rows, more = (n_steps, n_lanes), (n_steps + 1, n_lanes)
        self.obs = _room(obs_space, more, device, obs_dtype)
        self.actions = _room(action_space, rows, device, torch.int64)
        self.starts = torch.zeros(more, dtype=torch.bool, device=device)
        self.terminal, self.truncated = (
            torch.zeros(rows, dtype=torch.bool, device=device) for _ in range(2)
        )
        self.values = torch.zeros(more, device=device)
        self.logprobs, self.reward = (torch.zeros(rows, device=device) for _ in range(2))
        self.state = None

    @property
    def reset(self):
        """(T, B) bool: whether row t's decision was ignored because an episode started instead."""
        return self.starts[1:]

    def store_world(self, t, world):
        """Writes down the world at time t, and gives it back as it was written, for the policy to
        act on.
        """
        self.obs[t] = world["obs"]
        self.starts[t] = world["reset"]
        return arrdict(obs=self.obs[t], reset=self.starts[t])

    def store_memory(self, state):
        """Writes down what the policy remembers before row 0."""
        if self.state is None:
            self.state = clone(state)
        else:
            self.state[:] = state

    def transitions(self):
        """The arguments of `returns.gae`, each (T, B), the last value (B,)."""
        return dict(
            value=self.values[:-1],
            last_value=self.values[-1],
            reward=self.reward,
            reset=self.reset,
            terminal=self.terminal,
            truncated=self.truncated,
        )

    def lanes(self, rows):
        """Whole sequences of some lanes, rows (M,) int64: arrdict(obs, starts, actions, logprobs,
        value), (T, M, ...), and their state (M, ...). A copy.
        """
        select = mapping(lambda leaf: leaf[: self.n_steps].index_select(1, rows))
        return arrdict(
            obs=select(self.obs),
            starts=select(self.starts),
            actions=select(self.actions),
            logprobs=select(self.logprobs),
            value=select(self.values),
            state=self.state.map(lambda leaf: leaf.index_select(0, rows)),
        )


def initial_actor_state(env, policy):
    """Resets an environment and gives the actor_state that `collect` begins with:
    arrdict(world=arrdict(obs, reset), state). It shares no memory with the environment.
    """
    world = env.reset()
    seen = arrdict(obs=mapping(torch.clone)(world["obs"]), reset=world["reset"].clone())
    return arrdict(world=seen, state=policy.initial(len(seen.reset)))


@torch.no_grad()
def collect(env, policy, rollout, actor_state):
    """Fills a rollout: T times act, env.step, write. Never asks the GPU a question, so it can be a
    CUDA graph.

    The actor_state (of `start`, or of the `collect` before) is brought up to date in place, and
    returned.
    """
    world, state = actor_state["world"], actor_state["state"]
    rollout.store_memory(state)
    for t in range(rollout.n_steps):
        decision, state = policy(rollout.store_world(t, world), state)
        rollout.actions[t] = decision["actions"]
        rollout.logprobs[t], rollout.values[t] = decision["logprobs"], decision["value"]

        world = env.step(arrdict(actions=decision["actions"]))
        rollout.reward[t] = world["reward"]
        rollout.terminal[t], rollout.truncated[t] = world["terminal"], world["truncated"]

    last = rollout.store_world(rollout.n_steps, world)
    rollout.values[-1] = policy(last, state, sample=False)[0]["value"]
    fresh = arrdict(world=arrdict(obs=world["obs"], reset=world["reset"]), state=state)
    for target, source in zip(leaves(actor_state), leaves(fresh), strict=True):
        target.copy_(source)
    return actor_state
