"""Rank and number of ranks from torchrun's environment variables, without PyTorch."""

import os
import socket
from typing import NamedTuple

NAMES = "RANK", "WORLD_SIZE", "LOCAL_RANK"


class RankInfo(NamedTuple):
    """This process among the ranks that torchrun started."""

    rank: int  # 0 to `n_ranks` - 1
    n_ranks: int  # on all machines
    local_rank: int  # among the ranks of this machine
    attempt: int = 0  # number of times that torchrun has restarted the ranks


def rank_info() -> RankInfo | None:
    """Returns this process's rank if torchrun started it. ValueError if its variables disagree."""
    if any(name not in os.environ for name in NAMES):
        return None
    texts = [os.environ[name] for name in NAMES]
    texts.append(os.environ.get("TORCHELASTIC_RESTART_COUNT", "0"))
    if not all(text.isdecimal() for text in texts) or int(texts[0]) >= int(texts[1]):
        variables = " ".join(f"{name}={text}" for name, text in zip(NAMES, texts))
        raise ValueError(
            f"{variables} is not a valid rank; to train in one process, unset these environment "
            "variables"
        )
    return RankInfo(*map(int, texts))


def rank() -> int:
    """Returns the rank of this process, 0 for a single process."""
    info = rank_info()
    return info.rank if info else 0


def hostname() -> str:
    return socket.gethostname()
