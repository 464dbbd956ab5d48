"""Capture: the walk over an environment's state and its restoration around a recording. The graphs
themselves need a GPU; most tests replace them and run anywhere.
"""

import collections
import copy
import gc
import weakref
from operator import attrgetter

import pytest
import torch

from megastep import arrdict, capture, envs, spaces
from megastep.read_only import ReadOnlyTensor
from tests.helpers import graphs_on_cpu

GPU = torch.cuda.is_available()


class Counter:
    """An environment in plain PyTorch. ``how`` selects how its step changes its state."""

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
        elif self.how == "scalar to tensor":
            self.steps = total.sum()
        elif self.how == "synchronises":
            total = total + float(total.sum())
        elif self.how == "drops":
            del self.parts["total"]
        elif self.how == "tuple":
            self.pair = (total,)
        elif self.how == "grows":
            self.parts["total"] = torch.cat([total, total])
        noise = torch.rand(4, device=self.device, generator=self.generator)
        return arrdict.arrdict(obs=total.view(4, 1, 1), reward=noise)


def actions(device, value=1, n=4):
    return arrdict.arrdict(actions=torch.full((n, 1), value, device=device))


def test_state_tree_finds_tensors_and_generators_by_path():
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


def test_restore_refuses_a_snapshot_of_another_environment():
    saved = capture.snapshot(envs.Explorer(3, device="cpu"))
    with pytest.raises(ValueError, match="which this Minimal does not have"):
        capture.restore(envs.Minimal(3, device="cpu"), saved)
    with pytest.raises(ValueError, match="but this Explorer needs"):
        capture.restore(envs.Explorer(4, device="cpu"), saved)
    env = Counter()
    env.pair = (env.pair[0].int(),)
    with pytest.raises(
        ValueError, match=r"pair\[0\] is \(4,\) torch.float32, but this Counter needs"
    ):
        capture.restore(env, capture.snapshot(Counter()))


@pytest.mark.parametrize(
    "how, error",
    [
        ("in place", None),
        ("rebound", None),
        ("scalar", "steps changed from 0 to 1"),
        ("scalar to tensor", "steps changed from 0 to a tensor"),
        ("tuple", "cannot be put back"),
        ("grows", "changed its shape"),
        ("drops", r"parts\['total'\], a tensor of shape \(4,\), was removed"),
    ],
)
def test_rebound_tensors_are_kept_in_place_and_other_changes_are_refused(how, error):
    env = Counter(how)
    state, before = capture._StateBefore([env]), env.parts["total"]
    env.step(actions("cpu"))
    if error:
        with pytest.raises(capture.CaptureError, match=error):
            state.keep_in_place()
    else:
        state.keep_in_place()
        assert env.parts["total"] is before and before.tolist() == [1.0] * 4


def test_moved_tensors_and_outputs_keep_their_numbers():
    """An environment that remembers its last total, and returns the total before that."""
    env = Counter()
    env.now, env.last = torch.full((4,), 2.0), torch.full((4,), 1.0)
    now, last = env.now, env.last
    state = capture._StateBefore([env])
    output = {"before": env.last, "row": env.now[:2], "number": 7}
    env.last, env.now = env.now, torch.full((4,), 3.0)
    output = state.keep_in_place(output)
    assert env.now is now and env.last is last
    assert now.tolist() == [3.0] * 4 and last.tolist() == [2.0] * 4
    assert output["before"].tolist() == [1.0] * 4 and output["row"].tolist() == [2.0] * 2
    assert output["number"] == 7


@pytest.mark.parametrize("how", ["rebound", "scalar", "scalar to tensor", "grows", "drops"])
def test_undo_restores_replaced_attributes(how):
    env = Counter(how)
    state, total = capture._StateBefore([env]), env.parts["total"]
    env.step(actions("cpu"))
    state.undo()
    assert env.parts["total"] is total and type(env.steps) is int and env.steps == 0


def test_undo_restores_containers_in_their_order():
    env = Counter()
    env.ordered = collections.OrderedDict(a=torch.zeros(1), b=1)
    env.queue = collections.deque([1, 2], maxlen=3)
    state = capture._StateBefore([env])
    env.ordered["c"], env.ordered["a"] = 2, torch.ones(1)
    env.ordered.move_to_end("a")
    env.queue.append(3)
    env.history.append(torch.zeros(2))
    state.undo()
    assert [*env.ordered] == ["a", "b"] and not env.ordered["a"].any()
    assert [*env.queue] == [1, 2] and env.queue.maxlen == 3 and len(env.history) == 1


