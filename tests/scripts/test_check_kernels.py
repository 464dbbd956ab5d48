"""The script that compiles all CUDA kernels without a GPU."""

from pathlib import Path

import check_kernels
import pytest

from megastep.agents.selfplay.opponents import LIBRARY as OPPONENTS
from megastep.kernels.build.kernel_library import KernelLibrary

ROOT = Path(__file__).resolve().parents[2]


def test_finds_every_folder_with_cuda_kernels():
    folders = {library.folder.resolve() for library in check_kernels.libraries()}
    files = [file for part in ("megastep", "agents") for file in (ROOT / part).glob("**/*.cu")]
    for part in "megastep", "agents":
        headers = (ROOT / part).glob("**/*.h")
        files += [path for path in headers if "\nEACH(" in path.read_text()]
    assert folders == {file.resolve().parent for file in files}


@pytest.mark.nightly
def test_all_kernels_fit_on_a_gpu():
    """tests/kernels/test_dependent_launch.py compiles all as far as PTX for each change."""
    pytest.importorskip("cuda.bindings.nvrtc")
    assert check_kernels.main([]) == 0


def test_names_what_does_not_compile(tmp_path, monkeypatch, capsys):
    bindings = pytest.importorskip("cuda.bindings.nvrtc")
    try:
        bindings.nvrtcVersion()
    except (RuntimeError, OSError) as error:
        pytest.skip(f"needs NVRTC: {error}")
    (tmp_path / "params.h").write_text("struct FailParams {\n    int n;\n};\n")
    text = '#include "common/backend.h"\n#include "params.h"\n\nKERNEL fail(FailParams p) { odd }\n'
    (tmp_path / "fail.cu").write_text(text)
    found = [OPPONENTS, KernelLibrary(tmp_path)]
    monkeypatch.setattr(check_kernels, "libraries", lambda: found)
    monkeypatch.setattr(check_kernels, "ROOT", Path("/"))
    assert check_kernels.main([]) == 1
    good, _, bad = capsys.readouterr().out.partition("\n")
    assert "failed" not in good and "failed: NVRTC could not build" in bad and "fail.cu(4)" in bad
