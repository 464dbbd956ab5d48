"""Checks that no agent passes a wall or gets stuck, on the courses of tests/helpers/walls.py:

    python scripts/check_walls.py --steps 1e9 --device auto

Prints a line per course, then the sums. The exit code is 1 if an agent passed a wall, sank into one
or got stuck; the first few cases are then printed in full, with exact floats.
"""

import argparse
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from megastep import engine
from tests.helpers import wall_courses, walls

INTERVAL = 10  # seconds between lines within a course


def sentence(total, seconds):
    return (
        f"{total['steps']:,} steps, {total['collisions']:,} collisions, {total['crossings']:,} "
        f"crossings, {total['sunk']:,} sunk, {total['stuck']:,} stuck of {total['tried']:,} tried "
        f"({total['held']:,} more held by geometry), {seconds:.1f} s"
    )


def arguments():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--steps", type=float, default=1e7, help="total agent steps, such as 1e9")
    parser.add_argument("--device", default="auto", help="auto, cpu, cuda")
    parser.add_argument(
        "--agents",
        type=int,
        default=None,
        help="maximum at once (default: 2,048 on a CPU, 1,048,576 on a GPU)",
    )
    parser.add_argument(
        "--tries",
        type=int,
        default=1024,
        help="stopped agents that try to get away after every 16 steps",
    )
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    if not 1 <= args.steps < 1e15:
        parser.error(f"--steps {args.steps:g} is not allowed: take 1 to 1e15")
    return args


def main():
    args = arguments()
    try:
        device = engine.device(args.device)
    except engine.EngineError as error:
        print(f"check_walls.py: {error}", file=sys.stderr)
        return 2
    n_agents = args.agents or (2048 if device.type == "cpu" else 1 << 20)
    steps = -(-int(args.steps) // len(wall_courses.COURSES))
    start, sums, descriptions = time.time(), {}, []
    for name in wall_courses.COURSES:
        began = last = time.time()

        def report(total, name=name, began=began):
            nonlocal last
            if time.time() - last > INTERVAL:
                last = time.time()
                print(f"{name} so far: {sentence(total, last - began)}", flush=True)

        total = walls.run(name, steps, n_agents, device, args.seed, args.tries, report)
        print(f"{name}: {sentence(total, time.time() - began)}", flush=True)
        descriptions += total["descriptions"][:3]
        sums = {key: sums.get(key, 0) + total[key] for key in total if isinstance(total[key], int)}
    for description in descriptions[:12]:
        print(description)
    print(f"all on {device}: {sentence(sums, time.time() - start)}")
    return int(any(sums[key] for key in ("crossings", "sunk", "stuck")))


if __name__ == "__main__":
    sys.exit(main())
