"""The script that compiles all CUDA kernels without a GPU."""

from pathlib import Path

import check_kernels
import pytest

ROOT = Path(__file__).resolve().parents[2]


def test_finds_every_folder_with_cuda_kernels():
    folders = {library.folder.resolve() for library in check_kernels.libraries()}
    files = [file for part in ("megastep", "agents") for file in (ROOT / part).glob("**/*.cu")]
    for part in "megastep", "agents":
        headers = (ROOT / part).glob("**/*.h")
        files += [path for path in headers if "\nEACH(" in path.read_text()]
    assert folders == {file.resolve().parent for file in files}


def test_compiles_all_of_them():
    bindings = pytest.importorskip("cuda.bindings.nvrtc")
    try:
        bindings.nvrtcVersion()
    except (RuntimeError, OSError) as error:
        pytest.skip(f"needs NVRTC: {error}")
    assert check_kernels.main([]) == 0
