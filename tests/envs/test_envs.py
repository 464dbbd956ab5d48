"""Every environment keeps the contract; the rules of Minimal and Explorer."""

import inspect
import math

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from megastep import arrdict, capture, contract, engine, envs, plotting, spaces, toys
from megastep.engine import EngineError
from megastep.engine.state_tree import state_tree
from megastep.envs import PointGoal
from megastep.envs.first_person import images
from megastep.geometries import sample
from megastep.kernels.build.launch import ENGINE
from megastep.modules import Robot
from tests.helpers.synchronisation import no_synchronisation

GPU = torch.cuda.is_available()
# Settings that let episodes end within a test.
SHORT = {
    "minimal": dict(shortest=3, longest=9),
    "explorer": dict(patience=1, res=1, subsample=1),
    "explorer, privileged": dict(patience=1, res=1, subsample=1, privileged=True),
    "explorer, continuous": dict(
        patience=1, res=1, subsample=1, privileged=True, resample=True, control="continuous"
    ),
    "explorer, cameras": dict(patience=1, res=1, subsample=1, cameras=(0, 0)),
    "memory": dict(limit=15, res=1, subsample=1),
    "memory, privileged": dict(limit=15, res=1, subsample=1, privileged=True, resample=True),
    "keys": dict(limit=15, res=1, subsample=1),
    "keys, privileged": dict(limit=15, res=1, subsample=1, privileged=True, resample=True),
    "deathmatch": dict(limit=20),
    "deathmatch, privileged": dict(limit=20, n_agents=2, damage=1, privileged=True),
    "deathmatch, all rules": dict(
        limit=20,
        n_agents=16,
        recovery=0.1,
        drain=0.05,
        health_per_hit=0.1,
        kill_reward=1,
        aim_reward=1,
        search_reward=1,
        hearing=5,
        privileged=True,
    ),
    "hideandseek": dict(limit=20, res=2, subsample=1),
    "hideandseek, privileged": dict(
        limit=20, prep=5, n_hiders=3, n_boxes=3, res=2, subsample=1, privileged=True, resample=True
    ),
    "pointgoal": dict(limit=15, res=1, subsample=1),
    "pointgoal, cameras": dict(limit=15, res=1, subsample=1, cameras=(0, 180)),
    "pointgoal, privileged": dict(limit=15, res=1, subsample=1, privileged=True),
    "pointgoal, continuous": dict(
        limit=15, res=1, subsample=1, privileged=True, resample=True, control="continuous"
    ),
    "pointgoal, robot": dict(limit=15, res=1, subsample=1, robot=Robot(n_rays=6), resample=True),
    "pointgoal, robot that slides": dict(
        limit=15, res=1, subsample=1, robot=Robot(sensor="rgb", speed=9.0, accel=90.0), slide=True
    ),
    "minatar": dict(id="seaquest", limit=20),
    "pong": dict(limit=20),
    "pong, pixels": dict(limit=20, pixels=True),
    "pong, self-play": dict(limit=20, self_play=True),
    "pong, pixels of both": dict(limit=20, pixels=True, self_play=True),
}


def chosen(names):
    """Leaves all settings but these to the nightly tests."""
    nightly = pytest.mark.nightly
    return [name if name in names else pytest.param(name, marks=nightly) for name in SHORT]


#: Each environment's first line, and the settings that compute most.
FIRST = chosen(envs.ENVS)
MOST = chosen(
    (
        *("minimal", "explorer, privileged", "explorer, continuous", "explorer, cameras"),
        *("memory, privileged", "keys, privileged", "deathmatch, privileged"),
        "hideandseek, privileged",
        *("pointgoal, continuous", "pong, pixels of both", "minatar"),
    )
)


def make(name, device="cpu", n_envs=12, seed=1, **settings):
    cls = envs.ENVS[name.split(",")[0]]
    if "geometries" in inspect.signature(cls).parameters:
        source = {"keys": "homes", "hideandseek": "quadrant"}.get(name.split(",")[0], "bench")
        settings["geometries"] = sample(source, 4)
    return cls(n_envs, seed=seed, device=device, **{**SHORT[name], **settings})


