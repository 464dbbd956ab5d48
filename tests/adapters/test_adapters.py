"""Environments in other libraries: their own checkers, the episodes that they see, and what does
not fit. What needs a library that is not installed is skipped.
"""

import copy
import importlib.util
import re
import subprocess
import sys
import warnings
from pathlib import Path

import forage
import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from megastep import adapters, arrdict, contract, dotdict, envs, geometries, spaces
from megastep.wrappers import Wrapper
from tests.helpers.made_up import Numbers
from tests.helpers.synchronisation import no_synchronisation

ROOT = Path(__file__).parents[2]
HOMES = geometries.sample("homes", 4, seed=7)
NEXT, SAME, OFF = AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP, AutoresetMode.DISABLED


def pong(n=4, **settings):
    return envs.Pong(n, **dict(limit=30, device="cpu") | settings)


def pointgoal(n=4, **settings):
    return envs.PointGoal(n, HOMES, limit=15, resample=True, **dict(device="cpu") | settings)


def moves(env, n_steps, seed=1):
    generator = torch.Generator().manual_seed(seed)
    return [contract.random_actions(env, generator) for _ in range(n_steps)]


# ---- Gymnasium ----


TEAMS = {"megastep/Deathmatch-v0", "megastep/HideAndSeek-v0"}  # several agents each


@pytest.mark.parametrize("full_name", sorted({*adapters.IDS} - TEAMS))
def test_gymnasium_makes_one(full_name):
    env = gymnasium.make(full_name, render_mode="rgb_array", seed=3)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of observations without bounds, such as velocities
        check_env(env.unwrapped, skip_render_check=True)
    first, _ = env.reset(seed=5)
    again, _ = env.reset(seed=5)
    assert gymnasium.utils.env_checker.data_equivalence(first, again)
    frame = env.render()
    assert frame.ndim == 3 and frame.dtype == np.uint8 and frame.std() > 1
    assert env.spec.id == full_name and env.spec.kwargs["seed"] == 3
    env.close()


def test_ids_are_those_of_all_environments():
    foreign = {"Gymnasium", "PettingZoo"}
    names = {kind.__name__ for kind in envs.ENVS.values()} - foreign
    assert {*adapters.IDS.values()} == names
    assert all(f"{name}".lower() in envs.ENVS for name in names)
    env = gymnasium.make_vec(
        "megastep.adapters:megastep/Deathmatch-v0", 2, n_agents=3, device="cpu"
    )
    assert env.num_envs == 6 and env.spec.id == "megastep/Deathmatch-v0"


def test_processes_of_environments_import_no_torch():
    code = "import sys, megastep.hosting.processes; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


@pytest.mark.parametrize("in_numpy", (True, False))
@pytest.mark.parametrize("mode", AutoresetMode)
def test_modes_show_the_same_episodes(mode, in_numpy):
    """What a native environment shows, in each mode: the last observation of an episode, its
    flags and metrics, and the first observation of the next.
    """
    env, twin = pointgoal(), pointgoal()
    vector = adapters.VectorEnv(env, mode, to_numpy=in_numpy, dtype=torch.float32)
    vector.reset(seed=7)
    twin.reset(seed=torch.arange(7, 11))
    env.desync()  # else all episodes would end in the same steps
    twin.desync()
    n_ends = 0
    for action in moves(env, 120):
        given = action[:, 0].numpy() if in_numpy else action[:, 0]
        obs, reward, terminated, truncated, infos = vector.step(given)
        world = twin.step(arrdict.arrdict(actions=action))
        ended = world.terminal | world.truncated
        assert torch.equal(torch.as_tensor(reward), world.reward)
        assert torch.equal(torch.as_tensor(terminated), world.terminal)
        assert torch.equal(torch.as_tensor(truncated), world.truncated)
        last, collisions = world.obs.d[:, 0].float(), world.metrics.collisions.clone()
        if mode is not NEXT:  # the twin begins what ended, too
            if mode is OFF and ended.any():
                assert torch.equal(torch.as_tensor(obs["d"]), last)
                obs, _ = vector.reset(options={"reset_mask": ended.numpy()})
            world = twin.reset(mask=ended) if ended.any() else world
        assert torch.equal(torch.as_tensor(obs["d"]), world.obs.d[:, 0].float())
        own = infos.get("final_info", infos) if mode is SAME else infos
        for lane in ended.nonzero().flatten().tolist():
            n_ends += 1
            assert own["collisions"][lane] == collisions[lane] and own["_collisions"][lane]
            if mode is SAME:
                final = infos["final_obs"][lane]["d"] if in_numpy else infos["final_obs"]["d"][lane]
                assert torch.equal(torch.as_tensor(final), last[lane])
    assert n_ends > 4


