"""Scenery: what the engine renders and collides with.

Walls, their textures and baked light, and lights belong to a *layout*; a world points at a layout,
so a million worlds share a few thousand homes. Each world adds only its agents' lines and the light
on them. N worlds, D layouts, A agents a world, M lines of the agent model, K texels of one world's
agents, W walls and T texels of all layouts.
"""

from functools import cached_property

import torch

from .ragged import Bounds, Ragged


def _expand(starts, widths):
    """Indices of the ranges [start, start + width), end to end."""
    offsets = widths.cumsum(0) - widths
    return torch.arange(int(widths.sum()), device=widths.device) + torch.repeat_interleave(
        starts - offsets, widths
    )


class Pieced(Bounds):
    """A read-only Ragged whose subarrays are pieces of two tensors, joined when asked for: the
    agents' part first, then the layout's.

    ``vals``, ``starts``, ``ends``, ``widths``, ``inverse`` and indexing are those of a
    :class:`~megastep.ragged.Ragged`; all are copies.
    """

    def __init__(self, vals, starts, widths):
        self._vals, self._starts, self._widths = vals, starts, widths

    @cached_property
    def widths(self):
        return self._widths[0] + self._widths[1]

    @cached_property
    def vals(self):
        first, second = self._vals
        starts = torch.stack([self._starts[0], self._starts[1] + len(first)], 1).flatten()
        return torch.cat([first, second])[_expand(starts, torch.stack(self._widths, 1).flatten())]

    @property
    def inverse(self):
        return torch.repeat_interleave(
            torch.arange(len(self), device=self.widths.device), self.widths
        )

    @property
    def device(self):
        return self._widths[0].device

    def __len__(self):
        return len(self._widths[0])

    def __getitem__(self, index):
        if isinstance(index, slice):
            chosen = range(len(self))[index]
            return Ragged(
                torch.cat([self[i] for i in chosen] or [self._vals[0][:0]]),
                self.widths[list(chosen)],
            )
        if not -len(self) <= index < len(self):
            raise IndexError(f"index {index} is out of range for {len(self)} subarrays")
        return torch.cat(
            [
                vals[int(s[index]) : int(s[index]) + int(w[index])]
                for vals, s, w in zip(self._vals, self._starts, self._widths)
            ]
        )

    def torchify(self):
        return Ragged(self.vals, self.widths)

    def numpyify(self):
        return self.torchify().numpyify()

    def __repr__(self):
        return f"Pieced({self.widths.cpu().numpy()})"


class Layouts:
    """The static part of scenery, shared by the worlds that show it.

    Args: ``lines`` Ragged (W, 2, 2) metres; ``textures`` Ragged (T, 3), one subarray a wall, linear
    light in [0, 1]; ``lights`` Ragged (l, 3), x, y, intensity; ``agent_textures`` (D, K, 3).
    ``lines.vals``, ``textures.vals``, ``baked.vals`` and ``lights.vals`` may be edited in place;
    call ``bake`` after moving walls or lights.
    """

    def __init__(self, lines, textures, lights, agent_textures, device):
        self.lines = Ragged(_floats(lines.vals, device), lines.widths.to(device))
        self.lights = Ragged(_floats(lights.vals, device), lights.widths.to(device))
        self.texels = torch.cat(
            [_floats(textures.vals, device), torch.ones((len(textures.vals), 1), device=device)], 1
        ).contiguous()
        self.textures = Ragged(self.texels[:, :3], textures.widths.to(device))
        self.baked = Ragged(self.texels[:, 3], textures.widths.to(device))
        self.agent_textures = _floats(agent_textures, device)
        self.wall_starts, self.light_starts, self.texel_starts = (
            _bounds(r.widths) for r in (self.lines, self.lights, self.textures)
        )
        for name, wanted, given in [
            ("texture for each wall", len(self.lines.vals), len(self.textures)),
            ("set of lights for each layout", len(self.lines), len(self.lights)),
            ("set of agent textures for each layout", len(self.lines), len(self.agent_textures)),
        ]:
            if wanted != given:
                raise ValueError(
                    f"scenery needs one {name}, so {wanted} of them, but {given} were given"
                )
        if len(textures.widths) and int(textures.widths.min()) < 1:
            raise ValueError(
                "every wall needs at least one texel, but a texture of width 0 was given"
            )
        self.bound()

    def __len__(self):
        return len(self.lines)

    def bound(self):
        """Draws ``boxes`` around every 32 walls of a layout, which let the GPU leave out what
        cannot be seen.
        """
        groups = (self.lines.widths + 31) // 32
        self.box_starts = _bounds(groups)
        first = self.lines.starts[self.lines.inverse]
        within = torch.arange(len(first), device=first.device) - first
        group = self.box_starts.long()[self.lines.inverse] + within // 32
        ends, where = self.lines.vals, group[:, None, None].expand(-1, 2, 2)
        low = torch.full((int(groups.sum()), 2), torch.inf, device=first.device)
        low.scatter_reduce_(0, where.reshape(-1, 2), ends.reshape(-1, 2), "amin")
        high = torch.full_like(low, -torch.inf).scatter_reduce_(
            0, where.reshape(-1, 2), ends.reshape(-1, 2), "amax"
        )
        self.boxes = torch.cat([low, high], 1)

    @cached_property
    def max_texels(self):
        """The most static texels that any layout has."""
        return int(self.texel_starts[self.wall_starts.long()].diff().max())


