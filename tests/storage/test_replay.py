"""The replay buffer against one that keeps everything in Python lists."""

import copy

import pytest
import torch
from torch import testing

from megastep import spaces
from megastep.agents.storage.replay import ReplayBuffer, ReplaySettings
from megastep.agents.storage.rollout import Rollout
from megastep.arrdict import arrdict
from megastep.capture import Graph
from megastep.dotdict import leaves
from megastep.engine.state_tree import rebind, walk
from tests.helpers.synchronisation import no_synchronisation

OBS = arrdict(
    eye=spaces.MultiImage(1, 3, 1, 4),
    raw=spaces.MultiImage(1, 1, 1, 2, dtype=torch.uint8),
    rest=arrdict(imu=spaces.MultiVector(1, 3), bag=spaces.MultiDiscrete(2, 300)),
)
ACTIONS = arrdict(move=spaces.MultiDiscrete(1, 7), aim=spaces.MultiDiscrete(1, 1000))
PRIVILEGED = arrdict(goal=spaces.MultiVector(1, 2))
B = 3
WITH_LAST = "obs", "privileged", "starts", "learns"  # T + 1 rows instead of T


class World:
    """Consecutive random rollouts of T steps. The last row of one is the first row of the next."""

    def __init__(self, n_steps, device="cpu", privileged=True, seed=0):
        self.n_steps, self.generator = n_steps, torch.Generator().manual_seed(seed)
        state = arrdict(cell=torch.zeros(B, 5, device=device))
        space = PRIVILEGED if privileged else None
        self.rollout = Rollout(n_steps, B, OBS, ACTIONS, state, device, space, values=False)
        self._fill(slice(None))

    def _fill(self, rows):
        rollout = self.rollout
        for tree in rollout.obs, rollout.privileged or {}, rollout.actions:
            for leaf in leaves(tree):
                leaf[rows] = self._numbers(leaf[rows], OBS)
        for leaf in rollout.reward, rollout.logprobs, *leaves(rollout.state):
            leaf[:] = self._numbers(leaf, None)
        for name in ("starts", "learns", "terminal", "truncated"):
            leaf = getattr(rollout, name)[rows]
            leaf[:] = (torch.rand(leaf.shape, generator=self.generator) < 0.4).to(leaf.device)

    def _numbers(self, like, space):
        if like.is_floating_point():
            numbers = torch.rand(like.shape, generator=self.generator)
            return numbers if space else numbers * 100 - 50
        high = 7 if like.dtype != torch.uint8 else 256
        return torch.randint(high, like.shape, generator=self.generator, dtype=like.dtype)

    def next(self):
        rollout = self.rollout
        for tree in rollout.obs, rollout.privileged or {}, rollout.starts, rollout.learns:
            for leaf in leaves(tree):
                leaf[0] = leaf[-1].clone()
        self._fill(slice(1, None))
        return rollout


