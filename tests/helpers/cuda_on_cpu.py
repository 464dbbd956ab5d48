"""Runs CUDA kernels on a CPU, a block at a time, through ``blocks_on_cpu.h``."""

import ctypes
import functools
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import torch

from megastep import cache
from megastep.agents.networks import fused, intakes
from megastep.engine import operations, rendering
from megastep.kernels.build import compile
from megastep.kernels.build.launch import BLOCK, Blocks, launch

HEADER = Path(__file__).with_name("blocks_on_cpu.h")
#: In place of headers of this name.
REPLACED = {"common/tensor_cores.h": Path(__file__).with_name("tensor_cores_on_cpu.h")}
FLAGS = (
    *("-std=c++17", "-O1", "-ffp-contract=off", "-shared", "-fPIC", "-fno-strict-aliasing"),
    "-U_FORTIFY_SOURCE",  # which takes a jump between fibers for an error
)
#: Threads that the GPU it stands for runs at once, where their number chooses a kernel.
RESIDENT_THREADS = 132 * 2048
#: As in `blocks_on_cpu.h`.
ORDERS = "forward", "reversed", "shuffled"
#: Order, and whether copies come late.
SCHEDULES = ("forward", False), ("reversed", True), ("shuffled", False), ("shuffled", True)
#: Kernels that give the CPU's bits have the CPU's half of backend.h here.
BACKEND = """
#undef KERNEL
#define HAS_THREADS
#include "common/backend.h"
#define BOUNDS(n_blocks)
#define PREFETCH(address)
constexpr unsigned int FULL_WARP = ~0u;
"""
#: What a C++ compiler does not take: (expression, replacement).
SPELLINGS = (
    (r"extern __shared__ (\w+) (\w+)\[\];", r"\1* \2 = (\1*)dynamic_shared;"),
    (r"extern __shared__ __align__\(\d+\) .* (\w+)\[\];", r"#define \1 dynamic_shared"),
    (r'asm\("cvt\.f32\.f16 %0, %1;" : "=f"\((\w+)\) : "h"\((.*)\)\);', r"\1 = half_to_float(\2);"),
)


@functools.cache
def _precompiled():
    """The folder of `HEADER` and its compiled form, which halves the time of a small kernel."""
    folder = tempfile.TemporaryDirectory()
    header = shutil.copy(HEADER, folder.name)
    options = f"-I{compile.KERNELS}", "-w", "-x", "c++-header", header, "-o", f"{header}.gch"
    subprocess.run([compile.compiler()[0], *FLAGS, *options], check=True)
    return folder


def _cluster(library, operation):
    """Returns how many blocks are a cluster: the argument of BOUNDS, where that sets clusters."""
    for text in library.sources(".cu").values():
        found = re.search(rf"BOUNDS\((\d+)\) {operation}[(,]", text)
        if found and "__cluster_dims__(n_blocks," in text:
            return int(found[1])
    return 1


class TensorOnCpu(torch.Tensor):
    """A tensor on the CPU that counts as on a GPU."""

    is_cuda = True


class CudaOnCpu:
    """A stand-in for `launch` that runs `.cu` files where tensors are on the CPU.

    Attributes:
        order: in which threads run, one of `ORDERS`.
        is_late: copies to shared memory, and what blocks of a cluster send each other, arrive as
            late as they may, and not at once; some of them, if threads are shuffled.
        launched: the operations since `install`.
    """

    def __init__(self):
        self.launched = set()
        self.order, self.is_late = "forward", False
        self._libraries = {}

    @staticmethod
    def tensor(tensor):
        """Returns a tensor, of the same memory, that counts as on a GPU."""
        return tensor.as_subclass(TensorOnCpu)

    def __call__(self, library, operation, device, shape, /, **fields):
        """Stands in for `launch`."""
        assert device.type == "cpu"
        blocks = shape if isinstance(shape, Blocks) else Blocks(-(-shape // BLOCK))
        if not all(blocks[:3]):
            return
        packed = vars(library.params)[library.cuda_operations[operation]](**fields)
        if library not in self._libraries:
            self._libraries[library] = self._build(library)
        function = getattr(self._libraries[library], f"run_{operation}")
        function.restype = ctypes.c_char_p
        cluster = _cluster(library, operation)
        numbers = *blocks, cluster, ORDERS.index(self.order), self.is_late
        numbers = map(ctypes.c_uint, numbers)
        message = function(ctypes.c_char_p(packed), *numbers)
        assert not message, f"{operation}: {message.decode()}"
        self.launched.add(operation)

    def in_every_order(self, function):
        """Returns what `function()` does, tensors: the same bits in each of `SCHEDULES`, whichever
        threads run first and whenever what they copy and send arrives. So no thread reads too
        early, or overwrites what another still reads.
        """
        results, before = [], (self.order, self.is_late)
        try:
            for self.order, self.is_late in SCHEDULES:
                results.append(function())
        finally:
            self.order, self.is_late = before
        for other in results[1:]:
            for one, same in zip(results[0], other, strict=True):
                bits = (leaf.flatten().view(torch.uint8) for leaf in (one, same))
                torch.testing.assert_close(*bits, rtol=0, atol=0)
        return results[0]

    def _build(self, library):
        """Loads a library from the cache of kernels."""
        sources = library.sources(".h", ".cu")
        for expression, replacement in SPELLINGS:
            sources = {k: re.sub(expression, replacement, text) for k, text in sources.items()}
        sources |= {name: path.read_text() for name, path in REPLACED.items()}
        lines = [f'#include "{HEADER.name}"']
        lines += [BACKEND] * ("--fmad=false" in library.cuda_flags)
        lines += [compile.joined(library.sources(".h", ".cu"))]
        lines += [
            f'extern "C" const char* run_{operation}(const {struct}* p, unsigned int x, '
            f"unsigned int y, unsigned int n_threads, unsigned int n_shared, "
            f"unsigned int n_cluster, Order thread_order, int is_late) "
            f"{{ return launch_blocks({operation}, *p, x, y, n_threads, n_shared, n_cluster, "
            f"thread_order, is_late); }}"
            for operation, struct in library.cuda_operations.items()
        ]
        sources["all.cpp"] = "\n".join(lines)
        parts = HEADER.read_text(), *compile.compiler(), *FLAGS, *sources, *sources.values()
        name = f"cuda-on-cpu-{compile._key(*parts)}.so"
        return compile._load(name, *cache.fetch(name, lambda: self._compiled(sources)))

    def _compiled(self, sources):
        with tempfile.TemporaryDirectory() as folder:
            for name, text in sources.items():
                path = Path(folder) / name
                path.parent.mkdir(exist_ok=True)
                path.write_text(text)
            folders = _precompiled().name, folder, compile.KERNELS
            command = [compile.compiler()[0], *FLAGS, *(f"-I{path}" for path in folders)]
            binary = Path(folder) / "all.so"
            subprocess.run([*command, f"{folder}/all.cpp", "-o", binary], check=True)
            return binary.read_bytes()

    def install(self, monkeypatch):
        """Replaces `launch` in all modules that import it."""
        self.launched.clear()
        monkeypatch.setattr(fused, "uses_gpu", lambda: True)
        for module in operations, rendering, intakes:
            monkeypatch.setattr(module, "n_resident_threads", lambda *_: RESIDENT_THREADS)
        for path, module in list(sys.modules.items()):
            if path.startswith("megastep.") and vars(module).get("launch") is launch:
                monkeypatch.setattr(module, "launch", self)
