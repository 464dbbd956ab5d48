"""A policy as launches of kernels without PyTorch, for programs of `megastep.web`.

B lanes, W width.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple, cast

import torch
from torch import nn

from megastep.agents.errors import UserError
from megastep.agents.networks.convolutions import Cnn, Conv
from megastep.agents.networks.cores import Stack
from megastep.agents.networks.heads import MultiDiscreteOutput
from megastep.agents.networks.intakes import ENCODERS, Categories, Flat, OneHot
from megastep.agents.networks.lstm import LSTM
from megastep.agents.networks.mingru import MinGRU
from megastep.agents.networks.plain_cores import Feedforward
from megastep.agents.networks.policy import Policy
from megastep.agents.networks.running_norm import RunningNorm
from megastep.agents.networks.web import LIBRARY
from megastep.web.program import Launch, Leaf, Program, Ref, words

FLOAT = 4  # bytes
KINDS = {torch.float16: 0, torch.float32: 1, torch.uint8: 2, torch.bool: 2, torch.int64: 3}
ACTIVATIONS = {torch.relu: 1, torch.tanh: 2}


class Acting(NamedTuple):
    """Where a program's policy has what a page shows."""

    section: str  # the name of its launches
    lanes: range  # that it acts in
    logits: Leaf  # (B, A, n) of these lanes
    states: list[Leaf]  # (B, W) each, the hidden state


def add_policy(
    program: Program, policy: Policy, lanes: range, section: str = "policy", seed: int = 1
) -> Acting:
    """Adds the forward pass of a policy that acts in some lanes to a program, as a section of
    launches and memory. The draws of its actions are not PyTorch's. Raises UserError for a core or
    an encoder of the user's, or actions of several kinds.
    """
    lowering = _Lowering(program, policy, lanes, seed)
    width, policy = policy.width, lowering.policy
    with torch.no_grad():
        x = lowering.scratch(width)
        columns, n_columns = lowering.intake()
        activation = ACTIVATIONS[policy.intake.activation]
        lowering.linear(columns, policy.intake.project, x, n_columns, width, activation)
        core = cast(nn.Module, policy.core)
        for one in core if isinstance(core, Stack) else [core]:
            lowering.core(one, x, width)
        logits = lowering.output(x, width)
    program.sections[section] = lowering.launches
    return Acting(section, lanes, logits, lowering.states)


def channels_of(leaf: Leaf) -> list[Leaf]:
    """Returns each channel of images (B, A, C, H, W), (B, A, H, W)."""
    (*lead, n, height, width), (*steps, stride, down, along) = leaf.shape, leaf.strides
    shape, strides = (*lead, height, width), (*steps, down, along)
    offsets = (leaf.ref.offset + i * stride * leaf.dtype.itemsize for i in range(n))
    return [Leaf(Ref(leaf.ref.buffer, offset), shape, strides, leaf.dtype) for offset in offsets]


