"""Draws every picture of README and docs again, and the pages of the site's gallery, from packaged
agents.

python scripts/pictures.py                    all, into docs/images and docs/play
python scripts/pictures.py explorer.gif explorer.html
python scripts/pictures.py gallery            the pages alone
"""

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

import show_homes
from examples import draw_plans

from megastep.agents.cli import record, web

DOCS = Path(__file__).resolve().parents[1] / "docs"
IMAGES, PAGES = DOCS / "images", DOCS / "play"
MOST = 8_000_000  # bytes of all pictures
#: What films or draws each: words for record.py, or for show_homes.py.
FILMS = {
    "explorer.gif": "run=explorer_anywhere home=3 steps=240 dpi=80 speed=2",
    "explorer.png": "run=explorer_anywhere home=3 steps=90",
    "cameras.png": "env=explorer geometry=maze geometry.braid=0.5 env.cameras=[0,120,240] steps=60 "
    "seed=5",
    "pointgoal.png": "run=pointgoal_anywhere home=4 steps=30",
    "homes.png": "run=pointgoal_anywhere homes=[1,2,3,4] steps=25 theme=dark dpi=70",
    "deathmatch.png": "run=deathmatch_anywhere against=hunter home=27 steps=60",
    "memory.gif": "run=memory_9 steps=240 dpi=70 speed=2 seed=2",
    "keys.png": "run=keys_anywhere steps=60",
    "minimal.png": "env=minimal geometry=box steps=20",
    "pong-court.png": "env=pong steps=30",
}
SHEETS = {
    "dense-homes.png": "--count 10 --density 3",
    "cluttered-homes.png": "--count 10 --density 3 --clutter 1",
    "mazes.png": "--mazes",
}
#: Floor plans of others beside what is made of them, which needs the extra `plans`.
OWN_PLANS = "own-plans.png"
#: Words for megastep web.
GALLERY = {
    "explorer.html": "run=explorer_anywhere homes=[3,0,1,2]",
    "deathmatch.html": "run=deathmatch_anywhere homes=[27,0,1]",
    "memory.html": "run=memory_9",
    "keys.html": "run=keys_anywhere",
    "pointgoal.html": "run=pointgoal_anywhere homes=[4,0,1]",
}


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("names", nargs="*", help="names of pictures; all by default")
    names = parser.parse_args(argv).names or [*FILMS, *SHEETS, OWN_PLANS, *GALLERY]
    names = [*GALLERY] if names == ["gallery"] else names
    if unknown := [name for name in names if name not in {*FILMS, *SHEETS, OWN_PLANS, *GALLERY}]:
        every = ", ".join([*FILMS, *SHEETS, OWN_PLANS, *GALLERY])
        raise SystemExit(f"There is no picture {unknown[0]}; there are {every}")
    for name in names:
        path = IMAGES / name
        if name in SHEETS:
            show_homes.main([str(path), *SHEETS[name].split()])
        elif name == OWN_PLANS:
            draw_plans.sheet(path)
        elif name in GALLERY:
            web.main([*GALLERY[name].split(), f"file={PAGES / name}"])
        elif code := record.main([*FILMS[name].split(), "device=cpu", f"file={path}"]):
            raise SystemExit(code)
    size = sum(path.stat().st_size for path in IMAGES.iterdir())
    print(f"{size / 1e6:.1f} MB in {IMAGES}")
    if size > MOST:
        raise SystemExit(f"Pictures may take {MOST / 1e6:.0f} MB")


if __name__ == "__main__":
    main()
