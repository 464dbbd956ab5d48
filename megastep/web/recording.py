"""Records what a step of an environment launches.

What counts is what kernels compute. Where PyTorch computes something in between, a replay would go
without it, so such an environment is refused with the name of the operation.
"""

import bisect
import ctypes
import struct
from collections.abc import Callable

import torch
from torch.utils._python_dispatch import TorchDispatchMode

from megastep import spaces
from megastep.arrdict import arrdict
from megastep.engine.state_tree import walk
from megastep.kernels.build.kernel_library import KernelLibrary
from megastep.kernels.build.launch import observed
from megastep.spaces import random_actions
from megastep.types import Env, World, n_lanes, optional
from megastep.web.program import Buffer, Launch, Leaf, Program, Ref, Replay, words

#: Steps with random actions that a replay must repeat, beside the recorded ones.
N_CHECKED = 16
#: Operators that only reserve memory.
ALLOCATIONS = ("empty", "empty_like", "empty_strided", "new_empty", "new_empty_strided")


class Tape(TorchDispatchMode):
    """Notes launches of kernels, and operators of PyTorch that compute.

    Attributes:
        launches: places are an address and an offset.
        used: addresses of the storages that launches use.
        made: those that operators reserved.
        written: (name, address of the storage, whether a launch had used it before) of operators
            that compute.
    """

    def __init__(self, recorder: "Recorder", is_first: bool = True):
        super().__init__()
        self.recorder, self.is_first = recorder, is_first
        self.launches: list[Launch] = []
        self.used: set[int] = set()
        self.made: dict[int, None] = {}
        self.written: list[tuple[str, int, bool]] = []

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # otherwise PyTorch imports its compiler, which takes seconds

    def __torch_dispatch__(self, func, types, args=(), kwargs=None) -> object:
        result = func(*args, **(kwargs or {}))
        name, returns = func._schema.name.rpartition("::")[2], func._schema.returns
        aliases = [one.alias_info for one in returns]
        if aliases and all(alias is not None and not alias.is_write for alias in aliases):
            return result  # a view
        for one in result if isinstance(result, (list, tuple)) else [result]:
            if isinstance(one, torch.Tensor):
                start = self.recorder.add(one)
                if not any(aliases):
                    self.made[start] = None
                if name not in ALLOCATIONS:
                    self.written.append((name.strip("_"), start, start in self.used))
        return result

    def observe(self, library: KernelLibrary, operation: str, packed: bytes) -> None:
        values = {}
        for word in words(library, operation):
            (value,) = struct.unpack_from(word.kind, packed, word.offset)
            if word.kind == "P" and value:
                start = self.recorder.find(value)
                self.used.add(start)
                if self.is_first:
                    self.recorder.use(start)
                value = Ref(start, value - start)
            values[word.name] = None if word.kind == "P" and not value else value
        self.launches.append(Launch(library, operation, values))


class Recorder:
    """Records an environment on a CPU. Keeps the storages of tensors, by address, so that none is
    used twice, and has a buffer of each that launches use.
    """

    def __init__(self, env: Env):
        self.name = type(env).__name__
        self.starts: list[int] = []
        self.storages: dict[int, torch.UntypedStorage] = {}
        self.index: dict[int, int] = {}  # of the buffer of each storage
        self.buffers: list[Buffer] = []
        for _, _, tensor in walk(env, torch.Tensor, only_state=False).values():
            self.add(tensor)

    def refusal(self, reason: str) -> ValueError:
        return ValueError(f"{self.name} cannot be exported: {reason}")

    # ---- Storages ----

    def add(self, tensor: torch.Tensor) -> int:
        """Adds a tensor's storage. Returns its address."""
        with torch._C.DisableTorchFunctionSubclass():  # a ReadOnlyTensor would copy it
            storage = tensor.untyped_storage()
        start = storage.data_ptr()
        if start not in self.storages:
            bisect.insort(self.starts, start)
            self.storages[start] = storage
        return start

    def find(self, address: int) -> int:
        """Returns the address of the storage that an address lies in."""
        i = bisect.bisect_right(self.starts, address) - 1
        if i >= 0 and address < self.starts[i] + self.storages[self.starts[i]].nbytes():
            return self.starts[i]
        raise ValueError("a kernel reads memory that no tensor of the environment holds")

    def contents(self, start: int) -> bytes:
        return ctypes.string_at(start, self.storages[start].nbytes())

    # ---- Buffers ----

    def use(self, start: int) -> int:
        """Returns the index of a storage's buffer. A new one has what the storage holds now."""
        if start not in self.index:
            self.index[start] = len(self.buffers)
            contents = self.contents(start)
            self.buffers.append(Buffer(len(contents), contents))
        return self.index[start]

    def run(self, call: Callable[[], World], is_reset: bool) -> tuple[Tape, dict]:
        """Calls a function of the environment, and makes buffers for what it uses. Returns its tape
        and the leaves of its world. Refuses what PyTorch computes between kernels.
        """
        tape = Tape(self)
        with tape, observed(tape.observe):
            world = call()
        leaves = world_leaves(world)
        used = tape.used | {self.add(leaf) for leaf in leaves.values()}
        for leaf in leaves.values():
            self.use(self.add(leaf))
        computed = {start for _, start, _ in tape.written}
        for start in tape.made:
            if start in self.index and start not in computed:
                i = self.index[start]
                self.buffers[i] = Buffer(self.buffers[i].n_bytes)
        if any(path.partition(".")[0] == "mask" for path in leaves):
            raise self.refusal("a page has no action masks")
        for operator, start, is_late in tape.written:
            if is_late if is_reset else start in used:
                raise self.refusal(
                    f"in {'reset' if is_reset else 'a step'}, PyTorch's operation {operator} "
                    "computes between its kernels, and a page has kernels alone; move it into one "
                    "(docs/kernels.md)"
                )
        return tape, leaves

    def launches(self, tape: Tape) -> list[Launch]:
        """Returns launches of a tape with places in buffers."""
        found = []
        for launch in tape.launches:
            places = {k: v for k, v in launch.values.items() if isinstance(v, Ref)}
            places = {k: Ref(self.index[start], offset) for k, (start, offset) in places.items()}
            found.append(launch._replace(values=launch.values | places))
        return found

    def leaf(self, tensor: torch.Tensor) -> Leaf:
        """Returns a tensor as a leaf of the program."""
        offset = int(tensor.storage_offset()) * tensor.itemsize
        ref = Ref(self.use(self.add(tensor)), offset)
        return Leaf(ref, tuple(tensor.shape), tensor.stride(), tensor.dtype)

    def copies(self, first: dict, later: dict) -> list[tuple[int, int]]:
        """Returns what is copied after a reset, so that its world lies where a step's does."""
        found = {}
        for path in later:
            if path not in first:
                raise self.refusal(f"its reset gives no {path}")
            source, target = (self.leaf(tree[path]) for tree in (first, later))
            sizes = [self.buffers[leaf.ref.buffer].n_bytes for leaf in (source, target)]
            if source.ref.offset != target.ref.offset or sizes[0] != sizes[1]:
                raise self.refusal(f"its reset and its steps have another {path}")
            if source.ref.buffer != target.ref.buffer:
                found[source.ref.buffer, target.ref.buffer] = None
        return [*found]

    def refuse_changes(self, one: list[Launch], other: list[Launch]) -> None:
        """Refuses two steps that launch different operations, or with different numbers."""
        names = [", ".join(launch.operation for launch in step) for step in (one, other)]
        if names[0] != names[1]:
            raise self.refusal(f"a step launches {names[0]}, and the next {names[1]}")
        for before, after in zip(one, other):
            for field, value in before.values.items():
                if not isinstance(value, Ref) and value != after.values[field]:
                    raise self.refusal(
                        f"{field} of {before.operation} changes from step to step; keep what "
                        "changes in a tensor that kernels write"
                    )


