"""The intake: turns an observation into a vector, by an encoder for each leaf.

`...` any leading axes, such as (B,) lanes or (T, B) time and lanes; A agents that one lane
controls. An image leaf is (..., A, C, H, W).
"""

import itertools
import math
from typing import Any

import torch
from torch import nn

from megastep import spaces
from megastep.agents.networks.fused import LIBRARY, fused
from megastep.agents.networks.linear import ACTIVATIONS, compute_dtype, linear
from megastep.agents.networks.running_norm import MAX_LEAVES, RunningNorm, are_readable, packed_leaf
from megastep.devices import n_resident_threads
from megastep.imports import resolve
from megastep.kernels.build.launch import launch
from megastep.types import Space, Tree

_ROWS, _BLOCKS = (LIBRARY.constants[f"NORMALISED_{name}"] for name in ("ROWS", "BLOCKS"))


# ---- Encoders of a leaf ----


class Flat(nn.Flatten):
    """Flattens a vector or an image: (..., *shape) -> (..., n_features)."""

    takes_parts = True

    def __init__(self, space: Space):
        super().__init__(-len(space.shape))
        self.n_features = math.prod(space.shape)


class OneHot(nn.Module):
    """One-hot encoding of integers: (..., A) -> (..., A n)."""

    is_normalised = False
    values: torch.Tensor  # (n,)

    def __init__(self, space: spaces.MultiDiscrete):
        super().__init__()
        self.n_features = space.n_agents * space.n_actions
        self.register_buffer("values", torch.arange(space.n_actions), persistent=False)

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        return obs[..., None].eq(self.values).flatten(-2)


class Categories(nn.Module):
    """One-hot encoding of MiniGrid's images, whose channels are kind, colour and state of a cell:
    (..., A, 3, H, W) -> (..., 21 A H W), the kinds of all cells first. ValueError for images of
    another number of channels.
    """

    SIZES = 11, 6, 4  # as minigrid.core.constants has them; a state may be a direction
    is_normalised = False
    values: torch.Tensor  # (11,), of the images' dtype, as converting them would take longer

    def __init__(self, space: spaces.MultiImage):
        super().__init__()
        if space.C != len(self.SIZES):
            raise ValueError(
                f"agent.encoder=categories is for images of kinds, colours and states, 3 channels, "
                f"not {space.C}"
            )
        self.n_features = math.prod(space.shape) // space.C * sum(self.SIZES)
        values = torch.arange(max(self.SIZES), dtype=torch.uint8)
        self.register_buffer("values", values, persistent=False)

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        pairs = zip(obs[..., None].unbind(-4), self.SIZES)
        parts = [channel.eq(self.values[:size]).flatten(-4) for channel, size in pairs]
        return torch.cat(parts, -1)


#: Encoders of images by name. An encoder is a module `Encoder(space)` with `n_features` that maps
#: images (..., A, C, H, W) to features (..., n_features). Optional attributes:
#:     is_normalised: the input is normalised by running statistics. Default: True.
#:     takes_parts: the input is normalised, and may be a part of wider rows. Default: False.
#:     encode_runs: encodes all runs of an intake together, such as `Conv`'s. Default: cannot.
ENCODERS = {
    "linear": "megastep.agents.networks.intakes:Flat",
    "conv": "megastep.agents.networks.convolutions:Conv",
    "cnn": "megastep.agents.networks.convolutions:Cnn",
    "categories": "megastep.agents.networks.intakes:Categories",
}


def make_encoder(space: Space, image_encoder: str, path: str) -> Any:
    """Returns the encoder of one leaf of an observation space, whose path messages name. Images
    have one of `ENCODERS`, or one of an import path. ValueError if the space is of an unknown kind,
    there is no such encoder, or its features have the wrong shape.
    """
    if isinstance(space, spaces.MultiImage):
        encoder = resolve(image_encoder, ENCODERS, nn.Module)(space)
        for lead in ((3,), (3, 2)) if ":" in image_encoder else ():
            with torch.no_grad():
                shape = tuple(encoder(torch.zeros(*lead, *space.shape)).shape)
            expected = *lead, getattr(encoder, "n_features", "n_features")
            if shape != expected:
                raise ValueError(
                    f"{image_encoder} breaks the contract of encoders: images "
                    f"{(*lead, *space.shape)} must give features {expected}, not {shape}"
                )
        return encoder
    if isinstance(space, spaces.MultiVector):
        return Flat(space)
    if isinstance(space, spaces.MultiDiscrete):
        return OneHot(space)
    raise ValueError(
        f"no intake is known for the observation space {path or 'itself'} = {space!r}: use "
        "MultiVector, MultiImage, MultiDiscrete or dicts of them"
    )


