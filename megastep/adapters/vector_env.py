"""Environments of megastep as Gymnasium's: a vector environment on the device, and one of N = 1."""

import inspect
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from megastep import arrdict, envs, spaces
from megastep.adapters.lane_steps import Lanes, ended, fresh
from megastep.dotdict import leaves, mapping
from megastep.plotting import rasterise
from megastep.types import Env, Space, Tree, optional

__all__ = ["SingleEnv", "VectorEnv", "make_single", "make_vector"]

OUTCOMES = "reward", "terminal", "truncated"
NUMPY: Any = {torch.float16: np.float16, torch.float32: np.float32}


class VectorEnv(gymnasium.vector.VectorEnv):
    """An environment of megastep as a `gymnasium.vector.VectorEnv`: each lane is one of its
    environments.

    Args:
        env: the environment.
        autoreset_mode: when a lane begins its next episode. ``NEXT_STEP``: in the step after its
            last. ``SAME_STEP``: at once; ``infos`` have the last observation as ``final_obs``, and
            most environments render all lanes twice; docs/adapters.md says which do not.
            ``DISABLED``: by ``reset(options={"reset_mask": mask})``.
        to_numpy: return arrays; otherwise tensors on the device, without synchronising. Tensors of
            ``infos`` are there in every step then, with masks. Where the environment allows some
            actions only, ``infos["action_mask"]`` says which in every step: int8 arrays, or bool.
        dtype: of observations in floats. Default: float32 for arrays, the environment's float16 for
            tensors.
        copy: return copies, of which on a GPU up to 32 steps' share memory. Otherwise tensors are
            valid until the next step or reset.
        render_mode: None, or ``rgb_array``, a drawing of each environment.
    """

    def __init__(
        self,
        env: Env,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        *,
        to_numpy: bool = True,
        dtype: torch.dtype | None = None,
        copy: bool = True,
        render_mode: str | None = None,
    ):
        name = getattr(autoreset_mode, "name", str(autoreset_mode)).upper()
        mode = next((m for m in AutoresetMode if name in (m.name, m.value.upper())), None)
        if mode is None:
            names = ", ".join(AutoresetMode.__members__)
            raise ValueError(f"autoreset_mode must be one of {names}, not {autoreset_mode!r}")
        needs_masks = mode is not AutoresetMode.NEXT_STEP
        purpose = f"autoreset_mode={mode.name}" if needs_masks else None
        parts = self._copied if copy or to_numpy else None
        self.lanes = Lanes(env, mode is AutoresetMode.SAME_STEP, purpose, parts, to_numpy)
        self.env, self.num_envs, self.device = env, self.lanes.n_lanes, self.lanes.device
        self.autoreset_mode, self.to_numpy, self.copy = mode, to_numpy, copy
        self.dtype = dtype or (torch.float32 if to_numpy else torch.float16)
        if self.dtype not in NUMPY:
            raise ValueError(f"dtype must be one of {', '.join(map(str, NUMPY))}, not {dtype!r}")
        self.single_observation_space = gymnasium_space(env.obs_space, self.dtype)
        self.single_action_space = gymnasium_space(env.action_space, torch.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        drawings = ["rgb_array"] if hasattr(env, "plot_state") else []
        if render_mode is not None and render_mode not in drawings:
            cure = "" if drawings else "; docs/new-environment.md shows how to draw with plot_state"
            raise ValueError(
                f"render_mode must be None or one of {drawings}, not {render_mode!r}{cure}"
            )
        self.render_mode = render_mode
        fps = optional(env, "fps")
        self.metadata = dict(autoreset_mode=mode, render_modes=drawings, render_fps=fps)
        self._ended = np.zeros(self.num_envs, bool)
        self._stepped: tuple | None = None

    def reset(
        self, *, seed: Tree = None, options: Mapping[str, Tree] | None = None
    ) -> tuple[Tree, dict[str, Tree]]:
        """Begins episodes in all lanes, or in those of a mask. Returns (observations, infos).

        Args:
            seed: an integer s, for seeds s, s + 1, ... of the lanes, or one seed per lane. An
                episode depends on the seed and the lane: lanes with equal seeds differ.
            options: ``reset_mask``: (B,) bool, lanes that begin; the others stay as they are.
        """
        super().reset(seed=seed if isinstance(seed, int) else None)
        options = dict(options or {})
        mask = options.pop("reset_mask", None)
        if options:
            raise ValueError(f"reset takes options['reset_mask'] alone, not {sorted(options)}")
        world = self.lanes.reset(seed, mask)
        parts = dict(obs=without_agents(self.env.obs_space, world["obs"]), mask=self._mask(world))
        if self.to_numpy:
            self._ended = np.zeros_like(self._ended) if mask is None else to_numpy(ended(world))
            parts = to_numpy(self._cast(parts))
        else:
            parts = self._cast(fresh(parts) if self.copy else parts)
        return parts["obs"], self._mask_infos(parts["mask"])

    def step(self, actions: Tree) -> tuple[Tree, Tree, Tree, Tree, dict[str, Tree]]:
        """Steps all lanes. Returns (observations, rewards, terminations, truncations, infos)."""
        if self.to_numpy and self.autoreset_mode is AutoresetMode.DISABLED and self._ended.any():
            raise ValueError(
                f"lane {int(self._ended.argmax())} has ended its episode: in DISABLED, begin the "
                'next by reset(options={"reset_mask": mask}) before the next step'
            )
        stepped = self.lanes.step(actions)
        parts = self._arrays(stepped) if self.to_numpy else self._tensors(stepped)
        infos, over = {}, parts["over"]
        if not self.to_numpy or over.any():  # Gymnasium's form: each key with a mask of its lanes
            infos = parts["metrics"] | {f"_{name}": over for name in parts["metrics"]}
            if self.autoreset_mode is AutoresetMode.SAME_STEP:
                final_obs = parts["final_obs"]
                infos = dict(final_obs=final_obs, _final_obs=over, final_info=infos)
                infos["_final_info"] = over
        infos |= self._mask_infos(parts["mask"])
        return parts["obs"], *(parts[name] for name in OUTCOMES), infos

    def _parts(self, world, final, over) -> dict[str, Tree]:
        """Returns what a step returns, without copies."""
        parts: dict[str, Tree] = {name: final[name] for name in OUTCOMES}
        parts |= dict(over=over, metrics=dict(final.get("metrics", {})), mask=self._mask(world))
        parts["obs"] = without_agents(self.env.obs_space, world["obs"])
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            parts["final_obs"] = without_agents(self.env.obs_space, final["obs"])
        return parts

    def _copied(self, world, final, over) -> dict[str, Tree]:
        """Returns parts as they are given away; arrays of last observations are cast later."""
        return self._cast(self._parts(world, final, over))

    def _cast(self, parts) -> dict[str, Tree]:
        """Returns parts with floats of observations in the dtype."""
        names = {"obs"} if self.to_numpy else {"obs", "final_obs"} & parts.keys()
        return parts | {name: as_dtype(parts[name], self.dtype) for name in names}

    def _tensors(self, stepped) -> dict[str, Tree]:
        if self.lanes.copies:
            return self.lanes.copies.take()
        if stepped is not self._stepped:  # on a GPU the same each time
            self._stepped, self._views = stepped, self._parts(*stepped)
            floats = filter(torch.is_floating_point, leaves(self._views["obs"]))
            self._casts = any(leaf.dtype != self.dtype for leaf in floats)
        parts = fresh(self._views) if self.copy else self._views
        return self._cast(parts) if self._casts else parts

    def _arrays(self, stepped) -> dict[str, Tree]:
        copies = self.lanes.copies
        parts = copies.take() if copies else to_numpy(self._copied(*stepped))
        is_same = self.autoreset_mode is AutoresetMode.SAME_STEP
        self._ended = np.zeros_like(self._ended) if is_same else parts["over"]
        if is_same and parts["over"].any():
            last = parts["final_obs"]
            parts["final_obs"] = np.full(self.num_envs, None, dtype=object)
            kind = NUMPY[self.dtype]
            cast = mapping(lambda leaf: leaf.astype(kind if leaf.dtype.kind == "f" else leaf.dtype))
            for lane in np.flatnonzero(parts["over"]):
                parts["final_obs"][lane] = cast(row(last, lane))
        return parts

    def _mask(self, world) -> dict[str, Tree]:
        """Returns the mask of the actions that are allowed now, if the environment gives one."""
        if "mask" not in world:
            return {}
        return {"action_mask": without_agents(self.env.action_space, world["mask"])}

    def _mask_infos(self, mask) -> dict[str, Tree]:
        """Returns a mask for infos; an array is int8, as Gymnasium's spaces sample by."""
        if not mask:
            return {}
        if self.to_numpy:
            mask = mapping(lambda leaf: leaf.astype(np.int8))(mask)
            return mask | {"_action_mask": np.ones(self.num_envs, bool)}
        everyone = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        return mask | {"_action_mask": everyone}

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Returns a drawing (H, W, 3) uint8 of each environment if ``render_mode`` is
        ``rgb_array``.
        """
        if self.render_mode is None:
            return None
        drawn: Tree = self.env
        return tuple(rasterise(drawn.display(e)) for e in range(drawn.n_envs))

    def close_extras(self, **kwargs: Tree) -> None:
        """Closes the environment."""
        self.lanes.close()


class SingleEnv(gymnasium.Env):
    """An environment of megastep with one lane as a `gymnasium.Env`, in NumPy. ``render_mode`` is
    None or ``rgb_array``.
    """

    def __init__(self, env: Env, render_mode: str | None = None):
        self.vector = VectorEnv(env, AutoresetMode.NEXT_STEP, render_mode=render_mode)
        if self.vector.num_envs != 1:
            raise ValueError(
                f"a single environment has one lane, but this {type(env).__name__} has "
                f"{self.vector.num_envs}: use VectorEnv, or ParallelEnv for several agents"
            )
        self.observation_space = self.vector.single_observation_space
        self.action_space = self.vector.single_action_space
        self.render_mode = render_mode
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": optional(env, "fps")}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Tree] | None = None
    ) -> tuple[Tree, dict[str, Tree]]:
        """Begins an episode. Returns (observation, info)."""
        super().reset(seed=seed)
        obs, infos = self.vector.reset(seed=seed, options=options)
        return row(obs, 0), _info(infos)

    def step(self, action: Tree) -> tuple[Tree, float, bool, bool, dict[str, Tree]]:
        """Returns (observation, reward, terminated, truncated, info)."""
        actions = arrdict.stack([action])
        obs, reward, terminated, truncated, infos = self.vector.step(actions)
        flags = bool(terminated[0]), bool(truncated[0])
        return row(obs, 0), float(reward[0]), *flags, _info(infos)

    def render(self) -> np.ndarray | None:
        """Returns a drawing (H, W, 3) uint8 if ``render_mode`` is ``rgb_array``."""
        frames = self.vector.render()
        return None if frames is None else frames[0]

    def close(self) -> None:
        """Closes the environment."""
        self.vector.close()


def _info(infos) -> dict[str, Tree]:
    """Returns the info of the only lane."""
    return {
        key: row(value, 0) if key == "action_mask" else float(value[0])
        for key, value in infos.items()
        if not key.startswith("_")
    }


def make_vector(name: str, num_envs: int = 1, **settings: Tree) -> VectorEnv:
    """Returns a :class:`VectorEnv` by its class name, for ``gymnasium.make_vec``. ``settings`` are
    its arguments and the environment's. ``num_envs`` counts environments; several agents are that
    many lanes.
    """
    _, *arguments = inspect.signature(VectorEnv).parameters
    own = {key: settings.pop(key) for key in arguments if key in settings}
    return VectorEnv(_made(name, num_envs, settings), **own)


def make_single(name: str, render_mode: str | None = None, **settings: Tree) -> SingleEnv:
    """Returns a :class:`SingleEnv` by its class name, on the CPU, for ``gymnasium.make``."""
    return SingleEnv(_made(name, 1, {"device": "cpu"} | settings), render_mode)


def _made(name, n_envs, settings) -> Env:
    kind = envs.ENVS[name.lower()]
    names = [*inspect.signature(kind).parameters][1:]
    if unknown := sorted(settings.keys() - {*names}):
        raise ValueError(f"{name} has no setting {unknown[0]}: it has {', '.join(names)}")
    return kind(n_envs, **settings)


# ---- Spaces and values, without an axis of one agent per lane ----


def gymnasium_space(space: Space, dtype: torch.dtype) -> gymnasium.Space:
    """Returns Gymnasium's space of one lane's actions, or observations with floats of a dtype."""
    if isinstance(space, Mapping):
        parts = {key: gymnasium_space(part, dtype) for key, part in space.items()}
        return gymnasium.spaces.Dict(parts)
    shape = space.shape[1:] if space.shape[0] == 1 else space.shape
    if isinstance(space, spaces.MultiDiscrete):
        if not shape:
            return gymnasium.spaces.Discrete(space.n_actions)
        return gymnasium.spaces.MultiDiscrete([space.n_actions] * space.n_agents)
    is_action = isinstance(space, spaces.MultiContinuous)
    pair = space.tensors() if is_action else space.bounds()
    low, high = (bound.expand(space.shape).reshape(shape).numpy() for bound in pair)
    kind = np.float32 if is_action else NUMPY[dtype]
    if space.dtype == torch.uint8:
        low, high, kind = np.clip(low, 0, 255), np.clip(high, 0, 255), np.uint8
    return gymnasium.spaces.Box(low.astype(kind), high.astype(kind), dtype=kind)


def without_agents(space: Space, values: Tree) -> Tree:
    """Returns observations (B, ...) or masks (B, A, n), a tensor or a dict of those of some parts
    of a space, without an axis of one agent per lane.
    """
    if isinstance(values, Mapping):
        return {key: without_agents(space[key], part) for key, part in values.items()}
    return values[:, 0] if space.shape[0] == 1 else values


@mapping
def as_dtype(leaf: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
    """Returns a tree of tensors whose floats are of a dtype."""
    return leaf.to(dtype) if leaf.is_floating_point() else leaf


def to_numpy(tree: Tree) -> Tree:
    """Returns a tree of tensors as arrays that share no memory with them. From a GPU all come
    together, into pinned memory, and are waited for once.
    """

    @mapping
    def on_cpu(leaf: torch.Tensor) -> torch.Tensor:
        target = torch.empty(leaf.shape, dtype=leaf.dtype, pin_memory=leaf.is_cuda)
        return target.copy_(leaf.detach(), non_blocking=True)

    copies = on_cpu(tree)
    for device in {leaf.device for leaf in leaves(tree) if leaf.is_cuda}:
        torch.cuda.current_stream(device).synchronize()
    return mapping(torch.Tensor.numpy)(copies)


@mapping
def row(leaf: Tree, lane: int | np.integer) -> Tree:
    """Returns one lane's values of a batch."""
    return leaf[lane]
