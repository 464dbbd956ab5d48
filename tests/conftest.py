"""Fixtures and settings of all tests: one thread per process, no display, no GPU needed."""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("LOKY_MAX_CPU_COUNT", "1")  # each worker imports torch, in seconds

import functools
import gc
import logging
import pickle
from pathlib import Path
from types import SimpleNamespace

import filelock
import pytest
import torch
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import ConfigRepository
from hydra.core.config_store import ConfigStore
from hydra.core.object_type import ObjectType
from hydra.core.utils import JobRuntime

from megastep import cache
from megastep.agents import package
from megastep.agents.cli import compose
from megastep.agents.launch import run as launch_run
from megastep.agents.runs import provenance

torch.set_num_threads(1)


def pytest_configure(config):
    """Has each worker begin with other files, so that each compiles its part of them, and finds
    the bytecode of the others.
    """
    worker = getattr(config, "workerinput", None)
    if worker and config.args == config.getini("testpaths"):
        folder = Path(__file__).parent
        paths = sorted(map(str, [*folder.glob("*/"), *folder.glob("test_*.py")]))
        start = len(paths) * int(worker["workerid"][2:]) // worker["workercount"]
        config.args = paths[start:] + paths[:start]


def pytest_collection_modifyitems(config, items):
    """Skips what needs a GPU where there is none, or leaves it out if it was not asked for."""
    if hasattr(config, "workerinput"):
        items.sort(key=lambda item: item.path)
    if torch.cuda.is_available():
        return
    needy = [item for item in items if item.get_closest_marker("cuda")]
    if "cuda" in config.option.markexpr:
        for item in needy:
            item.add_marker(pytest.mark.skip(reason="there is no GPU"))
    else:
        config.hook.pytest_deselected(items=needy)
        items[:] = [item for item in items if not item.get_closest_marker("cuda")]


def pytest_ignore_collect(collection_path, config):
    """Imports no file without tests of the tier that is chosen."""
    tier = config.option.markexpr
    if tier in ("slow", "nightly") and collection_path.match("test_*.py"):
        return f"mark.{tier}" not in collection_path.read_text() or None


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
def device(request):
    """Each device in turn, for tests that hold on both."""
    return request.param


@pytest.fixture(autouse=True)
def logs():
    """Takes away what Hydra adds to Python's logging, which would write to a closed stream."""
    root = logging.getLogger()
    level = root.level
    yield
    root.setLevel(level)
    for handler in [*root.handlers]:
        if type(handler) in (logging.StreamHandler, logging.FileHandler):
            root.removeHandler(handler)


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Changes to an empty folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def trainers(monkeypatch):
    """The trainers that `train` makes during a test."""
    made, make_trainer = [], launch_run.make_trainer

    def remember(*arguments, **options):
        made.append(make_trainer(*arguments, **options))
        return made[-1]

    monkeypatch.setattr(launch_run, "make_trainer", remember)
    return made


@pytest.fixture(scope="session", autouse=True)
def composed_once():
    """Has Hydra compose the same words, list a group's files and read a file once per session.

    Each takes a tenth of a second or more, and tests repeat the same few. Folders other than
    configs/ are read anew.
    """
    load, list_options = ConfigLoaderImpl.load_configuration, ConfigLoaderImpl.get_group_options
    read, cached = ConfigRepository.load_config, {}

    def copied(key, method, *arguments, **options):
        key = str((key, compose.BlockSource.blocks))
        if key not in cached:
            cached[key] = pickle.dumps(method(*arguments, **options))
        return pickle.loads(cached[key])  # in a tenth of the time of copy.deepcopy

    def once(loader, method, *arguments, **options):
        paths = [entry.path for entry in loader.get_search_path().get_path()]
        folders = [path for path in paths if not path.startswith(("pkg://", "structured://"))]
        if folders != [f"blocks://{package.CONFIGS}"]:
            return method(loader, *arguments, **options)
        key = method, JobRuntime.instance().get("name"), arguments, options
        return copied(key, method, loader, *arguments, **options)

    def load_once(loader, *arguments, **options):
        config = once(loader, load, *arguments, **options)
        config.hydra.runtime.cwd = os.getcwd()
        return config

    def read_once(repository, config_path):
        source = repository._find_object_source(config_path, ObjectType.CONFIG)
        if source is None or source.path not in (str(package.CONFIGS), "hydra.conf"):
            return read(repository, config_path)
        return copied((source.path, config_path), read, repository, config_path)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ConfigLoaderImpl, "load_configuration", load_once)
        patch.setattr(
            ConfigLoaderImpl, "get_group_options", functools.partialmethod(once, list_options)
        )
        patch.setattr(ConfigRepository, "load_config", read_once)
        quick = SimpleNamespace(deepcopy=lambda config: pickle.loads(pickle.dumps(config)))
        patch.setattr(compose, "copy", quick)
        # Hydra copies all that is stored whenever it composes, and only reads it
        patch.setattr(ConfigStore, "__deepcopy__", lambda store, memo: store, raising=False)
        yield


@pytest.fixture(scope="session", autouse=True)
def frozen_once():
    """Has each command not count again what is left out of garbage collections."""
    gc.collect()
    gc.freeze()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gc, "get_freeze_count", lambda: 1)
        yield


@pytest.fixture(scope="session", autouse=True)
def built_once(tmp_path_factory):
    """Has workers wait for what one of them builds, such as kernels."""
    fetch, folder = cache.fetch, tmp_path_factory.getbasetemp().parent

    def fetch_once(name, build):
        with filelock.FileLock(folder / f"{name}.lock"):
            return fetch(name, build)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cache, "fetch", fetch_once)
        yield


@pytest.fixture(scope="session", autouse=True)
def no_sync():
    """Waits for no disk: what a test leaves need not outlive the machine."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda handle: None)
        yield


@pytest.fixture(scope="session", autouse=True)
def commit_once():
    """Asks git for the commit of this checkout once."""
    commit = provenance.commit
    ours = functools.cache(lambda: commit(package.ROOT))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            provenance, "commit", lambda path: ours() if path == package.ROOT else commit(path)
        )
        yield


@pytest.fixture(scope="session", autouse=True)
def home(tmp_path_factory):
    """Has runs signed with a key of this session, and not with the user's."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CONFIG_HOME", str(tmp_path_factory.mktemp("home")))
        yield


@pytest.fixture(scope="session")
def cuda_on_cpu():
    """Runs CUDA kernels on a CPU."""
    from tests.helpers.cuda_on_cpu import CudaOnCpu

    return CudaOnCpu()


@pytest.fixture(
    params=["forward", "reversed", "shuffled", pytest.param("cuda", marks=pytest.mark.cuda)]
)
def to_gpu(request, monkeypatch):
    """Moves a tensor to a GPU, or to a CPU on which it counts as on a GPU and CUDA kernels run, the
    threads of a block in one of three orders.
    """
    if request.param == "cuda":
        return torch.Tensor.cuda
    cuda_on_cpu = request.getfixturevalue("cuda_on_cpu")
    cuda_on_cpu.install(monkeypatch)
    monkeypatch.setattr(cuda_on_cpu, "order", request.param)
    return cuda_on_cpu.tensor
