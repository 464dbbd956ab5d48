"""The tasks of MiniGrid by their ids in Gymnasium's registry, as minigrid 3.2 registers them."""

from pathlib import Path
from typing import NamedTuple

from megastep.kernels.build.kernel_library import KernelLibrary

LIBRARY = KernelLibrary(Path(__file__).parent / "kernels")
_C = LIBRARY.constants
RED, GREY = 0, 5
WITH_MISSIONS = "UNLOCK_PICKUP", "KEY_CORRIDOR", "PUT_NEAR", "GO_TO_DOOR"


class Task(NamedTuple):
    """A task: what the kernel needs to know of it. ``a`` to ``c`` are described in layouts.h."""

    task: int
    width: int
    height: int
    limit: int
    a: int = 0
    b: int = 0
    c: int = 0
    n_actions: int = 7
    sees_through: int = 0

    @property
    def has_mission(self) -> bool:
        """Whether missions differ between episodes."""
        return self.task in {_C[name] for name in WITH_MISSIONS}


def _tasks() -> dict[str, Task]:
    tasks = {}

    def add(name: str, task: str, size: int, limit: int, height: int | None = None, **more) -> None:
        tasks[f"MiniGrid-{name}"] = Task(_C[task], size, height or size, limit, **more)

    for size in 5, 6, 8, 16:
        empty: dict = dict(task="EMPTY_ROOM", size=size, limit=4 * size**2, sees_through=1)
        add(f"Empty-{size}x{size}-v0", **empty)
        obstacles: dict = dict(empty, task="DYNAMIC_OBSTACLES", b=min(size // 2, 8), n_actions=3)
        add(f"Dynamic-Obstacles-{size}x{size}-v0", **obstacles)
        if size < 8:
            add(f"Empty-Random-{size}x{size}-v0", **empty, a=1)
            add(f"Dynamic-Obstacles-Random-{size}x{size}-v0", **obstacles, a=1)
        add(f"DoorKey-{size}x{size}-v0", "DOOR_KEY", size, 10 * size**2)
        if size < 16:
            door: dict = dict(sees_through=1)
            add(f"GoToDoor-{size}x{size}-v0", "GO_TO_DOOR", size, 4 * size**2, **door)
    add("FourRooms-v0", "FOUR_ROOMS", 19, 100)
    add("Unlock-v0", "UNLOCK", 11, 288, 6)
    add("UnlockPickup-v0", "UNLOCK_PICKUP", 11, 288, 6)
    for size, n_rows in (3, 1), (3, 2), (3, 3), (4, 3), (5, 3), (6, 3):
        width, height = 3 * (size - 1) + 1, n_rows * (size - 1) + 1
        corridor: dict = dict(a=size, b=n_rows)
        name = f"KeyCorridorS{size}R{n_rows}-v0"
        add(name, "KEY_CORRIDOR", width, 30 * size**2, height, **corridor)
    for name, n_rooms, size in (
        ("N2-S4-v0", 2, 4),
        ("N4-S5-v0", 6, 5),  # as the original has it
        ("N4-S5-v1", 4, 5),
        ("N6-v0", 6, 10),
    ):
        rooms: dict = dict(a=n_rooms, b=n_rooms, c=size)
        add(f"MultiRoom-{name}", "MULTI_ROOM", 25, 20 * n_rooms, **rooms)
    for size in 5, 6, 7:
        add(f"LavaGapS{size}-v0", "LAVA_GAP", size, 4 * size**2)
    for kind, cell in ("Lava", _C["LAVA"] + 16 * RED), ("Simple", _C["WALL"] + 16 * GREY):
        for size, n in (9, 1), (9, 2), (9, 3), (11, 5):
            add(f"{kind}CrossingS{size}N{n}-v0", "CROSSING", size, 4 * size**2, a=n, b=cell)
    for number, row in (1, 2), (2, 5):
        add(f"DistShift{number}-v0", "DIST_SHIFT", 9, 252, 7, a=row, sees_through=1)
    for size in 7, 9, 11, 13, 17:
        if size < 17:
            add(f"MemoryS{size}-v0", "MEMORY", size, 5 * size**2)
        if size > 11:
            add(f"MemoryS{size}Random-v0", "MEMORY", size, 5 * size**2, a=1)
    for size in 6, 8:
        add(f"RedBlueDoors-{size}x{size}-v0", "RED_BLUE_DOORS", 2 * size, 20 * size**2, size)
        near: dict = dict(b=2 if size == 6 else 3, sees_through=1)
        add(f"PutNear-{size}x{size}-N{near['b']}-v0", "PUT_NEAR", size, 5 * size, **near)
    return tasks


TASKS = _tasks()
