"""Imported floor plans: what each format becomes, and hostile files."""

import json
import shutil
import tracemalloc
from pathlib import Path

import draw_plans
import numpy as np
import pytest
import yaml
from PIL import Image

from megastep import cubicasa as original
from megastep import geometries, geometry, toys
from megastep.agents import console
from megastep.agents.cli import entry
from megastep.geometries import checks, databases

imports = pytest.importorskip(
    "megastep.geometries.plans.imports", reason="needs the extra plans", exc_type=ImportError
)
safe, Options = imports.safe, imports.Options
maps, outlines, shapely = imports.maps, imports.outlines, imports.outlines.shapely

HOSTILE = Path(__file__).parents[1] / "data" / "hostile"
EXPECTED = json.loads((HOSTILE / "EXPECTED.json").read_text())
SHARED = Path(__file__).parents[3] / "shared" / "data"
#: Of files that are refused, words of the sentence.
REFUSED = {
    "bad_points_0.svg": "is not finite",
    "bad_points_1.svg": "odd number",
    "no_spaces.svg": "no room",
    "no_walls.svg": "no wall",
    "empty_floorplan.svg": "empty",
    "empty_file.svg": "empty",
    "truncated.svg": "cut short",
    "billion_laughs.svg": "entities",
    "external_entity.svg": "entities",
    "deep_nesting.svg": "within one another",
    "huge_extent.svg": "above 1e",
    "houseexpo_few_verts.json": "2 corners",
    "houseexpo_nan.json": "NaN",
}
SAME = [name for name, case in EXPECTED.items() if "same answer" in case["expect"]]


@pytest.fixture(autouse=True)
def data_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    return tmp_path / "data" / "megastep"


def plan_of(name, **options):
    options["source"] = "houseexpo" if name.endswith("json") else "cubicasa"
    content = (HOSTILE / name).read_bytes()
    return imports.read(Options(**options), safe.Member(name, content))


def test_two_rooms():
    for sealed, n_walls in ((True, 16), (False, 20)):
        plan = plan_of("ok_two_rooms.svg", sealed=sealed)
        (g,), (notes,) = plan.geometries, plan.notes
        assert len(g.walls) == n_walls
        np.testing.assert_allclose(g.walls.min((0, 1)), 1, atol=1e-6)
        np.testing.assert_allclose(np.ptp(g.walls, axis=(0, 1)), (7.4, 3.4), atol=1e-5)
        assert notes.n_reachable == 2 and notes.n_sealed == sealed
        assert (g.lights[0, 0] < g.lights[1, 0]) and len(g.doors) == (1 if sealed else 2)
    g = plan_of("ok_two_rooms.svg").geometries[0]
    # the gap in the wall between the rooms, x from 5.2 to 5.3 m, is 0.9 m wide
    np.testing.assert_allclose(g.doors[0, :, 0], 5.25, atol=0.01)
    assert abs(g.doors[0, 0, 1] - g.doors[0, 1, 1]) == pytest.approx(0.9, abs=0.01)
    np.testing.assert_allclose(g.lights, [(3.2, 2.7), (6.75, 2.7)], atol=0.011)
    assert checks.errors(g) == []


@pytest.mark.parametrize("name", [*SAME, "bom_utf16.svg"])
def test_same_answer(name):
    expected, (g,) = plan_of("ok_two_rooms.svg").geometries[0], plan_of(name).geometries
    np.testing.assert_allclose(g.walls, expected.walls, atol=1e-5)
    np.testing.assert_array_equal(g.masks, expected.masks)


@pytest.mark.parametrize("name, words", REFUSED.items())
def test_refused(name, words):
    tracemalloc.start()
    plan = plan_of(name)
    assert tracemalloc.get_traced_memory()[1] < 1e8
    tracemalloc.stop()
    assert not plan.geometries and words in plan.refusal and "\n" not in plan.refusal


def test_files_of_too_many_elements_are_refused(monkeypatch):
    monkeypatch.setattr(safe, "MAX_ELEMENTS", 50)
    assert safe.svg(b"<svg>" + b"<g></g>" * 49 + b"</svg>") is not None
    with pytest.raises(ValueError, match="more than 50 elements"):
        safe.svg(b"<svg>" + b"<g></g>" * 50 + b"</svg>")


def test_rooms_without_doors_have_walls():
    (g,) = plan_of("ok_closed_room_needs_interior_ring.svg").geometries
    assert len(g.walls) == 12, "two rooms and the outline"
    assert g.masks.max() == len(g.lights) == 1, "nobody can be in both"


def test_repaired_and_crowded_plans_are_sound():
    for name in ("ok_bowtie_space.svg", "many_walls.svg"):
        (g,) = plan_of(name).geometries
        assert np.isfinite(g.walls).all() and g.masks.max() >= 1, "which has been checked"


