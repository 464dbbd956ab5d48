"""What a function changes that steps an environment, and that no CUDA graph repeats."""

import re

import torch

from megastep.engine.state_tree import node_at
from megastep.env_state import GENERATORS, LARGE, EnvState, as_bytes, name_of
from megastep.types import Env

__all__ = ["HostState"]


class HostState(EnvState):
    """The state of an environment that is not in tensors, and that in tensors and generators on the
    CPU where the environment is on a GPU, before a CUDA graph is recorded; also of the policies
    that act in it.
    """

    knows_large = False

    def __init__(self, env: Env, policies: object = None):
        super().__init__(env, policies)
        self.is_on_gpu = torch.device(env.device).type == "cuda"
        self.before = self._records()
        for path, (kind, *parts) in self.before.items():
            if kind == "tensor":  # what else changes is a copy
                self.before[path] = "tensor", parts[0].clone() if self._is_frozen(path) else None

    def changed(self) -> str | None:
        """Returns the name of something that has changed: a plain value, an array, the length of a
        list, a generator, or a tensor on the CPU. None if there is none, or all objects are
        megastep's own.
        """
        if not any(is_users for *_, is_users in self._nodes()):
            return None
        was, now = self._comparable(self.before), self._comparable(self._records())
        changed = sorted(path for path in {*was, *now} if was.get(path) != now.get(path))
        if not changed:
            return None
        is_global = re.match(r"\.generators\['(\w+)'\]", changed[0])
        return f"the global generator of {is_global[1]}" if is_global else name_of(changed[0])

    def restore(self) -> None:
        """Puts all back, but for the lengths of lists and tensors."""
        now = self._records()
        for path, record in self.before.items():
            has_changed = record[0] == "value" and repr(now.get(path)) != repr(record)
            if has_changed or record[0] in ("array", "generator"):
                self._load({path: record})

    def _comparable(self, records) -> dict[str, list]:
        """Returns {name: what is equal for equal values} of what no graph repeats."""
        comparable = {}
        for path, (kind, *parts) in records.items():
            name = f"{path} (its length)" if kind == "list" else path
            if kind in ("value", "array", "list") or self._is_frozen(path):
                parts = parts[:1] if kind == "tensor" else parts
                comparable[name] = [
                    as_bytes(part).numpy().tobytes()
                    if isinstance(part, torch.Tensor)
                    else repr(part)
                    for part in parts
                ]
        return comparable

    def _is_frozen(self, path) -> bool:
        """Returns whether a graph repeats nothing there: a tensor or generator on the wrong device,
        or a generator that is not PyTorch's.
        """
        node = node_at(self.root, path)
        if isinstance(node, (torch.Tensor, torch.Generator)):
            is_small = isinstance(node, torch.Generator) or node.nbytes < LARGE
            return self.is_on_gpu and node.device == torch.device("cpu") and is_small
        return isinstance(node, GENERATORS)
