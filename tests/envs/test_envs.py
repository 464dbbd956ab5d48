"""Every environment against the contract, and the rules of each."""

import inspect

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from megastep import arrdict, capture, contract, dotdict, envs, plotting, spaces, toys
from megastep.engine import EngineError
from megastep.engine.state_tree import state_tree
from megastep.geometries import sample

GPU = torch.cuda.is_available()
DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]
SHORT = {
    "minimal": dict(shortest=3, longest=9),
    "explorer": dict(patience=1, res=1, subsample=1),
    "explorer, privileged": dict(patience=1, res=1, subsample=1, privileged=True),
    "explorer, cameras": dict(patience=1, res=1, subsample=1, cameras=(0, 0)),
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
    ),
    "pointgoal": dict(limit=15, res=1, subsample=1),
    "pointgoal, privileged": dict(limit=15, res=1, subsample=1, privileged=True),
    "pong": dict(limit=20),
    "pong, pixels": dict(limit=20, pixels=True),
    "pong, self-play": dict(limit=20, self_play=True),
}  # settings of which episodes end within a test


@pytest.fixture(params=DEVICES)
def device(request):
    if request.param == "cuda" and not GPU:
        pytest.skip("needs a GPU")
    return request.param


def make(name, device="cpu", n_envs=12, seed=1, **settings):
    made = envs.ENVS[name.split(",")[0]]
    if "geometries" in inspect.signature(made).parameters:
        settings["geometries"] = sample("bench", 4)
    return made(n_envs, seed=seed, device=device, **{**SHORT[name], **settings})


def idle(env):
    """The decision of every lane's action 0."""
    lanes = env.n_envs * env.n_agents
    return arrdict.arrdict(actions=torch.zeros((lanes, 1), dtype=torch.long, device=env.device))


# ---- The contract ----


@pytest.mark.parametrize("name", SHORT)
def test_contract(name, device):
    worlds = contract.rollout(make(name, device), 60)
    ends = sum(int((w.terminal | w.truncated).sum()) for w in worlds)
    assert ends >= 12, "the episodes of this test are short enough to see them end"


