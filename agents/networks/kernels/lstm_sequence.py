"""The LSTM over a whole sequence on a GPU with clusters of blocks (Hopper and later): one kernel
forward and one backward, whose recurrent weights stay on the chip from the first step to the last.

T steps, B lanes, W units, 128 or 256. All tensors are contiguous, on one GPU. Gates, weights,
outputs and their gradients are bfloat16, states are float32, resets are bool.
"""

from pathlib import Path

import torch

from megastep.agents.networks.kernels.layers import sum_rows
from megastep.kernels.build.kernel_library import FAST_CUDA_FLAGS, KernelLibrary
from megastep.kernels.build.launch import Blocks, launch

# Lambdas with type parameters are device code only if everything is.
LIBRARY = KernelLibrary(
    Path(__file__).parent / "clusters", (*FAST_CUDA_FLAGS, "--device-as-default-execution-space")
)
WIDTHS = 128, 256
MIN_STEPS = 2  # for one step, loading the weights takes longer than the products
MAX_STEPS = LIBRARY.constants["MAX_STEPS"]
_THREADS = LIBRARY.constants["SEQUENCE_THREADS"]
_LANES = LIBRARY.constants["SEQUENCE_LANES"]
#: Outputs, recurrent inputs, the last output and cell, and what the backward pass needs.
Unrolled = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, tuple]
#: Those of the gates, of the bias, and of the output and the cell before the sequence, if needed.
Gradients = tuple[torch.Tensor, torch.Tensor, torch.Tensor | None, torch.Tensor | None]
_BLOCK_UNITS = LIBRARY.constants["BLOCK_UNITS"]


def is_supported(x: torch.Tensor) -> bool:
    """Returns whether the kernels run a sequence x (T, B, W) of this dtype on its device."""
    if not (
        x.is_cuda
        and x.dtype == torch.bfloat16
        and x.shape[-1] in WIDTHS
        and MIN_STEPS <= len(x) <= MAX_STEPS
        and x.numel()
    ):
        return False
    # consumer GPUs of the same generations have clusters too, but less shared memory
    gpu = torch.cuda.get_device_properties(x.device)
    needed = max(_memory(direction, x.shape[-1]) for direction in ("forward", "backward"))
    return gpu.major >= 9 and gpu.shared_memory_per_block_optin >= needed


def forward(gates, weight, reset, output, cell, needs_backward, residual=None) -> Unrolled:
    """Unrolls the recurrence.

    Args:
        gates: (T, B, 4 W), products of the inputs, with the bias.
        weight: (4 W, W), recurrent.
        reset: (T, B) bool.
        output: (B, W) float32, before the sequence.
        cell: (B, W) float32, before the sequence.
        needs_backward: whether to save what `backward` needs.
        residual: (T, B, W), added to the outputs, or None.

    Returns:
        outputs (T, B, W), the recurrent input of each step (T, B, W), the last output, without the
        residual, and the last cell (B, W) float32, and what to pass on to `backward`, two tensors
        or two times None.
    """
    (n_steps, n_lanes, _), width = gates.shape, weight.shape[1]
    n_clusters = -(-n_lanes // _LANES)
    outputs = gates.new_empty(n_steps, n_lanes, width)
    hiddens = torch.empty_like(outputs)
    after, last_cell = torch.empty_like(output), torch.empty_like(cell)
    saved = None, None
    if needs_backward:
        lead = n_steps, n_clusters, width // _BLOCK_UNITS
        saved = (
            gates.new_empty(*lead, _LANES // 8, _THREADS, 8),
            cell.new_empty(*lead, _LANES // 8, _THREADS, 2),
        )
    launch(
        *_where("forward", width, gates.device, n_clusters),
        gates=gates,
        weight=weight,
        reset=reset,
        last_output=output,
        last_cell=cell,
        residual=residual,
        outputs=outputs,
        hiddens=hiddens,
        output=after,
        cell=last_cell,
        saved_gates=saved[0],
        saved_cells=saved[1],
        n_steps=n_steps,
        n_lanes=n_lanes,
        n_clusters=n_clusters,
    )
    return outputs, hiddens, after, last_cell, saved


def backward(weight, reset, saved_gates, saved_cells, d_outputs, d_cell) -> Gradients:
    """Computes the gradients of `forward`'s gates, output and cell.

    Args:
        weight: (4 W, W), recurrent.
        reset: (T, B) bool.
        saved_gates: of `forward`.
        saved_cells: of `forward`.
        d_outputs: (T, B, W).
        d_cell: (B, W) float32, gradient of the last cell. None: 0.

    Returns:
        The gradients of the gates (T, B, 4 W), of a bias (4 W,) float32, which is their sum, and of
        the output and the cell before the sequence, (B, W) float32.
    """
    n_steps, n_lanes, width = d_outputs.shape
    n_clusters = -(-n_lanes // _LANES)
    d_gates = d_outputs.new_empty(n_steps, n_lanes, 4 * width)
    d_bias = saved_cells.new_empty(n_clusters, 4 * width)
    d_last_output, d_last_cell = (saved_cells.new_empty(n_lanes, width) for _ in range(2))
    launch(
        *_where("backward", width, weight.device, n_clusters),
        weight=weight.T.contiguous(),
        reset=reset,
        saved_gates=saved_gates,
        saved_cells=saved_cells,
        d_outputs=d_outputs,
        d_cell=d_cell,
        d_gates=d_gates,
        d_bias=d_bias,
        d_last_output=d_last_output,
        d_last_cell=d_last_cell,
        n_steps=n_steps,
        n_lanes=n_lanes,
        n_clusters=n_clusters,
    )
    return d_gates, sum_rows(d_bias), d_last_output, d_last_cell


def _where(direction, width, device, n_clusters) -> tuple[KernelLibrary, str, torch.device, Blocks]:
    """Returns the arguments of a launch but its fields."""
    n_blocks = width // _BLOCK_UNITS * n_clusters
    blocks = Blocks(n_blocks, threads=_THREADS, shared=_memory(direction, width))
    return LIBRARY, f"lstm_sequence_{direction}_{width}", device, blocks


def _memory(direction, width) -> int:
    """Returns the bytes of shared memory that a block needs."""
    return LIBRARY.constants[f"{direction.upper()}_MEMORY_{width}"]