# ---- The intake ----


def _fits(intake, obs, lanes=None) -> bool:
    leaves = intake.leaves(obs)
    has_known = intake.is_fused and len(leaves) <= MAX_LEAVES and are_readable(leaves)
    is_bf16 = compute_dtype(intake.project.weight) == torch.bfloat16
    has_gradient = any(leaf.requires_grad for leaf in leaves)
    return has_known and is_bf16 and not has_gradient


def _has_words(leaf) -> bool:
    """Returns whether four numbers of a leaf (..., F) are always a word."""
    return leaf.shape[-1] % 4 == 0 and leaf.data_ptr() % (4 * leaf.itemsize) == 0


def _encode_on_gpu(intake, obs, lanes=None) -> torch.Tensor:
    """Selects lanes, normalises and concatenates leaves in one kernel."""
    leaves, norms = intake.leaves(obs), [intake.norms[i] for i in intake.order]
    flat = [leaves[i].flatten(-intake.norms[i].mean.dim()) for i in intake.order]
    lead = flat[0].shape[:-1]
    if lanes is None:
        flat = [leaf.reshape(1, -1, leaf.shape[-1]) for leaf in flat]
    n_steps, n_lanes = flat[0].shape[:2]
    n_selected = n_lanes if lanes is None else len(lanes)
    shape = n_steps, n_selected, intake.n_columns
    features = flat[0].new_empty(shape, dtype=torch.bfloat16)
    plain = itertools.takewhile(_has_words, flat)
    n_plain, n_rows = sum(leaf.shape[-1] // 4 for leaf in plain), n_steps * n_selected
    n_threads = intake.n_columns - 3 * n_plain  # of a row: one per word, and per other column
    # no more than the GPU runs at once: a thread reads statistics and divides once for all its rows
    room = n_resident_threads(features.device, _BLOCKS) // n_threads
    stride = min(-(-n_rows // _ROWS), max(room, 1))
    launch(
        *(LIBRARY, "normalise", features.device, stride * n_threads),
        leaves=b"".join(map(packed_leaf, norms, flat)),
        **dict(lanes=lanes, features=features, n_rows=n_rows, n_lanes=n_lanes),
        **dict(n_selected=n_selected, n_columns=intake.n_columns),
        **dict(n_plain_words=n_plain, stride=stride),
    )
    return intake.encode_columns(features if lanes is not None else features.view(*lead, -1))


class ConcatIntake(nn.Module):
    """Normalises and encodes every leaf of an observation, concatenates the features, and projects
    them to (..., width) with an activation.

    Initially every leaf has the same weight, however many numbers it has: weights have variance
    2 / (leaves x features of the leaf), which preserves the size of the inputs (He et al. 2015).

    `running_norms` are its normalisations by running statistics.

    Images have an encoder, "linear", "conv", "cnn" or an import path. The activation is "relu" or
    "tanh". `n_features` counts those of all leaves together, before the projection. ValueError if a
    space is of an unknown kind, or nothing is observed.
    """

    def __init__(self, space: Space, width: int, encoder: str = "linear", activation: str = "relu"):
        super().__init__()
        leaves = {
            path: leaf
            for path, leaf in spaces.leaves(space).items()
            if not isinstance(leaf, spaces.MultiEmpty)
        }
        if not leaves:
            raise ValueError(f"the observation space {space!r} has nothing in it to encode")
        self.activation = ACTIVATIONS[activation]
        self.paths = list(leaves)
        encoders = [make_encoder(leaf, encoder, path) for path, leaf in leaves.items()]
        self.encoders = nn.ModuleList(encoders)
        self.norms = nn.ModuleList(
            RunningNorm(leaf) if getattr(encoder, "is_normalised", True) else nn.Identity()
            for leaf, encoder in zip(leaves.values(), encoders)
        )
        self.running_norms = [norm for norm in self.norms if isinstance(norm, RunningNorm)]
        #: whether a kernel may normalise all leaves side by side
        self.is_fused = all(vars(type(encoder)).get("takes_parts") for encoder in encoders)
        sizes = [encoder.n_features for encoder in encoders]
        self.n_features = sum(sizes)
        # GPUs multiply matrices whose columns are a multiple of 8 several times faster
        self.n_padding = -self.n_features % 8
        self.project = nn.Linear(self.n_features + self.n_padding, width)
        with torch.no_grad():
            self.project.bias.zero_()
            blocks = self.project.weight.split([*sizes, self.n_padding], dim=1)
            blocks[-1].zero_()
            for block, size in zip(blocks, sizes):
                block.normal_(std=math.sqrt(2 / (len(sizes) * size)))
        self._lay_out(list(leaves.values()))

    def _lay_out(self, leaves) -> None:
        """Puts leaves side by side: images first, so that their rows start at multiples of 16
        bytes, at last at least `n_padding` zeros.

        Sets `order` of leaves, `n_columns`, and `runs` of columns in the order of the features:
        (encoder, shape, start, end). Flat neighbours are one run, the padding too, with None.
        """
        is_flat = [isinstance(encoder, Flat) for encoder in self.encoders]
        n_leaves, sizes = len(leaves), [math.prod(leaf.shape) for leaf in leaves]
        self.order = sorted(range(n_leaves), key=is_flat.__getitem__)
        starts = dict(
            zip(self.order, itertools.accumulate((sizes[i] for i in self.order), initial=0))
        )
        starts[n_leaves] = sum(sizes)
        self.runs = []
        for i, size in enumerate([*sizes, self.n_padding]):
            end = starts[i] + size
            if i < n_leaves and not is_flat[i]:
                self.runs.append((i, leaves[i].shape, starts[i], end))
            elif self.runs and self.runs[-1][0] is None:
                self.runs[-1] = (None, None, self.runs[-1][2], end)
            elif size:
                self.runs.append((None, None, starts[i], end))
        self.n_columns = -8 * (-(sum(sizes) + self.n_padding) // 8)

    def forward(self, obs: Tree, lanes: torch.Tensor | None = None) -> torch.Tensor:
        """Returns the projected features (..., width) of leaves (..., *shape), or of some `lanes`,
        (M,) int64, of leaves (T, B, ...).
        """
        return linear(self.encode(obs, lanes), self.project, self.activation)

    @fused(_encode_on_gpu, _fits)
    def encode(self, obs: Tree, lanes: torch.Tensor | None = None) -> torch.Tensor:
        """Returns all leaves, normalised, encoded and concatenated, with columns of zeros at the
        end: (..., n_features + n_padding).
        """
        leaves = self.leaves(obs)
        if lanes is not None:
            leaves = [leaf.index_select(1, lanes) for leaf in leaves]
        dtype = compute_dtype(self.project.weight)
        features = [
            encoder(norm(leaf)).to(dtype)
            for leaf, norm, encoder in zip(leaves, self.norms, self.encoders, strict=True)
        ]
        if self.n_padding:
            features.append(features[0].new_zeros((*features[0].shape[:-1], self.n_padding)))
        return torch.cat(features, dim=-1)

    def encode_columns(self, columns: torch.Tensor) -> torch.Tensor:
        """Returns `encode` of normalised leaves side by side, (..., n_columns)."""
        others = [encoder for encoder in self.encoders if not isinstance(encoder, Flat)]
        if not others:  # one run, of all columns
            return columns
        if encode_runs := getattr(others[0], "encode_runs", None):
            features = encode_runs(columns.flatten(0, -2), self.runs, self.encoders)
            return features.unflatten(0, columns.shape[:-1])
        features = []
        for i, shape, start, end in self.runs:
            part = columns[..., start:end]
            part = part if i is None else self.encoders[i](part.unflatten(-1, shape))
            features.append(part.contiguous())  # so that `cat` is several times faster
        return torch.cat(features, -1)

    def normalised_leaves(self, obs: Tree) -> list[torch.Tensor]:
        """Returns the leaf of each of `running_norms`."""
        pairs = zip(self.norms, self.leaves(obs), strict=True)
        return [leaf for norm, leaf in pairs if isinstance(norm, RunningNorm)]

    def leaves(self, obs: Tree) -> list[torch.Tensor]:
        """Returns the observation's leaves, in the order of `paths`."""
        values = spaces.leaves(obs)
        return [values[path] for path in self.paths]