class Fake:
    """The smallest environment: episodes of three steps, observing how old they are, that says all
    that a world may. ``fault`` breaks a clause of the contract.
    """

    n_envs, n_agents, device, fps = 2, 1, "cpu", 10.0
    obs_space = dotdict.dotdict(
        age=spaces.MultiVector(1, 1),
        sky=spaces.MultiImage(1, 3, 1, 2, dtype=torch.uint8),
        body=dotdict.dotdict(hands=spaces.MultiDiscrete(2, 4)),
    )
    action_space, roles = spaces.MultiDiscrete(1, 2), ("runner",)
    privileged_space = dotdict.dotdict(left=spaces.MultiVector(1, 1), lane=spaces.MultiVector(1, 2))

    def check(self):
        pass

    def __init__(self, fault=None):
        self.fault, self.age = fault, torch.tensor([0, 1])

    def _world(self, reset):
        ends = (self.age == 3) & ~reset
        world = arrdict.arrdict(
            obs=arrdict.arrdict(
                age=self.age.float().view(2, 1, 1),
                sky=torch.full((2, 1, 3, 1, 2), 255, dtype=torch.uint8),
                body=arrdict.arrdict(hands=self.age[:, None] + torch.zeros(2, dtype=torch.int64)),
            ),
            privileged=arrdict.arrdict(
                left=3.0 - self.age.view(2, 1, 1), lane=torch.eye(2).view(2, 1, 2)
            ),
            reward=torch.where(reset, 0.0, 1.0),
            reset=reset,
            terminal=ends & torch.tensor([True, False]),
            truncated=ends & torch.tensor([False, True]),
            learns=torch.tensor([True, False]),
            metrics=arrdict.arrdict(laps=torch.where(ends, 3.0, torch.nan)),
        )
        told = world.privileged
        later = self.fault and self.age.max() > 1
        faults = {
            "late reset": dict(reset=torch.zeros_like(reset)),
            "both": dict(terminal=ends, truncated=ends),
            "paid": dict(reward=torch.ones(2)),
            "absent": dict(obs=arrdict.arrdict(age=world.obs.age, sky=world.obs.sky)),
            "shape": dict(obs=arrdict.arrdict(world.obs, age=world.obs.age[:, 0])),
            "double": dict(obs=arrdict.arrdict(world.obs, age=world.obs.age.double())),
            "not a number": dict(obs=arrdict.arrdict(world.obs, age=world.obs.age / 0 * 0)),
            "pale": dict(obs=arrdict.arrdict(world.obs, sky=world.obs.sky.half())),
            "half hands": dict(
                obs=arrdict.arrdict(world.obs, body=dict(hands=world.obs.body.hands / 2))
            ),
            "five hands": dict(
                obs=arrdict.arrdict(world.obs, body=dict(hands=world.obs.body.hands + 1))
            ),
            "learns once": dict(learns=torch.tensor(True)),
            "learns a bit": dict(learns=torch.ones(2)),
            "metric of a column": dict(metrics=dict(laps=torch.zeros(2, 1))),
            "metric of integers": dict(metrics=dict(laps=torch.zeros(2, dtype=torch.int64))),
            "metric of one": dict(metrics=dict(laps=3.0)),
            "metric that is taken": dict(metrics={"return": torch.zeros(2)}),
            "metric of two words": dict(metrics={"lap/time": torch.zeros(2)}),
            "metric without a value": dict(metrics=dict(laps=torch.full((2,), torch.nan))),
            "metric alone": dict(metrics=torch.zeros(2)),
            "metric that comes late": dict(metrics=dict(laps=torch.zeros(2), more=torch.zeros(2)))
            if later
            else {},
            "more seen": dict(obs=arrdict.arrdict(world.obs, more=world.obs.age)),
            "less told": dict(privileged=dict(left=told.left)),
            "more told": dict(privileged=dict(told, more=told.left)),
            "told bare": dict(privileged=told.left),
            "told in a column": dict(privileged=dict(told, lane=told.lane[..., :1])),
            "told in half": dict(privileged=dict(told, lane=told.lane.half())),
            "told no number": dict(privileged=dict(told, left=told.left / 0 * 0)),
            "dtype": dict(reset=reset.float()),
            "nan": dict(reward=world.reward / 0 * 0),
            "ends at once": dict(
                terminal=reset | world.terminal, truncated=world.truncated & False
            ),
        }
        for key, value in faults.get(self.fault, {}).items():
            world[key] = value
        gone = {"no reward": "reward", "told nothing": "privileged", "learns at first": "learns"}
        for key, absent in gone.items():
            if self.fault == key and (absent != "learns" or later):
                del world[absent]
        return world

    def reset(self):
        self.age = torch.tensor([0, 1])
        return self._world(torch.ones(2, dtype=torch.bool))

    def step(self, decision):
        reset = self.age == 3
        self.age = torch.where(reset, 0, self.age + 1)
        return self._world(reset)


def test_the_checker_accepts_a_world_that_keeps_the_contract():
    contract.rollout(Fake(), 9)


@pytest.mark.parametrize("name", contract.ATTRIBUTES)
def test_the_checker_names_what_an_environment_lacks(name):
    class Lacking:
        def __getattr__(self, asked):
            if asked == name:
                raise AttributeError(asked)
            return getattr(Fake(), asked)

    with pytest.raises(
        AssertionError,
        match=f"Lacking breaks the contract: it has no {name}: {contract.ATTRIBUTES[name]}",
    ):
        contract.check_environment(Lacking())


@pytest.mark.parametrize(
    "name, value, clause",
    [
        ("fps", 0, "fps is a positive number of steps per second, not 0"),
        ("layout", torch.zeros(3, dtype=torch.int32), "layout has one integer per environment"),
        ("layout", torch.zeros(2), "layout has one integer per environment"),
        ("roles", ("leader", "follower"), "roles has one name per agent of an environment, 1 in"),
        ("roles", (), "roles has one name per agent"),
        ("roles", "a", "roles has one name per agent"),
        ("roles", ("the leader",), "roles has one name per agent"),
        ("roles", (1,), "roles has one name per agent"),
    ],
)
def test_the_checker_names_an_attribute_that_is_wrong(name, value, clause):
    env = Fake()
    setattr(env, name, value)
    with pytest.raises(AssertionError, match=clause):
        contract.check_environment(env)