def test_numpys_wrappers_run_over_it():
    names = ["RecordEpisodeStatistics", "NormalizeReward", "FlattenObservation", "DictInfoToList"]
    names += ["NumpyToTorch"] * bool(importlib.util.find_spec("array_api_compat"))
    from gymnasium.wrappers import vector as wrappers

    for name in names:
        wrapper = getattr(wrappers, name)
        env, n_episodes = wrapper(adapters.VectorEnv(pong())), 0
        env.reset(seed=1)
        for _ in range(70):
            action = env.action_space.sample()
            is_torch = name == "NumpyToTorch"
            *_, infos = env.step(torch.as_tensor(action) if is_torch else action)
            n_episodes += "episode" in infos
        assert n_episodes or name != "RecordEpisodeStatistics"


def test_lanes_with_equal_seeds_differ_and_repeat():
    env = adapters.VectorEnv(pong(3))
    obs, again = (env.reset(seed=[5, 5, 7])[0] for _ in range(2))
    assert np.array_equal(obs, again) and not np.array_equal(obs[0], obs[1])


def test_an_environment_has_one_adapter_the_last():
    room = pong()
    first = adapters.VectorEnv(room, to_numpy=False)
    first.reset()
    for make in (
        lambda: adapters.VectorEnv(room, dtype=torch.float64),
        lambda: adapters.VectorEnv(room, render_mode="human"),
        lambda: adapters.SingleEnv(room),
    ):
        with pytest.raises(ValueError, match="must be|has one lane"):
            make()
        first.step(first.action_space.sample())  # an adapter that could not be made leaves it
    second = adapters.VectorEnv(room)
    second.reset()
    for call in (first.reset, lambda: first.step(first.action_space.sample())):
        with pytest.raises(ValueError, match="this Pong was given to another adapter since"):
            call()
    copied = copy.deepcopy(second)
    adapters.VectorEnv(room).reset()
    copied.step(copied.action_space.sample())


