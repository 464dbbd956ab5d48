"""The replay memory, against one that keeps everything in Python lists."""

import pytest
import torch
from torch import testing

from megastep import spaces
from megastep.agents.networks.policy import Policy
from megastep.agents.storage.replay import Replay, ReplaySettings, _cast
from megastep.agents.storage.rollout import Rollout
from megastep.arrdict import arrdict
from megastep.capture import Graph
from megastep.dotdict import leaves

OBS = arrdict(
    eye=spaces.MultiImage(1, 3, 1, 4),
    raw=spaces.MultiImage(1, 1, 1, 2, dtype=torch.uint8),
    rest=arrdict(imu=spaces.MultiVector(1, 3), bag=spaces.MultiDiscrete(2, 300)),
)
ACTIONS = arrdict(move=spaces.MultiDiscrete(1, 7), aim=spaces.MultiDiscrete(1, 1000))
PRIVILEGED = arrdict(goal=spaces.MultiVector(1, 2))
B = 3
MORE = "obs", "privileged", "starts", "learns"  # of which there is one row more


class World:
    """Rollouts of T steps that go on where the one before ended, of random numbers; the last row of
    one is the first of the next.
    """

    def __init__(self, n_steps, device="cpu", privileged=True, seed=0):
        self.n_steps, self.generator = n_steps, torch.Generator().manual_seed(seed)
        state = arrdict(cell=torch.zeros(B, 5, device=device))
        seen = PRIVILEGED if privileged else None
        self.rollout = Rollout(n_steps, B, OBS, ACTIONS, state, device, seen, values=False)
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
        most = 7 if like.dtype != torch.uint8 else 256
        return torch.randint(most, like.shape, generator=self.generator, dtype=like.dtype)

    def next(self):
        rollout = self.rollout
        for tree in rollout.obs, rollout.privileged or {}, rollout.starts, rollout.learns:
            for leaf in leaves(tree):
                leaf[0] = leaf[-1].clone()
        self._fill(slice(1, None))
        return rollout


