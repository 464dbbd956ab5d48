"""megastep import source=SOURCE path=FILE: floor plans of others, as geometries."""

import importlib.util
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from megastep.agents import console, package
from megastep.agents.cli.command import Command
from megastep.agents.errors import UserError, user_errors

HELP = """Imports floor plans.

  megastep import source=cubicasa path=cubicasa5k          CubiCasa5k: 5,000 real homes
  megastep import source=houseexpo path=json               HouseExpo: 35,000 homes that people drew

The path is the folder of what you downloaded and unpacked, or a single file. The database goes to
$XDG_DATA_HOME/megastep, or ~/.local/share/megastep, with a report and a contact sheet; then
geometry=cubicasa and geometry=houseexpo use it, a tenth of the files is the test split.

  megastep import source=svg path=home.svg scale=0.001     a drawing in millimetres
  megastep import source=map path=map.yaml                 a map that a robot made, of ROS
  megastep import source=map path=scan.png metres_per_pixel=0.02

These write home.npz here, and a picture, home-sheet.png; geometry=files geometry.path=home.npz uses
it. In a drawing walls have the id, class or label `wall`, doors `door`; walls=NAME names another.

  file=plan.npz        where it goes, overwritten if it exists
  licence=accept       confirms the licence
  entrances=open       leaves the doors to the outside open; by default they are closed"""

#: Title, place and licence of the databases.
DATABASES = {
    "cubicasa": (
        "CubiCasa5k (Kalervo et al. 2019)",
        "https://zenodo.org/record/2613548",
        "CC BY-NC 4.0: no commercial use, name the authors",
    ),
    "houseexpo": (
        "HouseExpo (Li et al. 2019)",
        "https://github.com/TeaganLi/HouseExpo",
        "MIT; its plans are from SUNCG, which was withdrawn after a dispute about rights",
    ),
}
MAX_LINES = 1_000  # of a report's lists
#: The keys that a source has, beside `source` and `path`.
KEYS = {
    **dict.fromkeys(DATABASES, ("licence", "entrances")),
    "svg": ("file", "scale", "walls", "doors"),
    "map": ("file", "metres_per_pixel"),
}
NEEDED = ("shapely", "defusedxml", "svgelements")
Metres = Annotated[float, Field(gt=0, lt=1e6)]


def run(
    source: Literal["cubicasa", "houseexpo", "svg", "map"],
    path: str,
    file: str | None = None,
    scale: Metres | None = None,
    walls: str | None = None,
    doors: str | None = None,
    metres_per_pixel: Metres | None = None,
    licence: Literal["accept"] | None = None,
    entrances: Literal["sealed", "open"] | None = None,
) -> None:
    """Imports floor plans."""
    for key, value in locals().items():
        if value is not None and key not in ("source", "path", *KEYS[source]):
            raise UserError(f"source={source} has no {key}; it has {', '.join(KEYS[source])}")
    if missing := [name for name in NEEDED if importlib.util.find_spec(name) is None]:
        raise UserError(
            f"importing needs {', '.join(missing)}; pip install {package.DISTRIBUTION}[plans]"
        )
    if source in DATABASES:
        _import_database(source, Path(path), licence, entrances != "open")
        return
    marks = {key: name for key, name in (("walls", walls), ("doors", doors)) if name}
    _import_own(source, Path(path), file, scale, metres_per_pixel, marks)