def test_what_does_not_fit_is_named_in_gymnasium():
    for mode in ("same_step", "disabled"):
        name = mode.upper()
        with pytest.raises(ValueError, match=f"autoreset_mode={name} needs reset.*docs/new-env"):
            adapters.VectorEnv(Numbers(), mode)
    assert adapters.VectorEnv(pong(), SAME.value).autoreset_mode is SAME  # "SameStep"
    with pytest.raises(ValueError, match="must be one of NEXT_STEP, SAME_STEP, DISABLED, not 'on'"):
        adapters.VectorEnv(pong(), "on")
    with pytest.raises(ValueError, match="a seed or a mask needs reset.*does not have"):
        adapters.VectorEnv(Numbers()).reset(seed=1)
    with pytest.raises(ValueError, match="docs/new-environment.md shows how to draw"):
        adapters.VectorEnv(Numbers(), render_mode="rgb_array")
    env = adapters.VectorEnv(pong(), OFF)
    env.reset()
    with pytest.raises(ValueError, match=r"takes options\['reset_mask'\] alone, not \['speed'\]"):
        env.reset(options={"speed": 2})
    with pytest.raises(ValueError, match=r"mask must be bool, of shape \(4,\), not torch.int64"):
        env.reset(options={"reset_mask": np.ones(4, int)})
    for seed in ([1, 2], 1.5):
        with pytest.raises(ValueError, match="seed must be an integer, or 4 of them"):
            env.reset(seed=seed)
    with pytest.raises(ValueError, match=r"actions must fit \(4, 1\), but their shape is \(3,\)"):
        env.step(np.zeros(3, int))
    for dtype in (torch.float64, np.float32):
        with pytest.raises(
            ValueError, match="dtype must be one of torch.float16, torch.float32, not"
        ):
            adapters.VectorEnv(pong(), dtype=dtype)
    with pytest.raises(
        ValueError, match="lane . has ended its episode: in DISABLED, begin the next"
    ):
        for _ in range(40):
            env.step(env.action_space.sample())
    with pytest.raises(ValueError, match="render_mode must be None or one of"):
        adapters.VectorEnv(pong(), render_mode="human")
    with pytest.raises(ValueError, match="Pong has no setting speed: it has seed, device, points"):
        gymnasium.make_vec("megastep/Pong-v0", 3, speed=3)
    with pytest.raises(ValueError, match="a single environment has one lane"):
        gymnasium.make("megastep/Pong-v0", self_play=True)
    assert len(adapters.VectorEnv(pong(2), render_mode="rgb_array").render()) == 2


INTEGERS = "bool int8 int16 int32 int64 uint8 uint16 uint32 uint64".split()


def test_discrete_actions_are_of_any_integer_dtype_and_no_other():
    env = adapters.VectorEnv(pong())
    choices = [1, 0, 1, 1]
    given = [np.array(choices, name) for name in INTEGERS]
    given += [torch.tensor(choices, dtype=getattr(torch, name)) for name in INTEGERS]
    given += [choices, [*map(bool, choices)], [*np.array(choices)], np.array(choices)[:, None]]
    shown = []
    for actions in given:
        env.reset(seed=1)
        shown.append(env.step(actions)[0])
    assert all(np.array_equal(shown[0], obs) for obs in shown)
    floats = [[0.7] * 4, np.full(4, 0.7), torch.ones(4).half(), torch.ones(4).cfloat()]
    for actions, name in zip(floats, ("float32", "float64", "float16", "complex64"), strict=True):
        text = f"actions must be integers from 0 to 2, but their dtype is torch.{name}; convert"
        with pytest.raises(ValueError, match=text):
            env.step(actions)
    with pytest.raises(ValueError, match="but their dtype is torch.float64"):
        gymnasium.make("megastep/Pong-v0").unwrapped.step(0.7)
    driven = adapters.VectorEnv(pointgoal(control="continuous"))
    driven.reset()
    driven.step(np.zeros((4, 3), int))


def test_an_extra_that_is_missing_is_named(monkeypatch):
    with pytest.raises(AttributeError, match="megastep.adapters has no Vec; it has SingleEnv"):
        _ = adapters.Vec
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    monkeypatch.setitem(sys.modules, "stable_baselines3.common.vec_env", None)
    monkeypatch.delitem(sys.modules, "megastep.adapters.sb3", raising=False)
    with pytest.raises(ImportError, match=r"pip install 'megastep-flatland\[sb3\]'"):
        _ = adapters.SB3VecEnv


# ---- PettingZoo ----


@pytest.mark.parametrize(
    "make",
    (
        lambda: pong(1, self_play=True),
        lambda: envs.Deathmatch(1, HOMES, n_agents=3, resample=True, limit=40, device="cpu"),
        lambda: forage.Forage(1, HOMES, limit=30, device="cpu"),
        lambda: envs.HideAndSeek(1, limit=30, device="cpu"),
    ),
)
def test_pettingzoo(make):
    tests = pytest.importorskip("pettingzoo.test")
    env = adapters.ParallelEnv(make(), render_mode="rgb_array")
    tests.parallel_api_test(env, num_cycles=100)
    tests.parallel_seed_test(lambda: adapters.ParallelEnv(make()), num_cycles=30)
    for agent in env.possible_agents:
        assert env.observation_space(agent) is env.observation_space(agent)
        assert env.action_space(agent) is env.action_space(agent)
    env.reset(seed=1)
    assert env.render().ndim == 3
    with pytest.raises(
        ValueError, match="a parallel environment has n_envs=1, but this Pong has 2"
    ):
        adapters.ParallelEnv(pong(2))


