"""Scenery from geometries: textures, lights, the agents' model, baked light."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from megastep import engine
from megastep.colour import gamma_decode
from megastep.engine import checks
from megastep.engine.operations import bake_cached
from megastep.engine.scenery import Layouts, Scenery
from megastep.ragged import Ragged

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from megastep.plotting import Area

__all__ = ["TEXEL", "agent_model", "display", "scenery", "spread", "texel_widths", "wall_textures"]

TEXEL = 0.05  # metres per texel
STRIPE = (0.4, 2.0)  # metres, min and max of the period of a wall's stripes
INTENSITY = (0.5, 1.6)  # min and max of a light's intensity
PALETTE = (
    "d9b08c a3c1ad e0d5b6 b7a7c9 9fb8d0 c98b8b d8c27a 8fae7d b0b0b0 cf9fb5 7fb0b0 e8e0d8"
).split()
# Saturated, unlike walls: an agent's weakest channel has at most a tenth of its light, a wall's at
# least an eighth. So a pixel shows which of the two it is at any brightness.
AGENT_PALETTE = (
    "3b6ea5 a5523b 2c9030 7a3ba5 a58a3b 3b9a9a a53b74 6f9a2a "
    "c87a18 2438c8 18a868 c82cb4 c8c020 5018c0 20a8e0 804010"
).split()
FRONT = "ff3020"


def linear(palette) -> np.ndarray:
    """Returns the linear light, (n, 3), of hexadecimal colours."""
    return gamma_decode(
        np.array([[int(colour[i : i + 2], 16) / 255 for i in (0, 2, 4)] for colour in palette])
    )


WALL_COLOURS, AGENT_COLOURS, (FRONT_COLOUR,) = map(linear, (PALETTE, AGENT_PALETTE, [FRONT]))


def texel_widths(lines: np.ndarray) -> np.ndarray:
    """Returns the number of 5 cm texels, (L,) int64 and at least 1, of lines (L, 2, 2)."""
    lengths = np.linalg.norm(lines[:, 1].astype(float) - lines[:, 0], axis=-1)
    return np.maximum(np.ceil(lengths / TEXEL - 1e-3), 1).astype(np.int64)


def agent_model(width: float = engine.AGENT_WIDTH) -> np.ndarray:
    """Returns the lines, (8, 2, 2), of an octagon ``width`` metres wide. The third is its front."""
    w, h = width / 2, width / 4
    corners = np.array(
        [(-h, -w), (h, -w), (w, -h), (w, h), (h, w), (-h, w), (-w, h), (-w, -h)], dtype=np.float32
    )
    return np.stack([corners, np.roll(corners, -1, 0)], 1)


def wall_textures(widths: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Returns texels (T, 3) of walls of ``widths`` (W,) texels: random stripes of two colours."""
    n, palette = len(widths), WALL_COLOURS
    base = palette[random.integers(len(palette), size=n)] * random.uniform(0.6, 1.0, (n, 1))
    stripe = palette[random.integers(len(palette), size=n)] * random.uniform(0.2, 0.8, (n, 1))
    period = random.uniform(*STRIPE, n)
    phase = random.uniform(0, 1, n)
    duty = random.uniform(0.1, 0.5, n)
    wall = np.repeat(np.arange(n), widths)
    along = (np.arange(len(wall)) - (widths.cumsum() - widths)[wall] + 0.5) * TEXEL
    turns = along / period[wall] + phase[wall]
    striped = turns - np.floor(turns) < duty[wall]
    return np.concatenate([base, stripe]).astype(np.float32)[wall + n * striped]


def _sorted_along_z_curve(parts) -> np.ndarray:
    """Returns the walls (M, 2, 2) of each layout along a Z-order curve: groups of 32 are close."""
    walls = np.concatenate(parts)
    cells = walls.mean(1).astype(np.int64)
    order = np.repeat(np.arange(len(parts)), [len(part) for part in parts]) << 16
    for bit in range(8):
        order += ((cells >> bit & 1) << np.array([2 * bit, 2 * bit + 1])).sum(-1)
    return walls[np.argsort(order, kind="stable")]