def _import_own(source, path, file, scale, metres_per_pixel, marks) -> None:
    """Imports one drawing or map."""
    if not path.is_file():
        raise UserError(f"path={path} does not exist, or is not a file")
    file = Path(file or f"{path.stem}.npz")
    if file.suffix != ".npz":
        raise UserError(f"file={file} must end with .npz")
    if source == "svg" and scale is None:
        raise UserError("scale is missing; scale=0.001 is for a drawing in millimetres")
    from megastep.agents.runs import folders
    from megastep.geometries import files
    from megastep.geometries.plans import imports, sheets

    with user_errors(f"{path} is not a floor plan: "):
        if source == "map":
            own = imports.own_map(path, metres_per_pixel)
        else:
            own = imports.own_svg(path, scale, **marks)
    with user_errors(f"{file} cannot be written: "):
        files.save(file, [own.geometry])
        sheet = file.with_name(f"{file.stem}-sheet.png")
        sheets.write(sheet, [(path.name, own.original, own.geometry)])
    for text in own.warnings:
        console.warn(f"{path.name}: {text}")
    g = own.geometry
    console.say(
        f"{g.masks.max()} rooms, {len(g.walls)} walls and {len(g.doors)} doors in {file}\n"
        f"the drawing beside the result: {sheet}\n"
        f"use: geometry=files {folders.quoted('geometry.path', file)}"
    )


def _import_database(source, path, licence, is_sealed) -> None:
    start = time.monotonic()
    if not path.exists():
        raise UserError(f"path={path} does not exist")
    title, place, terms = DATABASES[source]
    console.say(f"{title}\n  from {place}\n  licence: {terms}")
    if licence is None:
        raise UserError("the licence is not confirmed; licence=accept does so")
    from megastep.geometries import databases
    from megastep.geometries.plans import imports, sheets

    options, suffix = imports.Options(source, is_sealed), imports.READERS[source].SUFFIX
    folder = databases.imported_path(source).parent
    with user_errors(f"{folder} cannot be written: ", (OSError,)):  # before all is read
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    with console.counting("files"), user_errors():
        n_files = sum(1 for _ in path.rglob(f"*{suffix}"))
        plans = imports.run(options, path, lambda n: console.count(n, max(n, n_files)))
    geometries = [g for plan in plans for g in plan.geometries]
    numbers = [i for i, plan in enumerate(plans) for _ in plan.geometries]
    with user_errors(f"{folder} cannot be written: "):
        file = databases.write_imported(source, geometries, numbers)
        sheet, report = (folder / f"{source}.{kind}" for kind in ("png", "md"))
        shown = ((p.name[-40:], p.drawing, p.geometries[0]) for p in plans if p.drawing is not None)
        sheets.write(sheet, [*shown])
        report.write_text(_report(source, path, plans, len(geometries)))
    n_refused = sum(not plan.geometries for plan in plans)
    console.say(
        f"{len(geometries):,} floor plans of {len(plans):,} files in {file}\n"
        f"{n_refused:,} files are refused; why is in {report}\n"
        f"contact sheet: {sheet}\n"
        f"use: geometry={source}; {console.duration(time.monotonic() - start)}"
    )


def _report(source, path, plans, n) -> str:
    """Returns the report of an import in Markdown."""
    title, _, licence = DATABASES[source]
    notes = [(plan.name, note) for plan in plans for note in plan.notes]
    refused = [(plan.name, plan.refusal) for plan in plans if plan.refusal]
    n_rooms, n_reachable = (sum(note[i] for _, note in notes) for i in (0, 1))
    warnings = [f"- {name}: {text}" for name, note in notes for text in note.warnings]
    lines = [
        f"# Import of {title}",
        f"- from {path}, licence {licence}",
        f"- {n:,} floor plans of {len(plans):,} files; {len(refused):,} are refused",
        f"- {n_reachable:,} of {n_rooms:,} rooms can be reached; agents spawn in these alone",
        f"- {sum(note.n_sealed for _, note in notes):,} doors to the outside are closed",
        "## Refused",
        *(f"- {n:,} times: {text}" for text, n in Counter(t for _, t in refused).most_common()),
        *[f"- {name}: {text}" for name, text in refused][:MAX_LINES],
        "## Warnings",
        *warnings[:MAX_LINES],
    ]
    return console.visible("\n".join(lines)) + "\n"


COMMAND = Command("import", run, HELP)
main = COMMAND.main
