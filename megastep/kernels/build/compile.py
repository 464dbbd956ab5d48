"""Builds a kernel library at first use, and loads it: for a CPU by the system's C++ compiler, for
a GPU by NVRTC, which is part of PyTorch's CUDA wheels. Both are cached under a hash of sources,
flags, compiler and processor.
"""

import ctypes
import functools
import hashlib
import json
import os
import platform
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from megastep import cache
from megastep.kernels.build.kernel_library import KERNELS, WASM_FLAGS, KernelLibrary, kernels


class EngineError(RuntimeError):
    """The engine cannot go on, for example without a compiler, GPU or enough memory, or with a NaN
    position. The message is one sentence and names the cure.
    """


def _key(*parts) -> str:
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:20]


# ---- The CPU ----


@functools.cache
def cpu(library: KernelLibrary) -> dict[str, Callable[[bytes], None]]:
    """Returns a library's operations for the CPU: {name: function of its packed struct}."""
    if not library.cpu_operations:
        return {}
    command, version = compiler()
    files = library.sources(".h", ".cpp")
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    features = (line for line in lines if line.startswith(("flags", "Features")))
    processor = next(features, platform.machine() + platform.processor())  # for -march=native
    key = _key(*files, *files.values(), *library.cpu_flags, command, version, processor)
    name = f"cpu-{key}.so"
    binary = _load(name, *cache.fetch(name, lambda: _build_cpu(library, command)))
    end_threads_at_forks(binary)
    functions = {operation: getattr(binary, operation) for operation in library.cpu_operations}
    for function in functions.values():
        function.argtypes, function.restype = [ctypes.c_char_p], None
    return functions


def end_threads_at_forks(library: ctypes.CDLL) -> None:
    """Has the OpenMP runtime of a library, if any, end its threads before each ``os.fork``; new
    ones start when they are needed, with the same bits. A fork copies only the thread that calls
    it, and GNU OpenMP does not notice: the first parallel loop of the child would wait forever.
    """
    pause = getattr(library, "omp_pause_resource_all", None)
    if pause is not None:
        os.register_at_fork(before=lambda: pause(1))  # omp_pause_soft: settings stay


end_threads_at_forks(ctypes.CDLL(torch._C.__file__))  # PyTorch's, which kernels mostly share


def compiler() -> tuple[str, str]:
    """Returns the C++ compiler's path, and its version as text. ``CXX`` overrides the default."""
    override = os.environ.get("CXX")
    for command in [override] if override else ["c++", "g++", "clang++"]:
        path = shutil.which(command)
        if path:
            return path, _run([path, "--version"])
    problem = f"CXX={override} is not executable" if override else "c++, g++, clang++ are missing"
    raise EngineError(
        f"The CPU engine needs a C++ compiler, and {problem}: install one (Debian: apt install "
        f"g++) or set CXX to yours."
    )


def _run(command, needs="", **env) -> str:
    """Runs a compiler in a new session, so that Ctrl-C reaches Python's handlers only. Returns its
    output. EngineError, with what it ``needs``, if it fails.
    """
    options: dict = dict(capture_output=True, text=True, start_new_session=True)
    process = subprocess.run(command, env={**os.environ, **env}, **options)
    if process.returncode:
        output = " ".join(process.stderr.split())[:500]
        raise EngineError(f"{command[0]} could not build {needs}. Its output: {output}")
    return process.stdout


def _build_cpu(library, command) -> bytes:
    """Returns a shared library of all ``.cpp`` files."""
    needs = (
        f"the CPU kernels in {library.folder}; it needs C++17, OpenMP (Debian: apt install g++), "
        f"and room in memory and in {tempfile.gettempdir()}"
    )
    with tempfile.TemporaryDirectory(prefix="megastep-") as folder:
        out, files = Path(folder) / "kernels.so", _cpu_sources(library, folder)
        options = *library.cpu_flags, f"-I{library.folder}", f"-I{KERNELS}"
        _run([command, *options, *files, "-o", str(out)], needs, TMPDIR=folder)
        return out.read_bytes()