def test_an_agent_that_dies_plays_on_until_its_round_is_over():
    pytest.importorskip("pettingzoo")
    game = envs.Deathmatch(1, HOMES, n_agents=2, resample=True, limit=50, drain=0.5, device="cpu")
    env = adapters.ParallelEnv(game)
    env.reset(seed=1)
    deaths, n_steps = 0, 0
    while env.agents:
        actions = {agent: env.action_space(agent).sample() for agent in env.agents}
        _, _, terminated, truncated, infos = env.step(actions)
        deaths += sum(info.get("terminal", False) for info in infos.values())
        n_steps += 1
    assert n_steps == 50 and deaths >= 2
    assert all(truncated[a] or terminated[a] for a in env.possible_agents)
    assert env.step({}) == ({}, {}, {}, {}, {})


# ---- Masks of actions ----


class Masked(envs.Pong):
    """Pong in which a paddle may not do again what it did last."""

    def reset(self, seed=None, mask=None):
        return self._masked(super().reset(seed=seed, mask=mask))

    def step(self, decision):
        self.last = decision.actions
        return self._masked(super().step(decision))

    def _masked(self, world):
        last = getattr(self, "last", torch.zeros(len(world.reward), 1, dtype=torch.int64))
        options = torch.arange(self.action_space.n_actions)
        return arrdict.arrdict(world, mask=options != last[..., None])


def masked(n=4, **settings):
    return Masked(n, limit=8, device="cpu", **settings)


def allowed(actions):
    return np.arange(3) != np.asarray(actions)[..., None]


@pytest.mark.parametrize("mode", (NEXT, SAME))
@pytest.mark.parametrize("in_numpy", (True, False))
def test_infos_of_gymnasium_have_the_mask_of_each_step(mode, in_numpy):
    env = adapters.VectorEnv(masked(), mode, to_numpy=in_numpy)
    _, infos = env.reset(seed=1)
    for _ in range(20):
        mask = infos["action_mask"]
        assert mask.dtype == (np.int8 if in_numpy else torch.bool) and infos["_action_mask"].all()
        rows = [np.asarray(row, np.int8) for row in mask]
        actions = np.array([env.single_action_space.sample(mask=row) for row in rows])
        assert all(row[action] == 1 for row, action in zip(rows, actions))
        *_, infos = env.step(actions)
        assert np.array_equal(np.asarray(infos["action_mask"], bool), allowed(actions))


def test_single_environments_and_players_have_the_mask():
    env = adapters.SingleEnv(masked(1))
    _, info = env.reset(seed=1)
    assert info["action_mask"].tolist() == [0, 1, 1]
    *_, info = env.step(2)
    assert info["action_mask"].tolist() == [1, 1, 0] and info["action_mask"].dtype == np.int8
    tests = pytest.importorskip("pettingzoo.test")
    game = adapters.ParallelEnv(masked(1, self_play=True))
    tests.parallel_api_test(game, num_cycles=30)
    game.reset(seed=1)
    *_, infos = game.step({"left": 1, "right": 2})
    assert {agent: info["action_mask"].tolist() for agent, info in infos.items()} == {
        "left": [1, 0, 1],
        "right": [1, 1, 0],
    }


