"""Layers on a GPU: the intake's normalisation, the bias' gradient, and categorical actions.

All tensors are contiguous and on one GPU. T steps, B lanes, M selected lanes, A agents per lane, n
choices.
"""

import itertools

import torch

from megastep.agents.networks.kernels.library import LIBRARY, kernel
from megastep.kernels.build.launch import BLOCK, WARP, Blocks, launch

MAX_LEAVES = LIBRARY.constants["MAX_LEAVES"]
MAX_CHOICES = LIBRARY.constants["ACT_THREADS"]
MAX_STEPS = 65_535  # of `normalise`; blocks along y
_WORD = 16  # bytes that a thread reads at once
_STRIP, _STRIP_THREADS = LIBRARY.constants["STRIP"], LIBRARY.constants["STRIP_THREADS"]


def normalise(
    leaves: list[torch.Tensor],
    means: list[torch.Tensor],
    scales: list[torch.Tensor],
    n_columns: int,
    lanes: torch.Tensor | None = None,
) -> torch.Tensor:
    """Returns (leaf - mean) / scale of some lanes, concatenated: (T, M, n_columns) bfloat16.
    Columns beyond the leaves' features are 0. T is at most 65,535.

    Args:
        leaves: at most `MAX_LEAVES`, (T, B, F) float16 or float32 each.
        means: float32, one per leaf, each a number for F / len(mean) neighbouring features.
        scales: float32, of the same shapes.
        n_columns: at least the features of all leaves, a multiple of 4.
        lanes: (M,) int64. None: all, M = B.
    """
    n_steps, n_lanes = leaves[0].shape[:2]
    n_selected = n_lanes if lanes is None else len(lanes)
    features = leaves[0].new_empty(n_steps, n_selected, n_columns, dtype=torch.bfloat16)
    plain = itertools.takewhile(lambda leaf: leaf.shape[-1] % 4 == 0, leaves)
    packed = [
        LIBRARY.params.IntakeLeafParams(
            values=leaf,
            mean=mean,
            scale=scale,
            n_features=leaf.shape[-1],
            group=leaf.shape[-1] // mean.numel(),
            is_half=int(leaf.dtype == torch.float16),
        )
        for leaf, mean, scale in zip(leaves, means, scales, strict=True)
    ]
    n_threads = n_columns // 4 * -(-n_selected // LIBRARY.constants["NORMALISED_ROWS"])
    launch(
        *(LIBRARY, "normalise", features.device, Blocks(-(-n_threads // BLOCK), n_steps)),
        leaves=b"".join(packed),
        lanes=lanes,
        features=features,
        n_steps=n_steps,
        n_lanes=n_lanes,
        n_selected=n_selected,
        n_columns=n_columns,
        n_plain_words=sum(leaf.shape[-1] // 4 for leaf in plain),
    )
    return features


def bias_gradient(
    d: torch.Tensor, activated: torch.Tensor | None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the gradient before a ReLU, and its sum over rows, float32.

    Args:
        d: (rows, columns) bfloat16, columns a multiple of 8; the gradient after the ReLU. May be
            some columns of a wider tensor, as `aligned_rows` returns them.
        activated: the ReLU's outputs. None: there is no ReLU, and `d` is returned.
    """
    n_rows, n_columns = d.shape
    n_words = n_columns * d.element_size() // _WORD
    n_strips = -(-n_rows // _STRIP)
    d_masked = d if activated is None else torch.empty_like(activated)
    sums = d.new_empty(n_strips, n_columns, dtype=torch.float32)
    blocks = Blocks(n_strips, -(-n_words // WARP), _STRIP_THREADS)
    launch(
        *(LIBRARY, "bias_gradient", d.device, blocks),
        d=d,
        activated=activated,
        d_masked=None if activated is None else d_masked,
        sums=sums,
        n_rows=n_rows,
        n_columns=n_columns,
        d_stride=d.stride(0),
    )
    return d_masked, sum_rows(sums)


def sum_rows(rows: torch.Tensor) -> torch.Tensor:
    """Returns the sums (columns,) of rows (n, columns) float32, always in the same order."""
    sums = rows.new_empty(rows.shape[1])
    blocks = Blocks(-(-rows.shape[1] // WARP), threads=_STRIP_THREADS)
    launch(
        *(LIBRARY, "sum_rows", rows.device, blocks),
        rows=rows,
        sums=sums,
        n_rows=rows.shape[0],
        n_columns=rows.shape[1],
    )
    return sums


def act(
    features: torch.Tensor,
    weight: torch.Tensor,
    bias: torch.Tensor,
    shape: tuple[int, int],
    noise: torch.Tensor | None,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Chooses actions by the softmax of a linear layer.

    Args:
        features: (B, W), W a multiple of 8.
        weight: (A n, W) in the same dtype.
        bias: (A n,) in the same dtype.
        shape: (A, n), n at most `MAX_CHOICES`.
        noise: (B, A, n) float32, exponentially distributed. None: takes the most likely actions.

    Returns:
        log-probabilities (B, A, n), actions (B, A) int64, and their log-probability (B,).
    """
    n_lanes, width = features.shape
    logits = features.new_empty(n_lanes, *shape, dtype=torch.float32)
    actions = torch.empty(n_lanes, shape[0], dtype=torch.int64, device=features.device)
    logprobs = torch.empty_like(logits[:, 0, 0])
    operation, n_threads = kernel("categorical_act", features.dtype), MAX_CHOICES * n_lanes
    launch(
        *(LIBRARY, operation, features.device, n_threads),
        features=features,
        weight=weight,
        bias=bias,
        noise=noise,
        logits=logits,
        actions=actions,
        logprobs=logprobs,
        n_lanes=n_lanes,
        width=width,
        n_agents=shape[0],
        n_choices=shape[1],
    )
    return logits, actions, logprobs


def terms(logits: torch.Tensor, actions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the log-probability of joint actions and the entropy, (rows,) each.

    Args:
        logits: log-probabilities (rows, A, n).
        actions: (rows, A) int64.
    """
    logprobs, entropies = logits.new_empty(2, len(logits))
    launch(
        *(LIBRARY, "categorical_terms", logits.device, len(logits)),
        **_rows(logits, actions),
        logprobs=logprobs,
        entropies=entropies,
    )
    return logprobs, entropies


def terms_backward(
    logits: torch.Tensor, actions: torch.Tensor, d_logprobs: torch.Tensor, d_entropies: torch.Tensor
) -> torch.Tensor:
    """Returns the gradient of `terms`' logits."""
    d_logits = torch.empty_like(logits)
    launch(
        *(LIBRARY, "categorical_terms_backward", logits.device, len(logits)),
        **_rows(logits, actions),
        d_logprobs=d_logprobs,
        d_entropies=d_entropies,
        d_logits=d_logits,
    )
    return d_logits


def _rows(logits, actions) -> dict[str, object]:
    n_rows, n_agents, n_choices = logits.shape
    return dict(
        logits=logits, actions=actions, n_rows=n_rows, n_agents=n_agents, n_choices=n_choices
    )
