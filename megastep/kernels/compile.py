"""Builds the kernels at first use and keeps what was built.

The CPU library comes from the system's C++ compiler, the GPU's cubin from NVRTC, which PyTorch's
CUDA wheels bring along: no nvcc. Either is kept in ``$MEGASTEP_CACHE`` (else
``$XDG_CACHE_HOME/megastep``, else ``~/.cache/megastep``) under a hash of sources, flags, compiler
and processor. A kept file ends in its own SHA-256, so a damaged one is seen and built again; it is
written beside its place and renamed, so that two processes cannot harm each other; where the folder
cannot be written a temporary one serves.
"""

import atexit
import ctypes
import functools
import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
from pathlib import Path

import torch

HERE = Path(__file__).parent
OPERATIONS = ("bake", "physics", "update_agent_geometry", "render", "spawn", "uniform")
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
DIGEST = 32


class EngineError(RuntimeError):
    """The machine cannot do what was asked: no compiler, no GPU, no memory, a position that is not
    a number. The message is one sentence with the cure.
    """


# ---- The cache ----


def _folder():
    chosen = os.environ.get("MEGASTEP_CACHE")
    base = (
        Path(chosen)
        if chosen
        else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "megastep"
    )
    try:
        base.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=base):
            return base
    except OSError:
        return None


def _intact(path):
    """The bytes of a kept file less the digest it ends in, or None if it is missing or damaged."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    body, digest = content[:-DIGEST], content[-DIGEST:]
    return body if body and hashlib.sha256(body).digest() == digest else None


@functools.cache
def _temporary():
    folder = Path(tempfile.mkdtemp(prefix="megastep-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def kept(name, build):
    """The path of ``name`` in the cache, built by ``build() -> bytes`` unless an intact one is
    there.
    """
    folder = _folder() or _temporary()
    path = folder / name
    if _intact(path) is None:
        body = build()
        handle, temporary = tempfile.mkstemp(dir=folder, prefix=name)
        with os.fdopen(handle, "wb") as file:
            file.write(body + hashlib.sha256(body).digest())
        os.replace(temporary, path)
    return path


def _key(*parts):
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:20]


def sources(*suffixes: str) -> dict[str, str]:
    """The text of each file of this folder with such a suffix, by name."""
    return {
        path.name: path.read_text() for path in sorted(HERE.iterdir()) if path.suffix in suffixes
    }


# ---- The CPU ----


def _compiler():
    """The C++ compiler's command, and its version as text."""
    asked = os.environ.get("CXX")
    for command in [asked] if asked else ["c++", "g++", "clang++"]:
        found = shutil.which(command)
        if found:
            return found, subprocess.run(
                [found, "--version"], capture_output=True, text=True
            ).stdout
    what = f"CXX={asked} is not a program" if asked else "none of c++, g++ and clang++ is there"
    raise EngineError(
        f"The CPU engine needs a C++ compiler and {what}: install one (Debian: apt install g++) "
        f"or set CXX to yours."
    )


def _processor():
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(
            (line for line in lines if line.startswith(("flags", "Features"))), platform.machine()
        )
    except OSError:
        return platform.machine() + platform.processor()


def _build_cpu(compiler):
    with tempfile.TemporaryDirectory(prefix="megastep-") as folder:
        out = Path(folder) / "engine.so"
        done = subprocess.run(
            [compiler, *CPU_FLAGS, *map(str, sorted(HERE.glob("*.cpp"))), "-o", str(out)],
            capture_output=True,
            text=True,
        )
        if done.returncode:
            raise EngineError(
                f"{compiler} could not build the CPU engine; it needs a C++17 compiler with "
                f"OpenMP (Debian: apt "
                f"install g++). It said: "
                f"{' '.join(done.stderr.split())[:500]}"
            )
        return out.read_bytes()


@functools.cache
def cpu():
    """The CPU backend: operation name -> function of its packed params."""
    compiler, version = _compiler()
    parts = (*sources(".h", ".cpp").values(), *CPU_FLAGS, compiler, version, _processor())
    name = f"cpu-{_key(*parts)}.so"
    library = ctypes.CDLL(str(kept(name, lambda: _build_cpu(compiler))))
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
            "The GPU engine needs the package cuda-bindings, which comes with PyTorch for CUDA "
            "13: pip install "
            "cuda-bindings."
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
        nvrtc.nvrtcCreateProgram(program_of(files).encode(), b"engine.cu", len(files), *headers),
        "NVRTC",
    )
    (status,) = nvrtc.nvrtcCompileProgram(program, len(flags), [flag.encode() for flag in flags])
    if int(status):
        log = bytearray(checked(nvrtc.nvrtcGetProgramLogSize(program), "NVRTC"))
        nvrtc.nvrtcGetProgramLog(program, log)
        raise EngineError(
            f"NVRTC could not build the GPU engine: {bytes(log).decode(errors='replace')[:2000]}"
        )
    cubin = bytearray(checked(nvrtc.nvrtcGetCUBINSize(program), "NVRTC"))
    checked(nvrtc.nvrtcGetCUBIN(program, cubin), "NVRTC")
    nvrtc.nvrtcDestroyProgram(program)
    return bytes(cubin)


def program_of(files: dict[str, str]) -> str:
    """The program of all ``.cu`` files: it includes each."""
    return "".join(f'#include "{name}"\n' for name in files if name.endswith(".cu"))


@functools.cache
def cuda(index):
    """The GPU backend on device ``index``: operation name -> CUfunction."""
    driver, nvrtc = bindings()
    major, minor = torch.cuda.get_device_capability(index)
    files = sources(".h", ".cu")
    flags = (*CUDA_FLAGS, f"--gpu-architecture=sm_{major}{minor}")
    try:
        version = checked(nvrtc.nvrtcVersion(), "NVRTC")
    except (RuntimeError, OSError) as error:
        raise EngineError(
            f"The GPU engine needs NVRTC, which comes with PyTorch's CUDA wheels, and it could "
            f"not be loaded "
            f"({error}): reinstall torch."
        ) from None
    path = kept(
        f"cuda-{_key(*files.values(), *flags, str(version))}.cubin",
        lambda: _build_cuda(files, flags),
    )
    with torch.cuda.device(index):
        torch.cuda.current_stream().synchronize()  # makes the device's primary context current
        module = checked(driver.cuModuleLoadData(_intact(path)), "Loading the GPU engine")
        functions = {
            operation: checked(
                driver.cuModuleGetFunction(module, operation.encode()), "Loading the GPU engine"
            )
            for operation in OPERATIONS
        }
    return functions