def idle(env):
    """The decision of action 0, or of numbers of 0, in every lane."""
    shape = env.n_envs * env.n_agents, *env.action_space.shape
    dtype = torch.float32 if is_continuous(env) else torch.long
    return arrdict.arrdict(actions=torch.zeros(shape, dtype=dtype, device=env.device))


def is_continuous(env):
    return isinstance(env.action_space, spaces.MultiContinuous)


def random_decision(env, generator):
    return arrdict.arrdict(actions=contract.random_actions(env, generator))


# ---- All environments ----


@pytest.mark.parametrize("name", SHORT)
def test_contract(name, device):
    worlds = contract.rollout(make(name, device), 60)
    n_ends = sum(int((w.terminal | w.truncated).sum()) for w in worlds)
    assert n_ends >= 12, "no clause about ends is tested unless episodes end"


@pytest.mark.parametrize(
    "name, settings",
    [
        ("minimal", dict(shortest=20, longest=40)),
        ("explorer", dict(patience=30)),
        ("deathmatch", dict(limit=20)),
        ("pointgoal", dict(limit=20)),
    ],
)
def test_desynced_lanes_are_in_the_middle_of_their_episodes(name, settings, device):
    ages = []
    for where, seed in ((device, 1), ("cpu", 1), ("cpu", 2)):
        env = make(name, where, 64, seed, **settings)
        first = env.reset().clone()
        env.desync()
        ages.append(getattr(env, "lifecycle", env).ages.cpu().clone())
    assert torch.equal(ages[0], ages[1]) and not torch.equal(ages[0], ages[2])
    limits = getattr(getattr(env, "lifecycle", env), "limits", torch.tensor([20]))
    assert ages[2].min() >= 0 and (ages[2] < limits).all() and len(ages[2].unique()) > 10
    world = env.step(idle(env))
    contract.check_world(env, world, last=arrdict.arrdict(first))
    new_limits = env.limits if name == "explorer" else limits
    assert torch.equal(world.truncated, ages[2] + 1 >= new_limits) and world.truncated.any()


@pytest.mark.parametrize("name", FIRST)
def test_equal_seeds_give_equal_episodes(name, device):
    first, second, other = (
        contract.rollout(make(name, device, seed=seed), 20, check=False) for seed in (1, 1, 2)
    )
    assert contract.same(arrdict.stack(first), arrdict.stack(second))
    assert not contract.same(arrdict.stack(first).obs, arrdict.stack(other).obs)


@pytest.mark.parametrize("name", FIRST)
def test_decision_after_the_end_of_an_episode_is_ignored(name):
    a, b = make(name), make(name)
    worlds, generator, n_ignored = [a.reset(), b.reset()], torch.Generator().manual_seed(3), 0
    for _ in range(40):
        ended = worlds[0].terminal | worlds[0].truncated
        decision = random_decision(a, generator)
        other = decision.clone()
        n_actions = 1 if is_continuous(a) else a.action_space.n_actions
        other.actions[ended] = (other.actions[ended] + 1) % n_actions
        n_ignored += int(ended.sum())
        worlds = [a.step(decision), b.step(other)]
        assert contract.same(*worlds)
    assert n_ignored


@pytest.mark.parametrize("name", ["explorer", "deathmatch", "pointgoal"])
def test_privileged_changes_nothing_else(name, device):
    plain, more = make(name, device), make(name, device, privileged=True)
    assert plain.privileged_space is None
    for a, b in zip(contract.rollout(plain, 30), contract.rollout(more, 30), strict=True):
        del b["privileged"]
        assert contract.same(a, b)


@pytest.mark.parametrize("name", FIRST)
def test_state_is_drawn_and_does_not_change_the_environment(name, device):
    env = make(name, device)
    contract.rollout(env, 3, check=False)
    before = contract.rollout(make(name, device), 3)[-1]
    state = arrdict.numpyify(env.state(5))
    image = plotting.rasterise(type(env).plot_state(state))
    assert image.ndim == 3 and image.std() > 5, "the figure is blank"
    contract.check_world(env, env.step(idle(env)), before)