def test_floors_are_geometries():
    two = plan_of("ok_two_floors_side_by_side_hidden.svg")
    assert [g.masks.max() for g in two.geometries] == [2, 2]


@pytest.mark.parametrize("sealed", [True, False])
def test_houseexpo(sealed):
    (g,) = plan_of("houseexpo_ok.json", sealed=sealed).geometries
    # the outline of 27.7 m2 is its walls
    x, y = g.walls.astype(float).reshape(-1, 2).T
    assert len(g.walls) == 12 and g.masks.max() == 2
    lengths = np.hypot(*(g.walls[:, 1] - g.walls[:, 0]).T)
    assert lengths.sum() == pytest.approx(2 * (7 + 4) + 2 * 3 + 2 * 0.1 - 2 * 0.1, abs=0.3)
    assert (x.min(), y.min(), x.max(), y.max()) == pytest.approx((1, 1, 8, 5))
    np.testing.assert_allclose(g.doors, [[(5.05, 2), (5.05, 3)]], atol=0.01)


def test_doorways_of_houseexpo():
    """A stub of a wall leaves a doorway of 1 m; a corner, a niche and a wide gap are none."""
    verts = [(0, 0), (8, 0), (8, 5), (6, 5), (6, 4.5), (5, 4.5), (5, 5), (4.1, 5), (4.1, 1), (4, 1)]
    verts += [(4, 5), (0, 5), (0, 3), (1, 3), (1, 2.9), (0, 2.9)]
    plan = json.dumps({"verts": verts, "room_category": {"room": [[0, 0, 4, 5], [4.1, 0, 8, 5]]}})
    (g,) = imports.read(Options("houseexpo"), safe.Member("a.json", plan.encode())).geometries
    np.testing.assert_allclose(g.doors, [[(5.05, 1), (5.05, 2)]], atol=0.01)


def run(*words):
    return entry.run_command("import", list(words))


@pytest.fixture
def homes(tmp_path):
    """A folder of two files."""
    for name in ("a/model.svg", "b/model.svg"):
        (tmp_path / "homes" / name).parent.mkdir(parents=True)
        shutil.copy(HOSTILE / "ok_two_rooms.svg", tmp_path / "homes" / name)
    return tmp_path / "homes"


def test_a_folder_becomes_a_database(homes, data_folder, capsys, monkeypatch):
    words = ("source=cubicasa", f"path={homes}")
    assert run(*words) == 2 and "licence=accept" in capsys.readouterr().err
    assert not data_folder.exists()
    monkeypatch.setattr(console, "LINE_EVERY", 0)
    assert run(*words, "licence=accept") == 0
    out = capsys.readouterr().out
    assert "\n2 of 2 files" in out and "2 floor plans of 2 files" in out
    names = sorted(path.name for path in data_folder.iterdir())
    assert names == ["cubicasa.md", "cubicasa.npz", "cubicasa.png"]
    npz = data_folder / "cubicasa.npz"
    elsewhere = shutil.copy(npz, data_folder.parent / "copied.npz")
    assert entry.run_command("check", [f"path={elsewhere}"]) == 0
    plans = geometries.sample("cubicasa", 3, "all")
    expected = plan_of("ok_two_rooms.svg").geometries[0]
    for g in plans:
        np.testing.assert_allclose(g.walls, expected.walls, atol=1e-6)
        np.testing.assert_array_equal(g.masks, expected.masks)
    assert len(original.sample(2, source="cubicasa")) == 2
    assert original.sample(1)[0].id == geometries.sample("homes", 1)[0].id
    parts = geometries.sample("suite", 4, "test", parts={"box": 1}, plans="cubicasa")
    assert [g.source for g in parts].count("cubicasa") == 2
    npz.write_bytes(npz.read_bytes()[:-100])
    with pytest.raises(ValueError, match="cubicasa.npz' cannot be read.*import source=cubicasa"):
        geometries.sample("cubicasa", 1)


