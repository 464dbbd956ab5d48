"""A scripted policy for Deathmatch that acts on observations alone. B lanes, R pixels."""

import math
from collections.abc import Mapping
from pathlib import Path

import torch

from megastep.arrdict import arrdict
from megastep.devices import threads
from megastep.engine import checks
from megastep.kernels.build.kernel_library import KernelLibrary
from megastep.kernels.build.launch import WARP, launch

LIBRARY = KernelLibrary(Path(__file__).parent / "kernels")
LOOK = LIBRARY.constants["LOOK"]


class Bot:
    """Plays Deathmatch: turns until another agent is at the centre of its view, keeps it there and
    approaches. If it sees no agent, it walks about and turns away from walls.

    It uses a world's `obs` (`rgb`, `d`, `imu`) and `reset` only, recognises agents by their
    saturated colours, and has no weights. It expects ten steps per second.

    Args:
        fov: the camera's field of view in degrees.
    """

    def __init__(self, fov: float = 70.0):
        self.fov = fov

    def initial(self, n_lanes: int, device: torch.device | str | None = None) -> arrdict:
        """Returns the initial state, (B,) each: steps since an agent was in view; direction to
        turn, 1 left or -1 right; steps left to turn from a wall; the last action was forward.
        """
        zeros = torch.zeros(n_lanes, dtype=torch.int64, device=device)
        return arrdict(
            lost=zeros + LOOK, side=zeros + 1, around=zeros, pushed=torch.zeros_like(zeros).bool()
        )

    def __call__(
        self,
        world: Mapping,
        state: Mapping,
        sample: bool = True,
        generator: torch.Generator | None = None,
    ) -> tuple[arrdict, arrdict]:
        """Chooses actions (B, 1) for the lanes of a world of Deathmatch, by the state of the last
        step or :meth:`initial`; ``sample`` and ``generator`` change nothing. Returns
        (arrdict(actions), new state). ValueError if the observations are not Deathmatch's.
        """
        obs = world["obs"]
        if not isinstance(obs, Mapping) or not {"rgb", "d", "imu"} <= obs.keys():
            raise ValueError("the bot needs observations rgb, d and imu, as Deathmatch has them")
        reset = world["reset"]
        n_lanes, n_pixels, device = len(reset), obs["rgb"].shape[-1], reset.device
        shapes = dict(rgb=(1, 3, 1, n_pixels), d=(1, 1, 1, n_pixels), imu=(1, 3))
        images = {name: obs[name].half().contiguous() for name in shapes}
        before = {name: leaf.contiguous() for name, leaf in state.items()}
        after = arrdict({name: torch.empty_like(leaf) for name, leaf in before.items()})
        actions = torch.empty(n_lanes, 1, dtype=torch.int64, device=device)
        half = torch.float16
        launch(
            *(LIBRARY, "bot", device, WARP * n_lanes),
            **{
                field: checks.address(name, images[name], (n_lanes, *shapes[name]), half, device)
                for field, name in (("rgb", "rgb"), ("depth", "d"), ("imu", "imu"))
            },
            reset=reset.contiguous(),
            **before,
            actions=actions,
            **{f"next_{name}": leaf for name, leaf in after.items()},
            slope=math.tan(math.radians(self.fov / 2)),
            n_lanes=n_lanes,
            n_pixels=n_pixels,
            n_threads=threads(),
        )
        return arrdict(actions=actions), after
