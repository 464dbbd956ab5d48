"""Runs CUDA kernels on a CPU, a block at a time, through ``blocks_on_cpu.h``."""

import ctypes
import re
import subprocess
import sys
from pathlib import Path

from megastep.engine import movement, rendering
from megastep.kernels.build import compile, headers
from megastep.kernels.build import launch as launching

HEADER = Path(__file__).with_name("blocks_on_cpu.h")
FLAGS = ("-std=c++17", "-O1", "-ffp-contract=off", "-shared", "-fPIC", "-fno-strict-aliasing")


class CudaOnCpu:
    """A stand-in for `launch` that runs `.cu` files where tensors are on the CPU.

    Args:
        folder: where it builds libraries.

    Attributes:
        is_reversed: runs the threads of a block, and blocks, in the opposite order.
        launched: the operations so far.
    """

    def __init__(self, folder: Path):
        self.folder, self.is_reversed, self.launched = folder, False, set()
        self._libraries = {}

    def __call__(self, program, operation, packed, device, threads, shared=0):
        assert device.type == "cpu"
        block = launching.BLOCK
        n_blocks, n_shared = -(-threads // block), shared * block // launching.WARP
        message = self._function(program, operation)(
            packed, n_blocks, block, n_shared, self.is_reversed
        )
        assert not message, f"{operation}: {message.decode()}"
        self.launched.add(operation)

    def _function(self, program, operation):
        if program not in self._libraries:
            self._libraries[program] = self._build(program)
        function = self._libraries[program][f"run_{operation}"]
        function.argtypes = [ctypes.c_char_p, *[ctypes.c_uint] * 3, ctypes.c_int]
        function.restype = ctypes.c_char_p
        return function

    def _build(self, program):
        files = program.sources(".cu")
        lines = [f'#include "{HEADER}"', f'#include "{program.folder}/params.h"']
        for name, text in files.items():
            text = re.sub(
                r"extern __shared__ (\w+) (\w+)\[\];", r"\1* \2 = (\1*)dynamic_shared;", text
            )
            lines += [f'#line 1 "{name}"', text]
        lines += [
            f'extern "C" const char* run_{operation}(const {struct}* p, unsigned int n_blocks, '
            f"unsigned int n_threads, unsigned int n_shared, int is_reversed) "
            f"{{ return launch_blocks({operation}, *p, n_blocks, n_threads, n_shared, "
            f"is_reversed); }}"
            for operation, struct in headers.operations(files).items()
        ]
        source = self.folder / f"{len(self._libraries)}.cpp"
        source.write_text("\n".join(lines))
        library = source.with_suffix(".so")
        command = [compile.compiler()[0], *FLAGS, f"-I{compile.KERNELS}", f"-I{program.folder}"]
        subprocess.run([*command, str(source), "-o", str(library)], check=True)
        return ctypes.CDLL(str(library))

    def install(self, monkeypatch):
        """Replaces `launch` in all modules that import it. The CPU counts as a GPU of 132
        multiprocessors, where their number chooses a kernel.
        """
        for module in movement, rendering:
            monkeypatch.setattr(module, "n_multiprocessors", lambda device: 132)
        original = launching.launch
        for name, module in list(sys.modules.items()):
            if name.startswith("megastep.") and vars(module).get("launch") is original:
                monkeypatch.setattr(module, "launch", self)
