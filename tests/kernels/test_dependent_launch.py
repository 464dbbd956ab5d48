"""Kernels that may start before the previous one has ended: they wait first."""

import re

import check_kernels
import pytest
import torch

from megastep.kernels.build import compile, launch
from megastep.kernels.build.kernel_library import KernelLibrary

PARAMS = """
#pragma once

struct RelayParams {
    const int* first;   // (n)
    const int* second;  // (n)
    int* after;         // (n)
    int n;
    int pause;  // clock cycles
};
"""
RELAY = """
#pragma once
#include "common/backend.h"
#include "params.h"

// after[i] = the smaller one of first[n - 1 - i] and second[n - 1 - i], and 1.
// The last block is slow, and the first one of the next kernel reads what it writes.
DEVICE void relay(const RelayParams& p) {
    int i = blockIdx.x * blockDim.x + threadIdx.x;
    long long start = clock64();
    while (blockIdx.x == gridDim.x - 1 && clock64() - start < p.pause)
        ;
    if (i < p.n)
        p.after[i] = min(p.first[p.n - 1 - i], p.second[p.n - 1 - i]) + 1;
}
"""
WAITS = """
#include "relay.h"

KERNEL waits(RelayParams p) {
    wait_for_previous();
    relay(p);
}
"""
CARELESS = """
#include "relay.h"

KERNEL careless(RelayParams p) { relay(p); }
"""
OURS = pytest.mark.parametrize(
    "library", check_kernels.libraries(), ids=lambda library: "/".join(library.folder.parts[-3:])
)


@pytest.fixture
def relays(tmp_path):
    files = {"params.h": PARAMS, "relay.h": RELAY, "waits.cu": WAITS, "careless.cu": CARELESS}
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    return KernelLibrary(tmp_path)


@OURS
def test_every_kernel_of_ours_waits_first(library):
    assert library.early_operations == library.cuda_operations.keys() != set()


@pytest.mark.parametrize(
    "body",
    [
        "// wait_for_previous();",
        "p.after[0] = 1; wait_for_previous();",
        "if (p.n) wait_for_previous();",
        "{ wait_for_previous(); }",
        "wait_for_previous;",
        "do_not_wait_for_previous();",
        "wait_for_previous(); }\n#else\nKERNEL waits(RelayParams p) {",
    ],
)
def test_only_a_wait_as_the_first_statement_counts(relays, body):
    (relays.folder / "waits.cu").write_text(f"KERNEL waits(RelayParams p) {{\n    {body}\n}}\n")
    assert relays.cuda_operations.keys() == {"waits", "careless"}
    assert relays.early_operations == set()


def ptx(library):
    """The PTX of a library, {kernel: text}. Skips if there is no NVRTC, which needs no GPU."""
    nvrtc = pytest.importorskip("cuda.bindings.nvrtc")
    try:
        nvrtc.nvrtcVersion()
    except (RuntimeError, OSError) as error:
        pytest.skip(f"needs NVRTC: {error}")
    files = library.sources(".h", ".cu")
    names, texts = [name.encode() for name in files], [text.encode() for text in files.values()]
    made = nvrtc.nvrtcCreateProgram(
        compile.joined(files).encode(), b"kernels.cu", len(files), texts, names
    )
    handle = compile.check_status(made, "NVRTC")
    flags = [*library.cuda_flags, "--gpu-architecture=compute_90a"]
    result = nvrtc.nvrtcCompileProgram(handle, len(flags), [flag.encode() for flag in flags])
    compile.check_status(result, "NVRTC")
    text = bytearray(compile.check_status(nvrtc.nvrtcGetPTXSize(handle), "NVRTC"))
    nvrtc.nvrtcGetPTX(handle, text)
    nvrtc.nvrtcDestroyProgram(handle)
    parts = re.split(r"\.entry (\w+)\(", text.decode(errors="replace"))
    return dict(zip(parts[1::2], parts[2::2], strict=True))


@OURS
def test_compiled_kernels_touch_global_memory_after_the_wait_only(library):
    """And never as read-only memory, whose reads the compiler may move before the wait."""
    kernels = ptx(library)
    assert kernels.keys() == library.cuda_operations.keys()
    for name, text in kernels.items():
        before, wait, after = text.partition("griddepcontrol.wait;")
        assert wait and "griddepcontrol.launch_dependents;" in after, name
        assert not re.search(
            r"\b(ld|st|red|atom|prefetch|cp)\.(?!param|local)|\bbra\b|\bret;", before
        ), name
        assert not re.search(r"\bld\.global\S*\.nc", after), name


def rounds(library, n_rounds, tensors, side):
    """Each round adds 7 to `a`: six kernels and an operation of PyTorch, each 1.

    They read what a kernel, PyTorch, a copy, a memset and another stream wrote just before.
    """
    a, b, c, d = tensors

    def relay(operation, first, second, after, pause):
        fields = dict(first=first, second=second, after=after, n=len(a), pause=pause)
        launch.launch(library, operation, a.device, len(a), **fields)

    for _ in range(n_rounds):
        relay("waits", a, a, b, 10_000)
        relay("careless", b, b, a, 10_000)
        a.add_(1)
        relay("waits", a, a, b, 10_000)
        c.copy_(b)
        relay("waits", c, c, a, 10_000)
        d.zero_()
        side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(side):
            relay("waits", a, a, d, 20_000)
        relay("waits", a, a, b, 100)
        torch.cuda.current_stream().wait_stream(side)
        relay("waits", b, d, a, 100)


def captured(library, tensors, side):
    """A CUDA graph of ten rounds."""
    rounds(library, 1, tensors, side)  # builds the library, which a capture must not do
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        rounds(library, 10, tensors, side)
    return graph


def starts(n_blocks):
    """The four tensors of `rounds`, and a stream."""
    start = torch.arange(n_blocks * launch.BLOCK, dtype=torch.int32, device="cuda")
    return [start.clone() for _ in range(4)], torch.cuda.Stream()


@pytest.mark.cuda
@pytest.mark.parametrize("n_blocks", [1, 200, 9000])  # 9000 do not fit on a GPU at once
def test_a_chain_of_kernels_gives_the_right_numbers(relays, n_blocks):
    tensors, side = starts(n_blocks)
    expected = tensors[0] + 7 * 300
    rounds(relays, 300, tensors, side)
    assert torch.equal(tensors[0], expected)


@pytest.mark.cuda
@pytest.mark.parametrize("n_blocks", [1, 200, 9000])
def test_a_captured_chain_of_kernels_gives_the_right_numbers(relays, n_blocks):
    """Also beside launches that are not captured."""
    tensors, side = starts(n_blocks)
    expected = tensors[0] + 7 * (1 + 50 * (10 + 1))
    graph = captured(relays, tensors, side)
    for _ in range(50):
        graph.replay()
        rounds(relays, 1, tensors, side)
    assert torch.equal(tensors[0], expected)


@pytest.mark.cuda
def test_a_captured_kernel_starts_early(relays):
    """One that is said to wait, and does not, reads old numbers: so the tests above can fail."""
    if not launch._can_start_early(0):
        pytest.skip("needs programmatic dependent launch")
    relays.early_operations = relays.early_operations | {"careless"}
    tensors, side = starts(200)
    expected = tensors[0] + 7 * (1 + 50 * 10)
    graph = captured(relays, tensors, side)
    for _ in range(50):
        graph.replay()
    assert not torch.equal(tensors[0], expected)
