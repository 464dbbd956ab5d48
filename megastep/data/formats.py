"""Datasets in the formats of other packages: Minari's, and LeRobot's v3. T steps.

Both are made from a folder of npz files, an episode at a time, and appear once they are whole.
"""

import importlib
import importlib.util
import io
import json
import os
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch

from megastep import spaces
from megastep.atomic_files import delete
from megastep.data import DatasetError, Episodes, episodes

#: Modules that writing a format needs.
NEEDED = {"minari": ("minari", "h5py", "gymnasium"), "lerobot": ("pyarrow", "pandas", "PIL")}
#: Size of a file of LeRobot's, bytes, and files per folder.
FILE_BYTES, PER_CHUNK = 100 * 2**20, 1000
TEMPORARY = ".tmp-format"
Progress = Callable[[int, int], None]


def require(format: str) -> None:
    """Raises DatasetError if a package is missing."""
    if absent := [name for name in NEEDED.get(format, ()) if not importlib.util.find_spec(name)]:
        raise DatasetError(
            f"format={format} needs {', '.join(absent)}: pip install 'megastep-flatland[{format}]'"
        )


def is_there(format: str, folder: Path) -> bool:
    """Returns whether a folder has a dataset of this format."""
    pattern = {"minari": "*/data/metadata.json", "lerobot": "meta/info.json"}[format]
    return any(folder.glob(pattern))


def convert(format: str, source: Episodes, folder: Path, progress: Progress) -> None:
    """Writes a dataset of another format into a folder. OSError if it cannot be written."""
    temporary = folder / TEMPORARY
    delete(temporary)
    temporary.mkdir()
    try:
        {"minari": _minari, "lerobot": _lerobot}[format](source, temporary, progress)
        for path in sorted(temporary.iterdir()):  # `meta`, which tells of the rest, is the last
            os.replace(path, folder / path.name)
    finally:
        delete(temporary)


def _each(source, progress) -> Iterator[episodes.Arrays]:
    for number, path in enumerate(source.files):
        progress(number, len(source))
        yield episodes.read(path)


def _parts(source, arrays) -> tuple[dict, dict, dict]:
    """Returns an episode's observations, its actions, and what no agent observes, by name."""
    named = source.codec.names.items()
    seen = {name: arrays[name] for path, name in named if not path.startswith("actions")}
    actions = {name: arrays[name] for path, name in named if path.startswith("actions")}
    rest = {name for name in arrays if name not in {*seen, *actions, *episodes.OUTCOMES}}
    return seen, actions, {name: arrays[name] for name in arrays if name in rest}


# ---- Minari ----


def _minari(source, folder, progress) -> None:
    from gymnasium.spaces import Box, Dict

    from megastep.adapters.vector_env import gymnasium_space

    named = source.codec.names.items()
    of_actions = {n: source.codec.spaces[p] for p, n in named if p.startswith("actions")}
    each = {name: gymnasium_space(one, torch.float32) for name, one in of_actions.items()}

    def obs_space(array) -> Any:
        bounds = (0, 255) if array.dtype == np.uint8 else (-np.inf, np.inf)
        return Box(*bounds, shape=array.shape[1:], dtype=array.dtype.type)

    def actions_of(name, array) -> np.ndarray:
        is_one_hot = isinstance(of_actions[name], spaces.MultiDiscrete)
        return array[1:].argmax(-1) if is_one_hot else array[1:]

    minari: Any = importlib.import_module("minari")  # whose annotations take no arrays

    def buffers() -> Iterator[Any]:
        for number, arrays in enumerate(_each(source, progress)):
            seen, actions, truth = _parts(source, arrays)
            actions = {name: actions_of(name, array) for name, array in actions.items()}
            yield minari.data_collector.EpisodeBuffer(
                id=number,
                observations=seen,
                actions=actions.get("action", actions),
                rewards=arrays["reward"][1:],
                terminations=arrays["terminal"][1:],
                truncations=arrays["truncated"][1:],
                infos=truth,
            )

    first = _parts(source, episodes.read(source.files[0]))[0]
    path = mock.patch.dict(os.environ, MINARI_DATASETS_PATH=str(folder.resolve()))
    with path, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of authors, and of an environment that Gymnasium makes
        minari.create_dataset_from_buffers(
            f"{source.label}-v0",
            buffers(),
            observation_space=Dict({name: obs_space(array) for name, array in first.items()}),
            action_space=each.get("action") or Dict(each),
            algorithm_name=source.about["settings"]["player"],
            description=json.dumps(source.about["settings"]),
            jpeg_encoding=False,  # which would blur images by default
        )


# ---- LeRobot ----


