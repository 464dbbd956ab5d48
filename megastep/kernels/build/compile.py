"""Builds the kernels at first use, and loads them.

The CPU library comes from the system's C++ compiler, the GPU's cubin from NVRTC, which PyTorch's
CUDA wheels bring along: no nvcc. Either is cached under a hash of sources, flags, compiler and
processor.
"""

import ctypes
import functools
import hashlib
import os
import platform
import re
import shutil
import signal
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import torch

from megastep import cache

HERE = Path(__file__).parents[1]
#: Each is a kernel of this name in two files, one for the GPU and one for the CPU.
OPERATIONS = tuple(sorted(path.stem for path in HERE.glob("*.cu")))
CPU_FLAGS = (
    "-std=c++17",
    "-O3",
    "-march=native",
    "-ffp-contract=off",
    "-fno-tree-slp-vectorize",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fopenmp",
    "-shared",
    "-fPIC",
)
BLOCK = 64  # threads per block, for the launcher and for the kernels
CUDA_FLAGS = (
    "--std=c++17",
    "--fmad=false",
    "--prec-div=true",
    "--prec-sqrt=true",
    "--ftz=false",
    "--generate-line-info",
    f"-DBLOCK={BLOCK}",
)


@dataclass(frozen=True, eq=False)
class Program:
    """Kernels for the GPU that are built together: every ``.cu`` and ``.h`` of a folder, which
    define the operations. Flags are NVRTC's, without the architecture.
    """

    folder: Path
    operations: tuple[str, ...]
    flags: tuple[str, ...]


ENGINE = Program(HERE, OPERATIONS, CUDA_FLAGS)


class EngineError(RuntimeError):
    """The machine cannot do this: no compiler, no GPU, no memory, a position that is not a number.
    The message is one sentence with the cure.
    """


def _key(*parts):
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:20]


def sources(*suffixes: str, folder: Path = HERE) -> dict[str, str]:
    """The text of each file of the folder with such a suffix, by name."""
    return {
        path.name: path.read_text() for path in sorted(folder.iterdir()) if path.suffix in suffixes
    }


# ---- The CPU ----


def _compiler():
    """The C++ compiler's command, and its version as text."""
    chosen = os.environ.get("CXX")
    for command in [chosen] if chosen else ["c++", "g++", "clang++"]:
        found = shutil.which(command)
        if found:
            return found, _run([found, "--version"]).stdout
    what = f"CXX={chosen} is not a program" if chosen else "none of c++, g++ and clang++ is there"
    raise EngineError(
        f"The CPU engine needs a C++ compiler and {what}: install one (Debian: apt install g++) "
        f"or set CXX to yours."
    )


def _run(command, **env):
    """Runs a compiler, apart from the terminal: what Ctrl-C does is for Python's handlers to say.
    EngineError if a signal stopped it.
    """
    done = subprocess.run(
        command, capture_output=True, text=True, start_new_session=True, env={**os.environ, **env}
    )
    by_driver = re.search(r"(\w+) signal terminated program", done.stderr)  # as g++ puts it
    if done.returncode < 0 or by_driver:
        name = by_driver[1] if by_driver else signal.Signals(-done.returncode).name
        raise EngineError(
            f"{command[0]} was stopped by a signal ({name}) before the CPU engine was built: start "
            f"again; if no one stopped it, free some memory first."
        )
    return done


def _processor():
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(
            (line for line in lines if line.startswith(("flags", "Features"))), platform.machine()
        )
    except OSError:
        return platform.machine() + platform.processor()


def _build_cpu(compiler):
    files = [str(path) for path in sorted(HERE.glob("*.cpp"))]
    try:
        with tempfile.TemporaryDirectory(prefix="megastep-") as folder:
            out = Path(folder) / "engine.so"
            done = _run([compiler, *CPU_FLAGS, *files, "-o", str(out)], TMPDIR=folder)
            if not done.returncode:
                return out.read_bytes()
    except OSError as error:
        raise EngineError(
            f"The CPU engine could not be built in {tempfile.gettempdir()} ({error.strerror}): "
            f"make room there, or set TMPDIR to a folder that has some."
        ) from None
    raise EngineError(
        f"{compiler} could not build the CPU engine; it needs a C++17 compiler with OpenMP "
        f"(Debian: apt install g++) and room in {tempfile.gettempdir()}. It said: "
        f"{' '.join(done.stderr.split())[:500]}"
    )


