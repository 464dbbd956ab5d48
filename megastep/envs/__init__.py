"""The environments: one file, one environment. ``ENVS`` names them."""

from .explorer import Explorer
from .minimal import Minimal

__all__ = ["ENVS", "Explorer", "Minimal"]

ENVS = {"minimal": Minimal, "explorer": Explorer}
