"""A checker of vector environments, for any `gymnasium.vector.VectorEnv`. This file needs
Gymnasium, NumPy and, for environments of tensors, PyTorch; it runs when copied alone.

`gymnasium.utils.env_checker.check_env` takes single environments. What goes wrong in vector
environments is mostly between the lanes and at the ends of episodes: autoreset, `final_obs`, masks
of `infos`, buffers that the next step overwrites, lanes that share random numbers.

    from megastep.adapters import check_vector_env  # or: from vector_checks import check_vector_env

    for fault in check_vector_env(env):
        print(fault)

A lane is one of the environments. Steps count from the reset, which is step 0.
"""

import random
from collections.abc import Callable, Mapping

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

try:
    import torch
except ImportError:  # then the environment has no tensors either
    torch = None

__all__ = ["VectorEnvError", "check_vector_env"]

FLAGS = "terminations", "truncations"


class VectorEnvError(AssertionError):
    """A vector environment has faults. The message has a line for each."""


def check_vector_env(
    env: VectorEnv,
    *,
    strict: bool = False,
    seed: int = 1,
    n_steps: int = 200,
    independent: bool = True,
    reuses_buffers: bool = False,
    make: Callable[[int], VectorEnv] | None = None,
    check_synchronisation: bool = False,
) -> list[str]:
    """Returns the faults of a vector environment, a sentence each, with lane and step; of several
    faults of one kind the first.

    Takes random actions for `n_steps` steps, five times. Episodes should be shorter than that.
    Resets the environment, and does not close it.

    Args:
        env: the environment, in the autoreset mode that its metadata name.
        strict: raise an error if there is a fault.
        seed: of resets and actions.
        n_steps: steps of each run.
        independent: check that no lane depends on the actions and resets of others. False for lanes
            that play with each other.
        reuses_buffers: it says that it overwrites what it has returned, as `copy=False` does.
        make: makes such an environment of as many lanes as its argument. If given, checks that
            lane 0 plays the same episodes when it is alone.
        check_synchronisation: check that steps do not wait for the GPU.

    Raises:
        VectorEnvError: if `strict` and there is a fault.
        TypeError: if it is no vector environment.
    """
    if not hasattr(env, "num_envs"):
        raise TypeError(
            f"check_vector_env takes a gymnasium.vector.VectorEnv, not a {type(env).__name__}; for "
            "a single environment there is gymnasium.utils.env_checker.check_env"
        )
    faults: dict[str, str] = {}
    try:
        _Checker(env, faults, seed, n_steps, reuses_buffers).run(
            independent, make, check_synchronisation
        )
    except _Unusable:
        pass  # what follows would fail too
    if strict and faults:
        raise VectorEnvError("\n".join(faults.values()))
    return [*faults.values()]


class _Unusable(Exception):
    """No further check makes sense."""


class _Record:
    """What a step or a reset returned: references, and copies of then."""

    def __init__(self, obs, rewards=None, terminations=None, truncations=None, infos=None) -> None:
        parts = dict(observations=obs, rewards=rewards)
        parts |= dict(terminations=terminations, truncations=truncations)
        self.given = _leaves({k: v for k, v in parts.items() if v is not None})
        self.given |= _leaves(infos or {}, "infos")
        self.values = {path: _array(leaf) for path, leaf in self.given.items()}
        self.obs, self.infos = obs, infos or {}

    def __getitem__(self, name) -> np.ndarray:
        return self.values[name]

    @property
    def ended(self) -> np.ndarray:
        """(B,) bool: the lanes whose episode ended."""
        return self["terminations"].astype(bool) | self["truncations"].astype(bool)

    def of(self, lane) -> dict[str, np.ndarray]:
        """The values of a lane, without infos."""
        return {k: v[lane] for k, v in self.values.items() if not k.startswith("infos")}

    def obs_of(self, lane) -> dict[str, np.ndarray]:
        """The observation of a lane."""
        return {k: v for k, v in self.of(lane).items() if k.startswith("observations")}


