"""The environments: one file, one environment. ``ENVS`` names them."""

from .explorer import Explorer
from .minimal import Minimal

ENVS = {"minimal": Minimal, "explorer": Explorer}