class Scenery:
    """N worlds of A agents each.

    ``Scenery(n_agents, lights, lines, textures, model)`` takes what every world has of its own:
    raggeds of ``lights`` (l, 3) and ``lines`` (L, 2, 2) by world, each world's agents' lines first,
    ``textures`` (T, 3) by line, and the agents' ``model`` (M, 2, 2) in metres about their origin.
    :meth:`of_layouts` shares layouts between worlds. The agents' texture widths must be the same in
    every world. ValueError if the parts do not fit.
    """

    def __init__(self, n_agents, lights, lines, textures, model, device=None):
        lights, lines, textures = (r.torchify() for r in (lights, lines, textures))
        device = torch.device(device or lines.vals.device)
        n, own = len(lines), n_agents * len(model)
        if int(lines.widths.min()) < own:
            raise ValueError(
                f"every world must begin with the {own} lines of its {n_agents} agents, but one "
                f"has "
                f"{int(lines.widths.min())} lines in all"
            )
        is_agent = (
            torch.arange(len(lines.vals), device=lines.vals.device) - lines.starts[lines.inverse]
            < own
        )
        if len(textures) != len(lines.vals):
            raise ValueError(
                f"scenery needs one texture for each line, so {len(lines.vals)} of them, but "
                f"{len(textures)} were given"
            )
        agent_widths = textures.widths[is_agent].view(n, own)
        if not bool((agent_widths == agent_widths[0]).all()):
            raise ValueError(
                "the texture widths of the agents' lines must be the same in every world, but "
                "they differ"
            )
        of_agent = is_agent[textures.inverse]
        layouts = Layouts(
            Ragged(lines.vals[~is_agent], lines.widths - own),
            Ragged(textures.vals[~of_agent], textures.widths[~is_agent]),
            lights,
            textures.vals[of_agent].view(n, -1, 3),
            device,
        )
        self._fill(n_agents, layouts, model, agent_widths[0], torch.arange(n), device)

    @classmethod
    def of_layouts(cls, n_agents, layouts, model, model_widths, layout):
        """``layout`` (N,) ints: the layout each world shows; ``model_widths`` (A M,) texels of each
        agent line.
        """
        self = cls.__new__(cls)
        self._fill(n_agents, layouts, model, model_widths, layout, layouts.texels.device)
        return self

    def _fill(self, n_agents, layouts, model, model_widths, layout, device):
        self.n_agents, self.layouts, self.device = n_agents, layouts, layouts.texels.device
        device = self.device
        self.model = _floats(model, device)
        self.model_texels = _bounds(torch.as_tensor(model_widths, device=device))
        self.layout = torch.as_tensor(layout, dtype=torch.int32, device=device).contiguous()
        if int(self.model_texels[-1]) != layouts.agent_textures.shape[1]:
            raise ValueError(
                f"the agents' textures have {layouts.agent_textures.shape[1]} texels a world, but "
                f"their lines "
                f"need {int(self.model_texels[-1])}"
            )
        if len(self.layout) and not 0 <= int(self.layout.min()) <= int(self.layout.max()) < len(
            layouts
        ):
            raise ValueError(
                f"worlds must show layouts 0 to {len(layouts) - 1}, but one shows "
                f"{int(self.layout.max())}"
            )
        self.agent_lines = self.model.repeat(self.n_envs, n_agents, 1, 1)
        self.agent_light = torch.ones((self.n_envs, layouts.agent_textures.shape[1]), device=device)
        self.reach = float(self.model.norm(dim=-1).max()) if len(self.model) else 0.0

    @property
    def n_envs(self):
        return len(self.layout)

    # Per-world views, as seed 002's users know them.

    @property
    def lines(self):
        """Per world, all its lines (L, 2, 2): the agents' first, as last placed."""
        layout, static = self.layout.long(), self.layouts.lines
        n = self.agent_lines.shape[1]
        own = torch.arange(self.n_envs, device=self.device) * n
        return Pieced(
            (self.agent_lines.flatten(0, 1), static.vals),
            (own, static.starts[layout]),
            (torch.full_like(own, n), static.widths[layout]),
        )

    @property
    def lights(self):
        """Per world, its lights (l, 3)."""
        layout, static = self.layout.long(), self.layouts.lights
        zero = torch.zeros_like(layout)
        return Pieced(
            (static.vals[:0], static.vals),
            (zero, static.starts[layout]),
            (zero, static.widths[layout]),
        )

    @property
    def textures(self):
        """Per line of all worlds, its texels (w, 3); line l of world e is line ``lines.starts[e] +
        l``.
        """
        own = self.layouts.agent_textures
        return self._by_line(
            (own.flatten(0, 1), self.layouts.textures.vals), self.layout.long() * own.shape[1]
        )

    @property
    def baked(self):
        """Per line of all worlds, the light on its texels (w,)."""
        own = self.agent_light
        return self._by_line(
            (own.flatten(), self.layouts.baked.vals),
            torch.arange(self.n_envs, device=self.device) * own.shape[1],
        )

    def _by_line(self, vals, agent_starts):
        static, layout = self.layouts.textures, self.layout.long()
        walls = self.layouts.lines
        n = len(self.model_texels) - 1
        order = Pieced(
            (
                torch.arange(self.n_envs * n, device=self.device),
                self.n_envs * n + torch.arange(len(walls.vals), device=self.device),
            ),
            (torch.arange(self.n_envs, device=self.device) * n, walls.starts[layout]),
            (torch.full_like(layout, n), walls.widths[layout]),
        ).vals
        is_agent = order < self.n_envs * n
        bounds = self.model_texels.long()
        world, line = order // max(n, 1), order % max(n, 1)
        wall = (order - self.n_envs * n).clamp(min=0)
        zero = torch.zeros_like(order)
        if not n:
            return Pieced(vals, (zero, static.starts[wall]), (zero, static.widths[wall]))
        world = world.clamp(max=self.n_envs - 1)
        starts = torch.where(is_agent, agent_starts[world] + bounds[line], zero)
        widths = torch.where(is_agent, (bounds[1:] - bounds[:-1])[line], zero)
        if not len(walls.vals):
            return Pieced(vals, (starts, zero), (widths, zero))
        return Pieced(
            vals,
            (starts, torch.where(is_agent, zero, static.starts[wall])),
            (widths, torch.where(is_agent, zero, static.widths[wall])),
        )

    def env(self, e):
        """World ``e`` alone: (lines (L, 2, 2), a tuple of lit textures (w, 3) one a line, lights
        (l, 3)), the agents' first. Cheap however many worlds there are.
        """
        layouts, d = self.layouts, int(self.layout[e])
        lines = torch.cat([self.agent_lines[e], layouts.lines[d]])
        first, last = int(layouts.wall_starts[d]), int(layouts.wall_starts[d + 1])
        bounds, own = layouts.texel_starts[first : last + 1].tolist(), self.model_texels.tolist()
        agents = layouts.agent_textures[d] * self.agent_light[e, :, None]
        walls = (
            layouts.texels[bounds[0] : bounds[-1], :3] * layouts.texels[bounds[0] : bounds[-1], 3:]
        )
        return (
            lines,
            (*agents.split(_widths(own)), *walls.split(_widths(bounds))),
            layouts.lights[d],
        )


def _widths(bounds):
    return [last - first for first, last in zip(bounds, bounds[1:])]


def _floats(vals, device):
    return torch.as_tensor(vals, dtype=torch.float32, device=device).contiguous()


def _bounds(widths):
    """(n + 1,) int32: where each subarray starts, and where the last ends."""
    ends = widths.cumsum(0)
    if len(ends) and int(ends[-1]) >= 2**31:
        raise ValueError(
            f"scenery holds at most 2,147,483,647 walls and texels of each kind, but "
            f"{int(ends[-1])} were given: "
            f"use fewer layouts"
        )
    return torch.cat([ends.new_zeros(1), ends]).to(torch.int32)