@pytest.mark.cuda
@pytest.mark.skipif(not GPU, reason="needs a GPU")
class TestOnTheGPU:
    @pytest.mark.parametrize("name", SHORT)
    def test_step_never_synchronises(self, name):
        env = make(name, "cuda")
        env.reset()
        decision = idle(env)
        env.step(decision)
        with no_synchronisation():
            for _ in range(3):
                env.step(decision)

    @pytest.mark.parametrize("name", SHORT)
    def test_cpu_gpu_and_cuda_graph_give_equal_episodes(self, name):
        """With 70 environments, which fill no whole number of blocks."""
        on_cpu, on_gpu, captured = (make(name, on, 70) for on in ("cpu", "cuda", "cuda"))
        runs = [
            contract.rollout(env, 60, check=False)
            for env in (on_cpu, on_gpu, capture.Captured(captured))
        ]
        assert contract.same(arrdict.stack(runs[0]), arrdict.stack(runs[1]))
        assert contract.same(arrdict.stack(runs[0]), arrdict.stack(runs[2]))


@pytest.mark.parametrize("name", MOST)
def test_cuda_kernels_on_a_cpu_give_equal_episodes(name, cuda_on_cpu, monkeypatch):
    """With the threads of a block in the order opposite to that of the CPU's loops."""
    expected = arrdict.stack(contract.rollout(make(name, n_envs=6), 24, check=False))
    cuda_on_cpu.install(monkeypatch)
    monkeypatch.setattr(cuda_on_cpu, "order", "reversed")
    found = contract.rollout(make(name, n_envs=6), 24, check=False)
    assert contract.same(expected, arrdict.stack(found))


@pytest.mark.parametrize("name", MOST)
def test_number_of_threads_changes_no_bit(name):
    runs = []
    try:
        for n in (1, 3):
            engine.set_threads(n)
            runs.append(arrdict.stack(contract.rollout(make(name, n_envs=7), 30, check=False)))
    finally:
        engine.set_threads(None)
    assert contract.same(*runs)


# ---- Continuous actions ----


@pytest.mark.parametrize("name", ["explorer", "pointgoal"])
def test_continuous_actions_of_one_do_what_discrete_actions_do(name, device):
    """Bit for bit. Numbers beyond 1 count as 1."""
    ahead, left, turn = torch.eye(3).tolist()
    weights = torch.tensor([ahead, left, left, ahead, ahead, turn, turn])
    weights *= torch.tensor([0, 1, -1, 1, -1, 1, -1])[:, None]
    discrete, continuous = (
        make(f"{name}, privileged", device, control=control)
        for control in ("discrete", "continuous")
    )
    generator = torch.Generator().manual_seed(1)
    assert contract.same(discrete.reset(), continuous.reset())
    for step in range(40):
        actions = torch.randint(7, (12, 1), generator=generator)
        numbers = weights[actions] * (1 + step % 2)
        worlds = [
            env.step(arrdict.arrdict(actions=chosen.to(device)))
            for env, chosen in ((discrete, actions), (continuous, numbers))
        ]
        assert contract.same(*worlds)


# ---- Explorer ----


def test_explorer_truncates_at_texels_seen_plus_patience():
    env, generator = make("explorer", patience=5), torch.Generator().manual_seed(1)
    env.reset()
    lengths, n_seen = torch.zeros(12), env.n_seen.clone()
    for _ in range(400):
        world = env.step(random_decision(env, generator))
        lengths = torch.where(world.reset, 0, lengths + 1)
        n_new = (64 * world.reward).round().int()
        n_seen = torch.where(world.reset, env.n_seen, n_seen + n_new)
        assert torch.equal(n_seen, env.n_seen)
        assert torch.equal(world.truncated, (lengths >= n_seen + 5) & ~world.reset)


def test_explorer_rewards_each_texel_once():
    """After a full turn in an empty box every texel has been seen. The rewards add up to the texels
    that the first observation did not show."""
    env = envs.Explorer(1, [toys.box()], device="cpu", res=1024, subsample=16)
    env.reset()
    n_first, total = int(env.n_seen), 0.0
    turn = arrdict.arrdict(actions=torch.tensor([[5]]))
    for _ in range(60):
        total += float(env.step(turn).reward)
    assert round(64 * total) == 400 - n_first, "four walls of 5 m have 100 texels of 5 cm each"
    assert not any(float(env.step(turn).reward) for _ in range(30))