class _Lowering:
    def __init__(self, program, policy, lanes, seed) -> None:
        self.program, self.policy, self.lanes = program, policy.actor(), lanes
        self.seed, self.n = seed, len(lanes)
        self.launches: list[Launch] = []
        self.states: list[Leaf] = []

    def launch(self, operation: str, **values) -> None:
        """Adds a launch. Words that are not given are 0, or null pointers."""
        layout = words(LIBRARY, operation)
        empty = {word.name: None if word.kind == "P" else 0 for word in layout}
        assert values.keys() <= empty.keys(), values.keys() - empty.keys()
        values = empty | values | dict(n_lanes=self.n) if "n_lanes" in empty else empty | values
        self.launches.append(Launch(LIBRARY, operation, values))

    def scratch(self, n: int) -> Ref:
        """Returns memory for n numbers of each lane, zeros at first."""
        return self.program.add(torch.zeros(self.n * n))

    def weights(self, tensor: torch.Tensor | None) -> Ref | None:
        return None if tensor is None else self.program.add(tensor.detach().float().cpu())

    def linear(self, x, layer: nn.Linear, out, n_in, n_out, activation=0, adds=0) -> None:
        sizes = dict(n_in=n_in, n_out=n_out, x_stride=n_in, out_stride=n_out)
        parts = dict(weight=self.weights(layer.weight), bias=self.weights(layer.bias))
        self.launch(
            "policy_linear", x=x, out=out, **parts, **sizes, adds=adds, activation=activation
        )

    # ---- Intake ----

    def intake(self) -> tuple[Ref, int]:
        """Adds normalisation and encoders. Returns the columns, and how many there are."""
        intake, first = self.policy.intake, 0
        n = intake.n_features + intake.n_padding
        columns = self.scratch(n)
        for path, norm, encoder in zip(intake.paths, intake.norms, intake.encoders):
            leaf = self.program.world[f"obs.{path}".rstrip(".")]
            target = Ref(columns.buffer, FLOAT * first)
            if type(encoder) in (Flat, OneHot):
                choices = len(encoder.values) if isinstance(encoder, OneHot) else 0
                self.normalise(leaf, norm, choices, target, n)
            elif isinstance(encoder, Categories):
                for channel, size in zip(channels_of(leaf), encoder.SIZES):
                    self.normalise(channel, norm, size, target, n)
                    n_numbers = math.prod(channel.shape[1:]) * size
                    target = target._replace(offset=target.offset + FLOAT * n_numbers)
            elif type(encoder) in (Conv, Cnn):
                self.convolve(leaf, norm, encoder, target, n)
            else:
                raise UserError(
                    f"a page has no encoder {type(encoder).__name__}; it has "
                    f"agent.encoder={', '.join(ENCODERS)}"
                )
            first += cast(Flat, encoder).n_features
        return columns, n

    def normalise(self, leaf: Leaf, norm, choices: int, out: Ref, out_stride: int) -> None:
        if leaf.dtype not in KINDS:
            raise UserError(f"a page has no observations of {leaf.dtype}")
        shape = leaf.shape[1:]
        n_missing = 4 - len(shape)
        sizes, strides = [1] * n_missing + [*shape], [0] * n_missing + [*leaf.strides[1:]]
        mean = scale = None
        if isinstance(norm, RunningNorm):
            mean, scale = (self.weights(part.expand(shape)) for part in (norm.mean, norm.scale))
        self.launch(
            "policy_normalise",
            **dict(obs=self.of_lanes(leaf), mean=mean, scale=scale, out=out),
            **{f"size{i}": size for i, size in enumerate(sizes)},
            **{f"stride{i}": stride for i, stride in enumerate(strides)},
            **dict(kind=KINDS[leaf.dtype], obs_stride=leaf.strides[0], out_stride=out_stride),
            choices=choices,
        )

    def convolve(self, leaf: Leaf, norm, encoder, out: Ref, out_stride: int) -> None:
        n_agents, channels, height, width = leaf.shape[1:]
        shape: Sequence[int] = (channels, height, width)
        if isinstance(encoder, Conv):  # rows count as channels
            shape = channels * height, 1, width
            layers = [encoder.first, encoder.second]
        else:
            layers = [layer for layer in encoder.layers if isinstance(layer, nn.Conv2d)]
        n = n_agents * math.prod(shape)
        x = self.scratch(n)
        self.normalise(leaf, norm, 0, x, n)
        for layer in layers:
            own = layer.kernel_size, layer.stride, cast("tuple[int, ...]", layer.padding)
            rows = 1, 1, 0  # of a convolution of rows
            kernel, stride, padding = (
                (row, *pair) if len(pair) == 1 else pair for row, pair in zip(rows, own)
            )
            sizes = [
                (size + 2 * pad - k) // step + 1
                for size, pad, k, step in zip(shape[1:], padding, kernel, stride)
            ]
            n_out = n_agents * layer.out_channels * math.prod(sizes)
            is_last = layer is layers[-1]
            target, target_stride = (out, out_stride) if is_last else (self.scratch(n_out), n_out)
            weight, bias = self.weights(layer.weight.movedim(0, -1)), self.weights(layer.bias)
            self.launch(
                "policy_convolve",
                **dict(x=x, weight=weight, bias=bias, out=target, n_images=n_agents),
                **dict(zip(("n_in", "height", "width"), shape)),
                **dict(n_out=layer.out_channels, out_height=sizes[0], out_width=sizes[1]),
                **dict(zip(("kernel_h", "kernel_w"), kernel)),
                **dict(zip(("stride_h", "stride_w"), stride)),
                **dict(zip(("padding_h", "padding_w"), padding)),
                **dict(x_stride=n, out_stride=target_stride),
            )
            x, n, shape = target, n_out, (layer.out_channels, *sizes)

    def of_lanes(self, leaf: Leaf) -> Ref:
        """Returns the place of a leaf's first number of these lanes."""
        offset = self.lanes.start * leaf.strides[0] * leaf.dtype.itemsize
        return Ref(leaf.ref.buffer, leaf.ref.offset + offset)

    # ---- Core ----

    def core(self, core, x: Ref, width: int) -> None:
        """Adds a recurrent core, whose outputs are added to x."""
        kind = type(core)
        if kind is Feedforward:
            hidden = self.scratch(width)
            self.linear(x, core.hidden, hidden, width, width, ACTIVATIONS[core.activation])
            self.launch("policy_add", x=hidden, out=x, n=self.n * width)
            return
        if kind not in (LSTM, MinGRU):
            raise UserError(
                f"a page has no recurrent core {kind.__name__}; it has "
                "agent.core=lstm, mingru, none"
            )
        n = {LSTM: 4, MinGRU: 2}[kind] * width
        gates, output = self.scratch(n), self.state(width)
        cell = self.state(width) if kind is LSTM else None
        self.linear(x, core.input, gates, width, n)
        if kind is LSTM:
            self.linear(output, core.recurrent, gates, width, n, adds=1)
        parts = dict(gates=gates, output=output, cell=cell)
        self.launch(f"policy_{kind.__name__.lower()}", **parts, x=x, width=width)

    def state(self, width: int) -> Ref:
        """Adds a hidden state, which is cleared where an episode starts."""
        state = self.scratch(width)
        reset = self.of_lanes(self.program.world["reset"])
        self.launch("policy_clear", reset=reset, state=state, width=width)
        self.states.append(Leaf(state, (self.n, width), (width, 1), torch.float32))
        return state

    # ---- Output ----

    def output(self, x: Ref, width: int) -> Leaf:
        """Adds the output. Returns the logits."""
        output = self.policy.output
        if type(output) is not MultiDiscreteOutput:
            raise UserError(
                f"a page has no {type(output).__name__}: it has discrete actions of one kind, "
                "drawn from their probabilities"
            )
        n_agents, n = output.shape
        scores, logits = self.scratch(n_agents * n), self.scratch(n_agents * n)
        self.linear(x, output.linear, scores, width, n_agents * n)
        self.launch(
            "policy_softmax",
            **dict(scores=scores, logits=logits, actions=self.of_lanes(self.program.actions)),
            counts=self.program.add(torch.zeros(self.n, dtype=torch.int32)),
            **dict(key0=self.seed & 0xFFFFFFFF, key1=self.seed >> 32),
            **dict(n_agents=n_agents, n_choices=n, first=self.lanes.start),
        )
        return Leaf(logits, (self.n, n_agents, n), (n_agents * n, n, 1), torch.float32)
