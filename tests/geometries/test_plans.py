"""Imported floor plans: what each format becomes, and hostile files."""

import io
import json
import tarfile
import tracemalloc
from pathlib import Path

import draw_plans
import numpy as np
import pytest
import yaml

from megastep import cubicasa as original
from megastep import geometries, toys
from megastep.agents.cli import entry
from megastep.geometries import checks, imported

imports = pytest.importorskip(
    "megastep.geometries.plans.imports", reason="needs the extra plans", exc_type=ImportError
)
safe, Options = imports.safe, imports.Options
maps, outlines, shapely = imports.maps, imports.outlines, imports.shapely

HOSTILE = Path(__file__).parents[1] / "data" / "hostile"
EXPECTED = json.loads((HOSTILE / "EXPECTED.json").read_text())
SHARED = Path(__file__).parents[3] / "shared" / "data"
#: Of files that are refused, words of the sentence.
REFUSED = {
    "bad_points_0.svg": "is no number",
    "bad_points_1.svg": "odd number",
    "no_spaces.svg": "no room",
    "no_walls.svg": "no wall",
    "empty_floorplan.svg": "empty",
    "empty_file.svg": "empty",
    "truncated.svg": "cut short",
    "billion_laughs.svg": "DOCTYPE or entities",
    "external_entity.svg": "DOCTYPE or entities",
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
    assert safe.xml(b"<svg>" + b"<g/>" * 49 + b"</svg>") is not None
    with pytest.raises(ValueError, match="or 50$"):
        safe.xml(b"<svg>" + b"<g/>" * 50 + b"</svg>")


def test_rooms_without_doors_have_walls():
    (g,) = plan_of("ok_closed_room_needs_interior_ring.svg").geometries
    assert len(g.walls) == 12, "two rooms and the outline"
    assert g.masks.max() == len(g.lights) == 1, "nobody can be in both"


def test_repaired_and_crowded_plans_are_sound():
    for name in ("ok_bowtie_space.svg", "many_walls.svg"):
        (g,) = plan_of(name).geometries
        assert np.isfinite(g.walls).all() and g.masks.max() >= 1, "which has been checked"


def test_floors_are_geometries_or_one():
    two = plan_of("ok_two_floors_side_by_side_hidden.svg")
    assert [g.masks.max() for g in two.geometries] == [2, 2]
    (one,) = plan_of("ok_two_floors_side_by_side_hidden.svg", per="file", sealed=False).geometries
    assert one.masks.max() == 4 and np.ptp(one.walls[..., 0]) > 12


def test_houseexpo():
    (g,) = plan_of("houseexpo_ok.json").geometries
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


def test_archive_becomes_a_database(data_folder, capsys, monkeypatch):
    words = ("source=cubicasa", f"path={HOSTILE / 'ok_archive.zip'}")
    assert run(*words) == 2 and "licence=accept" in capsys.readouterr().err
    assert not data_folder.exists()
    assert run(*words, "licence=accept") == 0
    assert "2 floor plans of 2 files" in capsys.readouterr().out
    names = sorted(path.name.split("-")[0] for path in data_folder.iterdir())
    assert names == ["cubicasa", "cubicasa.md", "cubicasa.png", "cubicasa.sha256"]
    (npz,) = data_folder.glob("*.npz")
    assert entry.run_command("check", [f"path={npz}"]) == 0
    plans = geometries.sample("cubicasa", 3, "all")
    expected = plan_of("ok_two_rooms.svg").geometries[0]
    for g in plans:
        np.testing.assert_allclose(g.walls, expected.walls, atol=1e-6)
        np.testing.assert_array_equal(g.masks, expected.masks)
    assert len(original.sample(2, source="cubicasa")) == 2
    assert original.sample(1)[0].id == geometries.sample("homes", 1)[0].id
    parts = geometries.sample("suite", 4, "test", parts={"box": 1}, plans="cubicasa")
    assert [g.source for g in parts].count("cubicasa") == 2
    npz.write_bytes(npz.read_bytes()[:-1] + b"\0\0")
    (data_folder / "cubicasa.sha256").touch()
    with pytest.raises(ValueError, match="wrong sha256.*import source=cubicasa"):
        geometries.sample("cubicasa", 1)


def test_floors_of_a_file_are_in_one_split(data_folder):
    data_folder.mkdir(parents=True)
    plans = [toys.box(3 + i / 100) for i in range(60)]
    for g in plans:
        g["doors"] = np.zeros((0, 2, 2))
    imported.write("houseexpo", plans, [i // 3 for i in range(60)])
    split = {
        name: {g.id // 3 for g in geometries.sample("houseexpo", 60, name)}
        for name in ("training", "test")
    }
    assert len(split["training"]) == 18 and len(split["test"]) == 2
    assert split["training"].isdisjoint(split["test"])
    first, again = (geometries.sample("houseexpo", 5, seed=3) for _ in range(2))
    assert [g.id for g in first] == [g.id for g in again]


def archive_of(path, members):
    with tarfile.open(path, "w:gz") as archive:
        for name, content in members.items():
            entry = tarfile.TarInfo(name)
            entry.size = len(content)
            archive.addfile(entry, io.BytesIO(content))
    return path


def test_a_refused_file_stops_no_other(tmp_path, data_folder, capsys):
    good = (HOSTILE / "houseexpo_ok.json").read_bytes()
    bad = (HOSTILE / "houseexpo_nan.json").read_bytes()
    large = good.replace(b"7.1", b"3100")
    path = archive_of(tmp_path / "json.tar.gz", {"a.json": bad, "b.json": good, "c.json": large})
    assert run("source=houseexpo", f"path={path}", "licence=accept") == 0
    report = (data_folder / "houseexpo.md").read_text()
    assert "a.json: it has the number NaN" in report and "check the scale" in report
    cut = tmp_path / "cut.tar.gz"
    cut.write_bytes(path.read_bytes()[:-30])
    before = (data_folder / "houseexpo.sha256").read_bytes()
    capsys.readouterr()
    assert run("source=houseexpo", f"path={cut}", "licence=accept") == 2
    assert "cut short" in capsys.readouterr().err
    assert (data_folder / "houseexpo.sha256").read_bytes() == before


@pytest.mark.parametrize(
    "words, sentence",
    [
        (["path=x.zip"], "source: is missing"),
        (["source=cubicas", "path=x.zip"], "did you mean cubicasa"),
        (["source=cubicasa", "path=none.zip"], "does not exist"),
        (["source=cubicasa", f"path={HOSTILE / 'traversal.zip'}"], "leads out of the archive"),
        (["source=houseexpo", f"path={HOSTILE / 'ok_archive.zip'}"], "no floor plan"),
        (["source=cubicasa", f"path={HOSTILE / 'empty_file.svg'}"], "it is empty"),
    ],
)
def test_bad_words(words, sentence, capsys, tmp_path, data_folder):
    assert run(*words, "licence=accept") == 2
    err = capsys.readouterr().err
    assert sentence in err and err.count("\n") <= 2
    assert not data_folder.exists() or list(data_folder.iterdir()) == []


def test_a_folder_that_cannot_be_written(capsys, data_folder):
    data_folder.parent.write_text("a file")
    words = ("source=cubicasa", f"path={HOSTILE / 'ok_archive.zip'}", "licence=accept")
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
    options = Options("cubicasa")
    plan = imports.read(options, member)
    (g,), (notes,) = plan.geometries, plan.notes
    assert "1 floors are left out: it " in notes.warnings[0] and warning in notes.warnings[0]
    np.testing.assert_array_equal(imports.first_home(options, member)[1].walls, g.walls)


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
    areas = [imports.statistics(g)["floor area of rooms, m²"] for g in homes[:8]]
    assert 25 < min(areas) and max(areas) < 120, "100 units are a metre"


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
    path = archive_of(tmp_path / "json.tar.gz", members)
    counts: list[int] = []
    one, two = (imports.run(Options("houseexpo"), path, counts.append, n)[0] for n in (1, 2))
    assert [plan.name for plan in one] == [plan.name for plan in two] == sorted(members)
    for a, b in zip(one, two, strict=True):
        assert a.refusal == b.refusal and len(a.geometries) == len(b.geometries)
        for g, h in zip(a.geometries, b.geometries):
            np.testing.assert_array_equal(g.walls, h.walls)
    assert counts[-1] == 60