def test_floors_of_a_file_are_in_one_split(data_folder):
    data_folder.mkdir(parents=True)
    plans = [toys.box(3 + i / 100) for i in range(60)]
    for g in plans:
        g["doors"] = np.zeros((0, 2, 2))
    databases.write_imported("houseexpo", plans, [i // 3 for i in range(60)])
    split = {
        name: {g.id // 3 for g in geometries.sample("houseexpo", 60, name)}
        for name in ("training", "test")
    }
    assert len(split["training"]) == 18 and len(split["test"]) == 2
    assert split["training"].isdisjoint(split["test"])
    first, again = (geometries.sample("houseexpo", 5, seed=3) for _ in range(2))
    assert [g.id for g in first] == [g.id for g in again]


def test_a_refused_file_stops_no_other(tmp_path, data_folder):
    good = (HOSTILE / "houseexpo_ok.json").read_bytes()
    bad = (HOSTILE / "houseexpo_nan.json").read_bytes()
    large = good.replace(b"7.1", b"3100")
    for name, content in {"a": bad, "b": good, "c": large}.items():
        (tmp_path / f"{name}.json").write_bytes(content)
    assert run("source=houseexpo", f"path={tmp_path}", "licence=accept") == 0
    report = (data_folder / "houseexpo.md").read_text()
    assert "a.json: it has the number NaN" in report and "check the scale" in report


@pytest.mark.parametrize(
    "words, sentence",
    [
        (["path=x.zip"], "source: is missing"),
        (["source=cubicas", "path=x.zip"], "did you mean cubicasa"),
        (["source=cubicasa", "path=none"], "does not exist"),
        (["source=cubicasa", "path=homes.zip"], "is an archive; unpack it, and give its folder"),
        (["source=houseexpo", f"path={Path(__file__).parent}"], "no floor plan"),
        (["source=cubicasa", f"path={HOSTILE / 'empty_file.svg'}"], "it is empty"),
    ],
)
def test_bad_words(words, sentence, capsys, data_folder, here):
    (here / "homes.zip").touch()
    assert run(*words, "licence=accept") == 2
    err = capsys.readouterr().err
    assert sentence in err and err.count("\n") <= 2
    assert not data_folder.exists() or list(data_folder.iterdir()) == []


def test_a_folder_that_cannot_be_written(capsys, data_folder):
    data_folder.parent.write_text("a file")
    words = ("source=cubicasa", f"path={HOSTILE}", "licence=accept")
    assert run(*words) == 2 and "cannot be written" in capsys.readouterr().err


@pytest.mark.parametrize(
    "fault, warning",
    [
        (('id="Floor-1"', 'id="Floor-1" transform="scale(40)"'), "check the scale"),
        (('class="Wall', 'class="Fence'), "it has no wall"),
        (('class="Space', 'class="Place'), "it has no room"),
    ],
)
def test_a_floor_that_is_no_home_stops_no_other(fault, warning):
    text = (HOSTILE / "ok_two_floors_side_by_side_hidden.svg").read_text()
    first, mark, second = text.partition('id="Floor-2"')
    member = safe.Member("house.svg", (first.replace(*fault) + mark + second).encode())
    plan = imports.read(Options("cubicasa"), member)
    (g,), (notes,) = plan.geometries, plan.notes
    assert "1 floors are left out: it " in notes.warnings[0] and warning in notes.warnings[0]
    np.testing.assert_array_equal(imports._home(plan.drawing, True, 0.005)[0].walls, g.walls)


@pytest.mark.skipif(not SHARED.exists(), reason="the floor plans are not beside the repository")
def test_real_plans_are_sound():
    members = [*safe.members(SHARED / "cubicasa", ".svg")]
    plans = [imports.read(Options("cubicasa"), member) for member in members]
    assert sum(len(plan.geometries) for plan in plans) == 8
    some = [*safe.members(SHARED / "houseexpo", ".json")][:12]
    plans += [imports.read(Options("houseexpo"), member) for member in some]
    homes = [g for plan in plans for g in plan.geometries]
    assert len(homes) == 20 and not any(plan.refusal for plan in plans)
    assert [error for g in homes for error in checks.errors(g)] == []
    sizes = [np.ptp(g.walls, axis=(0, 1)).max() for g in homes[:8]]
    assert 5 < min(sizes) and max(sizes) < 30, "100 units are a metre"


# ---- Plans of one's own ----


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    folder = tmp_path_factory.mktemp("drawn")
    draw_plans.main(folder)
    return folder


@pytest.mark.parametrize(
    "name, n_rooms, size, n_doors, warning",
    [
        ("curved.svg", 2, (8, 8.25), 1, ""),
        ("millimetres.svg", 3, (9.15, 7.15), 0, ""),
        ("transformed.svg", 3, (6, 10), 0, "1 openings lead outside, 0.9 m wide"),
        ("scan.png", 3, (10, 6), 0, "turned by -3."),
        ("slam.yaml", 3, (9.4, 5.4), 0, ""),
        ("partly.yaml", 3, (9.4, 5.4), 0, "edge is unknown"),
    ],
)
def test_drawings_and_maps(drawn, name, n_rooms, size, n_doors, warning, here, capsys):
    file = here / "home.npz"
    words = [f"path={drawn / name}", f"file={file}", *draw_plans.WORDS[name]]
    assert run(*words) == 0
    assert warning in capsys.readouterr().err
    (g,) = geometries.sample("files", 1, path=file)
    assert checks.errors(g) == [] and g.masks.max() == n_rooms == len(g.lights)
    np.testing.assert_allclose(np.ptp(g.walls, axis=(0, 1)), size, atol=0.15)
    assert len(g.doors) == n_doors and (here / "home-sheet.png").exists()
    # no wall goes on beyond a doorway of 0.9 m: an agent walks through each
    lengths = np.hypot(*(g.walls[:, 1] - g.walls[:, 0]).T)
    assert lengths.min() > 0.009 and len(g.walls) < 100


def test_an_arc_is_within_2_cm(drawn):
    own = imports.own_svg(drawn / "curved.svg", 1)
    # the inner wall's corner is an arc of 1.1 m and 1 m around (4.6, 2.4) of the drawing
    points = own.geometry.walls.reshape(-1, 2) - own.geometry.walls.min((0, 1))
    height = np.ptp(own.geometry.walls[..., 1])
    radii = np.hypot(points[:, 0] - 4.6, height - points[:, 1] - 2.4)
    near = (points[:, 0] > 4.7) & (points[:, 0] < 5.65) & (height - points[:, 1] > 2.5)
    near &= height - points[:, 1] < 3.55
    assert near.sum() >= 8
    assert np.minimum(abs(radii[near] - 1), abs(radii[near] - 1.1)).max() < 0.02


@pytest.mark.parametrize(
    "name, words, sentence",
    [
        ("curved.svg", ["source=svg"], "scale is missing"),
        ("curved.svg", ["source=svg", "scale=400"], "check the scale"),
        ("curved.svg", ["source=svg", "scale=nan"], "scale: nan is out of range"),
        ("curved.svg", ["source=svg", "scale=1", "walls=mur"], "no shape is marked 'mur'"),
        ("curved.svg", ["source=svg", "scale=1", "metres_per_pixel=1"], "has no metres_per_pixel"),
        ("scan.png", ["source=map"], "needs metres_per_pixel"),
        ("scan.png", ["source=map", "metres_per_pixel=8"], "check the resolution"),
        ("slam.yaml", ["source=svg", "scale=1"], "no XML"),
        ("curved.svg", ["source=map", "metres_per_pixel=1"], "cannot be read"),
    ],
)
def test_bad_own_plans(drawn, name, words, sentence, here, capsys):
    assert run(f"path={drawn / name}", *words) == 2
    err = capsys.readouterr().err
    assert sentence in err and err.count("\n") <= 2 and not list(here.iterdir())


def test_name_with_blanks_is_quoted_where_the_next_command_is_printed(here, capsys):
    draw_plans.ros_map(here, "a", np.pad(np.full((40, 40), 254, np.uint8), 5), 0.1)
    assert run("source=map", "path=a.yaml", "file=my home.npz") == 0
    assert "use: geometry=files 'geometry.path=\"my home.npz\"'\n" in capsys.readouterr().out


def test_bad_maps(here, capsys):
    black = np.zeros((50, 50), np.uint8)
    cases = {"image: ../x.png\nresolution: 1": "there is no image", "- 1": "no 'image'"}
    cases["image: a.pgm\nresolution: x"] = "no number"
    cases["image: a.pgm\nresolution: 0.05"] = "all walls"
    for text, sentence in cases.items():
        draw_plans.ros_map(here, "a", black, 0.05)
        (here / "a.yaml").write_text(text)
        assert run("source=map", "path=a.yaml") == 2
        assert sentence in capsys.readouterr().err
    open_plan = '<svg><rect id="wall" width="9" height="0.2"/></svg>'
    (here / "open.svg").write_text(open_plan)
    assert run("source=svg", "path=open.svg", "scale=1") == 2
    assert "enclose no floor" in capsys.readouterr().err
    assert not list(here.glob("*.npz"))


def test_thresholds_of_ros_are_exclusive(here):
    """A cell is free below free_thresh and a wall above occupied_thresh. 51 / 255 is 0.2."""
    draw_plans.ros_map(here, "a", np.array([[50, 51, 204, 205]], np.uint8), 0.05)
    text = (here / "a.yaml").read_text()
    numbers = {"negate": 1, "free_thresh": 0.2, "occupied_thresh": 0.8}
    (here / "a.yaml").write_text(json.dumps({**yaml.safe_load(text), **numbers}))
    grid = maps.load(here / "a.yaml")
    assert grid.free.tolist() == [[True, False, False, False]]
    assert grid.unknown.tolist() == [[False, True, True, False]]


def test_lights_hang_in_their_rooms():
    """In the middle of a rectangle. The centroid of the other room, a U, is in the first."""
    inner, home = shapely.box(2, 2, 5, 6), shapely.box(0, 0, 7, 6)
    wall = inner.buffer(0.1, join_style="mitre") & home
    outer, door = home - wall, shapely.box(3, 1.9, 4, 2)
    drawing = outlines.Drawing([wall - inner], [inner, outer], [door], [])
    g, notes = outlines.geometry_of(drawing)
    assert notes.n_reachable == 2 and checks.errors(g) == []
    lights = g.lights.astype(float) - g.walls.min((0, 1))
    np.testing.assert_allclose(lights[0], (3.5, 4), atol=0.04)  # slits of 3 cm are closed
    assert outer.contains(shapely.Point(lights[1])) and not outer.contains(outer.centroid)


@pytest.mark.slow
def test_processes_give_what_one_gives(tmp_path):
    good, bad = ((HOSTILE / f"houseexpo_{name}.json").read_bytes() for name in ("ok", "nan"))
    members = {f"{i:03}.json": bad if i % 7 == 0 else good for i in range(60)}
    for name, content in members.items():
        (tmp_path / name).write_bytes(content)
    counts: list[int] = []
    one, two = (imports.run(Options("houseexpo"), tmp_path, counts.append, n) for n in (1, 2))
    assert [plan.name for plan in one] == [plan.name for plan in two] == sorted(members)
    for a, b in zip(one, two, strict=True):
        assert a.refusal == b.refusal and len(a.geometries) == len(b.geometries)
        for g, h in zip(a.geometries, b.geometries):
            np.testing.assert_array_equal(g.walls, h.walls)
    assert counts[-1] == 60


# ---- Drawings and maps of strangers, in several dialects ----

STRANGERS = HOSTILE.parent / "plans"
#: Of drawings, the size in metres and the width of the inner wall's gap. All have two rooms.
SIZES = {
    "15_style_transform": (4, 2.5, 0.45),
    "26_butt_narrow_door": (8, 5, 0.6),
}


def gap_of(g):
    """The width of the gap in the middle of the plan: its walls end there."""
    x, y = g.walls.reshape(-1, 2).T
    middle = y[np.abs(x - (x.min() + x.max()) / 2) < 0.45]
    centre = (y.min() + y.max()) / 2
    return middle[middle > centre].min() - middle[middle < centre].max()


@pytest.mark.parametrize("path", sorted(STRANGERS.glob("[0-9]*.svg")), ids=lambda p: p.stem)
def test_dialects_of_svg_give_the_same_plan(path):
    reference = imports.own_svg(STRANGERS / "00_reference.svg", 0.001)
    width, height, gap = SIZES.get(path.stem, (8, 5, 0.9))
    own = imports.own_svg(path, 0.001)
    assert own.geometry.masks.max() == 2 and own.warnings == []
    np.testing.assert_allclose(np.ptp(own.geometry.walls, axis=(0, 1)), (width, height), atol=1e-4)
    assert gap_of(own.geometry) == pytest.approx(gap, abs=0.01)
    if width == 8 and not any(word in path.stem for word in ("butt", "clone")):
        np.testing.assert_allclose(own.geometry.walls, reference.geometry.walls, atol=1e-4)


PEN = "fill:none;stroke:#000;stroke-width"
KINDS = "rect path line class use units font switch media stroke paint turn"


def drawn_as(kind, i, x, y, width, height):
    """A wall's elements, definitions and rules of style. Hidden shapes are beside some."""
    thick, box = min(width, height), f'x="{x}" y="{y}" width="{width}" height="{height}"'
    ends = (x, y + height / 2, x + width, y + height / 2)
    if width < height:
        ends = (x + width / 2, y, x + width / 2, y + height)
    line = " ".join(f'{key}="{v}"' for key, v in zip(("x1", "y1", "x2", "y2"), ends))
    path = f"M{ends[0]},{ends[1]} {ends[2]},{ends[3]}"
    defs, style, rect = "", "", f"<rect {box}"
    if kind == "rect":
        text = f"{rect}/>{rect} class='unseen' transform='scale(3)'/>"
    elif kind == "path":
        text = f'<path fill-rule="evenodd" d="M{x} {y}h{width}v{height}h{-width}z"/>'
    elif kind == "line":
        text = f'<path style="{PEN}:{thick}" d="{path}"/>'
    elif kind == "class":
        style = f"line.a{{stroke-width:7}} #w{i}.thick, b{{{PEN}:{thick}px}}"
        text = f'<line id="w{i}" class="a thick" stroke="red" {line}/>'
    elif kind == "use":
        defs = f'<g id="u{i}"><rect width="{width}" height="{height}" fill="red"/></g>'
        text = f'<use xlink:href="#u{i}" x="{x}" y="{y}"/>'
    elif kind == "units":
        mm = 96 / 25.4
        text = f'<rect x="{x / mm}mm" y="{y * 0.75}pt" width="{width / 96}in" height="{height}px"/>'
    elif kind == "font":
        text = f'<g font-size="125%"><rect x="{x / 20}em" y="{y}" width="{width / 20}em" '
        text += f'height="{height / 16}rem"/></g>'
    elif kind == "switch":
        text = f"<switch><path requiredExtensions='a:b' d='M0 0h9v9z'/>{rect}/>{rect} y='9'/>"
        text = text.replace(" y='9'", " transform='scale(2)'") + "</switch>"
    elif kind == "media":
        style = (
            f"@media print {{#m{i}{{display:none}}}} @media screen {{ #m{i} {{{PEN}:{thick}}} }}"
        )
        text = f'<polyline id="m{i}" points="{path[1:]}"/>'
    elif kind == "stroke":
        style = f"g.s > a>.x{i}{{{PEN}:{thick}!important;stroke-miterlimit:1}}"
        text = f'<g class="s"><a><path class="x{i}" style="stroke-width:1" d="{path}z"/></a></g>'
    elif kind == "paint":
        text = (
            f'<g visibility="hidden">{rect} transform="scale(2)"/>{rect} visibility="visible"/></g>'
        )
        text += (
            f'{rect[:-1]}9" style="opacity:0"/>{rect[:-1]}9" fill="#0000"/>{rect} opacity=".5"/>'
        )
    else:
        text = f'<rect x="{-y - height}" y="{x}" width="{height}" height="{width}" '
        text += 'style="transform:rotate(-.25turn)"/>'
    return text, defs, style


def drawing_of(kinds, turn, factor, unit, order):
    """A drawing of the plan of 00_reference.svg: its walls as elements of several kinds."""
    walls = [(0, 0, 8, 0.2), (0, 4.8, 8, 0.2), (0, 0, 0.2, 5), (7.8, 0, 0.2, 5)]
    walls += [(3.95, 0, 0.1, 2), (3.95, 2.9, 0.1, 2.1)]
    parts = [drawn_as(kinds[i], i, *(v * unit for v in walls[i])) for i in order]
    text, defs, style = map("".join, zip(*parts))
    return (
        '<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink">'
        f"<style>/* {{ */ g .unseen{{display:none}} {style}</style><defs>{defs}</defs>"
        f'<g class="wall" style="transform:scale({factor})"><g transform="{turn}">{text}</g></g>'
        "</svg>"
    )


def test_random_dialects_of_svg_give_the_same_plan():
    """Floors overlap by 99 %, and ends of walls are within 1 cm of those drawn as rectangles."""
    random, truths = np.random.default_rng(1), {}
    for _ in range(60):
        turn = str(random.choice(["", "rotate(90)", "scale(-1,1)"]))
        factor, unit = random.choice([0.5, 1, 4]), random.choice([1, 100, 1000])
        form = turn, factor, unit, random.permutation(6)
        plain = drawing_of(["rect"] * 6, *form)
        text = drawing_of(random.choice(KINDS.split(), 6), *form)
        (drawing, warnings), (truth, _) = (
            imports.svg.read(one.encode(), 1 / unit / factor) for one in (text, plain)
        )
        assert warnings == [], text
        union = shapely.union(drawing.floor, truth.floor).area
        assert shapely.intersection(drawing.floor, truth.floor).area > 0.99 * union, text
        if turn not in truths:
            truths[turn] = outlines.geometry_of(truth)[0].walls
            assert len(truths[turn]) == 16
        g, _ = outlines.geometry_of(drawing)
        ends, true_ends = (np.sort(w.reshape(-1, 2) @ (1, 1e-4j)) for w in (g.walls, truths[turn]))
        assert g.masks.max() == 2 and np.allclose(ends.real, true_ends.real, atol=0.01), text


@pytest.mark.parametrize(
    "smooth, spelt_out",
    [  # after another kind of curve, S and T begin straight ahead (SVG 2, 9.3.6 and 9.3.7)
        ("Q0 0 4 0S9 3 9 6", "Q0 0 4 0C4 0 9 3 9 6"),
        ("C0 0 2-2 4 0T9 6", "C0 0 2-2 4 0L9 6"),
        ("C0 0 2-2 4 0T9 0t0 6", "C0 0 2-2 4 0L9 0Q14 0 9 6"),
        ("C0 0 2-2 4 0s5 3 5 6", "C0 0 2-2 4 0C6 2 9 3 9 6"),
        ("Q0-2 4 0T9 6", "Q0-2 4 0Q8 2 9 6"),
    ],
)
def test_smooth_curves_go_on_from_their_own_kind(smooth, spelt_out):
    form = '<svg><path id="wall" fill="none" stroke="red" stroke-width=".2" d="M0 6{}L0 6z"/></svg>'
    floors = [imports.svg.read(form.format(d).encode(), 1)[0].floor for d in (smooth, spelt_out)]
    assert floors[0].symmetric_difference(floors[1]).area < 0.01 < 20 < floors[1].area


@pytest.mark.parametrize("d", ["M4 3h0", "M4 3z", "M4 3L4 3", "M1 1M4 3l0 0z"])
@pytest.mark.parametrize("cap, area", [("round", np.pi / 4), ("square", 1), ("butt", 0)])
def test_a_pillar_may_be_a_dot(d, cap, area):
    """Where a line has no length, its caps alone are drawn (SVG 2, 13.5.4)."""
    room = '<path id="wall" fill="none" stroke="red" stroke-width="1" d="M0 0h8v6h-8z{}"/>'
    text = f'<svg stroke-linecap="{cap}">{room}</svg>'
    floor = imports.svg.read(text.format(d).encode(), 1)[0].floor
    assert 7 * 5 - floor.area == pytest.approx(area, abs=0.01)


def test_auto_is_the_default_and_a_part_of_a_viewport_is_refused():
    room = '<path id="wall" fill="none" stroke="red" d="M0 0h8v6h-8z" stroke-width="{}"/>'
    pillar = '<rect id="wall-2" x="3" y="2" width="2" height="2" rx="{}" ry="1"/>'
    text = f"<svg>{room}{pillar}</svg>"
    floor = imports.svg.read(text.format(1, "auto").encode(), 1)[0].floor
    assert floor.area == pytest.approx(7 * 5 - np.pi, abs=0.02)
    with pytest.raises(ValueError, match="stroke-width='3%' is a part of a viewport, which is not"):
        imports.svg.read(text.format("3%", 1).encode(), 1)


def test_what_is_not_read_of_a_drawing_is_said():
    text = (STRANGERS / "00_reference.svg").read_text()
    for change, words in {
        '<g id="wall" clip-path="url(#a)">': "6 times clip-path",
        '<style>g:hover{fill:none}</style><g id="wall">': "the style 'g:hover'",
        '<g id="wall"><use href="#none"/>': "1 times use of what is not in the file",
        '<g id="wall"><svg><rect/></svg>': "1 times svg",
    }.items():
        _, (warning,) = imports.svg.read(text.replace('<g id="wall">', change).encode(), 0.001)
        assert warning.startswith("not read, ") and words in warning
    nested = text.replace("<g ", "<svg><g ").replace("</g>", "</g></svg>")
    with pytest.raises(ValueError, match="no shape is marked 'wall'.*; not read: 1 times svg"):
        imports.svg.read(nested.encode(), 0.001)


SVG = '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 100 100">{}</svg>'
USE = '<use href="#a{}"/>'  # a hundred million rectangles
USES = "".join(f'<g id="a{i}">{10 * USE.format(i - 1)}</g>' for i in range(1, 9))
SCRIBBLE = " ".join(map(str, np.random.default_rng(0).uniform(0, 99, 20_000).round(2)))


@pytest.mark.parametrize(
    "shapes, words",
    [
        ('<g id="wall"><use href="#wall"/></g>', "too many"),
        (
            f'<rect id="a0" width="1" height="1"/>{USES}<g id="wall"><use href="#a8"/></g>',
            "too many",
        ),
        ('<path id="wall" d="M0 0{}"/>'.format("a1 1 0 0 1 1 1" * 160_000), "characters"),
        (f'<polyline id="wall" stroke="#000" points="{SCRIBBLE}"/>', "cross one another"),
    ],
    ids=["cycle", "uses", "arcs", "scribble"],
)
def test_drawings_that_would_take_minutes_are_refused(shapes, words, monkeypatch):
    monkeypatch.setattr(imports.svg, "MAX_WORK", 100_000)
    with pytest.raises(ValueError, match=words):
        imports.svg.read(SVG.format(shapes).encode(), 1.0)


def test_a_file_that_takes_too_long_is_refused(monkeypatch):
    """Though its lines do not cross: GEOS, which nothing interrupts, takes a minute to grow it."""
    monkeypatch.setattr(imports, "SECONDS", 1)
    teeth = "".join(f"L{1 + i / 500} {90 if i % 2 else 2}" for i in range(40_000))
    comb = SVG.format(f'<rect width="9" height="9" id="wall-1"/><path id="wall" d="M1 1{teeth}z"/>')
    path = Path("comb.svg")
    monkeypatch.setattr(safe, "of_file", lambda *_: safe.Member(path.name, comb.encode()))
    with pytest.raises(ValueError, match="it takes more than 1 s to read"):
        imports.own_svg(path, 1.0)


@pytest.mark.parametrize("path", sorted(STRANGERS.glob("*.yaml")), ids=lambda p: p.stem)
def test_maps_of_ros(path):
    """A wall of one cell stays; modes, `negate` and numbers are read as map_server does."""
    own = imports.own_map(path)
    n_rooms, area, words = (3, 31, "2.5 m of") if "40" in path.stem else (2, 33.4, "")
    rooms = checks.fine_rooms(own.geometry)[1]
    assert own.geometry.masks.max() == n_rooms
    assert (rooms > 0).sum() * checks.FINE**2 == pytest.approx(area, rel=0.02)
    np.testing.assert_allclose(np.ptp(own.geometry.walls, axis=(0, 1)), (8, 5), atol=1e-4)
    assert words in "".join(own.warnings) and bool(own.warnings) == bool(words)


def test_modes_alpha_and_places_of_maps(here):
    """Beside `trinary`: `scale` counts between the thresholds, `raw` gives percents."""
    values = np.array([[255, 250, 200, 120, 30, 0]], np.uint8)
    (here / "elsewhere").mkdir()
    draw_plans.ros_map(here / "elsewhere", "a", values, 0.05)
    text = (here / "elsewhere" / "a.yaml").read_text()
    path = here / "b.yaml"

    def states(mode, image="elsewhere/a.pgm"):
        path.write_text(text.replace("a.pgm", image) + f"mode: {mode}\n")
        grid = maps.load(path)
        cells = np.select([grid.free, grid.unknown], list(".?"), "#")[0]
        return "".join(cells), len(grid.warnings)

    assert states("trinary") == ("..??##", 0)
    assert states("scale") == ("...###", 1)
    assert states("raw") == ("????..", 1)
    Image.merge("LA", [Image.fromarray(v) for v in (values, np.minimum(values, 120) * 2)]).save(
        here / "a.png"
    )
    assert states("scale", "/nowhere/a.png") == ("??????", 0)
    path.write_text(text + "mode: other\n")
    with pytest.raises(ValueError, match="trinary, scale and raw"):
        maps.load(path)


def test_changes_of_a_map_are_said_and_drawn(here):
    cells = np.full((60, 80), 0, np.uint8)
    cells[2:-2, 2:-2] = 254
    cells[20:22, 20:22] = 0  # a speck
    cells[2:-2, 40] = 0  # a wall of one cell
    cells[30:48, 40] = 254
    draw_plans.ros_map(here, "a", cells, 0.05)
    own = imports.own_map(here / "a.yaml")
    assert own.geometry.masks.max() == 2
    assert own.warnings == ["4 cells (0.01 m2) of specks are floor now"]
    coloured = np.argwhere((own.original == maps.TO_FLOOR).all(-1))
    assert coloured.tolist() == [[20, 20], [20, 21], [21, 20], [21, 21]]


@pytest.mark.parametrize("name", ["terrace_below", "terrace_right", "pillar"])
def test_rooms_outdoors_and_columns_of_cubicasa(name):
    (drawing,) = imports.cubicasa.read((STRANGERS / f"{name}.svg").read_bytes())
    g, _ = outlines.geometry_of(drawing, sealed=False, tolerance=0.005)
    cells = geometry.indices(g.lights, g.masks.shape, g.res)
    assert (g.masks[tuple(cells.T)] == np.arange(1, len(g.lights) + 1)).all()
    assert (len(g.walls), len(g.lights)) == ((12, 1) if name == "pillar" else (12, 2))


def blocks_of(seed, *boxes):
    """Returns blocks at (x, y, width, height) of a plan that is turned and moved, each from its
    middle: edges that touch are equal but for rounding, where GEOS's unions may lose one block.
    """
    random = np.random.default_rng(seed)
    angle, place = random.uniform(0, 2 * np.pi), random.uniform(-20, 20, 2)
    turn = np.array([(np.cos(angle), np.sin(angle)), (-np.sin(angle), np.cos(angle))])
    corners = np.array([(1, 1), (1, -1), (-1, -1), (-1, 1)])
    return [
        corners * (w / 2, h / 2) @ turn + (np.array([x, y]) @ turn + place) for x, y, w, h in boxes
    ]


@pytest.mark.parametrize("seed", [0, 1092, 1141, 2052])  # it lost one with all but 0
def test_no_block_of_a_slanted_wall_is_lost(seed):
    outer = [(4.5, -0.1, 9.4, 0.2), (4.5, 3.1, 9.4, 0.2), (-0.1, 1.5, 0.2, 3), (9.1, 1.5, 0.2, 3)]
    walls = blocks_of(seed, *outer, *((4.5, y, 1, 1) for y in (0.5, 1.5, 2.5)))
    drawing = outlines.enclosed([shapely.Polygon(corners) for corners in walls], [])
    assert drawing.floor.area == pytest.approx(24, abs=1e-3) and len(drawing.rooms) == 2


@pytest.mark.parametrize("seed", [0, 125, 128, 387])  # too
def test_no_part_of_a_slanted_path_is_lost(seed):
    rings = blocks_of(seed, (0, 0, 4, 3), (4, 0, 4, 3))
    assert outlines.area_of(rings).area == pytest.approx(24, abs=1e-3)
