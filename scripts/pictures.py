"""Draws every picture of README and docs again, and the films and pages of the site's gallery, from
packaged agents.

python scripts/pictures.py                    all, into docs/images and docs/play
python scripts/pictures.py explorer.gif explorer.html
python scripts/pictures.py gallery            docs/play alone, which the repository does not hold
"""

import argparse
import functools
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

import show_homes
from examples import draw_plans

from megastep.agents.cli import record, train, web
from megastep.geometries import files

DOCS = Path(__file__).resolve().parents[1] / "docs"
IMAGES, PAGES = DOCS / "images", DOCS / "play"
MOST = 20_000_000  # bytes of both
#: What films or draws each: words for record.py, or for show_homes.py.
FILMS = {
    "explorer.gif": "run=explorer_anywhere home=3 steps=200 dpi=70 speed=2",
    "explorer.png": "run=explorer_anywhere home=3 steps=90",
    "cameras.png": "env=explorer geometry=maze geometry.braid=0.5 env.cameras=[0,120,240] steps=60 "
    "seed=5",
    "pointgoal.png": "run=pointgoal_anywhere home=4 steps=30",
    "homes.png": "run=pointgoal_anywhere homes=[1,2,3,4] steps=25 theme=dark dpi=70",
    "deathmatch.png": "run=deathmatch_anywhere against=hunter home=27 steps=60",
    "hideandseek.png": "run=hideandseek_quadrant against=hideandseek_ramps home=3 steps=180 dpi=70",
    "memory.gif": "run=memory_9 steps=160 dpi=60 speed=2 seed=2",
    "keys.png": "run=keys_anywhere steps=60",
    "minimal.png": "env=minimal geometry=box steps=20",
    "pong-court.png": "env=pong steps=30",
    "minigrid.png": "run=DOORKEY steps=12 seed=4 dpi=70",
}
SHEETS = {
    "dense-homes.png": "--count 10 --density 3",
    "cluttered-homes.png": "--count 10 --density 3 --clutter 1",
    "mazes.png": "--mazes",
}
#: Floor plans of others beside what is made of them, which needs the extra `plans`.
OWN_PLANS = "own-plans.png"
#: Explorers in a home of each source: a picture of it, and a film for the gallery.
SOURCES = {
    "in-a-column": "geometry=column",
    "in-homes": "geometry=homes home=5",
    "in-dense-homes": "geometry=homes geometry.density=3 home=2",
    "in-cluttered-homes": "geometry=homes geometry.density=3 geometry.clutter=1 home=4",
    "in-bench": "geometry=bench home=2",
    "in-mazes": "geometry=maze geometry.braid=0.3 home=1",
    "in-memory-mazes": "geometry=memory_maze geometry.size=11 home=1",
    "in-a-drawing": "geometry=files geometry.path=PLAN split=all",
}
FILMS |= {
    f"{name}.png": f"run=explorer_anywhere {words} steps=100 dpi=60"
    for name, words in SOURCES.items()
}
#: The films of the gallery, each beside the picture of that name; words for record.py.
MOVING = {
    "pointgoal.mp4": "run=pointgoal_anywhere home=4 steps=160 dpi=70 speed=2",
    "deathmatch.mp4": "run=deathmatch_anywhere against=hunter home=27 steps=160 dpi=70 speed=2",
    "hideandseek.mp4": "run=hideandseek_quadrant against=hideandseek_ramps home=3 steps=220 dpi=70 "
    "speed=2",
    "keys.mp4": "run=keys_anywhere steps=160 dpi=70 speed=2",
    "minimal.mp4": "env=minimal geometry=box steps=100 dpi=80",
    "pong-court.mp4": "run=PONG steps=200 dpi=80",
    "minigrid.mp4": "run=DOORKEY steps=150 dpi=80",
}
MOVING |= {
    f"{name}.mp4": f"run=explorer_anywhere {words} steps=120 dpi=50 speed=2"
    for name, words in SOURCES.items()
}
#: Trains agents that pictures, films and pages name.
TRAINED = {
    "PONG": "env=pong env.n_envs=64 env.points=1 agent.core=none agent.width=32 "
    "learner.n_minibatches=8 samples=200000 device=cpu",
    "DOORKEY": "experiment=minigrid env.id=MiniGrid-DoorKey-6x6-v0 samples=1000000 device=cpu",
}
#: Words for megastep web.
GALLERY = {
    "explorer.html": "run=explorer_anywhere homes=[3,0,1,2]",
    "deathmatch.html": "run=deathmatch_anywhere homes=[27,0,1]",
    "hideandseek.html": "run=hideandseek_quadrant against=hideandseek_ramps homes=[3,0,1]",
    "memory.html": "run=memory_9",
    "keys.html": "run=keys_anywhere",
    "pointgoal.html": "run=pointgoal_anywhere homes=[4,0,1]",
    "minigrid.html": "run=DOORKEY",
}


def filmed(words: str, path: Path) -> None:
    """Writes a picture or a film.

    Args:
        words: for record.py; in them PLAN is the file of a drawn floor plan.
    """
    with tempfile.TemporaryDirectory() as folder:
        if "PLAN" in words:
            files.save(f"{folder}/plan.npz", [draw_plans.curved_house()])
        words = trained(words.replace("PLAN", f"{folder}/plan.npz"))
        if code := record.main([*words.split(), "device=cpu", f"file={path}"]):
            raise SystemExit(code)


@functools.cache
def agent(name: str) -> str:
    """Trains one of `TRAINED`. Returns its folder."""
    folder = f"{tempfile.mkdtemp()}/{name.lower()}"
    train.main([*TRAINED[name].split(), f"folder={folder}"])
    return folder


def trained(words: str) -> str:
    """Returns words with the folders of the agents that they name."""
    for name in TRAINED:
        words = words.replace(name, agent(name)) if name in words else words
    return words


def main(argv=None):
    every = [*FILMS, *SHEETS, OWN_PLANS, *MOVING, *GALLERY]
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("names", nargs="*", help="names of pictures; all by default")
    names = parser.parse_args(argv).names or every
    names = [*MOVING, *GALLERY] if names == ["gallery"] else names
    if unknown := [name for name in names if name not in every]:
        raise SystemExit(f"There is no picture {unknown[0]}; there are {', '.join(every)}")
    PAGES.mkdir(exist_ok=True)
    for name in names:
        path = IMAGES / name
        if name in SHEETS:
            show_homes.main([str(path), *SHEETS[name].split()])
        elif name == OWN_PLANS:
            draw_plans.sheet(path)
        elif name in GALLERY:
            web.main([*trained(GALLERY[name]).split(), f"file={PAGES / name}"])
        elif name in MOVING:
            filmed(MOVING[name], PAGES / name)
        else:
            filmed(FILMS[name], path)
    size = sum(path.stat().st_size for folder in (IMAGES, PAGES) for path in folder.iterdir())
    print(f"{size / 1e6:.1f} MB in {IMAGES} and {PAGES}")
    if size > MOST:
        raise SystemExit(f"Pictures, films and pages may take {MOST / 1e6:.0f} MB")


if __name__ == "__main__":
    main()