def test_read_only_outputs_are_kept():
    env = Counter()
    env.now = torch.zeros(2)
    state, view = capture._StateBefore([env]), ReadOnlyTensor(env.now, "now")
    env.now = torch.ones(2)
    assert torch.as_tensor(state.keep_in_place({"view": view})["view"]).tolist() == [0, 0]


class Lazy:
    """A function that creates a part of its state in the first call, such as a hidden state."""

    def __init__(self):
        self.hidden, self.total = None, torch.zeros(2)

    def __call__(self):
        if self.hidden is None:
            self.hidden = {"h": torch.zeros(2)}
        self.hidden["h"].add_(1)
        self.total.add_(1)
        return self.hidden["h"]


@pytest.fixture
def on_cpu(monkeypatch):
    """Graphs are recorded without a GPU."""
    graphs_on_cpu.install(monkeypatch)


def test_a_tensor_created_by_the_function_is_kept(on_cpu):
    lazy = Lazy()
    graph = capture.Graph(lazy, (), (lazy,))
    assert graph._out is lazy.hidden["h"], "the graph writes into the attribute's tensor"
    assert lazy.total.tolist() == [0, 0], "other state is restored"


def test_a_graph_keeps_the_tensors_it_uses(on_cpu):
    class Tables:
        IS_STATELESS = True

        def __init__(self):
            self.rows = torch.zeros(3)

    class Fields:
        __slots__ = ("cells",)

        def __init__(self):
            self.cells = torch.zeros(3)

    class NamedFields(Fields):
        """Has a ``__dict__`` beside the slots of its base."""

    lazy = Lazy()
    lazy.constant = ReadOnlyTensor(torch.ones(2), "constant")
    lazy.tables, lazy.fields, lazy.named = Tables(), Fields(), NamedFields()
    graph = capture.Graph(lazy, (), (lazy,))
    used = lazy.total, lazy.hidden["h"], lazy.constant, lazy.tables.rows, lazy.fields.cells
    used += (lazy.named.cells,)
    tensors = [weakref.ref(leaf) for leaf in used]
    del lazy, used
    assert all(tensor() is not None for tensor in tensors)
    del graph
    assert all(tensor() is None for tensor in tensors)


def test_a_failed_recording_restores_the_state(on_cpu):
    lazy = Lazy()

    def fails():
        lazy()
        raise RuntimeError("no graph of this")

    with pytest.raises(RuntimeError, match="no graph of this"):
        capture.Graph(fails, (), (lazy,))
    assert lazy.hidden is None and lazy.total.tolist() == [0, 0]


def test_arguments_are_copied_in_before_each_replay(on_cpu):
    example, inputs = {"x": torch.zeros(2)}, []
    graph = capture.Graph(lambda tree: inputs.append(tree["x"]) or tree["x"], (example,), ())
    output = graph({"x": torch.tensor([3.0, 4.0])})
    assert output is inputs[-1] and output.tolist() == [3, 4]
    assert example["x"].tolist() == [0, 0]


@pytest.mark.parametrize(
    "argument, error",
    [
        ({"x": torch.zeros(3)}, r"shape \(2,\), but called with \(3,\)"),
        ({}, "captured with arguments"),
    ],
)
def test_arguments_of_other_shapes_or_trees_are_refused(on_cpu, argument, error):
    graph = capture.Graph(lambda tree: tree["x"], ({"x": torch.zeros(2)},), ())
    with pytest.raises(ValueError, match=error):
        graph(argument)


def test_the_warning_names_the_attribute_or_the_line(on_cpu):
    env = Counter("scalar")
    with pytest.warns(UserWarning, match=r"steps changed from 0 to 1 .*device\.$"):
        assert capture.capture(env.step, (actions("cpu"),), (env,)) == env.step
    assert env.steps == 0

    def fails():
        raise RuntimeError("no graph of this")

    with pytest.warns(UserWarning, match=r"no graph of this at .*test_capture.py:\d+$"):
        assert capture.capture(fails, (), ()) is fails


def test_a_copy_steps_its_own_environment():
    env = capture.Captured(Counter())
    env.step(actions("cpu"))
    copied = copy.deepcopy(env)
    for _ in range(2):
        copied.step(actions("cpu"))
    assert env.parts["total"].tolist() == 4 * [1] and copied.parts["total"].tolist() == 4 * [3]
    assert copy.copy(env).parts is env.parts


def test_on_the_cpu_steps_are_not_captured():
    env = capture.Captured(Counter("scalar"))
    env.step(actions("cpu"))
    env.step(actions("cpu"))
    assert env.steps == 2 and env.n_envs == 4


