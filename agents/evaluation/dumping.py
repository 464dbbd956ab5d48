"""Writes episodes of an agent as a dataset. B lanes, T steps.

Episodes are played in waves, one per lane, each from seeds of its own. So a dump that was stopped
goes on with the first wave that is not complete, and memory holds three waves at most.
"""

import concurrent.futures
import contextlib
import errno
import json
import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch

from megastep import data, spaces
from megastep.agents import console
from megastep.agents.errors import UserError, user_errors
from megastep.agents.evaluation import eval_env, playing
from megastep.agents.factory import check, env_failures, settings
from megastep.agents.factory import make as factory
from megastep.agents.generator import SeededGenerator, stream_seed
from megastep.agents.runs import checkpoint, folders, restore
from megastep.agents.storage.collector import Collector
from megastep.agents.storage.rollout import Rollout, copy_tree
from megastep.agents.training.callbacks import close_env
from megastep.arrdict import arrdict
from megastep.atomic_files import delete, write_atomically
from megastep.data import episodes, formats
from megastep.types import Env, PolicyLike, Tree, optional, takes_masks

#: Lanes that play at once.
LANES = 1024
#: Steps that are copied from the device at once.
STEPS = 64
#: Threads that write files; more would wait for Python's lock.
WRITERS = min(8, os.cpu_count() or 1)
#: Folder of the episodes of a dataset in another format, until they are converted.
STAGED = "episodes"


def run(cfg: settings.Dump) -> Path:
    """Writes a dataset, or what is missing of it. UserError if the folder has other files."""
    folder, device = Path(cfg.folder), factory.make_device(cfg.device)
    with user_errors(kinds=(data.DatasetError,)):
        formats.require(cfg.format)
    loaded = None
    if cfg.run is not None:
        loaded = folders.load_checkpoint(folders.find(cfg.run), cfg.trust, device)
    env_settings, geometry, homes = factory.played_in(cfg, loaded)
    env_settings = settings.changed_known(env_settings, resample=True)
    with env_failures.caught(env_settings, Path()):
        waves = Waves(cfg, env_settings, homes, loaded, device)
        about = waves.about(env_settings, geometry)
        _claim(folder, about)
        staged = folder if cfg.format == "npz" else folder / STAGED
        with folders.locked(folder), _tidied(folder, staged):
            if cfg.format == "npz":
                waves.write(folder)
            elif not formats.is_there(cfg.format, folder):
                staged.mkdir(exist_ok=True)
                waves.write(staged)
                write_atomically(staged / data.ABOUT, _text({**about, "format": "npz"}))
                formats.convert(cfg.format, data.load(staged), folder, console.count)
            if cfg.format != "npz":
                delete(staged)
    said = f"{cfg.episodes:,} episodes are in {folder}"
    if waves.n_steps:
        rate = console.number(waves.n_steps / waves.seconds)
        said += f"; {waves.n_steps:,} steps were played and written at {rate}/s"
    console.say(said)
    return folder


def _text(about) -> bytes:
    return json.dumps(about, indent=1).encode()


def _claim(folder, about) -> None:
    """Makes the folder of a dataset. UserError if it has other files or another dataset."""
    with user_errors(folders.CANNOT.format(folder)):
        if not folder.exists() or not any(folder.iterdir()):
            folder.mkdir(parents=True, exist_ok=True)
            write_atomically(folder / data.ABOUT, _text(about))
            return
    if not (folder / data.ABOUT).exists():
        raise UserError(f"{folder} has other files; choose a new folder")
    with user_errors(kinds=(data.DatasetError,)):
        old = data.about(folder)
    about = json.loads(_text(about))  # as JSON has it
    old, new = dict(check.leaves(old)), dict(check.leaves(about))
    if changed := [key for key in {**old, **new} if old.get(key) != new.get(key)]:
        key = changed[0]
        raise UserError(
            f"{folder} has another dataset: its {key} is {old.get(key)} and not {new.get(key)}; "
            "choose a new folder, or repeat the words of that dump"
        )