@pytest.mark.parametrize(
    "fault, clause",
    [
        ("late reset", "reset follows"),
        ("both", "exclude"),
        ("paid", "pays nothing"),
        ("no reward", "a world has reward"),
        ("absent", "observation body.hands is as its space says"),
        ("shape", "observation age is as its space says"),
        ("double", "observation age is a float on the device"),
        ("not a number", "observation age is finite"),
        ("pale", "observation sky is of the torch.uint8 that its space names"),
        ("half hands", "observation body.hands is integers"),
        ("five hands", "observation body.hands is from 0 to 3"),
        ("learns once", "learns has one bool per lane"),
        ("learns a bit", "learns has one bool per lane"),
        ("learns at first", "every world has learns, or none has"),
        (
            "metric of a column",
            r"metric laps has one float32 per lane, \(2,\), .*not torch.float32 \(2, 1\)",
        ),
        ("metric of integers", r"not torch.int64 \(2,\)"),
        ("metric of one", "not 3.0"),
        ("metric that is taken", "not 'return'"),
        ("metric of two words", "not 'lap/time'"),
        ("metric without a value", "metric laps is finite where episodes end"),
        ("metric alone", "metrics is a dict"),
        ("metric that comes late", "every world has the same metrics"),
        ("more seen", r"observation has the keys of its space, and not \['more'\]"),
        ("told nothing", "a world has privileged values if, and only if"),
        ("less told", "privileged lane are as their space says"),
        ("more told", r"privileged has the keys of its space, and not \['more'\]"),
        ("told bare", "privileged left are as their space says"),
        ("told in a column", "privileged lane are as their space says"),
        ("told in half", "privileged lane are float32 on the device"),
        ("told no number", "privileged left are finite"),
        ("dtype", "flags are bools"),
        ("nan", "rewards are finite"),
        ("ends at once", "does not end"),
    ],
)
def test_the_checker_names_the_broken_clause(fault, clause):
    with pytest.raises(contract.ContractError, match=f"^Fake breaks the contract: .*{clause}"):
        contract.rollout(Fake(fault), 9)


@pytest.mark.parametrize("space", [None, spaces.MultiVector(1, 1)])
def test_privileged_values_may_be_absent_or_bare(space):
    class Bare(Fake):
        privileged_space = space

        def _world(self, reset):
            world = super()._world(reset)
            told = world.pop("privileged")
            return world if space is None else arrdict.arrdict(world, privileged=told.left)

    contract.rollout(Bare(), 9)


def test_privileged_values_need_a_space():
    env = Fake()
    env.privileged_space = None
    with pytest.raises(contract.ContractError, match="only if, there is a privileged_space"):
        contract.rollout(env, 0)


@pytest.mark.parametrize("name", SHORT)
def test_a_seed_determines_an_episode(name, device):
    first, second, other = (
        contract.rollout(make(name, device, seed=seed), 20, check=False) for seed in (1, 1, 2)
    )
    assert contract.same(arrdict.stack(first), arrdict.stack(second))
    assert not contract.same(arrdict.stack(first).obs, arrdict.stack(other).obs)


@pytest.mark.parametrize("name", SHORT)
def test_an_ended_lane_ignores_its_decision(name):
    a, b = make(name), make(name)
    worlds, generator, ignored = [a.reset(), b.reset()], torch.Generator().manual_seed(3), 0
    for _ in range(40):
        ended = worlds[0].terminal | worlds[0].truncated
        actions = contract.random_actions(a, generator)
        others = torch.where(ended[:, None], (actions + 1) % a.action_space.n_actions, actions)
        ignored += int(ended.sum())
        worlds = [a.step(arrdict.arrdict(actions=actions)), b.step(arrdict.arrdict(actions=others))]
        assert contract.same(*worlds)
    assert ignored