@pytest.mark.cuda
@pytest.mark.skipif(not GPU, reason="needs a GPU")
class TestOnTheGPU:
    def test_no_graph_is_freed_while_another_is_recorded(self):
        old = [capture.capture(lambda x: x + 1, (torch.ones(3, device="cuda"),), ())]
        old.append(old)  # a circle, which only garbage collection frees
        graph, holders = weakref.ref(old[0]), [old]
        thresholds = gc.get_threshold()

        def function(x):
            holders.clear()
            return x + len([[] for _ in range(100)])

        del old
        gc.set_threshold(1, 1, 1)
        try:
            new = capture.Graph(function, (torch.ones(3, device="cuda"),), (), warmup=0)
        finally:
            gc.set_threshold(*thresholds)
        assert new(torch.zeros(3, device="cuda")).tolist() == [100] * 3
        gc.collect()
        assert graph() is None

    @pytest.mark.parametrize("how", ["in place", "rebound"])
    def test_replays_are_steps(self, how):
        eager, env = Counter(how, "cuda"), capture.Captured(Counter(how, "cuda"))
        for value in (1, 2, 0, 2):
            a, b = eager.step(actions("cuda", value)), env.step(actions("cuda", value))
            assert torch.equal(a.obs, b.obs) and torch.equal(a.reward, b.reward)
        assert isinstance(env._step, capture.Graph)
        assert env.parts["total"].tolist() == eager.parts["total"].tolist()

    @pytest.mark.parametrize(
        "how, error",
        [
            ("scalar", "steps changed from"),
            ("tuple", "cannot be put back"),
            ("synchronises", "test_capture.py:"),
            ("grows", "changed its shape"),
        ],
    )
    def test_a_step_that_cannot_be_captured_runs_eagerly_with_one_warning(self, how, error):
        env = capture.Captured(Counter(how, "cuda"))
        with pytest.warns(UserWarning, match=error):
            env.step(actions("cuda"))
        assert not isinstance(env._step, capture.Graph)
        assert how == "grows" or env.step(actions("cuda")).obs.shape[0] == 4
        torch.rand(1, device="cuda")  # the default generator is usable again

    def test_warming_up_does_not_advance_the_environment(self):
        env = envs.Explorer(8, device="cuda")
        env.reset()
        counts, ages = env.spawner.counts.clone(), env.ages.clone()
        captured = capture.Captured(env)
        captured.step(arrdict.arrdict(actions=torch.zeros((8, 1), dtype=torch.long, device="cuda")))
        assert torch.equal(env.spawner.counts, counts) and torch.equal(env.ages, ages + 1)

    def test_an_environment_may_be_dropped(self):
        decision = arrdict.arrdict(actions=torch.full((64, 1), 3, device="cuda"))
        settings = dict(resample=True, privileged=True, device="cuda")
        eager, env = (envs.Explorer(64, **settings) for _ in range(2))
        for one in (eager, env):
            one.reset()
        graph = capture.capture(env.step, (decision,), (env,))
        del env, one
        gc.collect()
        torch.full((2**28,), torch.nan, device="cuda")  # takes the memory that is free
        for _ in range(5):
            expected, world = eager.step(decision), graph(decision)
        assert torch.equal(world.obs.rgb, expected.obs.rgb)
        assert torch.equal(world.reward, expected.reward)

    def test_a_captured_step_allocates_nothing(self):
        env = capture.Captured(envs.Explorer(64, device="cuda"))
        env.reset()
        decision = arrdict.arrdict(actions=torch.zeros((64, 1), dtype=torch.long, device="cuda"))
        env.step(decision)
        before = torch.cuda.memory_stats()["allocation.all.allocated"]
        for _ in range(5):
            env.step(decision)
        assert torch.cuda.memory_stats()["allocation.all.allocated"] == before

    @pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two GPUs")
    def test_capture_on_the_second_device(self):
        pair = [
            capture.Captured(envs.Explorer(16, device=f"cuda:{i}", resample=True)) for i in (0, 1)
        ]
        for env in pair:
            env.reset()
        for k in range(230):
            worlds = [env.step(actions(env.device, k % 7, 16)) for env in pair]
            assert worlds[1].reward.device == torch.device("cuda:1")
            assert torch.cuda.current_device() == 0
            for name in ("obs.rgb", "obs.d", "obs.imu", "reward", "reset", "truncated"):
                a, b = (attrgetter(name)(world).cpu() for world in worlds)
                assert torch.equal(a, b), name
        assert all(isinstance(env._step, capture.Graph) for env in pair)