class Lists:
    """The reference: all rollouts ever added, as lists of rows."""

    def __init__(self, n_rollouts, n_steps, length):
        self.n_rollouts, self.n_steps, self.length = n_rollouts, n_steps, length
        self.rows = {}  # name: rows since the beginning
        self.states, self.is_finite = [], []

    def add(self, rollout, is_finite=True):
        for name, tree in fields(rollout).items():
            rows = self.rows.setdefault(name, [])
            rows.extend(tree.map(torch.clone)[t] for t in range(self.n_steps))
        self.states.append(arrdict(state=rollout.state).map(torch.clone))
        self.is_finite.append(is_finite)

    def drawable(self):
        """Returns the rollouts where a sequence may start."""
        n = len(self.is_finite)
        touched = {
            j: range(j, (j * self.n_steps + self.length) // self.n_steps + 1)
            for j in range(max(0, n - self.n_rollouts), n)
        }
        return [
            j
            for j, rollouts in touched.items()
            if rollouts[-1] < n and all(self.is_finite[i] for i in rollouts)
        ]

    def sequence(self, j, lane):
        """Yields (name, path, tensor) for every leaf of the sequence that starts with rollout j."""
        first = j * self.n_steps
        for name, rows in self.rows.items():
            length = self.length + (name in WITH_LAST)
            parts = [*map(spaces.leaves, rows[first : first + length])]
            for path in parts[0]:
                yield name, path, torch.stack([part[path][lane] for part in parts])
        for path, leaf in spaces.leaves(self.states[j]).items():
            yield "state", path, leaf[lane]


def fields(rollout):
    names = "obs starts learns actions logprobs reward terminal truncated".split()
    trees = {name: arrdict({name: getattr(rollout, name)}) for name in names}
    if rollout.privileged is not None:
        trees["privileged"] = arrdict(privileged=rollout.privileged)
    return trees


def buffer_of(world, n_rollouts, length, **settings):
    settings["burn_in"] = length - world.n_steps
    settings = ReplaySettings(capacity=n_rollouts * world.n_steps * B + 1, **settings)
    return ReplayBuffer(world.rollout, settings)


def compare(replay, lists, n=20):
    """Compares which sequences can be drawn, and every field of a sample, with the reference.

    Returns the (rollout, lane) drawn.
    """
    priorities = replay.tree.priorities.view(-1, B).cpu()
    drawable = {j % replay.n_rollouts for j in lists.drawable()}
    assert {slot for slot, row in enumerate(priorities) if row.any()} == drawable
    assert replay.n_available.item() == len(drawable) * B
    assert replay.is_ready.item() == bool(drawable)
    if not drawable:
        return set()
    batch = replay.sample(n, torch.Generator(replay.n_added.device).manual_seed(n))
    drawn, parts = set(), spaces.leaves(batch)
    for m in range(n):
        slot, lane = divmod(batch.index[m].item(), B)
        j = len(lists.is_finite) - 1 - batch.age[m].item()
        assert j % replay.n_rollouts == slot and j in lists.drawable()
        drawn.add((j, lane))
        for name, path, expected in lists.sequence(j, lane):
            leaf = parts[path]
            leaf = (leaf[m] if name == "state" else leaf[:, m]).cpu()
            close = dict(rtol=2**-11, atol=0) if name == "state" else dict(rtol=0, atol=0)  # fp16
            testing.assert_close(leaf, expected.cpu(), msg=f"{path} of {j, lane}", **close)
    return drawn


@pytest.mark.parametrize(
    "n_steps, length, n_rollouts",
    [(4, 4, 3), (4, 5, 3), (4, 8, 3), (4, 11, 5), (1, 1, 2), (3, 7, 3)],
)
def test_every_field_of_every_sequence_through_wraps(n_steps, length, n_rollouts, device):
    world = World(n_steps, device)
    replay, lists = buffer_of(world, n_rollouts, length=length), Lists(n_rollouts, n_steps, length)
    drawn = set()
    for _ in range(2 * n_rollouts + 2):
        rollout = world.next()
        replay.add(rollout)
        lists.add(rollout)
        drawn |= compare(replay, lists)
    n_whole = len(lists.is_finite) - length // n_steps
    assert drawn == {(j, lane) for j in range(n_whole) for lane in range(B)}


def test_nonfinite_rollouts_are_never_drawn():
    world = World(4)
    replay, lists = buffer_of(world, 6, length=9), Lists(6, 4, 9)
    flags = [True, False, True, True, True, True, True, False, True, True, True, True]
    for is_finite in flags:
        rollout = world.next()
        if not is_finite:
            rollout.reward[2, 1] = torch.nan
        replay.add(rollout, torch.tensor(is_finite))
        lists.add(rollout, is_finite)
        compare(replay, lists)


def test_priorities_and_importance_weights(device):
    world = World(4, device)
    replay = buffer_of(world, 3, length=4, alpha=0.5, beta=1.0)
    for _ in range(3):
        replay.add(world.next())
    assert replay.tree.priorities.tolist() == [1] * 6 + [0] * 3
    errors = torch.tensor([0.0, 1, 4, 9, 16, torch.nan], device=device)
    replay.set_priorities(torch.arange(6, device=device), errors)
    expected = torch.tensor([1e-3, 1, 2, 3, 4, 1, 0, 0, 0], dtype=torch.float64)
    testing.assert_close(
        replay.tree.priorities.cpu(), expected
    )  # square roots; NaN changes nothing
    batch = replay.sample(1400, torch.Generator(device).manual_seed(0)).map(torch.Tensor.cpu)
    testing.assert_close(batch.probability, (expected / expected.sum())[batch.index])
    counts = torch.bincount(batch.index, minlength=9)
    assert (counts - 1400 * expected / expected.sum()).abs().max() <= 2  # stratified: one per part
    # beta = 1 makes up for the priorities
    testing.assert_close(
        batch.weight, (1 / expected[batch.index] / (1 / expected[batch.index]).max()).float()
    )


def test_new_sequences_get_largest_priority_of_last_sample():
    world = World(4)
    replay = buffer_of(world, 3, length=4, alpha=1.0)
    for _ in range(2):
        replay.add(world.next())
    replay.set_priorities(torch.arange(B), torch.tensor([5.0, 7.0, 6.0]))
    replay.add(world.next())
    assert replay.tree.priorities.tolist() == [5, 7, 6, 7, 7, 7, 0, 0, 0]
    replay.set_priorities(torch.tensor([3, 8]), torch.tensor([2.0, 99.0]))
    replay.add(world.next())
    assert replay.tree.priorities.tolist() == [0, 0, 0, 2, 7, 7, 2, 2, 2], (
        "index 8 cannot be drawn yet"
    )


def test_sequences_that_cannot_be_drawn_get_no_priority():
    world = World(4)
    replay = buffer_of(world, 3, length=8, alpha=1.0)
    for _ in range(4):
        replay.add(world.next())
    replay.set_priorities(torch.arange(9), torch.full((9,), 3.0))
    assert replay.tree.priorities.tolist() == [0, 0, 0, 3, 3, 3, 0, 0, 0]


def test_alpha_zero_ignores_priorities():
    world = World(4)
    replay = buffer_of(world, 4, length=4)
    for _ in range(4):
        replay.add(world.next())
    replay.set_priorities(torch.arange(12), torch.arange(12.0))
    batch = replay.sample(900, torch.Generator().manual_seed(0))
    assert torch.bincount(batch.index).tolist() == [100] * 9
    assert torch.equal(batch.weight, torch.ones(900))


def test_priorities_do_not_change_before_start():
    world, steps = World(4), []
    replay = buffer_of(world, 5, length=4, start=4 * 4 * B, alpha=1.0)
    for _ in range(4):
        replay.add(world.next())
        replay.set_priorities(torch.arange(B), torch.full((B,), 0.5))
        steps.append((replay.tree.priorities.tolist(), replay.new_priority.item()))
    ones, zeros = [1.0] * B, [0.0] * B
    assert steps == [
        (zeros * 5, 1),
        (ones + zeros * 4, 1),
        (ones * 2 + zeros * 3, 1),
        ([0.5] * B + ones * 2 + zeros * 2, 0.5),
    ]


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, 1e30])
def test_sample_of_empty_buffer_is_finite(bad):
    world = World(4)
    replay = buffer_of(world, 3, length=8)
    rollout = world.next()
    rollout.obs.eye[1], rollout.reward[2], rollout.privileged.goal[3] = bad, bad, bad
    replay.add(rollout, torch.tensor(False))
    batch = replay.sample(4, torch.Generator().manual_seed(0))
    assert not batch.index.any() and not batch.probability.any()
    for leaf in leaves(batch):
        assert (leaf.float().abs() <= 100).all()


