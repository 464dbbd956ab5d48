"""What a function changes that steps an environment, and that no CUDA graph repeats."""

import contextlib
import re

import torch

from megastep.env_state import LARGE, EnvState, as_bytes, is_writable, name_of, record_of
from megastep.types import Env

__all__ = ["HostState"]


class HostState(EnvState):
    """The state of an environment that is not in tensors, and that in tensors and generators on the
    CPU where the environment is on a GPU, before a CUDA graph is recorded.

    Args:
        env: the environment.
        policies: act in it, and may have a state of their own.
    """

    knows_large = False

    def __init__(self, env: Env, policies: object = None):
        super().__init__(env, policies)
        self.before = self._host_records()

    def _host_records(self) -> dict[str, tuple]:
        records = {}
        is_on_gpu = torch.device(self.env.device).type == "cuda"
        for path, node, is_users in self._nodes():
            is_frozen = is_on_gpu and getattr(node, "device", None) == torch.device("cpu")
            with contextlib.suppress(TypeError, ValueError, RuntimeError):  # of rare kinds
                if isinstance(node, torch.Generator):
                    records[path] = "generator" if is_frozen else "repeated", node.get_state()
                elif not isinstance(node, torch.Tensor):
                    records[path] = record_of(node, is_users)
                elif is_frozen and node.nbytes < LARGE and is_writable(node):
                    records[path] = "frozen", as_bytes(node).clone()
        return {path: record for path, record in records.items() if record}

    def changed(self) -> str | None:
        """Returns the name of something that has changed: a plain value, an array, the length of a
        list, a generator, or a tensor on the CPU. None if there is none, or all objects are
        megastep's own.
        """
        if not any(is_users for *_, is_users in self._nodes()):
            return None
        was, now = _comparable(self.before), _comparable(self._host_records())
        changed = sorted(path for path in {*was, *now} if was.get(path) != now.get(path))
        if not changed:
            return None
        is_global = re.match(r"\.generators\['(\w+)'\]", changed[0])
        return f"the global generator of {is_global[1]}" if is_global else name_of(changed[0])

    def restore(self) -> None:
        """Puts all back, but for the lengths of lists and tensors."""
        now, kinds = self._host_records(), ("array", "generator", "repeated")
        for path, record in self.before.items():
            has_changed = record[0] == "value" and repr(now.get(path)) != repr(record)
            if has_changed or record[0] in kinds:
                self._load({path: record})


def _comparable(records) -> dict[str, list]:
    """Returns {name: what is equal for equal values} of what no graph repeats."""
    return {
        f"{path} (its length)" if kind == "list" else path: [
            part.numpy().tobytes() if isinstance(part, torch.Tensor) else repr(part)
            for part in parts
        ]
        for path, (kind, *parts) in records.items()
        if kind in ("value", "array", "list", "generator", "frozen")
    }
