"""Capture: the walk over state runs anywhere; the graphs themselves need a GPU."""

from operator import attrgetter

import pytest
import torch

from megastep import arrdict, capture, envs, spaces

GPU = torch.cuda.is_available()
on_gpu = [pytest.mark.cuda, pytest.mark.skipif(not GPU, reason="needs a GPU")]


class Counter:
    """An environment in PyTorch alone. ``how`` says how its step changes its state."""

    n_envs, n_agents = 4, 1
    obs_space, action_space = spaces.MultiVector(1, 1), spaces.MultiDiscrete(1, 3)

    def __init__(self, how="in place", device="cpu"):
        self.how, self.device = how, device
        self.parts = {"total": torch.zeros(4, device=device), 7: torch.zeros(4, device=device)}
        self.steps, self.history = 0, [torch.zeros(4, device=device)]
        self.pair = (torch.zeros(4, device=device),)
        self.generator = torch.Generator(device).manual_seed(1)

    def step(self, decision):
        total = self.parts["total"] + decision.actions[:, 0]
        if self.how == "in place":
            self.parts["total"].copy_(total)
        elif self.how == "rebound":
            self.parts["total"], self.parts[7], self.history[0] = total, total * 3, total * 2
        elif self.how == "scalar":
            self.steps += 1
        elif self.how == "asks":
            total = total + float(total.sum())
        elif self.how == "tuple":
            self.pair = (total,)
        elif self.how == "grows":
            self.parts["total"] = torch.cat([total, total])
        noise = torch.rand(4, device=self.device, generator=self.generator)
        return arrdict.arrdict(obs=total.view(4, 1, 1), reward=noise)


def actions(device, value=1, n=4):
    return arrdict.arrdict(actions=torch.full((n, 1), value, device=device))


def test_the_walk_finds_tensors_and_generators_by_path():
    tree = capture.state_tree(Counter())
    assert set(tree) == {".parts['total']", ".parts[7]", ".history[0]", ".pair[0]", ".generator"}
    paths = capture.state_tree(envs.Explorer(2, device="cpu"))
    assert {
        ".core.agents.positions",
        ".core.scenery.layout",
        ".seen",
        ".spawner.counts",
        ".ended",
    } <= set(paths)


def test_a_snapshot_brings_an_episode_back():
    env = envs.Explorer(3, device="cpu")
    env.reset()
    turn = arrdict.arrdict(actions=torch.full((3, 1), 5))
    env.step(turn)
    saved = capture.snapshot(env)
    first = [env.step(turn) for _ in range(5)]
    capture.restore(env, saved)
    again = [env.step(turn) for _ in range(5)]
    assert all(
        torch.equal(a.obs.rgb, b.obs.rgb) and torch.equal(a.reward, b.reward)
        for a, b in zip(first, again, strict=True)
    )


def test_a_snapshot_of_another_environment_is_refused():
    saved = capture.snapshot(envs.Explorer(3, device="cpu"))
    with pytest.raises(ValueError, match="which this Minimal does not have"):
        capture.restore(envs.Minimal(3, device="cpu"), saved)
    with pytest.raises(ValueError, match="but this Explorer needs"):
        capture.restore(envs.Explorer(4, device="cpu"), saved)


def test_settling_copies_rebound_tensors_back_and_names_changed_scalars():
    for how, fault in [
        ("in place", None),
        ("rebound", None),
        ("scalar", "steps changed from 0 to 1"),
        ("tuple", "cannot be put back"),
        ("grows", "changed its shape"),
    ]:
        env = Counter(how)
        state, before = capture._State([env]), env.parts["total"]
        env.step(actions("cpu"))
        if fault:
            with pytest.raises(capture.CaptureError, match=fault):
                state.settle()
        else:
            state.settle()
            assert env.parts["total"] is before and before.tolist() == [1.0] * 4, how


def test_on_the_cpu_an_environment_steps_as_it_is():
    env = capture.Captured(Counter("scalar"))
    env.step(actions("cpu"))
    env.step(actions("cpu"))
    assert env.steps == 2 and env.n_envs == 4


@pytest.mark.cuda
@pytest.mark.skipif(not GPU, reason="needs a GPU")
class TestOnTheGPU:
    @pytest.mark.parametrize("how", ["in place", "rebound"])
    def test_replays_are_steps(self, how):
        eager, env = Counter(how, "cuda"), capture.Captured(Counter(how, "cuda"))
        for value in (1, 2, 0, 2):
            a, b = eager.step(actions("cuda", value)), env.step(actions("cuda", value))
            assert torch.equal(a.obs, b.obs) and torch.equal(a.reward, b.reward), (
                "the same numbers, newly_seen with each replay"
            )
        assert (
            isinstance(env._step, capture.Graph)
            and env.parts["total"].tolist() == eager.parts["total"].tolist()
        )

    @pytest.mark.parametrize(
        "how, fault",
        [
            ("scalar", "steps changed from"),
            ("tuple", "cannot be put back"),
            ("asks", "test_capture.py:"),
            ("grows", "changed its shape"),
        ],
    )
    def test_what_cannot_be_captured_runs_eagerly_with_one_warning(self, how, fault):
        env = capture.Captured(Counter(how, "cuda"))
        with pytest.warns(UserWarning, match=fault):
            env.step(actions("cuda"))
        assert not isinstance(env._step, capture.Graph)
        assert how == "grows" or env.step(actions("cuda")).obs.shape[0] == 4, (
            "it goes on as it would have"
        )

    def test_warming_up_does_not_advance_the_world(self):
        env = envs.Explorer(8, device="cuda")
        env.reset()
        counts, lengths = env.spawner.counts.clone(), env.length.clone()
        captured = capture.Captured(env)
        captured.step(arrdict.arrdict(actions=torch.zeros((8, 1), dtype=torch.long, device="cuda")))
        assert torch.equal(env.spawner.counts, counts) and torch.equal(env.length, lengths + 1)

    def test_a_captured_step_allocates_nothing(self):
        env = capture.Captured(envs.Explorer(64, device="cuda"))
        env.reset()
        decision = arrdict.arrdict(actions=torch.zeros((64, 1), dtype=torch.long, device="cuda"))
        env.step(decision)
        before = torch.cuda.memory_stats()["allocation.all.allocated"]
        for _ in range(5):
            env.step(decision)
        assert torch.cuda.memory_stats()["allocation.all.allocated"] == before

    def test_any_stream_will_do(self):
        results = []
        for side in (False, True):
            env = envs.Explorer(16, device="cuda")
            with torch.cuda.stream(torch.cuda.Stream() if side else torch.cuda.current_stream()):
                world = env.reset()
                for _ in range(10):
                    world = env.step(arrdict.arrdict(actions=torch.full((16, 1), 3, device="cuda")))
                torch.cuda.current_stream().synchronize()
            results.append(world.obs.rgb)
        assert torch.equal(*results)

    @pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two GPUs")
    def test_any_device_will_do(self):
        made = [
            capture.Captured(envs.Explorer(16, device=f"cuda:{i}", resample=True)) for i in (0, 1)
        ]
        for env in made:
            env.reset()
        for k in range(230):
            here, there = (env.step(actions(env.device, k % 7, 16)) for env in made)
            assert (
                there.reward.device == torch.device("cuda:1") and torch.cuda.current_device() == 0
            )
            for name in ("obs.rgb", "obs.d", "obs.imu", "reward", "reset", "truncated"):
                a, b = (attrgetter(name)(world).cpu() for world in (here, there))
                assert torch.equal(a, b), name
        assert all(isinstance(env._step, capture.Graph) for env in made)
