"""The checker of vector environments finds each planted fault, and none where there is none."""

import pathlib
import shutil
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from megastep import envs, geometries
from megastep.adapters import VectorEnv as OurVectorEnv
from megastep.adapters import check_vector_env, vector_checks

N, LIMIT = 3, 9
NEXT, SAME, OFF = AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP, AutoresetMode.DISABLED


class Walks(VectorEnv):
    """N lanes walk left or right; the observation is where, how long, and a random number. An
    episode is terminated at 3 steps from its start, and truncated after 9.

    Args:
        fault: one thing that it does wrong.
    """

    def __init__(self, n=N, mode=NEXT, fault=None):
        self.num_envs, self.fault, self.mode = n, fault, mode
        self.metadata = {} if fault == "no mode" else {"autoreset_mode": mode}
        self.single_observation_space = gymnasium.spaces.Box(-9, 9, (3,), np.float32)
        self.single_action_space = gymnasium.spaces.Discrete(3)
        n_batched = n + (fault == "batched space")
        self.observation_space = batch_space(self.single_observation_space, n_batched)
        self.action_space = batch_space(self.single_action_space, n)
        self.spec = gymnasium.envs.registration.EnvSpec(
            "Walks-v0", "tests:Walks", max_episode_steps=LIMIT
        )
        self.generators = [np.random.default_rng(i) for i in range(n)]
        self.place, self.age, self.start = (np.zeros(n) for _ in range(3))
        self.ended = np.zeros(n, bool)
        self.buffers = np.zeros((n, 3), np.float32), np.zeros(n, np.float32)

    def _begin(self, mask):
        for lane in np.flatnonzero(mask):
            self.start[lane] = np.round(self.generators[lane].uniform(-2, 2), 3)
            if self.fault == "global generator":
                self.start[lane] = np.random.uniform(-2, 2)
        self.place[mask], self.age[mask] = self.start[mask], 0
        self.ended[mask] = False

    def _obs(self):
        obs = np.stack([self.place, self.age, self.start], 1).astype(np.float32)
        if self.fault == "buffer of observations":
            self.buffers[0][:] = obs
            return self.buffers[0]
        if self.fault == "beyond bounds":
            obs[-1, 0] += 20 * (self.age[-1] == 2)
        if self.fault == "double observations":
            return obs.astype(np.float64)
        return obs[:, None] if self.fault == "shape of observations" else obs

    def reset(self, *, seed=None, options=None):
        if seed is not None and self.fault != "seed ignored":
            self.generators = [np.random.default_rng(seed + i) for i in range(self.num_envs)]
            if self.fault == "equal lanes":
                self.generators = [np.random.default_rng(seed) for _ in range(self.num_envs)]
            if self.fault == "batch unlike alone":
                n = self.num_envs
                self.generators = [np.random.default_rng(seed + i * 7 + n) for i in range(n)]
            self.seed = seed
        elif self.fault == "reset repeats":
            self.generators = [np.random.default_rng(self.seed + i) for i in range(self.num_envs)]
        mask = np.ones(self.num_envs, bool)
        if options and "reset_mask" in options:
            mask = options["reset_mask"]
            if self.fault == "mask resets all":
                mask = np.ones(self.num_envs, bool)
            if self.fault == "mask ignored":
                self.ended[:], mask = False, mask & False
        ended = self.ended.copy()
        self._begin(mask)
        if self.fault == "end survives reset" and not options:
            self.ended = ended
        return self._obs(), {}

    def step(self, actions):
        fault, mode = self.fault, self.mode
        moves = np.asarray(actions) - 1.0
        if fault == "actions written":
            actions[0] = 0
        if fault == "lanes touch":
            moves[-1] = moves[0]
        begins = self.ended.copy() if mode is NEXT else np.zeros(self.num_envs, bool)
        self.age += 1
        self.place += moves
        self._begin(begins)
        if fault == "action at reset":
            self.place[begins] += moves[begins]
        terminated = (np.abs(self.place - self.start) >= 3) & ~begins
        truncated = (self.age >= LIMIT) & ~terminated & ~begins
        if fault == "time limit missed":
            truncated[-1] = self.age[-1] >= LIMIT + 1
        reward = np.where(begins, 0, 1).astype(np.float32)
        if fault == "reward at reset":
            reward[:] = 1
        if fault == "reward nan":
            reward[self.age == 2] = np.nan
        if fault == "limit is terminal":
            terminated, truncated = terminated | truncated, truncated & False
        self.ended, over, infos = terminated | truncated, terminated | truncated, {}
        if fault == "info without mask":
            infos["age"] = self.age.copy()
        if mode is SAME and over.any():
            infos |= self._same_step(over)
        elif fault == "resets at once":
            self._begin(over)
        if fault == "buffer of rewards":
            self.buffers[1][:] = reward
            reward = self.buffers[1]
        if fault == "column of rewards":
            reward = reward[:, None]
        if fault == "flags in floats":
            terminated = terminated.astype(np.float32)
        return self._obs(), reward, terminated, truncated, infos

    def _same_step(self, over):
        last = self._obs().copy()
        self._begin(over)
        final_obs, mask = np.full(self.num_envs, None, dtype=object), over.copy()
        for lane in np.flatnonzero(over):
            final_obs[lane] = (self._obs() if self.fault == "final is first" else last)[lane]
        if self.fault == "final of wrong lanes":
            mask = np.roll(mask, 1)
        if self.fault == "no final":
            return {}
        return dict(final_obs=final_obs, _final_obs=mask)