def _load(name, body, path) -> ctypes.CDLL:
    """Loads a shared library from its cached file or, without a cache, from a temporary copy."""
    if path is not None:
        try:
            return ctypes.CDLL(str(path))
        except OSError as error:  # of a mount that is noexec
            cache.warn(f"no library can be loaded from {path.parent} ({error})")
    with tempfile.TemporaryDirectory(prefix="megastep-") as folder:
        copy = Path(folder) / name
        copy.write_bytes(body)
        return ctypes.CDLL(str(copy))


# ---- WebAssembly ----

#: Name of the section of a module that holds {operation: the `wasm_key` of its library}.
WASM_SECTION = "megastep"
WASM_PACKAGES = (
    " (Debian: apt install clang lld wasi-libc libc++-dev-wasm32 libclang-rt-dev-wasm32)"
)


def wasm_key(library: KernelLibrary) -> str:
    """Returns a hash of a library's sources for the CPU and of clang's flags."""
    files = library.sources(".h", ".cpp")
    return _key(*files, *files.values(), *WASM_FLAGS)


def wasm(libraries: Mapping[KernelLibrary, Sequence[str]]) -> bytes:
    """Returns CPU operations of several libraries as one WebAssembly module, which imports nothing,
    and exports them, `malloc` and its memory. It computes the same bits as the CPU. EngineError if
    clang or its libraries for WebAssembly are missing, or cannot build them.
    """
    command, version = wasm_tools()
    keys = {name: wasm_key(library) for library, names in libraries.items() for name in names}
    key = _key(json.dumps(keys), command, version)
    return cache.fetch(f"wasm-{key}.wasm", lambda: _build_wasm(libraries, command, keys))[0]


def wasm_keys(module: bytes) -> dict[str, str]:
    """Returns {operation: the `wasm_key` of its library} of a module that `wasm` built."""
    head = WASM_SECTION.encode()
    start = module.rindex(bytes([len(head)]) + head) + 1 + len(head)
    return json.loads(module[start:])


def wasm_tools() -> tuple[str, str]:
    """Returns the path of a clang++ that builds WebAssembly, and its version as text."""
    for suffix in ("", *(f"-{version}" for version in range(14, 40))):
        path = shutil.which(f"clang++{suffix}")
        if path and any(map(shutil.which, (f"wasm-ld{suffix}", "wasm-ld"))):
            return path, _run([path, "--version"])
    raise EngineError(
        f"Kernels for a browser are built by clang, and clang++ or wasm-ld is missing: install "
        f"them with WebAssembly's libraries{WASM_PACKAGES}."
    )


def _build_wasm(libraries, command, keys) -> bytes:
    linked = [f"-Wl,--export={name}" for name in ("malloc", *keys)]
    needs = f"kernels for a browser; it needs lld and WebAssembly's libraries{WASM_PACKAGES}"
    with tempfile.TemporaryDirectory(prefix="megastep-") as folder:
        objects = []
        for i, library in enumerate(libraries):
            folders = f"-I{library.folder}", f"-I{KERNELS}"
            for source in _cpu_sources(library, folder):
                objects.append(str(Path(folder) / f"{i}-{Path(source).name}.o"))
                _run([command, *WASM_FLAGS, *folders, "-c", source, "-o", objects[-1]], needs)
        out = Path(folder) / "kernels.wasm"
        # without -O: clang would have a wasm-opt that it finds change what it built
        options = "--target=wasm32-wasi", "-mexec-model=reactor", "-Wl,--strip-all"
        _run([command, *options, *linked, *objects, "-o", str(out)], needs)
        return out.read_bytes() + _section(WASM_SECTION.encode(), json.dumps(keys).encode())


def _section(name: bytes, content: bytes) -> bytes:
    """Returns a custom section of a WebAssembly module."""
    content = bytes([len(name)]) + name + content
    sevens = [len(content) >> shift & 127 for shift in (0, 7, 14, 21)]  # bits a byte, lowest first
    return bytes([0, *(seven | 128 for seven in sevens[:3]), sevens[3]]) + content


# ---- The GPU ----


