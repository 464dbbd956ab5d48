"""Builds megastep/web/megastep.wasm, the kernels of web pages that come with megastep.

Run it after a change of kernels; a test says when. Needs clang, lld and WebAssembly's libraries
(Debian: apt install clang lld wasi-libc libc++-dev-wasm32 libclang-rt-dev-wasm32).
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from megastep.agents.networks.web import LIBRARY as POLICY
from megastep.envs.deathmatch.bot import LIBRARY as DEATHMATCH
from megastep.envs.explorer import LIBRARY as EXPLORER
from megastep.envs.hideandseek import LIBRARY as HIDEANDSEEK
from megastep.envs.keys import LIBRARY as KEYS
from megastep.envs.memory import LIBRARY as MEMORY
from megastep.envs.minatar import LIBRARY as MINATAR
from megastep.envs.minigrid.tasks import LIBRARY as MINIGRID
from megastep.envs.pointgoal import LIBRARY as POINTGOAL
from megastep.envs.pong.tracker import LIBRARY as PONG
from megastep.kernels.build import compile
from megastep.kernels.build.launch import ENGINE
from megastep.web.page import SHIPPED

LIBRARIES = ENGINE, EXPLORER, POINTGOAL, DEATHMATCH, PONG, MINATAR, MINIGRID, MEMORY, KEYS
LIBRARIES += HIDEANDSEEK, POLICY
#: Operations of setting up, of scripted bots and of robots, which no page launches.
ABSENT = {"bake", "place_objects", "uniform", "bot", "scan"}


def operations():
    """Returns the operations of the module, by library."""
    return {
        library: [name for name in library.cpu_operations if name not in ABSENT]
        for library in LIBRARIES
    }


if __name__ == "__main__":
    SHIPPED.write_bytes(compile.wasm(operations()))
    print(f"{SHIPPED}: {SHIPPED.stat().st_size:,} bytes")
