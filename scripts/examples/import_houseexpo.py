"""Turns floor plans of HouseExpo (Li et al. 2019, "HouseExpo: A large-scale 2D indoor layout
dataset for learning-based algorithms on mobile robots") into a file for `geometry=files`.

    python scripts/examples/import_houseexpo.py HouseExpo/json houseexpo.npz
    python evaluate.py run=pointgoal_anywhere geometry=files geometry.path=houseexpo.npz split=all

The dataset has a JSON file per home, and is not part of megastep. A home is the outline of its
free space, in metres, and boxes around its rooms; there is no furniture. Files that are no such
homes are left out, and named.
"""

import argparse
import json
import math
import sys
from pathlib import Path

import numpy as np
from matplotlib.path import Path as Polygon

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from megastep import dotdict, geometry
from megastep.geometries import files

MARGIN = 1.0  # metres to the left of a home and below


def home(number: int, plan: dict) -> dotdict.dotdict:
    """Returns the geometry of a plan.

    Raises:
        ValueError: saying what is wrong with it.
    """
    corners = np.array(plan["verts"], float)
    if corners.ndim != 2 or corners.shape[1] != 2 or not np.isfinite(corners).all():
        raise ValueError("its verts are not a list of finite x and y")
    shift = MARGIN - corners.min(0)
    corners = corners + shift
    corners = corners[np.hypot(*(corners - np.roll(corners, 1, 0)).T) > 0]
    walls = np.stack([corners, np.roll(corners, -1, 0)], 1)  # from each corner to the next
    boxes = [box for room in plan["room_category"].values() for box in room]
    centres = np.array(boxes, float).reshape(-1, 2, 2).mean(1) + shift
    lights = centres[Polygon(corners).contains_points(centres)]
    masks = geometry.masks(walls, [corners])
    plan = dotdict.dotdict(id=number, walls=walls, lights=lights, masks=masks, res=geometry.RES)
    return geometry.validate_geometry(plan)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="of the JSON files")
    parser.add_argument("file", type=Path, help="to write, .npz")
    parser.add_argument("--n", type=int, default=math.inf, help="number of homes, at most")
    args = parser.parse_args(argv)
    homes = []
    for path in sorted(args.folder.glob("*.json")):
        if len(homes) >= args.n:
            break
        try:
            homes.append(home(len(homes), json.loads(path.read_text())))
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            print(f"{path.name} is left out: {error!r}")
    if not homes:
        print(f"import_houseexpo.py: {args.folder} has no floor plan of HouseExpo", file=sys.stderr)
        return 2
    try:
        files.save(args.file, homes)
    except OSError as error:
        print(f"import_houseexpo.py: {args.file} cannot be written: {error}", file=sys.stderr)
        return 2
    print(f"{len(homes)} homes are in {args.file}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