@functools.cache
def cuda(library: KernelLibrary, index: int) -> dict[str, object]:
    """Returns a library's operations on GPU ``index``: {name: CUfunction}."""
    if not library.cuda_operations:
        return {}
    driver, _ = bindings()
    major, minor = torch.cuda.get_device_capability(index)
    # a Hopper's own instructions, too
    cubin = build_cuda(library, f"sm_{major}{minor}{'a' * ((major, minor) == (9, 0))}")
    loading = "Loading the GPU's kernels"
    with torch.cuda.device(index):
        torch.cuda.current_stream().synchronize()  # makes the device's primary context current
        module = check_status(driver.cuModuleLoadData(cubin), loading)
        return {
            operation: check_status(driver.cuModuleGetFunction(module, operation.encode()), loading)
            for operation in library.cuda_operations
        }


def build_cuda(library: KernelLibrary, architecture: str) -> bytes:
    """Returns a library's kernels for GPUs of an architecture, such as ``sm_90``. Needs no GPU."""
    _, nvrtc = bindings()
    files = library.sources(".h", ".cu")
    flags = (*library.cuda_flags, f"--gpu-architecture={architecture}")
    try:
        version = check_status(nvrtc.nvrtcVersion(), "NVRTC")
    except (RuntimeError, OSError) as error:
        raise EngineError(
            f"Kernels on a GPU need NVRTC, which comes with PyTorch's CUDA wheels, and it could "
            f"not be loaded ({error}): reinstall torch."
        ) from None
    cubin, _ = cache.fetch(
        f"cuda-{_key(*files, *files.values(), *flags, str(version))}.cubin",
        lambda: _build_cuda(files, flags),
    )
    return cubin


@functools.cache
def bindings() -> tuple[Any, Any]:
    """Returns the modules ``driver`` and ``nvrtc`` of cuda.bindings."""
    try:
        # pyright finds no types, whether it is installed or not
        from cuda.bindings import driver, nvrtc  # pyright: ignore
    except ImportError:
        raise EngineError(
            "Kernels on a GPU need the package cuda-bindings, which comes with PyTorch for CUDA "
            "13: pip install cuda-bindings."
        ) from None
    return driver, nvrtc


def check_status(result: tuple, action: str) -> Any:
    """Returns the results of a call of cuda.bindings, without its status. EngineError if that is an
    error; ``action`` names what failed.
    """
    status, *values = result
    if int(status):
        raise EngineError(
            f"{action} failed with {getattr(status, 'name', status)}: check that the NVIDIA driver "
            f"supports CUDA {torch.version.cuda}, which this PyTorch is built for."
        )
    return values[0] if len(values) == 1 else values


def _build_cuda(files, flags) -> bytes:
    """Returns a cubin of all ``.cu`` files. NVRTC gets every file under its own name, so its
    errors, ncu and compute-sanitizer name file and line: physics.h:23.
    """
    _, nvrtc = bindings()
    names, texts = [name.encode() for name in files], [text.encode() for text in files.values()]
    program = check_status(
        nvrtc.nvrtcCreateProgram(joined(files).encode(), b"kernels.cu", len(files), texts, names),
        "NVRTC",
    )
    (status,) = nvrtc.nvrtcCompileProgram(program, len(flags), [flag.encode() for flag in flags])
    if int(status):
        log = bytearray(check_status(nvrtc.nvrtcGetProgramLogSize(program), "NVRTC"))
        nvrtc.nvrtcGetProgramLog(program, log)
        raise EngineError(
            f"NVRTC could not build the GPU's kernels: {bytes(log).decode(errors='replace')[:2000]}"
        )
    cubin = bytearray(check_status(nvrtc.nvrtcGetCUBINSize(program), "NVRTC"))
    check_status(nvrtc.nvrtcGetCUBIN(program, cubin), "NVRTC")
    nvrtc.nvrtcDestroyProgram(program)
    return bytes(cubin)


def joined(files: dict[str, str]) -> str:
    """Returns a source that includes every ``.cu`` file, and every header with an operation."""
    included = (
        name
        for name, text in files.items()
        if name.endswith(".cu") or name.endswith(".h") and kernels({name: text})
    )
    return "".join(f'#include "{name}"\n' for name in included)


def _cpu_sources(library, folder) -> list[str]:
    """Returns the paths of the sources for a CPU. Writes one, for headers' operations."""
    source = Path(folder) / "each.cpp"
    source.write_text(joined(library.sources(".h")))
    return [*(str(library.folder / name) for name in library.sources(".cpp")), str(source)]