def _load(name, body, path):
    """The library ``body``, from its cached file or else from a private one that is gone again."""
    if path is not None:
        try:
            return ctypes.CDLL(str(path))
        except OSError as error:
            cache.warn(f"no library can be loaded from {path.parent} ({error})")
    try:
        with tempfile.TemporaryDirectory(prefix="megastep-") as folder:
            copy = Path(folder) / name
            copy.write_bytes(body)
            return ctypes.CDLL(str(copy))
    except OSError as error:
        raise EngineError(
            f"The CPU engine was built, but cannot be loaded from {tempfile.gettempdir()} "
            f"({error}): set MEGASTEP_CACHE to a folder of your own, with room, whose mount is not "
            f"noexec."
        ) from None


@functools.cache
def cpu():
    """The CPU backend: operation name -> function of its packed params."""
    compiler, version = _compiler()
    parts = (*sources(".h", ".cpp").values(), *CPU_FLAGS, compiler, version, _processor())
    name = f"cpu-{_key(*parts)}.so"
    library = _load(name, *cache.fetch(name, lambda: _build_cpu(compiler)))
    functions = {operation: getattr(library, operation) for operation in OPERATIONS}
    for function in functions.values():
        function.argtypes, function.restype = [ctypes.c_char_p], None
    return functions


# ---- The GPU ----


@functools.cache
def bindings():
    try:
        from cuda.bindings import driver, nvrtc
    except ImportError:
        raise EngineError(
            "Kernels on a GPU need the package cuda-bindings, which comes with PyTorch for CUDA "
            "13: pip install cuda-bindings."
        ) from None
    return driver, nvrtc


def checked(result, what):
    """What a call of cuda.bindings returned beside its status, or an EngineError."""
    status, *values = result
    if int(status):
        raise EngineError(
            f"{what} failed with {getattr(status, 'name', status)}; is the NVIDIA driver as new "
            f"as PyTorch's "
            f"CUDA {torch.version.cuda}?"
        )
    return values[0] if len(values) == 1 else values


def _build_cuda(files, flags):
    """A cubin of all kernels. NVRTC gets every file under its own name, so that its errors, ncu and
    compute-sanitizer name the file and line: physics.cu:23.
    """
    _, nvrtc = bindings()
    headers = [text.encode() for text in files.values()], [name.encode() for name in files]
    program = checked(
        nvrtc.nvrtcCreateProgram(program_of(files).encode(), b"kernels.cu", len(files), *headers),
        "NVRTC",
    )
    (status,) = nvrtc.nvrtcCompileProgram(program, len(flags), [flag.encode() for flag in flags])
    if int(status):
        log = bytearray(checked(nvrtc.nvrtcGetProgramLogSize(program), "NVRTC"))
        nvrtc.nvrtcGetProgramLog(program, log)
        raise EngineError(
            f"NVRTC could not build the GPU's kernels: {bytes(log).decode(errors='replace')[:2000]}"
        )
    cubin = bytearray(checked(nvrtc.nvrtcGetCUBINSize(program), "NVRTC"))
    checked(nvrtc.nvrtcGetCUBIN(program, cubin), "NVRTC")
    nvrtc.nvrtcDestroyProgram(program)
    return bytes(cubin)


def program_of(files: dict[str, str]) -> str:
    """The program of all ``.cu`` files: it includes each."""
    return "".join(f'#include "{name}"\n' for name in files if name.endswith(".cu"))


@functools.cache
def cuda(index, program):
    """A program on GPU ``index``: operation name -> CUfunction."""
    driver, nvrtc = bindings()
    major, minor = torch.cuda.get_device_capability(index)
    files = sources(".h", ".cu", folder=program.folder)
    flags = (*program.flags, f"--gpu-architecture=sm_{major}{minor}")
    try:
        version = checked(nvrtc.nvrtcVersion(), "NVRTC")
    except (RuntimeError, OSError) as error:
        raise EngineError(
            f"Kernels on a GPU need NVRTC, which comes with PyTorch's CUDA wheels, and it could "
            f"not be loaded ({error}): reinstall torch."
        ) from None
    cubin, _ = cache.fetch(
        f"cuda-{_key(*files.values(), *flags, str(version))}.cubin",
        lambda: _build_cuda(files, flags),
    )
    loading = "Loading the GPU's kernels"
    with torch.cuda.device(index):
        torch.cuda.current_stream().synchronize()  # makes the device's primary context current
        module = checked(driver.cuModuleLoadData(cubin), loading)
        return {
            operation: checked(driver.cuModuleGetFunction(module, operation.encode()), loading)
            for operation in program.operations
        }
