"""Counts of the texels that agents have seen, and of the visible ones they have not.

N environments, A agents per environment, D layouts. A tensor of texels has one bit per static texel
of a layout, in ``n_words`` words of 32.
"""

import torch

from megastep.engine import checks
from megastep.engine.agents import Agents, check_on_cpu
from megastep.engine.launch_params import (
    error_flag_address,
    lanes_of,
    scenery_params,
    state_params,
)
from megastep.engine.scenery import Scenery
from megastep.kernels.build.launch import BLOCK, ENGINE, launch

__all__ = ["BANDS", "SECTORS", "coverage", "texel_bits", "unseen"]

BANDS = ENGINE.constants["BANDS"]
SECTORS = ENGINE.constants["SECTORS"]


def unseen(
    scenery: Scenery, agents: Agents, seen: torch.Tensor, visible: torch.Tensor
) -> torch.Tensor:
    """Counts the visible texels that each agent has not seen yet, by bearing and distance.

    Args:
        seen: (N, A, n_words) int32, as :func:`~megastep.engine.observe` marks them.
        visible: (D, n_words) int32, from :func:`~megastep.modules.visible_texels`.

    Returns:
        (N, A, 3, 16) int32: texels within 1.5 m, within 4 m and beyond, in 16 sectors of 22.5
        degrees. Sector 0 is straight ahead, and they run to the left. Texels of one wall that share
        a word are all counted at their midpoint.
    """
    n, a = lanes_of(scenery, agents)
    counts = torch.empty((n, a, BANDS, SECTORS), dtype=torch.int32, device=scenery.device)
    launch(
        *(ENGINE, "unseen", scenery.device, BLOCK * n * a),
        scenery=scenery_params(scenery, agents.radius),
        **state_params(scenery, agents, "positions", "angles"),
        **_seen_and_visible(scenery, seen, visible),
        error_flag=error_flag_address(scenery, agents),
        counts=counts,
    )
    check_on_cpu(agents)
    return counts


def coverage(
    scenery: Scenery,
    agents: Agents,
    seen: torch.Tensor,
    visible: torch.Tensor,
    mask: torch.Tensor,
) -> torch.Tensor:
    """Computes the fraction of its layout's visible texels that each masked agent has seen.

    Args:
        seen: (N, A, n_words) int32, as :func:`~megastep.engine.observe` marks them.
        visible: (D, n_words) int32, from :func:`~megastep.modules.visible_texels`.
        mask: (N, A) bool, agents to compute it for.

    Returns:
        (N, A) float32, 0 where not in ``mask``.
    """
    lanes, device = lanes_of(scenery, agents), scenery.device
    fractions = torch.empty(lanes, device=device)
    launch(
        *(ENGINE, "coverage", device, fractions.numel()),
        scenery=scenery_params(scenery, agents.radius),
        **_seen_and_visible(scenery, seen, visible),
        mask=checks.address("mask", mask, lanes, torch.bool, device),
        error_flag=error_flag_address(scenery, agents),
        coverage=fractions,
    )
    check_on_cpu(agents)
    return fractions


def texel_bits(
    scenery: Scenery, name: str, bits: torch.Tensor, axes: tuple[int, ...]
) -> tuple[int, int]:
    """Returns the address and ``n_words`` of a tensor (*axes, n_words) of texels.

    Raises:
        TypeError, ValueError: naming it, if it does not fit the scenery.
    """
    min_words = -(-scenery.layouts.max_texels // 32)
    n_words = checks.length(name, bits, axis=-1)
    if n_words < min_words:
        raise ValueError(
            f"{name} must have a bit for each of a layout's texels, so at least {min_words} words, "
            f"but it has {n_words}"
        )
    address = checks.address(name, bits, (*axes, n_words), torch.int32, scenery.device)
    return address, n_words


def _seen_and_visible(scenery, seen, visible):
    lanes = scenery.n_envs, scenery.n_agents
    seen_at, n_words = texel_bits(scenery, "seen", seen, lanes)
    shape = len(scenery.layouts), n_words
    visible_at = checks.address("visible", visible, shape, torch.int32, scenery.device)
    return dict(seen=seen_at, visible=visible_at, n_words=n_words)
