"""Copies of many tensors at once, against `Tensor.copy_`."""

import pytest
import torch

from megastep.agents.storage.copies import _MAX_SELECTED, copy_all, select_lanes, select_tree
from megastep.arrdict import arrdict
from megastep.kernels.build import copies

DTYPES = torch.bool, torch.uint8, torch.int32, torch.int64, torch.float16, torch.float32
SIZES = 0, 1, 3, 16, 1000, 70_001  # the last takes several blocks


def numbers(shape, dtype, to, seed):
    generator = torch.Generator().manual_seed(seed)
    return to(torch.randint(0, 100, shape, generator=generator).to(dtype))


def on(device):
    """Returns a function that moves tensors to a device."""
    return lambda tensor: tensor.to(device)


def cases(to):
    """Returns pairs (buffer, its part to write, source): plain copies, then others."""
    cases = []

    def add(buffer, part, source):
        cases.append((buffer, part(buffer), source))

    for i, dtype in enumerate(DTYPES):
        for n in SIZES:
            # what lies around the target must stay
            buffer = numbers((n + 64,), dtype, to, seed=i)
            source = numbers((n + 1,), dtype, to, seed=i + n)
            add(buffer, lambda buffer, n=n: buffer[16 : 16 + n], source[:n])
            add(buffer.clone(), lambda buffer, n=n: buffer[15 : 15 + n], source[1:])
            add(buffer.clone(), lambda buffer, n=n: buffer[16 : 16 + n], source[1:])
    n_plain = len(cases)
    matrix = numbers((9, 8), torch.float32, to, seed=99)
    add(to(torch.zeros(9, 16)), lambda buffer: buffer[:, ::2], matrix)
    add(to(torch.zeros(8, 9)), lambda buffer: buffer, matrix.T)
    add(to(torch.zeros(9, 8)), lambda buffer: buffer, matrix[0].expand(9, 8))
    add(to(torch.zeros(9, 8)), lambda buffer: buffer, matrix[0])
    add(to(torch.zeros(9, 8, dtype=torch.float16)), lambda buffer: buffer, matrix)
    add(to(torch.zeros(9, 8, dtype=torch.bool)), lambda buffer: buffer, matrix)
    add(to(torch.zeros(9, 8)), lambda buffer: buffer, matrix.cpu())
    return cases, n_plain


def check_copies(ours, theirs):
    """Compares buffers, with what lies around the targets, with those of `Tensor.copy_`."""
    copy_all([(target, source) for _, target, source in ours])
    for _, target, source in theirs:
        target.copy_(source)
    for i, ((buffer, _, _), (expected, _, _)) in enumerate(zip(ours, theirs, strict=True)):
        assert torch.equal(buffer.cpu(), expected.cpu()), i


def test_kernels_do_what_copy_does(to_gpu):
    check_copies(*(some[:n_plain] for some, n_plain in map(cases, (to_gpu, torch.Tensor.cpu))))


def test_copies_what_copy_does(device, monkeypatch):
    launches, launch = [], copies.launch
    monkeypatch.setattr(
        copies, "launch", lambda *args, **fields: launches.append(args) or launch(*args, **fields)
    )
    (ours, n_plain), (theirs, _) = (cases(on(device)) for _ in range(2))
    check_copies(ours, theirs)
    copy_all([])
    n_launches = -(-n_plain // copies._MAX_COPIES) if device == "cuda" else 0
    assert n_plain > 2 * copies._MAX_COPIES and len(launches) == n_launches


@pytest.mark.cuda
@pytest.mark.parametrize("start", (0, 1))
def test_the_largest_copies_arrive(start):
    """In words of 16 bytes, and byte by byte, up to 2 GiB."""
    source = torch.randint(256, (2**31,), dtype=torch.uint8, device="cuda")
    target = torch.zeros_like(source)
    copy_all([(target[start : start - 1 or None], source[start : start - 1 or None])])
    assert torch.equal(target[1:-1], source[1:-1])
    assert int(target[-1 if start == 0 else 0]) == 0


def test_sources_that_nobody_else_holds_are_copied(device):
    """Conversions between them would take the memory of a source that is freed too early."""
    source = torch.arange(10_000.0, device=device)
    plain = [torch.zeros(10_000, device=device) for _ in range(8)]
    half = [torch.zeros(10_000, dtype=torch.float16, device=device) for _ in range(8)]

    def pairs():
        for i in range(8):
            yield plain[i], source + i
            yield half[i], source * 0 + i

    copy_all(pairs())
    for i in range(8):
        assert torch.equal(plain[i], source + i) and (half[i] == i).all()


def test_false_condition_changes_no_bit(device):
    for condition in (False, True):
        some, _ = cases(on(device))
        pairs = [(target, source) for _, target, source in some]
        pairs = [(target, source.to(target.device)) for target, source in pairs]
        before = [target.clone() for target, _ in pairs]
        copy_all(pairs, torch.tensor(condition, device=device))
        for old, (target, source) in zip(before, pairs, strict=True):
            expected = source.to(target.dtype).expand_as(target) if condition else old
            assert torch.equal(target, expected)


def test_selects_lanes_of_a_tree(device):
    n_lanes, lanes = 70, torch.tensor([3, 69, 0, 3], device=device)
    leaves = [numbers((n_lanes, 1, 3), dtype, on(device), seed=i) for i, dtype in enumerate(DTYPES)]
    leaves += [numbers((4, n_lanes), torch.float32, on(device), seed=9)[1]]
    leaves += [numbers((n_lanes, 2), torch.float32, on(device), seed=9)[:, 1]]
    tree = arrdict(some=arrdict({str(i): leaf for i, leaf in enumerate(leaves)}), one=leaves[0])
    selected = select_tree(tree, lanes)
    assert type(selected) is type(selected.some) is arrdict
    assert torch.equal(selected.one, leaves[0][lanes])
    for i, leaf in enumerate(leaves):
        assert torch.equal(selected.some[str(i)], leaf[lanes]), i


@pytest.mark.parametrize("n_selected", [0, 1, 1500])
def test_selects_lanes_in_every_step(to_gpu, n_selected):
    """Words of every size, numbers of steps that differ, and tensors of many blocks and of one."""
    n_lanes = 2000
    lanes = torch.randperm(n_lanes, generator=torch.Generator().manual_seed(1))[:n_selected]
    shapes = (3, 16), (1, 1), (5, 6), (2, 50), (1, 4), (4, 3, 2)
    tensors = [
        numbers((n_steps, n_lanes, *rest), dtype, torch.Tensor.cpu, seed=i)
        for n_steps, *rest in shapes
        for i, dtype in enumerate(DTYPES)
    ]
    assert len(tensors) > 2 * _MAX_SELECTED
    selected = select_lanes([*map(to_gpu, tensors)], to_gpu(lanes))
    for i, (tensor, ours) in enumerate(zip(tensors, selected, strict=True)):
        assert torch.equal(ours.cpu(), tensor[:, lanes]), i