def _lerobot(source, folder, progress) -> None:
    """Writes v3.0: T + 1 frames per episode. `next.reward`, `next.done` and `next.truncated` of a
    frame are of the step that follows it; the last has an action and a reward of zeros.
    """
    import pandas as pd
    import pyarrow as pa  # pyright: ignore[reportMissingImports]
    import pyarrow.parquet as pq  # pyright: ignore[reportMissingImports]

    writer, list_writer, features, sums, rows = None, None, {}, {}, []
    path_of_list = folder / "meta" / "episodes" / _FILE.format(chunk_index=0, file_index=0)
    path_of_list.parent.mkdir(parents=True)
    size, file_number, n_frames, fps = 0, 0, 0, source.about["fps"]
    for number, arrays in enumerate(_each(source, progress)):
        frames = _frames(source, arrays)
        n = len(arrays["reward"])
        order = np.arange(n)
        frames |= {"timestamp": (order / fps).astype(np.float32), "frame_index": order}
        frames |= {"episode_index": np.full(n, number), "index": order + n_frames}
        frames["task_index"] = np.zeros(n, np.int64)
        own = _sums(frames)
        for name, values in own.items():
            old = sums.get(name)
            sums[name] = [f(*two) for f, *two in zip(JOINED, old, values)] if old else values
        columns = {name: _column(pa, array) for name, array in frames.items()}
        table = pa.table(columns)
        if writer is not None and size > FILE_BYTES:
            writer.close()
            writer, size, file_number = None, 0, file_number + 1
        place = dict(zip(("chunk_index", "file_index"), divmod(file_number, PER_CHUNK)))
        if writer is None:
            path = folder / "data" / _FILE.format(**place)
            path.parent.mkdir(parents=True, exist_ok=True)
            writer = pq.ParquetWriter(path, table.schema, compression="snappy")
        writer.write_table(table)
        size += table.nbytes
        row = dict(episode_index=number, tasks=[source.label], length=n)
        row |= {f"data/{key}": value for key, value in place.items()}
        row |= dict(dataset_from_index=n_frames, dataset_to_index=n_frames + n)
        row |= {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
        for name, values in _stats(own).items():
            row |= {f"stats/{name}/{key}": value for key, value in values.items()}
        rows.append(row)
        if len(rows) == PER_CHUNK or number + 1 == len(source):
            table, rows = pa.Table.from_pylist(rows), []
            list_writer = list_writer or pq.ParquetWriter(path_of_list, table.schema)
            list_writer.write_table(table)
        n_frames += n
        features = features or {name: _feature(array) for name, array in frames.items()}
    assert writer is not None and list_writer is not None
    writer.close()
    list_writer.close()
    meta = folder / "meta"
    pd.DataFrame({"task_index": [0]}, index=[source.label]).to_parquet(meta / "tasks.parquet")
    (meta / "stats.json").write_text(json.dumps(_stats(sums), indent=1))
    rate = int(fps) if fps == int(fps) else fps
    about: dict[str, Any] = dict(codebase_version="v3.0", robot_type="megastep", fps=rate)
    about |= dict(total_episodes=len(source), total_frames=n_frames, total_tasks=1)
    about |= dict(chunks_size=PER_CHUNK, data_files_size_in_mb=FILE_BYTES // 2**20)
    about |= dict(video_files_size_in_mb=200, splits={"train": f"0:{len(source)}"}, video_path=None)
    about |= dict(data_path=f"data/{_FILE}", features=features)
    (meta / "info.json").write_text(json.dumps(about, indent=1))


_FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"


def _frames(source, arrays) -> dict[str, np.ndarray]:
    """Returns the columns of an episode: images (T + 1, H, W, 3) uint8, others (T + 1, n)."""
    seen, actions, truth = _parts(source, arrays)
    n = len(arrays["reward"])

    def flat(array) -> np.ndarray:
        return array.reshape(n, -1).astype(np.float32)

    def ahead(array) -> np.ndarray:
        return np.concatenate([array[1:], np.zeros_like(array[:1])])

    frames = {
        f"observation.{name}": array if name == "image" else flat(array)
        for name, array in seen.items()
    }
    frames["action"] = np.concatenate([flat(ahead(array)) for array in actions.values()], 1)
    frames |= {"next.reward": ahead(arrays["reward"])}
    frames["next.done"] = ahead(arrays["terminal"] | arrays["truncated"])
    frames["next.truncated"] = ahead(arrays["truncated"])
    for name, array in truth.items():
        if name not in episodes.PLANS:
            frames[f"truth.{name}"] = flat(array)
    return frames


def _column(pa, array) -> Any:
    if array.ndim == 4:
        images = [{"bytes": _png(image), "path": None} for image in array]
        return pa.array(images, pa.struct({"bytes": pa.binary(), "path": pa.string()}))
    if array.ndim == 1 or array.shape[1] == 1:
        return pa.array(array.reshape(-1))
    return pa.FixedSizeListArray.from_arrays(array.reshape(-1), array.shape[1])


def _png(image) -> bytes:
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(image).save(file, "PNG", compress_level=1)
    return file.getvalue()


def _feature(array) -> dict[str, Any]:
    if array.ndim == 4:
        names = ["height", "width", "channels"]
        return dict(dtype="image", shape=array.shape[1:], names=names)
    return dict(dtype=str(array.dtype), shape=array.shape[1:] or (1,), names=None)


#: How sums of episodes are joined: minimum, maximum, sum, sum of squares, numbers, frames.
JOINED = np.minimum, np.maximum, np.add, np.add, np.add, np.add


def _sums(frames) -> dict[str, list[np.ndarray]]:
    """Returns what the statistics of an episode's features are made of."""
    found = {}
    for name, array in frames.items():
        values = array.reshape(len(array), -1).astype(np.float64)
        if array.ndim == 4:
            values = array.reshape(-1, array.shape[-1]) / 255
        found[name] = [values.min(0), values.max(0), values.sum(0), np.square(values).sum(0)]
        found[name] += [np.array([len(values)]), np.array([len(array)])]
    return found


def _stats(sums) -> dict[str, dict[str, Any]]:
    """Returns minimum, maximum, mean and standard deviation of each feature, as LeRobot keeps them,
    and its number of frames.
    """
    found = {}
    for name, (low, high, total, squares, n, count) in sums.items():
        std = np.sqrt(np.maximum(squares / n - (total / n) ** 2, 0))
        shape = (3, 1, 1) if name == "observation.image" else (-1,)
        values = dict(min=low, max=high, mean=total / n, std=std)
        found[name] = {key: value.reshape(shape).tolist() for key, value in values.items()}
        found[name]["count"] = count.tolist()
    return found