@contextlib.contextmanager
def _tidied(folder, staged) -> Iterator[None]:
    """Removes a dataset of no episode after an error. An OSError becomes a UserError."""
    try:
        yield
    except (OSError, UserError) as error:
        if not (is_begun := any(staged.glob("episode-*.npz"))):
            for path in staged, folder / data.ABOUT:
                delete(path)
        if isinstance(error, UserError):
            raise
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        cure = "repeat the command to go on" if is_begun else "repeat the command"
        problem = "the disk is full: make room" if full else f"{error}: choose another folder"
        raise UserError(f"{folder} cannot be written, as {problem}, and {cure}") from error


class _Told:
    """An environment whose observations are `seen`, what agents see, and, if told, `truth`."""

    def __init__(self, env: Env, is_told: bool):
        self.env, self.truth = env, optional(env, "truth") if is_told else dict
        if self.truth is None:
            raise UserError(f"truth=true: {type(env).__name__} has no method truth(); leave it out")
        truth = self._told(env.reset())["obs"]["truth"]
        self.shapes = {name: tuple(leaf.shape[1:]) for name, leaf in self.truth().items()}
        space = {k: spaces.MultiVector(*v.shape[1:], dtype=torch.float32) for k, v in truth.items()}
        self.obs_space = dict(seen=env.obs_space, truth=space)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.env, name)

    def reset(self, **options) -> arrdict:
        return self._told(self.env.reset(**options))

    def step(self, decision) -> arrdict:
        return self._told(self.env.step(decision))

    def _told(self, world) -> arrdict:
        truth = {name: leaf.float().flatten(1)[:, None] for name, leaf in self.truth().items()}
        return arrdict(world, obs=arrdict(seen=world["obs"], truth=arrdict(truth)))


class _Actor:
    """A policy that sees what it should of `_Told` worlds, and whose draws have a seed."""

    def __init__(self, policy: PolicyLike, greedy: bool):
        self.policy, self.greedy, self.draws = policy, greedy, SeededGenerator(1)
        self.initial = policy.initial
        self.compute_dtype = getattr(policy, "compute_dtype", contextlib.nullcontext)

    def __call__(self, world, state, **_) -> tuple[Any, Tree]:
        world = arrdict(world, obs=world["obs"]["seen"])
        generator = self.draws.on(world["reset"].device)
        return self.policy(world, state, sample=not self.greedy, generator=generator)