def test_stable_baselines_asks_for_the_mask():
    pytest.importorskip("stable_baselines3")
    env = adapters.SB3VecEnv(masked())
    env.reset()
    assert env.has_attr("action_masks") and not adapters.SB3VecEnv(pong()).has_attr("action_masks")
    env.step(np.array([0, 1, 2, 1]))
    masks = np.stack(env.env_method("action_masks"))
    assert np.array_equal(masks, allowed([0, 1, 2, 1]))
    assert np.array_equal(env.env_method("action_masks", indices=[2])[0], allowed(2))
    ppo = pytest.importorskip("sb3_contrib").MaskablePPO
    model = ppo("MlpPolicy", env, n_steps=8, batch_size=16, n_epochs=1, device="cpu")
    model.learn(64)
    observations = env.reset()
    for _ in range(20):
        mask = np.stack(env.env_method("action_masks"))
        actions, _ = model.predict(observations, action_masks=mask)
        assert mask[np.arange(4), actions].all()
        observations, *_ = env.step(actions)


def test_torchrl_acts_by_the_mask():
    torchrl_envs = pytest.importorskip("torchrl.envs")
    env = adapters.TorchRLEnv(masked())
    torchrl_envs.utils.check_env_specs(env)
    assert "action_mask" not in adapters.TorchRLEnv(pong()).observation_spec
    rollout = torchrl_envs.TransformedEnv(env, torchrl_envs.ActionMask()).rollout(
        20, break_when_any_done=False
    )
    assert rollout["action_mask"].gather(2, rollout["action"][..., None]).all()
    assert not rollout["action_mask"].all() and rollout["next", "done"].any()


# ---- TorchRL, Stable-Baselines3, rsl_rl ----


class Parts(Wrapper):
    """Takes a dict of actions, of which one counts."""

    def __init__(self, env):
        super().__init__(env)
        self.action_space = dotdict.dotdict(
            move=env.action_space, spare=spaces.MultiContinuous(1, 2)
        )

    def before(self, actions):
        return actions["move"]


@pytest.mark.parametrize(
    "make",
    (
        pong,
        lambda: pointgoal(privileged=True),
        lambda: envs.PointGoal(3, HOMES, limit=20, control="continuous", device="cpu"),
        lambda: Parts(pong()),
    ),
)
def test_torchrl(make):
    utils = pytest.importorskip("torchrl.envs.utils")
    env, twin = adapters.TorchRLEnv(make()), make()
    utils.check_env_specs(env)
    env.set_seed(5)
    rollout = env.rollout(60, break_when_any_done=False)
    world = twin.reset(seed=5 + torch.arange(contract.n_lanes(twin)))
    for t in range(60):  # partial resets begin the next episode where one ended, and leave others

        def one(space, leaf, t=t) -> torch.Tensor:
            return leaf[:, t].reshape(-1, *space.shape).contiguous()

        actions = spaces.map(one, twin.action_space, rollout["action"])
        world = twin.step(arrdict.arrdict(actions=actions))
        assert torch.equal(rollout["next", "reward"][:, t, 0], world.reward)
        assert torch.equal(rollout["next", "truncated"][:, t, 0], world.truncated)
        world = twin.reset(mask=world.terminal | world.truncated)
    assert rollout["next", "done"].any()


@pytest.mark.parametrize("mode", (SAME, OFF))
def test_torchrls_own_wrapper_reads_the_mode(mode):
    libs = pytest.importorskip("torchrl.envs.libs.gym")
    assert adapters.VectorEnv(pong()).autoreset_mode is NEXT
    env = libs.GymWrapper(adapters.VectorEnv(pong(), mode))
    rollout = env.rollout(70, break_when_any_done=False)
    ends = rollout["next", "done"][:, :-1, 0]
    last, first = rollout["next", "observation"][:, :-1][ends], rollout["observation"][:, 1:][ends]
    assert ends.any() and (last != first).any(-1).all()