class _Checker:
    def __init__(self, env, faults, seed, n_steps, reuses_buffers) -> None:
        self.env, self.faults, self.seed, self.n_steps = env, faults, seed, n_steps
        self.reuses_buffers, self.n, self.limit = reuses_buffers, env.num_envs, None
        self.mode, self.is_tensor, self.device = AutoresetMode.NEXT_STEP, False, None
        # whether a final observation was the first one, and whether a reset lane did not move
        self.equal_finals, self.unmoved = [], []

    def fault(self, kind: str, sentence: str) -> None:
        self.faults.setdefault(kind, sentence)

    def run(self, independent, make, check_synchronisation) -> None:
        env = self.env
        self.check_attributes()
        env.action_space.seed(self.seed)
        self.actions = [_copied(env.action_space.sample()) for _ in range(self.n_steps)]
        run = self.play(env, self.actions, check=True)
        self.check_seeds(run)
        self.check_resets_clear_ends(run)
        if self.mode is AutoresetMode.NEXT_STEP:
            self.check_ignored_actions(run)
        if independent and self.n > 1:
            self.check_independence(run)
            if self.mode is AutoresetMode.DISABLED:
                self.check_masks()
        if make is not None:
            self.check_alone(make, run)
        if check_synchronisation:
            self.check_synchronisation()

    # ---- What can be seen without a step ----

    def check_attributes(self) -> None:
        env = self.env
        n = env.num_envs
        if not isinstance(n, int) or n < 1:
            self.fault("num_envs", f"num_envs must be a positive integer, but it is {n!r}.")
            raise _Unusable
        for name in "observation", "action":
            single = getattr(env, f"single_{name}_space", None)
            batch = getattr(env, f"{name}_space", None)
            if not isinstance(single, gymnasium.Space) or not isinstance(batch, gymnasium.Space):
                self.fault("spaces", f"{name}_space and single_{name}_space must be spaces.")
                raise _Unusable
            expected = batch_space(single, n)
            if batch != expected:
                self.fault(
                    f"{name} space",
                    f"{name}_space must be single_{name}_space batched {n} times, {expected}, but "
                    f"it is {batch}.",
                )
        mode = env.metadata.get("autoreset_mode")
        self.mode = mode if isinstance(mode, AutoresetMode) else AutoresetMode.NEXT_STEP
        if mode is not self.mode:
            self.fault(
                "mode",
                f"metadata['autoreset_mode'] must be an AutoresetMode, but it is {mode!r}; "
                "checked as NEXT_STEP.",
            )
        self.limit = getattr(getattr(env, "spec", None), "max_episode_steps", None)

    # ---- One run ----

    def play(self, env, actions, check=False, seed=None) -> list[_Record]:
        """Returns the records of a seeded reset and a step per action."""
        records = [self.reset(env, check, seed=self.seed if seed is None else seed)]
        self.lengths, self.at_limit = np.zeros(env.num_envs, int), []
        for step, action in enumerate(actions, 1):
            if self.mode is AutoresetMode.DISABLED and step > 1 and records[-1].ended.any():
                mask, last = records[-1].ended, records[-1]
                begun = self.reset(env, check, options={"reset_mask": mask.copy()})
                if check:
                    self.check_masked_reset(last, begun, mask, step - 1)
            records.append(self.step(env, action, step, check))
            if check:
                self.check_step(records, step)
        if check:
            self.check_limit()
            if not any(record.ended.any() for record in records[1:]):
                self.fault(
                    "no end",
                    f"no episode ended in {len(actions)} steps of random actions, so nothing about "
                    "ends was checked: give n_steps a larger number, or a shorter time limit.",
                )
        return records

    def reset(self, env, check=False, **options) -> _Record:
        returned = env.reset(**options)
        is_pair = isinstance(returned, tuple) and len(returned) == 2
        if not is_pair or not isinstance(returned[1], Mapping):
            self.fault("reset", "reset must return (observations, infos), infos a dict.")
            raise _Unusable
        record = _Record(returned[0], infos=returned[1])
        if check:
            self.check_observations(env, record, 0)
            self.check_infos(record, 0)
        return record

    def step(self, env, action, step, check=False) -> _Record:
        given = _like(action, self.is_tensor, self.device)
        before = _arrays(given)
        returned = env.step(given)
        if not isinstance(returned, tuple) or len(returned) != 5:
            self.fault(
                "step",
                "step must return (observations, rewards, terminations, truncations, infos), but "
                f"at step {step} it returned {type(returned).__name__} of "
                f"{len(returned) if isinstance(returned, tuple) else 1}.",
            )
            raise _Unusable
        if check and not _equal(before, _arrays(given)):
            self.fault(
                "actions",
                f"step must leave the actions as they are, but step {step} wrote into them.",
            )
        return _Record(*returned)

    # ---- Shapes, dtypes, bounds ----

    def check_observations(self, env, record, step) -> None:
        leaves = record.given
        first = next(iter(leaves.values()))
        self.is_tensor = torch is not None and isinstance(first, torch.Tensor)
        self.device = first.device if self.is_tensor else None
        spaces = _spaces(env.single_observation_space)
        names = [path for path in leaves if path.startswith("observations")]
        if {*names} != {*spaces}:
            self.fault(
                "keys", f"observations must have {[*spaces]}, but at step {step} they have {names}."
            )
            raise _Unusable
        for path, space in spaces.items():
            leaf, value = leaves[path], record[path]
            kind, shape = type(leaf).__name__, (env.num_envs, *space.shape)
            if not isinstance(leaf, np.ndarray) and not self.is_tensor:
                self.fault(
                    "type",
                    f"{path} must be an array or a tensor, but at step {step} it is a {kind}.",
                )
                raise _Unusable
            if value.shape != shape:
                self.fault(
                    "shape",
                    f"{path} must have shape {shape}, but at step {step} it has {value.shape}.",
                )
                raise _Unusable
            if value.dtype != space.dtype:
                self.fault(
                    "dtype",
                    f"{path} must be {space.dtype}, as its space is, but at step "
                    f"{step} it is {value.dtype}.",
                )
            if self.is_tensor and leaf.device != self.device:
                self.fault(
                    "device",
                    f"{path} is on {leaf.device} at step {step}, but other "
                    f"observations are on {self.device}.",
                )
            for lane in range(env.num_envs):
                if value.dtype == space.dtype and not space.contains(value[lane]):
                    self.fault(
                        "bounds",
                        f"{path} of lane {lane} is outside its space at step "
                        f"{step}: {_short(value[lane])} is not in {space}.",
                    )
                    break

    def check_step(self, records, step) -> None:
        record, last = records[-1], records[-2]
        self.check_observations(self.env, record, step)
        for name, kinds in (("rewards", "fiu"), *((flag, "b") for flag in FLAGS)):
            value, words = record.values.get(name), "bool" if kinds == "b" else "numbers"
            leaf = record.given.get(name)
            if value is None or value.shape != (self.n,) or value.dtype.kind not in kinds:
                described = "missing" if value is None else f"{value.dtype} of shape {value.shape}"
                self.fault(
                    name,
                    f"{name} must be {words} of shape ({self.n},), but at step {step} "
                    f"they are {described}.",
                )
                raise _Unusable
            if self.is_tensor and getattr(leaf, "device", None) != self.device:
                self.fault(
                    "device",
                    f"{name} must be tensors on {self.device}, as observations are, "
                    f"at step {step}.",
                )
        bad = np.flatnonzero(~np.isfinite(record["rewards"]))
        if len(bad):
            self.fault(
                "finite",
                f"the reward of lane {bad[0]} is {record['rewards'][bad[0]]} at step {step}.",
            )
        self.check_infos(record, step)
        if not self.reuses_buffers:
            self.check_buffers(records, step)
        is_first = self.check_autoreset(record, last, step)
        self.lengths = np.where(is_first, 0, self.lengths + 1)
        self.note_limit(record, step)
        if self.mode is not AutoresetMode.NEXT_STEP:
            self.lengths[record.ended] = 0

    def check_buffers(self, records, step) -> None:
        for age, old in enumerate(reversed(records[-4:-1]), 1):
            for path, value in old.values.items():
                now = _array(old.given[path])
                if not _same(now, value):
                    lanes = [
                        i for i in range(min(self.n, len(value))) if not _same(now[i], value[i])
                    ]
                    self.fault(
                        f"buffer {path.split('.')[0]}",
                        f"{path} that step {step - age} returned changed in step {step}, first in "
                        f"lane {lanes[0] if lanes else 0}: copy them, or say reuses_buffers=True.",
                    )

    # ---- Infos ----

    def check_infos(self, record, step, infos=None, name="infos") -> None:
        """Requires a mask (B,) bool beside each key, true where a lane has it."""
        infos = record.infos if infos is None else infos
        if not isinstance(infos, Mapping):
            self.fault(
                "infos", f"infos must be a dict, but at step {step} it is a {type(infos).__name__}."
            )
            raise _Unusable
        for key, value in infos.items():
            if not isinstance(key, str) or key.startswith("_"):
                continue
            mask = infos.get(f"_{key}")
            shape = None if mask is None else _array(mask).shape
            if shape != (self.n,) or _array(mask).dtype != bool:
                self.fault(
                    "mask of infos",
                    f"{name}[{key!r}] must have a mask {name}['_{key}'], bool "
                    f"of shape ({self.n},), at step {step}.",
                )
            if isinstance(value, Mapping) and key != "final_obs":
                self.check_infos(record, step, value, f"{name}[{key!r}]")
            elif not isinstance(value, Mapping) and len(value) != self.n:
                self.fault(
                    "length of infos",
                    f"{name}[{key!r}] must have {self.n} rows at step "
                    f"{step}, but it has {len(value)}.",
                )

    # ---- Autoreset ----

    def check_autoreset(self, record, last, step) -> np.ndarray:
        """Returns (B,) bool: the lanes whose first observation the record has."""
        began = np.zeros(self.n, bool)
        if self.mode is AutoresetMode.SAME_STEP:
            self.check_final_obs(record, step)
        if self.mode is AutoresetMode.NEXT_STEP and "terminations" in last.values:
            began = last.ended
        for lane in np.flatnonzero(began):
            if record["rewards"][lane] != 0:
                self.fault(
                    "reward at reset",
                    f"in NEXT_STEP the step after an end begins an episode, with reward 0, but "
                    f"lane {lane}, which ended at step {step - 1}, has reward "
                    f"{record['rewards'][lane]:g} at step {step}.",
                )
            if record.ended[lane]:
                self.fault(
                    "end at reset",
                    f"in NEXT_STEP the step after an end begins an episode, but lane {lane} ends "
                    f"again at step {step}.",
                )
        return began

    def check_final_obs(self, record, step) -> None:
        over = record.ended
        mask = record.infos.get("_final_obs")
        if not over.any():
            if mask is not None and _array(mask).any():
                self.fault(
                    "final_obs mask",
                    f"infos['_final_obs'] is True in lane "
                    f"{int(_array(mask).argmax())} at step {step}, but no episode ended.",
                )
            return
        lane = int(over.argmax())
        if "final_obs" not in record.infos or mask is None:
            self.fault(
                "final_obs",
                f"in SAME_STEP infos must have final_obs and _final_obs where an "
                f"episode ends, as in lane {lane} at step {step}.",
            )
            return
        wrong = np.flatnonzero(_array(mask) != over)
        if len(wrong):
            self.fault(
                "final_obs mask",
                f"infos['_final_obs'] must be True where an episode ended, "
                f"but in lane {wrong[0]} it is {bool(_array(mask)[wrong[0]])} at step {step}.",
            )
            return
        for lane in np.flatnonzero(over):
            final = _leaves(_row(record.infos["final_obs"], lane), "observations")
            final = {path: _array(leaf) for path, leaf in final.items()}
            own = record.obs_of(lane)
            shapes = {path: value.shape for path, value in own.items()}
            if {path: value.shape for path, value in final.items()} != shapes:
                self.fault(
                    "final_obs shape",
                    f"infos['final_obs'] of lane {lane} must have the "
                    f"shapes {shapes} at step {step}.",
                )
                return
            self.equal_finals.append(_equal(final, own))
        if len(self.equal_finals) >= 3 and all(self.equal_finals):
            self.fault(
                "final_obs new",
                "infos['final_obs'] must be the last observation of an "
                f"episode, but in lane {lane} at step {step} it is the first of the next, "
                "which observations have.",
            )

    def note_limit(self, record, step) -> None:
        if self.limit is None:
            return
        late = np.flatnonzero(self.lengths > self.limit)
        if len(late):
            self.fault(
                "limit",
                f"lane {late[0]} goes on at step {step}, after more than the "
                f"{self.limit} steps of spec.max_episode_steps.",
            )
        for lane in np.flatnonzero((self.lengths == self.limit) & record.ended):
            self.at_limit.append((lane, step, bool(record["truncations"][lane])))

    def check_limit(self) -> None:
        if len(self.at_limit) > 1 and not any(is_truncated for *_, is_truncated in self.at_limit):
            lane, step, _ = self.at_limit[0]
            self.fault(
                "truncation",
                f"an episode that reaches the time limit of {self.limit} steps "
                f"must be truncated, but in lane {lane} it is terminated at step {step}, and "
                "so are all others that do.",
            )

    # ---- Masks ----

    def check_masked_reset(self, last, begun, mask, step) -> None:
        for lane in range(self.n):
            is_same = _equal(begun.obs_of(lane), last.obs_of(lane))
            if not mask[lane] and not is_same:
                self.fault(
                    "mask others",
                    f"reset_mask is False in lane {lane}, but its observation "
                    f"changed in the reset after step {step}.",
                )
            if mask[lane]:
                self.unmoved.append(is_same)
        if len(self.unmoved) >= 3 and all(self.unmoved):
            lane = int(mask.argmax())
            self.fault(
                "mask ignored",
                f"reset_mask is True in lane {lane} after step {step}, but the "
                "reset returns the last observation of its old episode.",
            )

    def check_masks(self) -> None:
        """Resets lanes in the middle of their episodes: the others must go on as without it."""
        n = min(10, self.n_steps)
        plain = self.play(self.env, self.actions[:n])
        first = next((t for t, r in enumerate(plain[1:], 1) if r.ended.any()), n + 1)
        half = max(1, min(first - 1, n // 2))
        mask = np.arange(self.n) % 2 == 0
        self.reset(self.env, seed=self.seed)
        for step in range(1, half + 1):
            last = self.step(self.env, self.actions[step - 1], step)
        if half >= first:
            return
        begun = self.reset(self.env, options={"reset_mask": mask.copy()})
        self.check_masked_reset(last, begun, mask, half)
        for step in range(half + 1, min(first, n + 1)):
            record = self.step(self.env, self.actions[step - 1], step)
            for lane in np.flatnonzero(~mask):
                if not _equal(record.of(lane), plain[step].of(lane)):
                    self.fault(
                        "mask others",
                        f"lane {lane} was not in the reset_mask after step "
                        f"{half}, but at step {step} it differs from a run without that reset.",
                    )
            if record.ended.any():
                return

    # ---- Runs that must agree ----

    def check_seeds(self, run) -> None:
        states = random.getstate(), np.random.get_state()
        random.seed(self.seed + 12345)
        np.random.seed(self.seed + 12345)
        if torch is not None:
            torch.manual_seed(self.seed + 12345)
        again = self.play(self.env, self.actions)
        random.setstate(states[0])
        np.random.set_state(states[1])
        if difference := _first_difference(run, again, range(self.n)):
            lane, step = difference
            self.fault(
                "seed",
                f"reset(seed={self.seed}) and the same actions must give the same "
                f"numbers, whatever the global generators, but lane {lane} differs at step "
                f"{step}.",
            )
            return
        other = self.reset(self.env, seed=self.seed + 1)
        starts_differ = not _equal(other.obs_of(0), run[0].obs_of(0))
        if starts_differ:
            first = self.reset(self.env, seed=self.seed)
            second = self.reset(self.env)
            if all(_equal(first.obs_of(lane), second.obs_of(lane)) for lane in range(self.n)):
                self.fault(
                    "unseeded reset",
                    "reset() without a seed must go on with the random "
                    "numbers, but at step 0 lane 0 and all others begin the same episode as "
                    f"with seed={self.seed} before.",
                )
        lanes = [tuple(map(bytes, other.obs_of(lane).values())) for lane in range(self.n)]
        if starts_differ and self.n > 1 and len({*lanes}) == 1:
            self.fault(
                "equal lanes",
                "at step 0 lane 1 and all others have the observation of lane "
                "0: each lane needs random numbers of its own.",
            )

    def check_resets_clear_ends(self, run) -> None:
        """A reset where an episode has just ended: the next step is the first of an episode."""
        ends = [t for t, record in enumerate(run[1:], 1) if record.ended.any()]
        if not ends:
            return
        self.play(self.env, self.actions[: ends[0]])
        again = self.play(self.env, self.actions[:3])
        if difference := _first_difference(run[:4], again, range(self.n)):
            lane, step = difference
            self.fault(
                "reset after end",
                "a reset after an end must begin as any other, but lane "
                f"{lane} differs at step {step} after it from a run without an episode before.",
            )

    def check_ignored_actions(self, run) -> None:
        """In the step that begins an episode the lane's action has no effect."""
        ends = [t for t, record in enumerate(run[1:-1], 1) if record.ended.any()]
        if not ends:
            return
        step, over = ends[0] + 1, run[ends[0]].ended
        other = _where(over, _rolled(self.env, self.actions, step), self.actions[step - 1])
        again = self.play(self.env, [*self.actions[: step - 1], other])
        for lane in np.flatnonzero(over):
            if not _equal(again[step].of(lane), run[step].of(lane)):
                self.fault(
                    "action at reset",
                    f"lane {lane} ended at step {step - 1}, so its action "
                    f"at step {step} has no effect, but with another one it differs.",
                )

    def check_independence(self, run) -> None:
        """Other actions in all lanes but one leave that lane as it is."""
        n = next((t for t, record in enumerate(run[1:], 1) if record.ended.any()), self.n_steps)
        n, own = min(n, 20), np.arange(self.n) == self.n - 1
        changed = [
            _where(own, action, self.env.action_space.sample()) for action in self.actions[:n]
        ]
        again = self.play(self.env, changed)
        if difference := _first_difference(run[: n + 1], again, [self.n - 1]):
            lane, step = difference
            self.fault(
                "independence",
                f"lane {lane} differs at step {step} if other lanes take other "
                "actions: lanes must not depend on each other, or say independent=False.",
            )

    def check_alone(self, make, run) -> None:
        env = make(1)
        actions = [_where(None, action, None) for action in self.actions]
        n, self.n = self.n, 1
        try:
            alone = self.play(env, actions)
        finally:
            self.n = n
            env.close()
        if difference := _first_difference(run, alone, [0]):
            self.fault(
                "alone",
                f"lane 0 of {n} differs from the same lane alone at step "
                f"{difference[1]}, with the same seed and actions.",
            )

    def check_synchronisation(self) -> None:
        if torch is None or not torch.cuda.is_available():
            self.fault("synchronisation", "check_synchronisation needs PyTorch and a GPU.")
            return
        self.reset(self.env, seed=self.seed)
        actions = [_like(action, self.is_tensor, self.device) for action in self.actions[:20]]
        self.env.step(actions[0])  # which may record a CUDA graph
        torch.cuda.synchronize()
        torch.cuda.set_sync_debug_mode("error")
        where = "step 1"
        try:
            for step, action in enumerate(actions[1:], 2):
                where = f"step {step}"
                self.env.step(action)
        except RuntimeError as error:
            self.fault(
                "synchronisation",
                f"{where} waits for the GPU, in lane 0 and all others: "
                f"{str(error).splitlines()[0]}",
            )
        finally:
            torch.cuda.set_sync_debug_mode("default")


# ---- Trees of arrays and tensors ----


def _leaves(tree, name="") -> dict:
    """Returns {path: leaf} of nested dicts and tuples."""
    if isinstance(tree, Mapping):
        parts = tree.items()
    elif isinstance(tree, tuple):
        parts = enumerate(tree)
    else:
        return {name: tree}
    found = {}
    for key, part in parts:
        found |= _leaves(part, f"{name}.{key}" if name else str(key))
    return found


def _spaces(space, name="observations") -> dict:
    """Returns {path: space} of nested dicts and tuples of spaces."""
    if isinstance(space, (gymnasium.spaces.Dict, gymnasium.spaces.Tuple)):
        parts = space.spaces
        parts = parts.items() if isinstance(parts, Mapping) else enumerate(parts)
        found = {}
        for key, part in parts:
            found |= _spaces(part, f"{name}.{key}")
        return found
    return {name: space}


def _array(leaf) -> np.ndarray:
    """Returns a copy of a leaf as an array."""
    if torch is not None and isinstance(leaf, torch.Tensor):
        return leaf.detach().cpu().numpy().copy()
    return np.array(leaf, dtype=object) if isinstance(leaf, (list, str)) else np.array(leaf)


def _arrays(tree) -> dict[str, np.ndarray]:
    return {path: _array(leaf) for path, leaf in _leaves(tree).items()}


def _row(tree, lane) -> object:
    """Returns one lane's values: of a batch, or of an array of objects, one per lane."""
    if isinstance(tree, Mapping):
        return {key: _row(part, lane) for key, part in tree.items()}
    return tuple(_row(part, lane) for part in tree) if isinstance(tree, tuple) else tree[lane]


def _copied(tree) -> object:
    return _map(np.array, tree)


def _map(function, tree, *others) -> object:
    if isinstance(tree, Mapping):
        return {key: _map(function, tree[key], *(o[key] for o in others)) for key in tree}
    if isinstance(tree, tuple):
        return tuple(_map(function, *parts) for parts in zip(tree, *others))
    return function(tree, *others)


def _like(actions, is_tensor, device) -> object:
    """Returns a copy of actions, as tensors if observations are."""
    if not is_tensor or torch is None:
        return _copied(actions)
    tensor = torch.tensor
    return _map(lambda leaf: tensor(leaf, device=device), actions)


def _where(mask, actions, others) -> object:
    """Returns actions where a mask is True, and others elsewhere; without one those of lane 0."""
    if mask is None:
        return _map(lambda leaf: np.array(leaf[:1]), actions)

    def chosen(a, b) -> np.ndarray:
        return np.where(mask.reshape(-1, *[1] * (a.ndim - 1)), a, b).astype(a.dtype)

    return _map(chosen, actions, _copied(others))


def _rolled(env, actions, step) -> object:
    """Returns actions that differ from those of a step in as many lanes as possible."""
    own = _arrays(actions[step - 1])
    samples = [_copied(env.action_space.sample()) for _ in range(50)]

    def n_changed(sample) -> int:
        others = _arrays(sample)
        return sum(int((others[k] != own[k]).reshape(len(own[k]), -1).any(1).sum()) for k in own)

    return max(samples, key=n_changed)


def _same(a, b) -> bool:
    """Returns whether two arrays are equal, NaN included."""
    if a.dtype == object or b.dtype == object:
        return a.shape == b.shape and all(
            x is y or _equal(_arrays(x), _arrays(y)) for x, y in zip(a.flat, b.flat)
        )
    return a.shape == b.shape and np.array_equal(a, b, equal_nan=a.dtype.kind in "fc")


def _equal(a, b) -> bool:
    return a.keys() == b.keys() and all(_same(a[path], b[path]) for path in a)


def _first_difference(a, b, lanes) -> tuple[int, int] | None:
    """Returns (lane, step) where two runs first differ, None if they do not."""
    for step, (one, other) in enumerate(zip(a, b)):
        for lane in lanes:
            if not _equal(one.of(lane), other.of(lane)):
                return lane, step
    return None


def _short(value) -> str:
    text = " ".join(str(value).split())
    return text if len(text) < 80 else f"{text[:77]}..."
