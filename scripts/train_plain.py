"""Trains with the plain form of fused operations, to tell a kernel's fault from a recipe's.

    python scripts/train_plain.py lstm,heads experiment=deathmatch samples=1e8 seed=1
    python scripts/train_plain.py all experiment=deathmatch samples=1e8 seed=1

The first word names the parts, separated by commas, or is `none` or `all`; the rest is that of
`train.py`. If an agent learns less than it did at an older commit, train `none` and `all` with the
same seed. If they differ by more than seeds do, train each part alone.
"""

import sys
from types import ModuleType
from typing import Any

import torch
from torch.nn import functional

from megastep.agents.algorithms import adam, order, ppo, ppo_loss
from megastep.agents.cli.entry import run_command
from megastep.agents.networks import (
    cores,
    critic,
    encoders,
    intakes,
    joint_heads,
    layers,
    lstm,
    mingru,
    outputs,
    policy,
    value_output,
)
from megastep.agents.networks.kernels import few_rows
from megastep.agents.selfplay import mixed_policy
from megastep.agents.storage import copies, rollout
from megastep.arrdict import arrdict

_LAYERS = layers, cores, critic, encoders, intakes, outputs, policy, value_output


def replace(name: str, value: Any, *owners: ModuleType | type) -> None:
    """Sets an attribute wherever it is. AttributeError if it is nowhere."""
    having = [owner for owner in owners if hasattr(owner, name)]
    if not having:
        raise AttributeError(f"no {name} in {', '.join(owner.__name__ for owner in owners)}")
    for owner in having:
        setattr(owner, name, value)


def plain_streams() -> None:
    """Opponents act one after another."""
    init = mixed_policy.MixedPolicy.__init__

    def serial(self, *args):
        init(self, *args)
        self.streams = []

    replace("__init__", serial, mixed_policy.MixedPolicy)


def plain_lstm() -> None:
    """An LSTM acts and learns step by step, with the same products and roundings."""

    def act(self, x, reset, state, is_residual):
        dtype = lstm.compute_dtype(self.recurrent.weight)
        states = state["output"].float(), state["cell"].float()
        weights = self.input.weight, self.input.bias, self.recurrent.weight
        with torch.autocast(x.device.type, enabled=False):
            output, cell, last = lstm._Sequence.apply(
                x.to(dtype), *weights, reset.bool(), *states, is_residual, False
            )
        return output, arrdict(output=last, cell=cell)

    replace("is_supported", lambda x: False, lstm.lstm_sequence)
    replace("_act", act, lstm.LSTM)


def plain_products() -> None:
    """Matrix products of few rows are PyTorch's, and so are those of an LSTM that acts."""
    replace("is_supported", lambda *matrices: False, few_rows)


def plain_mingru() -> None:
    """A minGRU's product is one of its own, and a scan by doubling follows."""
    replace("is_supported", lambda x: False, mingru.mingru_step)
    replace("_recurrence", lambda x: mingru._CPU_RECURRENCE, mingru)


def plain_heads() -> None:
    """Scores, value and prediction of an update are products of their own."""
    replace("fit", lambda *args: False, joint_heads)


def plain_conv() -> None:
    """The convolutions of `encoder=conv` are products of their own."""
    replace("can_encode", lambda *args: False, encoders, intakes)


def plain_layers() -> None:
    """Linear layers are PyTorch's, bias gradients and ReLU of their own."""

    def affine(x, weight, bias, activation=None):
        x = torch.cat(x, -1) if isinstance(x, tuple) else x
        y = functional.linear(x.to(layers.compute_dtype(weight)), weight, bias)
        return y if activation is None else activation(y)

    def linear(x, layer, activation=None):
        return affine(x, layer.weight, layer.bias, activation)

    replace("affine", affine, *_LAYERS)
    replace("linear", linear, *_LAYERS)


def plain_adam() -> None:
    """Adam is PyTorch's."""
    replace("is_fused", property(lambda self: False), adam.Adam)


def plain_loss() -> None:
    """PPO's loss is that of its definition."""

    def plain(**terms):
        value, metrics = ppo_loss.plain_loss(**terms)
        return value, {name: metric.detach() for name, metric in metrics.items()}

    replace("ppo_loss", plain, ppo)


def plain_copies() -> None:
    """Tensors are copied and selected from one by one."""

    def select_lanes(tensors, lanes):
        return [tensor.index_select(1, lanes) for tensor in tensors]

    def copy_all(pairs, condition=None):
        for target, source in list(pairs):
            if condition is not None:
                source = torch.where(condition, source.to(target.device), target)
            target.copy_(source)

    replace("select_lanes", select_lanes, copies, rollout)
    replace("copy_all", copy_all, copies, rollout)


def plain_order() -> None:
    """Minibatches are ordered by PyTorch's sort."""
    replace("_MAX_COUNTED", 0, order)


PARTS = {
    "streams": plain_streams,
    "lstm": plain_lstm,
    "products": plain_products,
    "mingru": plain_mingru,
    "heads": plain_heads,
    "conv": plain_conv,
    "layers": plain_layers,
    "adam": plain_adam,
    "loss": plain_loss,
    "copies": plain_copies,
    "order": plain_order,
}


def chosen(word: str) -> list[str]:
    """Returns the parts that a word names. ValueError if one is unknown."""
    names = {"none": [], "all": [*PARTS]}.get(word, word.split(","))
    for name in names:
        if name not in PARTS:
            raise ValueError(
                f"unknown part {name!r}. Available: {', '.join(PARTS)}; none or all alone"
            )
    return names


def main(argv: list[str]) -> int:
    try:
        names = chosen(argv[0] if argv else "")
    except ValueError as error:
        print(f"train_plain.py: {error}", file=sys.stderr)
        return 2
    for name in names:
        PARTS[name]()
    sys.argv = ["train.py", *argv[1:]]
    return run_command("train")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
