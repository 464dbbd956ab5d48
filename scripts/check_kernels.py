"""Compiles all CUDA kernels, on a machine without a GPU too:

    pip install cuda-bindings nvidia-cuda-nvrtc
    python scripts/check_kernels.py
    python scripts/check_kernels.py sm_100    # another architecture than that of an H200

Prints a line per folder of kernels, and NVRTC's messages where it fails. Exit code 1 then. Folders
for Hopper and later, `acting`, `clusters` and `convolutions`, fail below sm_90.
"""

import argparse
import importlib
import pkgutil
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import megastep
from megastep.kernels.build.compile import EngineError, build_cuda
from megastep.kernels.build.kernel_library import KernelLibrary

ROOT = Path(__file__).resolve().parents[1]


def libraries() -> list[KernelLibrary]:
    """Returns all libraries of megastep that have kernels for GPUs, by folder."""
    found = {}
    for module in pkgutil.walk_packages(megastep.__path__, "megastep."):
        if not makes_library(module):
            continue
        for value in vars(importlib.import_module(module.name)).values():
            if isinstance(value, KernelLibrary) and value.cuda_operations:
                found[value.folder] = value
    return [found[folder] for folder in sorted(found)]


def makes_library(module: pkgutil.ModuleInfo) -> bool:
    """Returns whether a module's source makes a library. Others may need packages of an extra."""
    spec = module.module_finder.find_spec(module.name)
    return "KernelLibrary(" in Path(spec.origin).read_text()


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("architecture", nargs="?", default="sm_90a")
    architecture = parser.parse_args(argv).architecture
    failed = False
    for library in libraries():
        start = time.perf_counter()
        try:
            build_cuda(library, architecture)
            result = f"{time.perf_counter() - start:.1f} s"
        except EngineError as error:
            result, failed = f"failed: {error}", True
        print(f"{library.folder.resolve().relative_to(ROOT)}: {result}")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