class Waves:
    """Plays and writes the episodes of a dump: `n_steps` so far, in so many `seconds`."""

    told: _Told  # made once an episode is missing

    def __init__(
        self,
        cfg: settings.Dump,
        env: settings.Env,
        homes: list[dict],
        loaded: checkpoint.Checkpoint | None,
        device: torch.device,
    ):
        self.cfg, self.loaded, self.n_steps, self.seconds = cfg, loaded, 0, 0.0
        self.where: dict = dict(seed=cfg.seed, device=device)
        self.sample = factory.make_sample(env, homes, **self.where)
        n_agents = optional(self.sample, "n_agents")
        n_envs = -(-min(cfg.episodes, LANES) // n_agents)
        self.settings = settings.changed(env, n_envs=n_envs)
        is_drawn = getattr(env, "resample", False)
        self.homes = homes if is_drawn else factory.spread(homes, n_envs)
        with factory.errors():
            self.codec = episodes.Codec(spaces.texts(self.sample))
        self.n_lanes, self.n_agents = n_envs * n_agents, n_agents
        self.most = cfg.max_steps or optional(self.sample, "max_episode_steps")

    def about(self, env: settings.Env, geometry: settings.Geometry) -> dict[str, Any]:
        """Returns what the dataset's file says."""
        cfg, names = self.cfg, ("episodes", "seed", "split", "greedy", "max_steps", "truth")
        chosen = {name: getattr(cfg, name) for name in names}
        chosen["player"] = cfg.bot if self.loaded is None else eval_env.name_of(self.loaded)
        chosen |= dict(env=check.as_tree(env), geometry=check.as_tree(geometry))
        texts = {path: repr(space) for path, space in self.codec.spaces.items()}
        about = dict(writer=data.WRITER, format=cfg.format)
        about |= dict(fps=float(optional(self.sample, "fps")), spaces=texts)
        return dict(about, settings=chosen)

    def _make(self, **seed: int) -> None:
        """Makes the environment, who plays in it, and what collects."""
        env = factory.construct(self.settings, geometries=self.homes, **{**self.where, **seed})
        if self.loaded is not None:
            policy: PolicyLike = restore.policy_of(self.loaded, env)
            restore.load_wrappers(env, self.loaded)
        else:
            policy = factory.make_bot(self.cfg.bot, self.settings, self.sample)
            policy = factory.in_env(policy, self.settings, env)
        self.told, self.actor = _Told(env, self.cfg.truth), _Actor(policy, self.cfg.greedy)
        state = self.actor.initial(self.n_lanes, env.device)
        about = STEPS, self.n_lanes, self.told.obs_space, env.action_space, state, env.device
        rollout = Rollout(*about, values=False)
        self.collect = Collector(cast(Env, self.told), cast(Any, self.actor), rollout)
        self.collect.can_capture &= playing.can_capture(env, [policy])

    # ---- Playing ----

    def _begin(self, wave) -> None:
        """Begins episodes that depend on the seed and the wave's number alone."""
        seed = stream_seed(self.cfg.seed, f"wave {wave}")
        if not hasattr(self, "told"):
            self._make()
        if takes_masks(self.told.env):
            world = self.told.reset(seed=seed)
        else:
            if wave:
                close_env(self.told.env)
                self._make(seed=seed % 2**31)
            world = self.told.reset()
        device = world["reset"].device
        start = self.collect.parts[-1]
        kept = arrdict({key: world[key] for key in start.world})
        copy_tree(start, arrdict(world=kept, state=self.actor.initial(self.n_lanes, device)))
        self.actor.draws.on(device).manual_seed(stream_seed(seed, "actions"))

    def play(
        self, wave: int
    ) -> tuple[dict[str, torch.Tensor], np.ndarray, np.ndarray, np.ndarray | None]:
        """Plays a wave. Returns its arrays (B, T + 1, ...), lengths (B,), layouts (B,), and when
        episodes begin, (B,): at 0, or once an agent that joins later is there.
        """
        self._begin(wave)
        layout = optional(self.told.env, "layout")
        layout = None if layout is None else layout.repeat_interleave(self.n_agents).cpu().numpy()
        parts, (lengths, begins) = [], np.zeros((2, self.n_lanes), np.int64)
        while not lengths.all() and len(parts) * STEPS < self.most:
            rollout = self.collect()
            parts.append(self._part(rollout))
            ends = (parts[-1]["terminal"] | parts[-1]["truncated"]).cpu().numpy()
            first, is_on = len(parts) * STEPS - STEPS + ends.argmax(1) + 1, lengths == 0
            lengths = np.where(is_on & ends.any(1), first, lengths)
            times = np.arange(len(parts) * STEPS - STEPS, len(parts) * STEPS) + 1
            until = np.minimum(np.where(lengths == 0, self.most, lengths), self.most)
            starts = rollout.starts[1:].T.cpu().numpy() & is_on[:, None]
            begins = np.maximum(begins, (starts * times * (times < until[:, None])).max(1))
        last, arrays = self._part(rollout, last=True), {}
        for name in parts[0]:
            rows = [part[name] for part in parts]
            if name.startswith("action") or name in episodes.OUTCOMES:  # row t led to time t
                rows = [torch.zeros_like(rows[0][:, :1]), *rows]
            else:
                rows.append(last[name])
            # asynchronously, into pinned memory
            arrays[name] = torch.cat(rows, 1).to("cpu", non_blocking=True)
        if torch.device(self.told.device).type == "cuda":
            torch.cuda.current_stream().synchronize()
        is_cut = np.flatnonzero((lengths == 0) | (lengths > self.most))
        lengths[is_cut] = end = min(self.most, STEPS * len(parts))
        arrays["truncated"][is_cut, end] = True
        return arrays, lengths, begins, layout

    def _part(self, rollout, last=False) -> dict[str, torch.Tensor]:
        """Returns copies of steps (B, T, ...), or the last observation (B, 1, ...), as stored."""
        rows = slice(-1, None) if last else slice(None, -1)
        found = {"obs": rollout.obs["seen"], "actions": rollout.actions}
        leaves = spaces.leaves(found)
        part = {}
        for path, name in self.codec.names.items():
            is_obs = path.startswith("obs")
            part[name] = self.codec.encode(path, leaves[path][rows] if is_obs else leaves[path])
        part |= {name: getattr(rollout, name) for name in ("reward", "terminal", "truncated")}
        for name, leaf in rollout.obs["truth"].items():
            part[name] = leaf[rows].unflatten(-1, self.told.shapes[name])[:, :, 0]
        if rollout.mask is not None:
            masks = spaces.leaves(rollout.mask, "mask").items()
            part |= {name: leaf[rows].squeeze(2) for name, leaf in masks}
        order = dict(memory_format=torch.contiguous_format)
        return {name: leaf.transpose(0, 1).clone(**order) for name, leaf in part.items()}

    # ---- Writing ----

    def write(self, folder: Path) -> None:
        """Writes the episodes that are missing in a folder."""
        start = time.monotonic()
        for path in folder.glob("*.tmp"):
            delete(path)
        there, n = {path.name for path in folder.glob("episode-*.npz")}, self.cfg.episodes
        pending: list[concurrent.futures.Future] = []
        with concurrent.futures.ThreadPoolExecutor(WRITERS) as pool:
            for wave, first in enumerate(range(0, n, self.n_lanes)):
                lanes = range(min(self.n_lanes, n - first))
                paths = {lane: folder / f"episode-{first + lane:06d}.npz" for lane in lanes}
                missing = {lane: path for lane, path in paths.items() if path.name not in there}
                if missing:
                    played = self.play(wave)
                    if not pending:
                        self._check_room(folder, played, n - len(there))
                    for task in pending:
                        task.result()
                    parts = np.array_split([*missing], WRITERS)
                    pending = [
                        pool.submit(self._write, played, {lane: missing[lane] for lane in part})
                        for part in parts
                    ]
                console.count(first + len(lanes), n)
            for task in pending:
                task.result()
        self.seconds = time.monotonic() - start

    def _check_room(self, folder, played, n_missing) -> None:
        arrays, lengths, *_ = played
        per_row = sum(leaf[0, 0].numel() * leaf.element_size() for leaf in arrays.values())
        needed = n_missing * (per_row * (lengths.mean() + 1) + 4096)
        free = shutil.disk_usage(folder).free
        if needed > free:
            raise UserError(
                f"{n_missing:,} episodes need about {needed / 1e9:,.1f} GB, and the disk of "
                f"{folder} has {free / 1e9:,.1f} GB left; write fewer (episodes=), or elsewhere"
            )

    def _write(self, played, paths) -> None:
        tensors, lengths, begins, layout = played
        arrays = {name: leaf.numpy() for name, leaf in tensors.items()}
        for lane, path in paths.items():
            rows = slice(int(begins[lane]), int(lengths[lane]) + 1)
            one = {name: array[lane, rows] for name, array in arrays.items()}
            for name in one if rows.start else ():
                if name.startswith("action") or name in episodes.OUTCOMES:
                    one[name][0] = 0  # as of all first rows
            if self.cfg.truth and layout is not None and self.homes:
                one = episodes.with_plan(one, self.homes[layout[lane]])
            episodes.write(path, one)
        self.n_steps += int((lengths - begins)[[*paths]].sum())
