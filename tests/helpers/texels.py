"""Bitmaps of texels."""

import torch


def packed(bits):
    """Packs bits (..., 32 n_words) into words (..., n_words) int32, the first in the lowest bit."""
    values = torch.tensor([2**i for i in range(31)] + [-(2**31)])
    return (bits.unflatten(-1, (-1, 32)) * values).sum(-1).int()


def unpacked(words):
    """Unpacks words (..., n_words) int32 into bits (..., 32 n_words) bool."""
    return (words.cpu()[..., None] >> torch.arange(32, dtype=torch.int32) & 1).bool().flatten(-2)


def n_texels(layouts):
    """(D,): the number of texels of each layout."""
    return layouts.texel_starts[layouts.wall_starts.long()].diff().cpu()


def seen_of(core):
    """Returns zeros (N, A, n_words) for the texels that each agent has seen."""
    n_words = -(-core.scenery.layouts.max_texels // 32)
    return torch.zeros((core.n_envs, core.n_agents, n_words), dtype=torch.int32, device=core.device)
