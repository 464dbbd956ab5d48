"""Datasets of whole episodes, as `megastep dump` writes them.

episodes = megastep.data.load("folder")
episodes[0].obs.rgb  # (T + 1, 1, 3, 1, 64)
loader = torch.utils.data.DataLoader(episodes, 32, shuffle=True, collate_fn=megastep.data.pad)
"""

import json
import operator
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch.utils import _pytree
from torch.utils.data import Dataset

from megastep.arrdict import arrdict
from megastep.data import episodes

__all__ = ["DatasetError", "Episodes", "load", "pad"]

#: The file that describes a dataset, and what it says of who wrote it.
ABOUT, WRITER = "dataset.json", "megastep"


class DatasetError(ValueError):
    """A folder is not a dataset that can be used so. The message says why, and the cure."""


def about(folder: Path) -> dict[str, Any]:
    """Returns what a dataset's file says of it. DatasetError if there is none of ours."""
    try:
        text = json.loads((folder / ABOUT).read_text())
        if text["writer"] == WRITER:
            return text
    except FileNotFoundError:
        problem = "does not exist" if not folder.exists() else f"has no {ABOUT}"
    except (OSError, ValueError, KeyError, TypeError) as error:
        problem = f"has a {ABOUT} that cannot be read ({type(error).__name__})"
    else:
        problem = "was written by another program"
    raise DatasetError(f"{folder} {problem}; give a folder that megastep dump has written")


class Episodes(Dataset):
    """Whole episodes in a folder of npz files, each an arrdict of tensors:

    - obs: (T + 1, ...) per leaf of the observation space, the last observation included
    - actions: (T, ...) per leaf of the action space
    - reward: (T,) float32; terminal, truncated: (T,) bool
    - (T + 1, ...) each: `mask`, the allowed actions, if the environment has any; and with
      `truth=true` poses and objects, and the floor plans `walls` (M, 2, 2) and `maze_layout`

    Args:
        folder: written by `megastep dump format=npz`.

    Attributes:
        about: the settings and spaces, as nested dicts.
        codec: of the spaces.
        files: one per episode, in order.

    Raises:
        DatasetError: it is another's, has another format, or is not complete.
    """

    def __init__(self, folder: str | os.PathLike):
        self.folder = Path(folder)
        self.about = about(self.folder)
        if (kind := self.about["format"]) != "npz":
            raise DatasetError(f"{folder} is in the format {kind}; read it by the package {kind}")
        self.codec = episodes.Codec(self.about["spaces"])
        self.files = sorted(self.folder.glob("episode-*.npz"))
        n = self.about["settings"]["episodes"]
        if len(self.files) < n:
            raise DatasetError(
                f"{folder} has {len(self.files):,} of {n:,} episodes; repeat its megastep dump, "
                "which goes on where it stopped"
            )

    @property
    def label(self) -> str:
        """What it is called in other formats: the environment, and who plays."""
        settings = self.about["settings"]
        name = settings["env"]["name"].rpartition(":")[2].lower()
        return re.sub(r"[^A-Za-z0-9]+", "_", f"{name}_{settings['player']}".split(",")[0])

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, index: int) -> arrdict:
        index = operator.index(index)
        try:
            return self.codec.decoded(episodes.read(self.files[index]))
        except (OSError, ValueError, KeyError) as error:
            raise DatasetError(f"{self.files[index]} cannot be read: {error}") from None


def load(folder: str | os.PathLike) -> Episodes:
    """Returns the dataset of a folder. Raises DatasetError as `Episodes` does."""
    return Episodes(folder)


def pad(batch: Sequence[arrdict]) -> arrdict:
    """Returns episodes as one, a `collate_fn`: tensors (T, B, ...) with zeros after their ends, and
    `valid` (T, B) bool, true for the steps that were taken. Floor plans are left out.
    """
    batch = [arrdict({k: v for k, v in one.items() if k not in episodes.PLANS}) for one in batch]
    valid = [torch.ones(len(one["reward"]), dtype=torch.bool) for one in batch]
    padded = torch.nn.utils.rnn.pad_sequence
    joined = _pytree.tree_map(lambda *leaves: padded([*leaves]), *batch)
    return arrdict(joined, valid=padded(valid))
