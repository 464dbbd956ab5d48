"""One step of Explorer as one operation. N environments, A agents each, B = N A lanes."""

from pathlib import Path
from typing import NamedTuple

import torch

from megastep.engine import checks
from megastep.engine.agents import Agents, check_on_cpu
from megastep.engine.launch_params import (
    error_flag_address,
    lanes_of,
    scenery_params,
    state_params,
    texel_bits,
)
from megastep.engine.scenery import Scenery
from megastep.envs.explorer.texel_runs import TexelRuns
from megastep.kernels.build.kernel_library import KernelLibrary
from megastep.kernels.build.launch import WARP, launch
from megastep.modules.visibility import TEXELS_PER_POINT

__all__ = ["N_BINS", "N_EPISODE", "LIBRARY", "ExplorerStep", "explorer_step"]

LIBRARY = KernelLibrary(Path(__file__).parent / "kernels")
N_EPISODE = LIBRARY.constants["N_EPISODE"]  # numbers that a critic sees of an episode
N_BINS = LIBRARY.constants["BANDS"] * LIBRARY.constants["SECTORS"]


class ExplorerStep(NamedTuple):
    """The outcome of a step, one row per lane."""

    reward: torch.Tensor  # (B,)
    reset: torch.Tensor  # (B,) bool
    terminal: torch.Tensor  # (B,) bool, always False
    truncated: torch.Tensor  # (B,) bool
    coverage: torch.Tensor | None  # (B,) 0 where no episode ends; None if not wanted, as the next
    episode: torch.Tensor | None  # (B, 1, 4): steps left / 200; steps taken, texels seen and left,
    # each / 1000
    unseen: torch.Tensor | None  # (B, 1, N_BINS): square root of (unseen texels / 64) in each bin:
    # within 1.5 m, within 4 m and beyond, in 16 sectors of 22.5 degrees. Sector 0 is straight
    # ahead, and they run to the left. A run's texels are all counted at its midpoint.


def explorer_step(
    scenery: Scenery,
    agents: Agents,
    newly_seen: torch.Tensor,
    seen: torch.Tensor,
    runs: TexelRuns | None,
    ages: torch.Tensor,
    limits: torch.Tensor,
    ended: torch.Tensor,
    *,
    patience: int = 200,
    coverage: bool = False,
    privileged: bool = False,
) -> ExplorerStep:
    """Rewards each agent for texels that it has seen for the first time, and ends episodes. See
    :class:`~megastep.envs.Explorer`.

    Args:
        newly_seen: (N, A) int32, from :func:`~megastep.engine.observe`.
        seen: (N, A, n_words) int32, the bitmap that it was given.
        runs: the visible texels of the scenery's layouts. None if neither ``coverage`` nor
            ``privileged``.
        ages: (B,) int32, steps since the first observation, updated in place.
        limits: (B,) int32, age at which the episode is truncated, updated in place.
        ended: (B,) bool, updated in place. In: lanes that start an episode in this step. Out: lanes
            whose episode ends in this step.
        patience: an episode is truncated after this many steps plus the texels seen.
        coverage: compute the fraction of the visible texels that was seen, where an episode ends.
        privileged: compute the privileged observation.

    Raises:
        TypeError, ValueError: naming the argument that does not fit.
        EngineError: on the CPU, if a position is NaN or a layout does not exist.
    """
    n, a = lanes = lanes_of(scenery, agents)
    device, n_lanes = scenery.device, n * a
    flags = [torch.empty(n_lanes, dtype=torch.bool, device=device) for _ in range(3)]
    coverage_out = episode = unseen = None
    if checks.flag("coverage", coverage):
        coverage_out = torch.empty(n_lanes, device=device)
    if checks.flag("privileged", privileged):
        episode = torch.empty((n_lanes, 1, N_EPISODE), device=device)
        unseen = torch.empty((n_lanes, 1, N_BINS), device=device)
    reward, (reset, terminal, truncated) = torch.empty(n_lanes, device=device), flags
    out = ExplorerStep(reward, reset, terminal, truncated, coverage_out, episode, unseen)
    seen_at, n_words = texel_bits(scenery, "seen", seen, lanes)
    tables = dict(runs=0, run_starts=0, n_visible=0)
    if coverage or privileged:
        tables = checks.instance("runs", runs, TexelRuns).addresses(scenery, n_words)
    launch(
        *(LIBRARY, "explorer_step", device, n_lanes * WARP if privileged else n_lanes),
        scenery=scenery_params(scenery, agents.radius),
        **state_params(scenery, agents, "positions", "angles"),
        newly_seen=checks.address("newly_seen", newly_seen, lanes, torch.int32, device),
        seen=seen_at,
        **tables,
        ages=checks.address("ages", ages, (n_lanes,), torch.int32, device),
        limits=checks.address("limits", limits, (n_lanes,), torch.int32, device),
        ended=checks.address("ended", ended, (n_lanes,), torch.bool, device),
        error_flag=error_flag_address(scenery, agents),
        **out._asdict(),
        n_words=n_words,
        patience=checks.integer("patience", patience, 1, 2**31 - 1),
        texels_per_point=TEXELS_PER_POINT,
    )
    check_on_cpu(agents)
    return out