def test_stable_baselines_get_the_last_observation():
    pytest.importorskip("stable_baselines3")
    env, twin = adapters.SB3VecEnv(pointgoal()), pointgoal()
    env.seed(7)
    env.reset()
    twin.reset(seed=torch.arange(7, 11))
    env.env.desync()
    twin.desync()
    n_ends = 0
    for action in moves(twin, 120):
        obs, reward, done, infos = env.step(action[:, 0].numpy())
        world = twin.step(arrdict.arrdict(actions=action))
        ended, last = world.terminal | world.truncated, world.obs.d.clone()
        truncated = world.truncated.clone()
        assert torch.equal(torch.as_tensor(done), ended)
        assert torch.equal(torch.as_tensor(reward), world.reward)
        world = twin.reset(mask=ended)
        assert torch.equal(torch.as_tensor(obs["d"]), world.obs.d[:, 0].float())
        for lane in ended.nonzero().flatten().tolist():
            n_ends += 1
            final = torch.as_tensor(infos[lane]["terminal_observation"]["d"])
            assert torch.equal(final, last[lane, 0].float())
            assert infos[lane]["TimeLimit.truncated"] == bool(truncated[lane])
            assert 0 <= infos[lane]["collisions"] <= 15
    assert n_ends > 4
    assert env.get_attr("n_envs") == [4] * 4 and env.env_is_wrapped(object) == [False] * 4
    with pytest.raises(ValueError, match="SAME_STEP needs reset.seed=None, mask=None"):
        adapters.SB3VecEnv(Numbers())


def test_stable_baselines_train_films_and_success_rates():
    ppo = pytest.importorskip("stable_baselines3").PPO
    keys = envs.Keys(4, geometries.sample("homes", 4, seed=7), limit=20, device="cpu")
    env = adapters.SB3VecEnv(keys, render_mode="rgb_array")
    assert {"keys_", "rgb"} <= {*env.observation_space.spaces}
    model = ppo("MultiInputPolicy", env, n_steps=32, batch_size=64, n_epochs=1, device="cpu")
    model.learn(128)
    assert len(model.ep_success_buffer) >= 4
    assert model.env.render().ndim == 3 and env.metadata["render_fps"] == 10
    env.step(np.zeros(4, int))
    for _ in range(20):
        _, _, done, infos = env.step(np.zeros(4, int))
        for info in (infos[lane] for lane in np.flatnonzero(done)):
            assert info["is_success"] == info["success"]
            assert info["terminal_observation"].keys() == env.observation_space.spaces.keys()


def test_written_lengths_end_episodes_of_rsl_rl():
    pytest.importorskip("rsl_rl.env")
    env = adapters.RslRlVecEnv(envs.PointGoal(64, HOMES, control="continuous", device="cpu"))
    n = torch.arange(64) % 8 + 1  # steps that are left
    assert env.max_episode_length == 500
    env.episode_length_buf = 500 - n
    for t in range(1, 9):
        _, _, dones, extras = env.step(torch.zeros(64, 3))
        assert torch.equal(dones, n == t) and torch.equal(extras["time_outs"], dones)
        assert torch.equal(env.episode_length_buf == 0, dones)


def test_rsl_rl_groups_and_time_outs():
    pytest.importorskip("rsl_rl.env")
    settings = dict(limit=20, control="continuous", privileged=True, device="cpu")
    env = adapters.RslRlVecEnv(envs.PointGoal(4, HOMES, **settings))
    groups = env.get_observations()
    assert groups["policy"].shape == (4, 64 * 4 + 6) and groups["critic"].shape == (4, 64 * 4 + 10)
    with torch.inference_mode():
        for _ in range(20):
            groups, reward, dones, extras = env.step(2 * torch.randn(4, 3))
    assert dones.all() and torch.equal(extras["time_outs"], dones) and reward.shape == (4,)
    assert not env.episode_length_buf.any()
    env.reset()
    with pytest.raises(
        ValueError, match="acts by vectors of numbers, but the actions of this Pong"
    ):
        adapters.RslRlVecEnv(pong())


# ---- A GPU ----


