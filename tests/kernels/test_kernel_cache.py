"""The cache of built kernels: reused, damaged, raced, full, shared, planted, interrupted. Faults
are real.
"""

import contextlib
import os
import subprocess
import sys

import pytest
from test_compile import ROOT, STEP, run

from megastep import cache

UNUSED = "the cache is not used"
BODY = b"what was built " * 10_000
root = pytest.mark.skipif(os.geteuid() != 0, reason="needs root")


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The file that a first use of the kernels puts in the cache, that use's output, and CXX."""
    folder, compiler = tmp_path_factory.mktemp("cache"), tmp_path_factory.mktemp("fast") / "c++"
    compiler.write_text('#!/bin/sh\nexec c++ "$@" -O0\n')
    compiler.chmod(0o755)
    status, out, err = run(STEP, folder, CXX=str(compiler))
    assert status == 0 and UNUSED not in err, err
    (path,) = folder.iterdir()
    return path, out, str(compiler)


@pytest.fixture(scope="module")
def quick(built, tmp_path_factory):
    """A path for CXX: a compiler that returns the library built before, after one second, or once
    there is a file $MARKER.go.
    """
    path = tmp_path_factory.mktemp("compiler") / "c++"
    path.write_text(
        '#!/bin/sh\n[ "$1" = --version ] && exec echo quick\n'
        'if [ "$MARKER" ]; then touch "$MARKER"; for i in $(seq 9999); do '
        '[ -e "$MARKER.go" ] && break; sleep 0.05; done; else sleep 1; fi\n'
        f'for out; do :; done\ncp {built[0]} "$out"\n'
    )
    path.chmod(0o755)
    return str(path)


@pytest.fixture
def fetch(monkeypatch):
    """``cache.fetch`` of a file in a folder, which returns (body, path, number of builds)."""

    def fetch(folder):
        monkeypatch.setenv("MEGASTEP_CACHE", str(folder))
        builds = []
        body, path = cache.fetch("name", lambda: builds.append(1) or BODY)
        return body, path, len(builds)

    return fetch


@contextlib.contextmanager
def mounted(folder, options):
    """Mounts a small file system on the folder. Skips the test if that is not permitted."""
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", options + ",mode=0700", "tmpfs", str(folder)]
    if sys.platform != "linux" or os.geteuid() or subprocess.run(command).returncode:
        pytest.skip("needs permission to mount")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


# ---- Reused, damaged, raced ----


def test_library_is_cached(built):
    path, out, compiler = built
    before = path.stat().st_mtime_ns
    assert run(STEP, path.parent, CXX=compiler)[:2] == (0, out)
    assert path.stat().st_mtime_ns == before


def test_new_folder_is_private(fetch, tmp_path):
    before = os.umask(0)
    try:
        body, path, builds = fetch(tmp_path / "new")
    finally:
        os.umask(before)
    assert (body, path, builds) == (BODY, tmp_path / "new" / "name", 1)
    assert path.parent.stat().st_mode & 0o777 == 0o700 and path.stat().st_mode & 0o777 == 0o600
    assert fetch(tmp_path / "new") == (BODY, path, 0)


@pytest.mark.parametrize("damage", ["truncated", "flipped", "empty", "garbage", "missing"])
def test_damaged_file_is_built_again(fetch, damage, tmp_path):
    _, path, _ = fetch(tmp_path)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    damaged = {"truncated": content[:1000], "flipped": content, "empty": b"", "garbage": b"x" * 500}
    if damage == "missing":
        path.unlink()
        assert fetch(tmp_path) == (BODY, path, 1)
    else:
        path.write_bytes(damaged[damage])
        with pytest.warns(UserWarning, match="is damaged"):
            assert fetch(tmp_path) == (BODY, path, 1)
    assert fetch(tmp_path) == (BODY, path, 0)


@pytest.mark.slow
def test_two_processes_build_at_once(built, quick, tmp_path):
    env = {**os.environ, "MEGASTEP_CACHE": str(tmp_path), "CXX": quick}
    command = [sys.executable, "-c", STEP]
    both = [
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT, env=env)
        for _ in range(2)
    ]
    assert [process.communicate()[0].strip() for process in both] == [built[1]] * 2
    assert len(list(tmp_path.iterdir())) == 1, "no temporary file is left"


# ---- Folders that cannot be used ----


@pytest.mark.slow
def test_noexec_folder(built, quick, tmp_path):
    with mounted(tmp_path / "noexec", "size=4m,noexec") as folder:
        status, out, err = run(STEP, folder, CXX=quick)
        assert (status, out) == (0, built[1]), err
        assert err.count(UNUSED) == 1 and "no library can be loaded" in err


@pytest.mark.parametrize("mode", [0o777, 0o770, 0o702])
def test_folder_writable_by_others(fetch, mode, tmp_path):
    _, path, _ = fetch(tmp_path)
    tmp_path.chmod(mode)
    with pytest.warns(UserWarning, match=f"{UNUSED}.*other users can write.*chmod 700"):
        assert fetch(tmp_path) == (BODY, None, 1)