@pytest.mark.parametrize("name", ["explorer", "pointgoal"])
def test_each_camera_shows_what_a_turned_agent_sees(name):
    """Cameras at 0, 90 and -90 degrees equal one camera on agents turned by these angles."""
    several = envs.ENVS[name](2, [toys.column()] * 2, device="cpu", cameras=[0, 90, -90])
    views = several.reset().obs
    assert views.rgb.shape == (2, *several.obs_space.rgb.shape) == (2, 1, 3, 3, 64)
    assert views.d.shape == (2, *several.obs_space.d.shape) == (2, 1, 1, 3, 64)
    for camera, yaw in enumerate((0, 90, -90)):
        one = envs.ENVS[name](2, [toys.column()] * 2, device="cpu")
        one.reset()
        one.core.agents.positions.copy_(several.core.agents.positions)
        one.core.agents.angles.copy_(several.core.agents.angles + yaw)
        obs = images(one._view())
        close = dict(rtol=0, atol=2e-3)  # fp16, and an angle that is rounded before it is turned
        torch.testing.assert_close(views.rgb[:, :, :, camera], obs.rgb[:, :, :, 0], **close)
        torch.testing.assert_close(views.d[:, :, :, camera], obs.d[:, :, :, 0], **close)
    if name == "explorer":
        assert (several.n_seen > one.n_seen).all(), "every camera marks texels as seen"


@pytest.mark.parametrize(
    "cameras, message",
    [
        ([], "^cameras.* 0 .*at least 1"),
        ([0] * 17, "^cameras.* 17 .*at most 16"),
        (["ahead"], "^cameras.* number"),
        ([1e10], "^cameras.* 1e"),
    ],
)
@pytest.mark.parametrize("make_env", [envs.Explorer, PointGoal])
def test_wrong_cameras_are_refused(make_env, cameras, message):
    with pytest.raises(ValueError, match=message):
        make_env(1, [toys.box()], device="cpu", cameras=cameras)


@pytest.mark.parametrize("name", SHORT)
def test_check_raises_errors_flagged_on_the_device(name, device):
    env = make(name, device)
    env.reset()
    env.check()
    bad = idle(env).map(torch.add, math.nan if is_continuous(env) else 99)
    if device == "cpu":  # operations on the CPU raise at once, so set the flag by hand
        with pytest.raises(EngineError, match="nvironment"):
            env.step(bad)
        (flag,) = [leaf for path, leaf in state_tree(env).items() if "error_flag" in path]
        flag.fill_(3 * ENGINE.constants["ERROR_KINDS"] + 1)
    else:
        env.step(bad)
    with pytest.raises(EngineError, match="nvironment"):
        env.check()
    env.check()


class Launches(TorchDispatchMode):
    """Counts the PyTorch operations that would launch a kernel on a GPU."""

    def __init__(self):
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        no_kernel = "aten::empty", "aten::_local_scalar"
        self.count += not (function.is_view or function.name().startswith(no_kernel))
        return function(*args, **(kwargs or {}))


@pytest.mark.parametrize(
    "name, max_launches",
    [
        ("minimal", 10),
        ("explorer", 0),
        ("explorer, privileged", 0),
        ("explorer, cameras", 0),
        ("deathmatch", 0),
        ("deathmatch, privileged", 0),
        ("deathmatch, all rules", 0),
        ("hideandseek, privileged", 0),
        ("pointgoal", 1),
        ("pointgoal, cameras", 1),
        ("pong", 0),
    ],
)
def test_step_launches_few_small_operations(name, max_launches):
    """With a few thousand environments the number of launches decides the time of a step."""
    env = make(name)
    env.reset()
    decision = idle(env)
    with Launches() as launches:
        env.step(decision)
    assert launches.count <= max_launches


def test_explorer_resamples_homes_at_resets_only(device):
    env, generator = make("explorer", device, resample=True), torch.Generator().manual_seed(1)
    env.reset()
    n_changes = 0
    for _ in range(60):
        before = env.layout.clone()
        world = env.step(random_decision(env, generator))
        changed = before != env.layout
        assert not bool((changed & ~world.reset).any())
        n_changes += int(changed.sum())
    assert n_changes and set(env.layout.tolist()) <= {0, 1, 2, 3}
    assert int(env.state(0).seen.sum()) == int(env.n_seen[0]), "the bitmap is of the new home"


# ---- Minimal ----
