"""Several policies in one environment, each at lanes of its own.

Axes: B lanes of an environment, L of them in a lineup.
"""

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from typing import Any

import torch

from megastep.arrdict import arrdict, cat
from megastep.dotdict import mapping


class MixedPolicy:
    """Policies, and the `lanes` that each plays, int64 (l,): together a policy like any other, for
    an environment whose lanes they all are.

    `act` is for an environment that others play in, too: it is given what its own lanes see, in the
    order of `lanes`, player by player. On a GPU each policy acts on a stream of its own, also
    within a graph: small networks do not fill it, one after the other they would wait.
    """

    def __init__(self, policies: Sequence[Any], lanes: Sequence[torch.Tensor]):
        self.policies, self.sizes = list(policies), [len(each) for each in lanes]
        self.lanes = torch.cat(list(lanes))
        self.order = self.lanes.argsort()
        is_cuda = self.lanes.is_cuda
        self.streams = [torch.cuda.Stream(self.lanes.device) for _ in policies[1:] if is_cuda]

    def initial(self, n_lanes: int, device: torch.device | str | None = None) -> arrdict:
        """The state of every policy, by its number."""
        return arrdict(
            {
                str(i): policy.initial(size, device)
                for i, (policy, size) in enumerate(zip(self.policies, self.sizes, strict=True))
            }
        )

    def __call__(
        self,
        world: Mapping,
        state: arrdict,
        sample: bool = True,
        generator: torch.Generator | None = None,
    ) -> tuple[arrdict, arrdict]:
        """One step for all lanes of an environment: (arrdict(actions), state)."""
        actions, state = self.act(self.seen(world), state, sample, generator)
        return arrdict(actions=_select(actions, self.order)), state

    def seen(self, world: Mapping) -> arrdict:
        """What policies see of a world, at the lineup's lanes."""
        return arrdict({key: _select(world[key], self.lanes) for key in ("obs", "reset")})

    def act(
        self,
        seen: arrdict,
        state: arrdict,
        sample: bool = True,
        generator: torch.Generator | None = None,
    ) -> tuple[Any, arrdict]:
        """Actions (L, ...) for what the lineup's lanes see, and the state after them."""
        main = torch.cuda.current_stream(self.lanes.device) if self.streams else None
        for stream in self.streams:
            stream.wait_stream(main)
        actions, after, first = [], arrdict(), 0
        for i, (policy, size) in enumerate(zip(self.policies, self.sizes, strict=True)):
            world, first = seen[first : first + size], first + size
            with torch.cuda.stream(self.streams[i - 1]) if self.streams and i else nullcontext():
                decision, after[str(i)] = policy(world, state[str(i)], sample, generator)
            actions.append(decision["actions"])
        for stream in self.streams:
            main.wait_stream(stream)
        return cat(actions), after


def _select(tree, lanes):
    return mapping(lambda leaf: leaf.index_select(0, lanes))(tree)