@pytest.mark.parametrize("mode", AutoresetMode)
@pytest.mark.parametrize("n", (1, N))
def test_no_fault_is_found_where_there_is_none(mode, n):
    assert not check_vector_env(Walks(n, mode), make=lambda n: Walks(n, mode), strict=True)


FAULTS = {
    # before a step
    "no mode": (NEXT, "metadata['autoreset_mode'] must be an AutoresetMode"),
    "batched space": (NEXT, "observation_space must be single_observation_space batched 3 times"),
    # shapes, dtypes, bounds
    "shape of observations": (NEXT, "observations must have shape (3, 3), but at step 0"),
    "double observations": (NEXT, "observations must be float32, as its space is, but at step 0"),
    "beyond bounds": (NEXT, "observations of lane 2 is outside its space at step 2"),
    "column of rewards": (NEXT, "rewards must be numbers of shape (3,), but at step 1"),
    "reward nan": (NEXT, "the reward of lane 0 is nan at step 2"),
    "flags in floats": (OFF, "terminations must be bool of shape (3,), but at step 1"),
    # buffers, infos
    "buffer of observations": (
        OFF,
        "observations that step 0 returned changed in step 1, first in",
    ),
    "buffer of rewards": (NEXT, "rewards that step "),
    "actions written": (NEXT, "step must leave the actions as they are, but step "),
    "info without mask": (SAME, "infos['age'] must have a mask infos['_age']"),
    # seeds
    "seed ignored": (NEXT, "reset(seed=1) and the same actions must give the same numbers"),
    "global generator": (NEXT, "whatever the global generators, but lane 0 differs at step 0"),
    "reset repeats": (NEXT, "reset() without a seed must go on with the random numbers"),
    "equal lanes": (NEXT, "lane 1 and all others have the observation of lane 0"),
    # ends
    "reward at reset": (NEXT, "has reward 1 at step "),
    "action at reset": (NEXT, "has no effect, but with another one it differs"),
    "resets at once": (NEXT, "begins an episode, with reward 0, but lane"),
    "end survives reset": (NEXT, "a reset after an end must begin as any other, but lane "),
    "limit is terminal": (OFF, "must be truncated, but in lane "),
    "time limit missed": (SAME, "lane 2 goes on at step "),
    "no final": (
        SAME,
        "infos must have final_obs and _final_obs where an episode ends, as in lane ",
    ),
    "final is first": (SAME, "must be the last observation of an episode, but in lane "),
    "final of wrong lanes": (SAME, "infos['_final_obs'] must be True where an episode ended"),
    "mask resets all": (OFF, "reset_mask is False in lane "),
    "mask ignored": (OFF, "returns the last observation of its old episode"),
    # between lanes
    "lanes touch": (NEXT, "lane 2 differs at step 1 if other lanes take other actions"),
    "batch unlike alone": (NEXT, "lane 0 of 3 differs from the same lane alone at step 0"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_planted_fault_is_named(fault):
    mode, sentence = FAULTS[fault]
    found = check_vector_env(Walks(N, mode, fault), make=lambda n: Walks(n, mode, fault))
    named = [line for line in found if sentence in line]
    assert len(named) == 1, found
    assert fault in ("no mode", "batched space") or "step" in named[0]
    with pytest.raises(vector_checks.VectorEnvError):
        check_vector_env(Walks(N, mode, fault), make=lambda n: Walks(n, mode, fault), strict=True)


def test_there_are_twenty_faults_of_lanes_and_steps():
    assert len(FAULTS) > 20


@pytest.mark.parametrize("mode", AutoresetMode)
@pytest.mark.parametrize("kind", (gymnasium.vector.SyncVectorEnv, gymnasium.vector.AsyncVectorEnv))
def test_gymnasiums_cartpole_passes(kind, mode):
    env = kind([lambda: gymnasium.make("CartPole-v1")] * N, autoreset_mode=mode)
    make = (
        None
        if kind is gymnasium.vector.AsyncVectorEnv
        else lambda n: kind([lambda: gymnasium.make("CartPole-v1")] * n, autoreset_mode=mode)
    )
    assert check_vector_env(env, make=make) == []
    env.close()


def test_gymnasiums_own_vector_of_cartpoles_passes_but_draws_all_lanes_from_one_generator():
    def make(n):
        return gymnasium.make_vec("CartPole-v1", n, vectorization_mode="vector_entry_point")

    assert check_vector_env(make(N)) == []
    (fault,) = check_vector_env(make(N), make=make)
    assert "lane 0 of 3 differs from the same lane alone at step 0" in fault


@pytest.mark.parametrize("mode", AutoresetMode)
@pytest.mark.parametrize("in_numpy", (True, False))
def test_our_environments_pass(mode, in_numpy):
    homes = geometries.sample("homes", 4, seed=7)
    for env in (
        envs.Pong(5, limit=40, device="cpu"),
        envs.PointGoal(4, homes, limit=30, control="continuous", resample=True, device="cpu"),
        envs.Keys(4, homes, limit=30, device="cpu"),
    ):
        assert check_vector_env(OurVectorEnv(env, mode, to_numpy=in_numpy), n_steps=100) == []
    env = envs.Pong(3, self_play=True, limit=40, device="cpu")
    env = OurVectorEnv(env, mode, to_numpy=in_numpy)
    assert check_vector_env(env, independent=False) == []
    assert any("lane 5 differs" in fault for fault in check_vector_env(env))
    env = OurVectorEnv(envs.Pong(3, limit=40, pixels=True, device="cpu"), mode, to_numpy=in_numpy)
    assert check_vector_env(env) == []


def test_tensors_that_are_not_copied_are_named_unless_announced():
    env = envs.Pong(3, limit=40, pixels=True, device="cpu")
    env = OurVectorEnv(env, to_numpy=False, copy=False)
    (fault,) = check_vector_env(env)
    assert "observations that step 0 returned changed in step 1, first in lane 0" in fault
    assert check_vector_env(env, reuses_buffers=True) == []


def test_a_single_environment_is_told_where_to_go():
    with pytest.raises(TypeError, match="VectorEnv, not a TimeLimit; for a single"):
        check_vector_env(gymnasium.make("CartPole-v1"))


def test_the_file_runs_when_copied_alone(tmp_path):
    shutil.copy(pathlib.Path(vector_checks.__file__), tmp_path)
    code = "import gymnasium, vector_checks as v; e = gymnasium.make_vec('CartPole-v1', 2); "
    code += "assert not v.check_vector_env(e); import sys; assert 'megastep' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env={"PATH": ""}, check=True)


@pytest.mark.cuda
@pytest.mark.parametrize("mode", AutoresetMode)
def test_steps_on_a_gpu_do_not_synchronise(mode):
    env = OurVectorEnv(envs.Pong(64, limit=40, device="cuda"), mode, to_numpy=False)
    assert check_vector_env(env, check_synchronisation=mode is not OFF) == []
    assert env.reset()[0].device.type == "cuda" and torch.cuda.is_available()