@pytest.mark.cuda
@pytest.mark.parametrize("mode", (NEXT, OFF, SAME))
def test_tensors_are_those_of_the_cpu_and_do_not_synchronise(mode):
    cpu = adapters.VectorEnv(pointgoal(), mode, to_numpy=False)
    gpu = adapters.VectorEnv(pointgoal(device="cuda"), mode, to_numpy=False)
    obs, on_gpu = cpu.reset(seed=3)[0], gpu.reset(seed=3)[0]
    cpu.env.desync()
    gpu.env.desync()
    assert all(torch.equal(obs[key], on_gpu[key].cpu()) for key in obs)
    actions = [action[:, 0] for action in moves(cpu.env, 60)]
    gpu.step(actions[0].cuda())  # which records a CUDA graph
    _, _, won, cut, _ = cpu.step(actions[0])
    if mode is OFF:  # and another
        gpu.reset(options={"reset_mask": (won | cut).cuda()})
        cpu.reset(options={"reset_mask": won | cut})
    kept = []
    for action in actions[1:]:
        given = action.cuda()
        with no_synchronisation():
            obs, reward, terminated, truncated, infos = gpu.step(given)
            ended = terminated | truncated
            if mode is OFF:
                obs, _ = gpu.reset(options={"reset_mask": ended})
        expected, paid, won, cut, told = cpu.step(action)
        if mode is OFF:
            expected, _ = cpu.reset(options={"reset_mask": won | cut})
        assert torch.equal(paid, reward.cpu()) and torch.equal(cut, truncated.cpu())
        if mode is SAME:
            final = infos["final_obs"]["rgb"][ended].cpu()
            assert torch.equal(final, told["final_obs"]["rgb"][won | cut])
        kept.append((obs, {key: leaf.clone() for key, leaf in obs.items()}, expected))
    for given, copies, expected in kept:  # no later step has written into them
        for key in given:
            assert torch.equal(given[key], copies[key])
            assert torch.equal(given[key].cpu(), expected[key])


def plain(tree):
    """Returns a tree whose arrays of objects, such as last observations, are lists."""
    if isinstance(tree, dict):
        return {key: plain(value) for key, value in tree.items()}
    is_array_of_objects = isinstance(tree, np.ndarray) and tree.dtype.kind == "O"
    if isinstance(tree, (tuple, list)) or is_array_of_objects:
        return [plain(value) for value in tree]
    return tree


@pytest.mark.cuda
@pytest.mark.parametrize("mode", (NEXT, SAME))
def test_arrays_are_those_of_the_cpu(mode):
    vectors = [adapters.VectorEnv(pointgoal(device=device), mode) for device in ("cpu", "cuda")]
    for vector in vectors:
        vector.reset(seed=3)
        vector.env.desync()
    actions = [action[:, 0].numpy() for action in moves(vectors[0].env, 40)]
    steps = [[plain(vector.step(action)) for action in actions] for vector in vectors]
    np.testing.assert_equal(*steps)


# ---- Training ----


@pytest.mark.nightly
@pytest.mark.parametrize(
    "name, package",
    [
        ("sb3", "stable_baselines3"),
        ("sb3_recurrent", "sb3_contrib"),
        ("torchrl", "torchrl"),
        ("rsl_rl", "rsl_rl"),
        ("skrl", "skrl"),
    ],
)
def test_libraries_train_agents_above_random(name, package):
    """By more than both 95 % intervals, after the budget that docs/adapters.md states."""
    pytest.importorskip(package)
    import other_libraries

    random, trained = other_libraries.compare(name, other_libraries.BUDGETS[name])
    assert trained[0] - trained[1] > random[0] + random[1], (random, trained)


@pytest.mark.slow
def test_the_code_of_the_page_runs():
    """In order. What needs a library that is not installed is left out."""
    names, n_run = {}, 0
    text = (ROOT / "docs" / "adapters.md").read_text()
    for block in re.findall(r"```python\n(.*?)```", text, re.S):
        try:
            exec(compile(block, "docs/adapters.md", "exec"), names)
            n_run += 1
        except ImportError:
            continue
    assert n_run >= 1