@pytest.mark.parametrize("name", SHORT)
def test_states_are_drawn(name, device):
    env = make(name, device)
    contract.rollout(env, 3, check=False)
    before = contract.rollout(make(name, device), 3)[-1]
    state = arrdict.numpyify(env.state(5))
    image = plotting.rasterise(type(env).plot_state(state))
    assert image.ndim == 3 and image.std() > 5, "a figure with something on it"
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
        torch.cuda.set_sync_debug_mode("error")
        try:
            for _ in range(3):
                env.step(decision)
        finally:
            torch.cuda.set_sync_debug_mode("default")

    @pytest.mark.parametrize("name", SHORT)
    def test_an_episode_is_the_same_on_cpu_and_gpu_captured_or_not(self, name):
        runs = [
            contract.rollout(env, 40, check=False)
            for env in (make(name), make(name, "cuda"), capture.Captured(make(name, "cuda")))
        ]
        assert contract.same(arrdict.stack(runs[0]), arrdict.stack(runs[1]))
        assert contract.same(arrdict.stack(runs[0]), arrdict.stack(runs[2]))


# ---- Explorer ----


def test_explorer_truncates_when_its_length_reaches_what_it_has_seen_and_its_patience():
    env = make("explorer", patience=5)
    world, length, seen = env.reset(), torch.zeros(12), None
    generator = torch.Generator().manual_seed(1)
    seen = env.n_seen.clone()
    for _ in range(400):
        world = env.step(arrdict.arrdict(actions=contract.random_actions(env, generator)))
        length = torch.where(world.reset, 0, length + 1)
        seen = torch.where(world.reset, env.n_seen, seen + (64 * world.reward).round().int())
        assert torch.equal(seen, env.n_seen) and torch.equal(
            world.truncated, (length >= seen + 5) & ~world.reset
        )


def test_explorer_pays_once_for_each_texel():
    """Turning on the spot in an empty box: after a full turn everything has been seen, and all pay
    adds up to what the first view did not show."""
    env = envs.Explorer(1, [toys.box()], device="cpu", res=1024, subsample=16)
    env.reset()
    first, paid = int(env.n_seen), 0.0
    turn = arrdict.arrdict(actions=torch.tensor([[5]]))
    for _ in range(60):
        paid += float(env.step(turn).reward)
    assert round(64 * paid) == 400 - first, "four walls of 5 m, 5 cm a texel"
    assert not any(float(env.step(turn).reward) for _ in range(30))


def test_explorer_sees_with_each_camera_what_it_would_see_turned():
    """Cameras at 0, 90 and -90 degrees show what one camera does in agents turned so far."""
    several = envs.Explorer(1, [toys.column()], device="cpu", cameras=[0, 90, -90])
    views = several.reset().obs
    assert views.rgb.shape == (1, 1, 3, 3, 64) and views.d.shape == (1, 1, 1, 3, 64)
    for camera, yaw in enumerate((0, 90, -90)):
        one = envs.Explorer(1, [toys.column()], device="cpu")
        one.reset()
        one.core.agents.positions.copy_(several.core.agents.positions)
        one.core.agents.angles.copy_(several.core.agents.angles + yaw)
        obs = one._observation()[0]
        close = dict(rtol=0, atol=2e-3)  # fp16, and an angle that is rounded before it is turned
        torch.testing.assert_close(views.rgb[:, :, :, camera], obs.rgb[:, :, :, 0], **close)
        torch.testing.assert_close(views.d[:, :, :, camera], obs.d[:, :, :, 0], **close)
    seen = [int(env.n_seen) for env in (several, one)]
    assert seen[0] > seen[1], "all cameras count"


@pytest.mark.parametrize(
    "cameras, message",
    [
        ([], "^cameras: a list of 0 is out of range: allowed is at least 1$"),
        ([0] * 17, "^cameras: a list of 17 is out of range: allowed is at most 16$"),
        (["ahead"], "^cameras: expected a number, got "),
        ([1e10], "^cameras must hold numbers below 1e"),
    ],
)
def test_explorer_refuses_cameras_that_are_none(cameras, message):
    with pytest.raises(ValueError, match=message):
        envs.Explorer(1, [toys.box()], device="cpu", cameras=cameras)


