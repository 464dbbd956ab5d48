"""The cache of built kernels: reused, damaged, raced, full, shared, planted, interrupted. Faults
are real.
"""

import contextlib
import os
import subprocess
import sys

import pytest

from megastep import cache
from megastep.envs.pong import LIBRARY as PONG
from megastep.kernels.build import compile
from tests.helpers.pages import ROOT

UNUSED = "the cache is not used"
BODY = b"what was built " * 10_000
root = pytest.mark.skipif(os.geteuid() != 0, reason="needs root")


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


def test_library_is_cached(tmp_path, monkeypatch):
    monkeypatch.setenv("MEGASTEP_CACHE", str(tmp_path))
    operations = compile.cpu.__wrapped__(PONG)
    (path,) = tmp_path.iterdir()
    before = path.stat().st_mtime_ns
    monkeypatch.setattr(compile, "_build_cpu", None)
    assert compile.cpu.__wrapped__(PONG).keys() == operations.keys() == {"pong_step"}
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


#: Builds for as long as the other process needs to build, too.
BUILDS = """
import pathlib, sys, time
from megastep import cache
def build():
    pathlib.Path(sys.argv[1], sys.argv[2]).touch()
    while len([*pathlib.Path(sys.argv[1]).iterdir()]) < 2:
        time.sleep(0.01)
    return b"x" * 1_000_000
print(len(cache.fetch("name", build)[0]))
"""


def test_two_processes_build_at_once(tmp_path):
    (started := tmp_path / "started").mkdir()
    env = {**os.environ, "MEGASTEP_CACHE": str(tmp_path / "cache")}
    command = [sys.executable, "-c", BUILDS, str(started)]
    both = [
        subprocess.Popen([*command, name], stdout=subprocess.PIPE, text=True, cwd=ROOT, env=env)
        for name in "ab"
    ]
    assert [process.communicate(timeout=100)[0].strip() for process in both] == ["1000000"] * 2
    assert len(list((tmp_path / "cache").iterdir())) == 1, "no temporary file is left"


# ---- Folders that cannot be used ----


def test_noexec_folder(tmp_path):
    body = compile._build_cpu(PONG, compile.compiler()[0])
    with mounted(tmp_path / "noexec", "size=4m,noexec") as folder:
        (folder / "kernels.so").write_bytes(body)
        with pytest.warns(UserWarning, match=f"{UNUSED}.*no library can be loaded"):
            assert compile._load("kernels.so", body, folder / "kernels.so").pong_step


@pytest.mark.parametrize("mode", [0o777, 0o770, 0o702])
def test_folder_writable_by_others(fetch, mode, tmp_path):
    _, path, _ = fetch(tmp_path)
    tmp_path.chmod(mode)
    with pytest.warns(UserWarning, match=f"{UNUSED}.*other users can write.*chmod 700"):
        assert fetch(tmp_path) == (BODY, None, 1)