class Lists:
    """The oracle: all rollouts ever added, as lists of rows of lanes."""

    def __init__(self, n_rollouts, n_steps, length):
        self.n_rollouts, self.n_steps, self.length = n_rollouts, n_steps, length
        self.rows = {}  # name: rows since the beginning
        self.states, self.fine = [], []

    def add(self, rollout, is_fine=True):
        for name, tree in fields(rollout).items():
            rows = self.rows.setdefault(name, [])
            rows.extend(tree.map(torch.clone)[t] for t in range(self.n_steps))
        self.states.append(arrdict(state=rollout.state).map(torch.clone))
        self.fine.append(is_fine)

    def drawable(self):
        """The rollouts at which a sequence may start."""
        n, more = len(self.fine), self.length + 1
        touched = {
            j: range(j, (j * self.n_steps + more - 1) // self.n_steps + 1)
            for j in range(max(0, n - self.n_rollouts), n)
        }
        return [j for j, of in touched.items() if of[-1] < n and all(self.fine[i] for i in of)]

    def sequence(self, j, lane):
        first = j * self.n_steps
        for name, rows in self.rows.items():
            length = self.length + (name in MORE)
            for path in paths(rows[0]):
                expected = [leaf_of(row, path)[lane] for row in rows[first : first + length]]
                yield name, path, torch.stack(expected)
        for path in paths(self.states[j]):
            yield "state", path, leaf_of(self.states[j], path)[lane]


def fields(rollout):
    names = "obs starts learns actions logprobs reward terminal truncated".split()
    found = {name: arrdict({name: getattr(rollout, name)}) for name in names}
    if rollout.privileged is not None:
        found["privileged"] = arrdict(privileged=rollout.privileged)
    return found


def paths(tree, path=()):
    if not isinstance(tree, dict):
        return [path]
    return [found for key in tree for found in paths(tree[key], (*path, key))]


def leaf_of(tree, path):
    for key in path:
        tree = tree[key]
    return tree


def memory(world, n_rollouts, **how):
    settings = ReplaySettings(capacity=n_rollouts * world.n_steps * B + 1, **how)
    return Replay(world.rollout, OBS, ACTIONS, settings)


def compare(replay, lists, n=20):
    """All that can be drawn, and each field of what is drawn, with the oracle."""
    priorities = replay.tree.priorities.view(-1, B).cpu()
    drawable = {j % replay.n_rollouts for j in lists.drawable()}
    assert {slot for slot, row in enumerate(priorities) if row.any()} == drawable
    assert replay.n_available.item() == len(drawable) * B
    assert replay.is_ready.item() == bool(drawable)
    if not drawable:
        return set()
    batch = replay.sample(n, torch.Generator(replay.n_added.device).manual_seed(n))
    drawn = set()
    for m in range(n):
        slot, lane = divmod(batch.index[m].item(), B)
        j = len(lists.fine) - 1 - batch.age[m].item()
        assert j % replay.n_rollouts == slot and j in lists.drawable()
        drawn.add((j, lane))
        for name, path, expected in lists.sequence(j, lane):
            found = leaf_of(batch, path)
            found = (found[m] if name == "state" else found[:, m]).cpu()
            close = dict(rtol=2**-11, atol=0) if name == "state" else dict(rtol=0, atol=0)  # fp16
            testing.assert_close(found, expected.cpu(), msg=f"{path} of {j, lane}", **close)
    return drawn


@pytest.mark.parametrize(
    "n_steps, length, n_rollouts",
    [(4, 4, 3), (4, 5, 3), (4, 8, 3), (4, 11, 5), (1, 1, 2), (3, 7, 3)],
)
def test_every_field_of_every_sequence_through_several_wraps(n_steps, length, n_rollouts, device):
    world = World(n_steps, device)
    replay, lists = memory(world, n_rollouts, length=length), Lists(n_rollouts, n_steps, length)
    drawn = set()
    for _ in range(2 * n_rollouts + 2):
        rollout = world.next()
        replay.add(rollout)
        lists.add(rollout)
        drawn |= compare(replay, lists)
    n_whole = len(lists.fine) - length // n_steps
    assert drawn == {(j, lane) for j in range(n_whole) for lane in range(B)}


def test_nothing_of_a_rollout_that_is_not_fine_is_drawn():
    world = World(4)
    replay, lists = memory(world, 6, length=9), Lists(6, 4, 9)
    fine = [True, False, True, True, True, True, True, False, True, True, True, True]
    for is_fine in fine:
        rollout = world.next()
        if not is_fine:
            rollout.reward[2, 1] = torch.nan
        replay.add(rollout, torch.tensor(is_fine))
        lists.add(rollout, is_fine)
        compare(replay, lists)


@pytest.mark.parametrize("length", [4, 6])
def test_what_was_never_written_is_never_drawn(length):
    world, poison = World(4, privileged=False), -77
    replay = memory(world, 5, length=length)
    for column in [*leaves(replay.columns), *leaves(replay.state)]:
        column.rows.fill_(poison if column.rows.dtype != torch.uint8 else 177)
    lists = Lists(5, 4, length)
    for _ in range(7):
        rollout = world.next()
        replay.add(rollout)
        lists.add(rollout)
        compare(replay, lists)


def test_sequences_are_drawn_by_their_priorities_and_weighed_against_them():
    world = World(4)
    replay = memory(world, 3, length=4, alpha=0.5, beta=1.0)
    for _ in range(3):
        replay.add(world.next())
    assert replay.tree.priorities.tolist() == [1] * 6 + [0] * 3
    replay.set_priorities(torch.arange(6), torch.tensor([0.0, 1, 4, 9, 16, torch.nan]))
    expected = torch.tensor([1e-3, 1, 2, 3, 4, 1, 0, 0, 0], dtype=torch.float64)
    testing.assert_close(replay.tree.priorities, expected)  # their root; nan changes nothing
    batch = replay.sample(1400, torch.Generator().manual_seed(0))
    testing.assert_close(batch.probability, (expected / expected.sum())[batch.index])
    counts = torch.bincount(batch.index, minlength=9)
    assert (counts - 1400 * expected / expected.sum()).abs().max() <= 2  # one in each part
    # an importance weight of exponent 1 makes every sequence count the same
    testing.assert_close(
        batch.weight, (1 / expected[batch.index] / (1 / expected[batch.index]).max()).float()
    )


def test_new_sequences_are_as_likely_as_the_likeliest_of_the_last_sample():
    world = World(4)
    replay = memory(world, 3, length=4, alpha=1.0)
    for _ in range(2):
        replay.add(world.next())
    replay.set_priorities(torch.arange(B), torch.tensor([5.0, 7.0, 6.0]))
    replay.add(world.next())
    assert replay.tree.priorities.tolist() == [5, 7, 6, 7, 7, 7, 0, 0, 0]
    replay.set_priorities(torch.tensor([3, 8]), torch.tensor([2.0, 99.0]))
    replay.add(world.next())
    assert replay.tree.priorities.tolist() == [0, 0, 0, 2, 7, 7, 2, 2, 2], "8 cannot be drawn yet"


def test_what_cannot_be_drawn_gets_no_priority():
    world = World(4)
    replay = memory(world, 3, length=8, alpha=1.0)
    for _ in range(4):
        replay.add(world.next())
    replay.set_priorities(torch.arange(9), torch.full((9,), 3.0))
    assert replay.tree.priorities.tolist() == [0, 0, 0, 3, 3, 3, 0, 0, 0]


def test_a_uniform_memory_draws_all_alike_whatever_it_is_told():
    world = World(4)
    replay = memory(world, 4, length=4)
    for _ in range(4):
        replay.add(world.next())
    replay.set_priorities(torch.arange(12), torch.arange(12.0))
    batch = replay.sample(900, torch.Generator().manual_seed(0))
    assert torch.bincount(batch.index).tolist() == [100] * 9
    assert torch.equal(batch.weight, torch.ones(900))


def test_pictures_in_bytes_are_as_close_as_said_and_clipped():
    world = World(4)
    replay = memory(world, 2, length=4, images="uint8")
    assert replay.columns.obs.eye.rows.dtype == torch.uint8
    rollout = world.next()
    rollout.obs.eye[1, :, 0, 0, 0, 0], rollout.obs.eye[1, :, 0, 0, 0, 1] = -3.0, 9.0
    expected = rollout.obs.eye[:4].clamp(0, 1)
    raw = rollout.obs.raw[:4].clone()
    replay.add(rollout)
    replay.add(world.next())
    batch = replay.sample(B)  # each lane once, in order
    assert batch.obs.eye.dtype == torch.float16
    # half a step is lost, and what float16 rounds
    testing.assert_close(batch.obs.eye[:4], expected, rtol=0, atol=0.5 / 255 + 5e-4)
    assert torch.equal(batch.obs.raw[:4], raw), "bytes stay what they are"


def test_steps_of_a_255th_come_back_bit_by_bit():
    steps = (torch.arange(256) / 255).half()
    assert torch.equal(_cast(_cast(steps, torch.uint8), torch.float16), steps)


def test_integers_take_the_fewest_bytes_that_hold_them():
    replay = memory(World(4), 2, length=4)
    dtypes = {path: leaf_of(replay.columns, path).rows.dtype for path in paths(replay.columns)}
    assert dtypes == {
        ("obs", "eye"): torch.float16,
        ("obs", "raw"): torch.uint8,
        ("obs", "rest", "imu"): torch.float16,
        ("obs", "rest", "bag"): torch.int16,
        ("actions", "move"): torch.uint8,
        ("actions", "aim"): torch.int16,
        ("reward",): torch.float32,
        ("logprobs",): torch.float32,
        ("privileged", "goal"): torch.float32,
    }
    assert replay.sample(2).actions.move.dtype == torch.int64


def test_a_state_too_large_for_float16_stays_finite():
    world = World(4)
    replay = memory(world, 2, length=4)
    world.rollout.state.cell[:] = 1e6
    replay.add(world.rollout)
    replay.add(world.rollout)
    assert replay.sample(2).state.cell.eq(65504).all()


def sixty_four_pixels(n_steps, width, n_rollouts=2, device="meta", **how):
    """A memory for 64 pixels of 3 colours, and an LSTM."""
    obs_space, action_space = spaces.MultiImage(1, 3, 1, 64), spaces.MultiDiscrete(1, 7)
    state = Policy(obs_space, action_space, width=width, critic=None).initial(100, device)
    rollout = Rollout(n_steps, 100, obs_space, action_space, state, device, values=False)
    logprobs = how.pop("logprobs", True)
    settings = ReplaySettings(capacity=n_rollouts * n_steps * 100, **how)
    return Replay(rollout, obs_space, action_space, settings, logprobs)


def test_bytes_are_those_that_are_allocated():
    tensors = []

    def search(value):
        if isinstance(value, torch.Tensor):
            tensors.append(value)
        elif isinstance(value, dict):
            [search(child) for child in value.values()]
        elif isinstance(value, list):
            [search(child) for child in value]
        elif hasattr(value, "__dict__"):
            search(vars(value))

    replay = sixty_four_pixels(16, 32, device="cpu")
    search(replay)
    assert replay.bytes == sum(tensor.untyped_storage().nbytes() for tensor in tensors)
    assert replay.bytes == sixty_four_pixels(16, 32).bytes, "which need no memory to be counted"


@pytest.mark.parametrize(
    "how, least, most",
    [
        (dict(images="fp16"), 2.43e6, 2.45e6),
        (dict(images="fp16", logprobs=False), 2.45e6, 2.47e6),
        (dict(images="uint8"), 4.58e6, 4.60e6),
    ],
)
def test_observations_per_gigabyte(how, least, most):
    """All that a sequence needs is counted, not the images alone: 384 or 192 bytes of 64 pixels
    of 3 colours, 16 of an LSTM's state every 64 steps, 5 or 9 of reward, action and probability, 1
    of flags.
    """
    replay = sixty_four_pixels(64, 256, n_rollouts=100, **how)
    assert least < 1e9 * replay.capacity / replay.bytes < most
    if how["images"] == "fp16":
        assert 2**30 * replay.capacity / replay.bytes > 2.5e6


@pytest.mark.parametrize(
    "how, sentence",
    [
        (dict(burn_in=8, length=8), "replay.burn_in=8 leaves nothing of a sequence of 8 steps"),
        (dict(length=3), "replay.length=3 is less than n_steps=4"),
        (dict(capacity=35, burn_in=4), "replay.capacity=35 is too small for a sequence of 8 steps"),
        (dict(capacity=35, burn_in=4), "it needs at least 36"),
    ],
)
def test_what_does_not_fit_is_said_in_a_sentence(how, sentence):
    with pytest.raises(ValueError, match=sentence):
        Replay(World(4).rollout, OBS, ACTIONS, ReplaySettings(**how))


def test_the_smallest_memory_holds_one_sequence_of_each_lane():
    world = World(4)
    replay = Replay(world.rollout, OBS, ACTIONS, ReplaySettings(capacity=36, burn_in=4))
    for n in range(5):
        replay.add(world.next())
        assert replay.n_available.item() == (B if n >= 2 else 0)


def test_learning_starts_once_enough_was_collected():
    world, ready = World(4), []
    replay = memory(world, 3, length=4, start=4 * 4 * B)
    for _ in range(6):
        replay.add(world.next())
        ready.append(replay.is_ready.item())
    assert ready == [False] * 3 + [True] * 3


def test_priorities_stay_alike_until_learning_starts():
    world, found = World(4), []
    replay = memory(world, 5, length=4, start=4 * 4 * B, alpha=1.0)
    for _ in range(4):
        replay.add(world.next())
        replay.set_priorities(torch.arange(B), torch.full((B,), 0.5))
        found.append((replay.tree.priorities.tolist(), replay.fresh.item()))
    one, none = [1.0] * B, [0.0] * B
    assert found == [
        (none * 5, 1),
        (one + none * 4, 1),
        (one * 2 + none * 3, 1),
        ([0.5] * B + one * 2 + none * 2, 0.5),
    ]


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, 1e30])
def test_a_sample_of_an_empty_memory_is_finite_whatever_was_added(bad):
    world = World(4)
    replay = memory(world, 3, length=8)
    rollout = world.next()
    rollout.obs.eye[1], rollout.reward[2], rollout.privileged.goal[3] = bad, bad, bad
    replay.add(rollout, torch.tensor(False))
    batch = replay.sample(4, torch.Generator().manual_seed(0))
    assert not batch.index.any() and not batch.probability.any()
    for leaf in leaves(batch):
        assert (leaf.float().abs() <= 100).all()


@pytest.mark.cuda
def test_a_captured_memory_is_the_eager_one_and_never_synchronises():
    found = []
    for is_captured in (False, True):
        world = World(4, "cuda")
        replay = memory(world, 4, length=6, alpha=0.9)
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
            torch.cuda.set_sync_debug_mode("error")
            try:
                graph() if is_captured else work()
            finally:
                torch.cuda.set_sync_debug_mode("default")
        found.append([leaf.cpu() for leaf in [*leaves(out.batch), replay.tree.priorities]])
    for eager, captured in zip(*found, strict=True):
        assert torch.equal(eager, captured)