@pytest.mark.parametrize("name", SHORT)
def test_check_raises_what_the_device_has_flagged(name, device):
    env = make(name, device)
    env.reset()
    env.check()
    if device == "cpu":  # whose operations look at once, so the flag is set by hand
        (flag,) = [leaf for path, leaf in state_tree(env).items() if "error_flag" in path]
        flag.fill_(8 * 3 + 1)
    else:
        env.step(idle(env).map(torch.add, 7))
    with pytest.raises(EngineError, match="nvironment"):
        env.check()
    env.check()


class Launches(TorchDispatchMode):
    """Counts PyTorch's operations that a GPU would launch a kernel for."""

    def __init__(self):
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        free = function.is_view or function.name().startswith(
            ("aten::empty", "aten::_local_scalar")
        )
        self.count += not free
        return function(*args, **(kwargs or {}))


@pytest.mark.parametrize(
    "name, most",
    [
        ("minimal", 10),
        ("explorer", 9),
        ("explorer, privileged", 18),
        ("explorer, cameras", 9),
        ("deathmatch", 1),
        ("deathmatch, privileged", 1),
        ("deathmatch, all rules", 4),  # three of them for search_reward
        ("pointgoal", 1),
        ("pong", 0),
    ],
)
def test_a_step_launches_few_small_operations(name, most):
    """At a few thousand environments their number is what a step takes on a GPU."""
    env = make(name)
    env.reset()
    decision = idle(env)
    with Launches() as launches:
        env.step(decision)
    assert launches.count <= most


@pytest.mark.parametrize("name", envs.ENVS)
def test_star_imports_bring_the_environment_and_no_more(name):
    found = {"arrdict": arrdict}
    exec(f"from megastep.envs.{name} import *", found)
    assert found.keys() - {"__builtins__"} == {"arrdict", envs.ENVS[name].__name__}
    assert found["arrdict"] is arrdict


@pytest.mark.parametrize("name", SHORT)
def test_an_environment_is_displayed_as_it_is(name):
    env = make(name)
    env.reset()
    figure = env.display(3)
    drawn = type(env).plot_state(arrdict.numpyify(env.state(3)))
    assert (plotting.rasterise(figure) == plotting.rasterise(drawn)).all()
    assert figure.axes[0].get_title().startswith("step 0")


def test_explorer_state_counts_what_the_bitmap_holds():
    env = make("explorer")
    contract.rollout(env, 10, check=False)
    state = env.state(3)
    assert int(state.seen.sum()) == int(state.n_seen) == int(env.n_seen[3])


# ---- Minimal ----


def test_minimal_lifespans_lie_between_their_bounds():
    env = envs.Minimal(64, device="cpu", shortest=3, longest=5)
    ends = [w.truncated for w in contract.rollout(env, 30)]
    ages = [
        [b - a for a, b in zip(e, e[1:])]
        for e in (torch.stack(ends)[:, lane].nonzero().flatten().tolist() for lane in range(64))
    ]
    spans = {
        age - 1 for lane in ages for age in lane
    }  # one step more for the new episode's first view
    assert spans == {3, 4, 5}


def test_minimal_forward_moves_a_metre_per_step():
    env = envs.Minimal(1, device="cpu")
    env.reset()
    env.core.agents.positions[:] = 3.0
    env.core.agents.angles[:] = 90.0
    env.step(arrdict.arrdict(actions=torch.tensor([[3]])))
    assert np.allclose(env.core.agents.positions.tolist(), [[[3.0, 4.0]]], atol=1e-5), (
        "10 m/s for a tenth of a second, along +y"
    )


def test_explorer_resamples_homes_at_respawn_alone(device):
    env, generator, moved = (
        make("explorer", device, resample=True),
        torch.Generator().manual_seed(1),
        0,
    )
    env.reset()
    for _ in range(60):
        before = env.core.scenery.layout.clone()
        world = env.step(arrdict.arrdict(actions=contract.random_actions(env, generator)))
        changed = before != env.core.scenery.layout
        assert not bool((changed & ~world.reset).any()), "homes change at respawns alone"
        moved += int(changed.sum())
    assert moved and set(env.core.scenery.layout.tolist()) <= {0, 1, 2, 3}
    assert int(env.state(0).seen.sum()) == int(env.n_seen[0]), (
        "what was seen belongs to the new home"
    )