def _part(geometries, name, shape) -> list:
    """Returns one part of all geometries as arrays. Raises ValueError if one does not fit."""
    parts = []
    for i, g in enumerate(geometries):
        array: Any = getattr(g, name, None)
        fits = isinstance(array, np.ndarray) and array.dtype.kind in "iuf"
        if fits and array.size:
            fits = array.shape[1:] == shape and bool((np.abs(array) < checks.LIMIT).all())
        if not fits:
            raise ValueError(
                f"geometries[{i}].{name} must be a numpy array of numbers below {checks.LIMIT:g}, "
                f"of shape {('n', *shape)}: make geometries with megastep.toys or "
                f"megastep.geometries.sample"
            )
        parts.append(np.reshape(array, (-1, *shape)))
    return parts


def spread(geometries: Sequence, n_envs: int) -> list:
    """Returns the geometries that ``n_envs`` environments start in: all, or evenly spaced ones."""
    n_envs = checks.integer("n_envs", n_envs, 1)
    n_layouts = len(checks.items("geometries", geometries))
    n_shown = min(n_envs, n_layouts)
    return [geometries[e * n_layouts // n_shown] for e in range(n_shown)]


def scenery(
    geometries: Sequence,
    n_agents: int = 1,
    n_envs: int | None = None,
    seed: int = 1,
    device: torch.device | str | None = None,
) -> Scenery:
    """Returns the baked :class:`~megastep.engine.Scenery` of ``n_envs`` environments. Each geometry
    becomes a layout: a floor plan with random textures and light intensities. Environment e of N
    starts with layout ``e % D`` of D; with more layouts than environments, with ``e * D // N``.

    Args:
        geometries: floor plans.
        n_agents: agents per environment.
        n_envs: number of environments. Default: one per geometry.
        seed: of textures and light intensities.
        device: where the tensors are, as in :func:`megastep.engine.device`. Default: a GPU if there
            is one.

    Raises:
        ValueError: if an argument does not fit. The message names it.
        EngineError: if the environments do not fit into memory.
    """
    geometries = checks.items("geometries", geometries)
    n_agents = checks.integer("n_agents", n_agents, 0)
    n_envs = checks.integer("n_envs", len(geometries) if n_envs is None else n_envs, 1)
    random = np.random.Generator(np.random.Philox(checks.integer("seed", seed, 0)))
    if not isinstance(device, torch.device):
        device = engine.device("auto" if device is None else device)
    model = agent_model()
    bodies = AGENT_COLOURS[np.arange(n_agents) % len(AGENT_COLOURS), None]
    colours = np.repeat(bodies, len(model), 1)
    colours[:, model.mean(1)[:, 0].argmax()] = FRONT_COLOUR
    model_widths = np.tile(texel_widths(model), n_agents)
    agent_textures = np.repeat(colours.reshape(-1, 3), model_widths, 0)
    engine.fit(n_envs, 20 * n_agents * len(model) + 4 * len(agent_textures) + 64, device)

    wall_parts, light_parts = _part(geometries, "walls", (2, 2)), _part(geometries, "lights", (2,))
    walls = _sorted_along_z_curve(wall_parts).astype(np.float32)
    widths = texel_widths(walls)
    positions = np.concatenate(light_parts)
    intensities = random.uniform(*INTENSITY, (len(positions), 1))
    lights = np.concatenate([positions, intensities], 1).astype(np.float32)
    layouts = Layouts(
        lines=Ragged(torch.as_tensor(walls), torch.tensor([len(part) for part in wall_parts])),
        textures=Ragged(torch.as_tensor(wall_textures(widths, random)), torch.as_tensor(widths)),
        lights=Ragged(torch.as_tensor(lights), torch.tensor([len(part) for part in light_parts])),
        agent_textures=torch.as_tensor(agent_textures, dtype=torch.float32).repeat(
            len(geometries), 1, 1
        ),
        device=device,
    )
    n_layouts = len(geometries)  # all are shown, or evenly spaced ones
    layout = torch.arange(n_envs) * n_layouts // min(n_envs, n_layouts) % n_layouts
    result = Scenery(n_agents, layouts, model, model_widths, layout)
    bake_cached(result)
    return result


def display(scenery: Scenery, e: int = 0, ax: "Area | Axes | None" = None) -> "Area | Axes":
    """Draws environment ``e`` in its lit colours. Returns what it is drawn on."""
    from megastep import plotting

    lines, colours, lights = scenery.env(e)
    texels = [of_line.cpu().numpy() for of_line in colours]
    return plotting.plot_scenery(lines.cpu().numpy(), texels, lights.cpu().numpy(), ax=ax)
