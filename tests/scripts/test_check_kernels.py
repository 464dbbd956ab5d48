"""The script that compiles all CUDA kernels without a GPU."""

from pathlib import Path

import check_kernels
import pytest

from megastep.kernels.build.compile import EngineError

ROOT = Path(__file__).resolve().parents[2]


def test_finds_every_folder_with_cuda_kernels():
    folders = {library.folder.resolve() for library in check_kernels.libraries()}
    files = [*(ROOT / "megastep").glob("**/*.cu"), *(ROOT / "agents").glob("**/*.cu")]
    files += [path for path in (ROOT / "megastep").glob("**/*.h") if "\nEACH(" in path.read_text()]
    assert folders == {file.resolve().parent for file in files}


@pytest.mark.parametrize("fails", [False, True])
def test_says_what_fails(fails, monkeypatch, capsys):
    def build(library, architecture):
        assert architecture == "sm_80"
        if fails and library.folder.parent.name == "pong":
            raise EngineError("NVRTC could not build")

    monkeypatch.setattr(check_kernels, "build_cuda", build)
    assert check_kernels.main(["sm_80"]) == int(fails)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(check_kernels.libraries())
    assert [line for line in lines if "failed" in line] == [
        "megastep/envs/pong/kernels: failed: NVRTC could not build"
    ] * fails


def test_compiles_all_of_them():
    bindings = pytest.importorskip("cuda.bindings.nvrtc")
    try:
        bindings.nvrtcVersion()
    except (RuntimeError, OSError) as error:
        pytest.skip(f"needs NVRTC: {error}")
    assert check_kernels.main([]) == 0