@pytest.mark.cuda
def test_captured_buffer_matches_eager_and_never_synchronises():
    results = []
    for is_captured in (False, True):
        world = World(4, "cuda")
        replay = buffer_of(world, 4, length=6, alpha=0.9)
        generator, out = torch.Generator("cuda").manual_seed(1), arrdict()
        flag = torch.ones((), dtype=torch.bool, device="cuda")

        def work(world=world, replay=replay, generator=generator, out=out, flag=flag):
            replay.add(world.rollout, flag)
            out["batch"] = replay.sample(32, generator)
            replay.set_priorities(out.batch.index, out.batch.reward.abs().amax(0))

        work()
        if is_captured:
            graph = Graph(work, (), (world.rollout, replay, generator))
        for _ in range(9):
            world.next()
            with no_synchronisation():
                graph() if is_captured else work()
        results.append([leaf.cpu() for leaf in [*leaves(out.batch), replay.tree.priorities]])
    for eager, captured in zip(*results, strict=True):
        assert torch.equal(eager, captured)


def moved(replay, to):
    """Returns a copy of a buffer with its tensors moved."""
    replay = copy.deepcopy(replay)
    for parent, step, leaf in walk(replay, (torch.Tensor,)).values():
        rebind(parent, step, to(leaf))
    return replay


@pytest.mark.parametrize("n_steps, length, n", [(4, 6, 32), (3, 3, 1), (5, 10, 300)])
def test_kernels_match_pytorch(n_steps, length, n, to_gpu):
    world = World(n_steps)
    # exponents that float32 has
    plain = buffer_of(world, 4, length=length, alpha=0.5, beta=0.75)
    for _ in range(9):
        plain.add(world.next())
    first = torch.arange(plain.tree.n)
    plain.set_priorities(first, torch.rand(len(first), generator=world.generator) + 0.1)
    fused = moved(plain, to_gpu)

    device = fused.flags.device
    batch = fused.sample(n, torch.Generator(device).manual_seed(1))
    expected = plain._read(batch.index.cpu(), batch.probability.cpu())
    assert plain.tree.priorities[batch.index.cpu()].all()
    testing.assert_close(batch.pop("weight").cpu(), expected.pop("weight"), rtol=1e-6, atol=0)
    parts = spaces.leaves(batch)
    for path, leaf in spaces.leaves(expected).items():
        ours = parts[path].cpu()
        assert ours.dtype == leaf.dtype and torch.equal(ours, leaf), path

    errors = torch.rand(len(first), generator=world.generator)
    errors[1::4], errors[2::8], errors[3::9] = torch.nan, torch.inf, 0.0
    index = batch.index.cpu()
    plain.set_priorities(index, errors[index])
    fused.set_priorities(batch.index, to_gpu(errors[index]))
    # the kernel's smallest error is a float32
    for ours, theirs in zip(fused.tree.levels, plain.tree.levels, strict=True):
        testing.assert_close(ours.cpu(), theirs, rtol=1e-8, atol=0)
    testing.assert_close(fused.new_priority.cpu(), plain.new_priority, rtol=1e-8, atol=0)