def record(env: Env) -> Program:
    """Returns an environment on a CPU as a program with the sections `reset` and `step`. It is
    reset and stepped with random actions, and a replay is compared with it: ValueError if what
    kernels compute is not all that a step does.
    """
    recorder, generator = Recorder(env), torch.Generator().manual_seed(1)
    if isinstance(env.action_space, dict):
        raise recorder.refusal("it takes several actions at once")
    if not optional(env, "capturable"):
        raise recorder.refusal("it steps in Python, not by kernels")

    def draw() -> torch.Tensor:
        return random_actions(env.action_space, n_lanes(env), generator=generator)

    actions = draw()
    recorder.use(recorder.add(actions))
    decision, taken, expected = arrdict(actions=actions), [], []

    def note(leaves) -> None:
        """Notes copies of a world's leaves, and what the storages `kept` hold by buffer."""
        world = {path: leaf.clone() for path, leaf in leaves.items()}
        taken.append(actions.clone())
        expected.append((world, {i: recorder.contents(start) for start, i in kept.items()}))

    kept: dict[int, int] = {}
    reset, first = recorder.run(env.reset, True)
    note(first)
    step, leaves = recorder.run(lambda: env.step(decision), False)
    if not step.launches:
        raise recorder.refusal("its steps launch no kernels")
    program = Program(recorder.leaf(actions), recorder.buffers)
    program.sections = dict(reset=recorder.launches(reset), step=recorder.launches(step))
    program.world = {path: recorder.leaf(leaf) for path, leaf in leaves.items()}
    program.copies = recorder.copies(first, leaves)
    made = {**step.made, **reset.made}
    kept.update({start: i for start, i in recorder.index.items() if start not in made})
    note(leaves)
    actions.copy_(draw())
    again = Tape(recorder, is_first=False)
    with again, observed(again.observe):
        leaves = world_leaves(env.step(decision))
    recorder.refuse_changes(step.launches, again.launches)
    note(leaves)
    for _ in range(N_CHECKED):
        actions.copy_(draw())
        note(world_leaves(env.step(decision)))
    replay = Replay(program)
    for t, (leaves, memory) in enumerate(expected):
        if t:
            replay.tensor(program.actions).copy_(taken[t])
        replay.run("step" if t else "reset")
        world = replay.world()
        different = [path for path in leaves if not _same(world[path], leaves[path])]
        different += [
            f"memory of {_place(program, i)}" for i in memory if replay.memory[i] != memory[i]
        ]
        if different:
            raise recorder.refusal(
                f"a replay of its kernels differs in {different[0]} "
                f"{f'in step {t}' if t else 'at the reset'}, so something else computes it"
            )
    return program


def world_leaves(world: World) -> dict[str, torch.Tensor]:
    """Returns the leaves of a world by path, without what only a critic sees."""
    return {
        path: leaf
        for path, leaf in spaces.leaves(world).items()
        if isinstance(leaf, torch.Tensor) and not path.startswith("privileged")
    }


def _same(one: torch.Tensor, other: torch.Tensor) -> bool:
    return one.contiguous().numpy().tobytes() == other.contiguous().numpy().tobytes()


def _place(program: Program, buffer: int) -> str:
    for launch in program.launches:
        for name, value in launch.values.items():
            if isinstance(value, Ref) and value.buffer == buffer:
                return f"{launch.operation}.{name}"
    return "the world"
