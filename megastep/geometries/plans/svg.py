"""Reads a floor plan that somebody drew: an SVG whose walls, and doors if any, are marked by the
id, class or label of an element, or of a group or layer around it. They cover what a browser paints
there, so hidden and transparent shapes are none. Paths and matrices are those of svgelements.
"""

import re
from collections import Counter
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element

import numpy as np
import shapely
import svgelements
from shapely.geometry.base import BaseGeometry
from svgelements import Close, Color, CubicBezier, Line, Matrix, Move, Path, QuadraticBezier

from megastep.geometries.plans import outlines, safe
from megastep.geometries.plans.outlines import Drawing

LABELS = ("{http://www.inkscape.org/namespaces/inkscape}label", "data-name")
HREFS = ("href", "{http://www.w3.org/1999/xlink}href")
#: Elements that draw nothing where they are, or nothing that is a wall.
SKIPPED = (
    *("defs", "clipPath", "mask", "marker", "pattern", "style", "script", "text"),
    *("foreignObject", "linearGradient", "radialGradient", "metadata", "namedview"),
)
#: What changes a shape and is not read. Elements have it from those around them, to be counted.
UNREAD = {"clip-path": "none", "mask": "none", "stroke-dasharray": "none", "transform-origin": ""}
#: Properties that elements inherit, and those that they do not.
INHERITED = {
    **UNREAD,
    **{"fill": "black", "fill-rule": "nonzero", "fill-opacity": "1", "color": "black"},
    **{"stroke": "none", "stroke-width": "1", "stroke-opacity": "1", "stroke-linecap": "butt"},
    **{"stroke-linejoin": "miter", "stroke-miterlimit": "4", "visibility": "visible"},
    "font-size": "16",  # pixels of an em
}
OWN = {"display": "inline", "opacity": "1", "transform": "", "vector-effect": "none"}
#: Pixels of a unit, of which 96 are an inch.
UNITS = {"px": 1, "in": 96, "cm": 96 / 2.54, "mm": 96 / 25.4, "pt": 4 / 3, "pc": 16, "rem": 16}
LENGTH = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?)(%|[a-z]*)", re.I)
RULE = re.compile(r"([^{}]+)\{([^{}]*)\}")
#: What is ignored: comments, fonts, other files, and styles of other media than screens.
IGNORED = re.compile(
    r"/\*.*?\*/|<!--|-->|@(?:import|charset)[^;]*;|@font-face[^}]*\}"
    r"|@media(?!\s+(?:screen|all)\s*\{)[^{]*\{(?:[^{}]*\{[^{}]*\})*[^{}]*\}",
    re.S,
)
MEDIA = re.compile(r"@media[^{]*\{((?:[^{}]*\{[^{}]*\})*)[^{}]*\}")
COMPOUND = re.compile(r"(>?)(\*|[\w-]+)?((?:[.#][\w-]+)*)")
CURVE = np.linspace(0, 1, 49)  # points of a curve, which are simplified later
CAPS = {"round": "round", "square": "square"}
#: Elements with the attributes that are their shape, of which two of an ellipse or a rounded
#: rectangle have the other as default.
SHAPES = {
    "rect": (svgelements.Rect, ("x", "y", "width", "height", "rx", "ry")),
    "circle": (svgelements.Circle, ("cx", "cy", "r")),
    "ellipse": (svgelements.Ellipse, ("cx", "cy", "rx", "ry")),
    "line": (svgelements.SimpleLine, ("x1", "y1", "x2", "y2")),
}
DEFAULTS = {"rx": "ry", "ry": "rx"}
MAX_PATHS = 1 << 19  # characters of all marked paths
MAX_SHAPES = 20_000
MAX_WORK = 2_000_000  # of elements, each of which costs as much as VISIT rules of style
VISIT = 20


class _Place(NamedTuple):
    """Where an element is: what it gets from those around it."""

    matrix: Matrix
    style: dict[str, str]
    opacity: float
    kind: str  # of a marked group around it
    chain: tuple  # (name, words) of the elements around it


def read(
    content: bytes, scale: float, walls: str = "wall", doors: str = "door"
) -> tuple[Drawing, list[str]]:
    """Returns the drawing of an SVG, `scale` metres per unit after all transforms, and what of it
    is not read. Walls, and doors in gaps of these or upon them, have a mark: an id, perhaps
    followed by a number, a word of the class, or a label of Inkscape or Illustrator. Raises
    ValueError.
    """
    reader = _Reader(safe.svg(content), scale, {"walls": walls, "doors": doors})
    unread = ", ".join(f"{n} times {name}" for name, n in reader.unread.items())
    if not reader.shapes["walls"]:
        raise ValueError(
            f"no shape is marked {walls!r} by id, class or label; walls= names another mark"
            + bool(unread) * f"; not read: {unread}"
        )
    outlines.check_extent(reader.shapes["walls"])
    warnings = [f"not read, so drawn otherwise in a browser: {unread}"] * bool(unread)
    return outlines.enclosed(reader.shapes["walls"], reader.shapes["doors"]), warnings


def tokens(element: Element) -> list[str]:
    """Returns the words of an element's class."""
    return (element.get("class") or "").split()


def transform(text: str | None, above: Matrix) -> Matrix:
    """Returns a transform within one. Raises ValueError if it is not finite."""
    if not text or text == "none":
        return above
    matrix = Matrix(text)
    matrix.render(ppi=96, width=0, height=0)
    matrix = matrix * above
    if not np.isfinite([matrix.a, matrix.b, matrix.c, matrix.d, matrix.e, matrix.f]).all():
        raise ValueError(f"transform {text[:40]!r} is not finite")
    return matrix


def apply(matrix: Matrix, points: np.ndarray) -> np.ndarray:
    """Returns points (P, 2) after a transform."""
    linear = np.array([[matrix.a, matrix.b], [matrix.c, matrix.d]])
    return points @ linear + (matrix.e, matrix.f)


def length(text: str, em: float = 16, whole: float = 1) -> float:
    """Returns a length in pixels, or a fraction of `whole`. Raises ValueError."""
    match = LENGTH.fullmatch(text.strip())
    sizes = UNITS | {"": 1, "%": whole / 100, "em": em}
    if not match or match[2].lower() not in sizes:
        raise ValueError(f"{text[:40]!r} is no length that is read")
    return float(match[1]) * sizes[match[2].lower()]


def _size(key, text, em) -> float:
    """Returns a length that is no part of a viewport."""
    if "%" in text:
        raise ValueError(f"{key}={text[:20]!r} is a part of a viewport, which is not read")
    return length(text, em)


def is_marked(element: Element, mark: str) -> bool:
    """True if an element's id, class or label is the mark, in any case."""
    mark = mark.lower()
    words = [*tokens(element), *(element.get(label) or "" for label in LABELS)]
    name = (element.get("id") or "").lower()
    is_id = re.fullmatch(rf"{re.escape(mark)}s?[-_ ]?\d*_?", name) is not None
    return is_id or any(word.lower() in (mark, f"{mark}s") for word in words)


def declarations(text: str) -> tuple[dict[str, str], dict[str, str]]:
    """Returns the properties of a style, and the important ones."""
    found: tuple[dict, dict] = {}, {}
    for key, _, value in (one.partition(":") for one in text.split(";")):
        value, mark, _ = value.partition("!important")
        if value.strip():
            found[bool(mark)][key.strip().lower()] = value.strip()
    return found


def is_painted(paint: str, opacity: str) -> bool:
    """True if a fill or stroke can be seen."""
    paint, fallback = re.sub(r"url\([^)]*\)", "", paint).strip().lower(), "url(" in paint
    if paint in ("none", "transparent") or length(opacity) <= 0:
        return False
    if "/" in paint:  # as in rgb(0 0 0 / 0%)
        return length(paint.partition("/")[2].strip(" )")) > 0
    return fallback or Color(paint).alpha != 0


class _Reader:
    """Collects the marked shapes of a document, in metres with y up."""

    def __init__(self, root, scale, marks) -> None:
        self.scale, self.marks = np.array((scale, -scale)), marks
        self.shapes: dict[str, list[BaseGeometry]] = {key: [] for key in marks}
        self.unread: Counter[str] = Counter()
        self.n_characters = self.n_shapes = self.n_corners = self.meetings = self.work = 0
        self.ids, self.rules = {}, []
        for element in root.iter():
            self.ids.setdefault(element.get("id"), element)
            if safe.name_of(element) == "style":
                self._add_rules(element.text or "")
        self.rules.sort(key=lambda rule: rule[0])
        self._visit(root, _Place(Matrix(), INHERITED, 1.0, "", ()))

    def _add_rules(self, text) -> None:
        for selectors, body in RULE.findall(MEDIA.sub(r"\1", IGNORED.sub("", text))):
            for selector in selectors.split(","):
                words = re.sub(r"\s*>\s*", " >", selector.strip()).split()
                parts = [COMPOUND.fullmatch(word) for word in words]
                if not parts or None in parts:
                    self.unread[f"the style {selector.strip()[:40]!r}"] += 1
                    continue
                found = [(p[1], p[2], re.findall(r"[.#][\w-]+", p[3])) for p in parts if p]
                names = [name for *_, names in found for name in names]
                n_ids = sum(name[0] == "#" for name in names)
                n_tags = sum(tag not in (None, "*") for _, tag, _ in found)
                rank = n_ids, len(names) - n_ids, n_tags
                self.rules.append((rank, found, declarations(body)))

    def _declared(self, element, chain) -> dict[str, str]:
        """Returns the attributes of an element after those of rules and of its own style."""
        sheets = [body for _, parts, body in self.rules if _matches(parts, chain)]
        sheets.append(declarations(element.get("style") or ""))
        found = {**element.attrib}
        for is_important in (False, True):
            for body in sheets:
                found |= body[is_important]
        return {key: value for key, value in found.items() if value != "auto"}  # the default

    def _visit(self, element, place) -> None:
        """Collects what is in an element."""
        name = safe.name_of(element)
        if name in SKIPPED:
            return
        if name == "symbol" or name == "svg" and place.chain:
            self.unread[name] += 1
            return
        self.work += VISIT + len(self.rules)
        if self.work > MAX_WORK or len(place.chain) > safe.MAX_DEPTH:
            raise ValueError("its elements, each times the rules of its style, are too many")
        ids = [f"#{element.get('id')}"] * ("id" in element.attrib)
        chain = (*place.chain, (name, {*ids, *(f".{word}" for word in tokens(element))}))
        own = self._declared(element, chain)
        style = {
            k: v if own.get(k, "inherit") == "inherit" else own[k] for k, v in place.style.items()
        }
        for key in ("fill", "stroke"):
            if style[key].lower() == "currentcolor":
                style[key] = style["color"]
        above = float(place.style["font-size"])
        is_length = LENGTH.fullmatch(style["font-size"])
        em = length(style["font-size"], above, above) if is_length else above
        style["font-size"] = str(em)
        once = {key: own.get(key, value) for key, value in OWN.items()}
        if once["display"] == "none":
            return
        opacity = place.opacity * length(once["opacity"])
        marked = [key for key, mark in self.marks.items() if is_marked(element, mark)]
        kind, matrix = (*marked, place.kind)[0], transform(once["transform"], place.matrix)

        def of(key, default: Any = 0) -> float:
            return _size(key, str(own.get(key, default)), em)

        place = _Place(matrix, style, opacity, kind, chain)
        if name == "use":
            href = next((own[key] for key in HREFS if key in own), "")
            target = self.ids.get(href[1:]) if href[:1] == "#" else None
            if target is None:
                self.unread["use of what is not in the file"] += bool(kind)
                return
            moved = transform(f"translate({of('x')}, {of('y')})", matrix)
            self._visit(target, place._replace(matrix=moved))
        elif kind and style["visibility"] == "visible" and opacity > 0:
            self._paint(name, own, of, place, once["vector-effect"] == "non-scaling-stroke")
        children = [child for child in element if "requiredExtensions" not in child.attrib]
        for child in children[: {"use": 0, "switch": 1}.get(name)]:
            self._visit(child, place)

    def _paint(self, name, own, of, place, is_fixed) -> None:
        """Adds what a shape covers: its fill and its stroke."""
        style, shapes = place.style, []
        lines = self._outline(name, own, of)

        def metres(points) -> np.ndarray:
            return apply(place.matrix, points) * self.scale

        area = abs(place.matrix.a * place.matrix.d - place.matrix.b * place.matrix.c)
        if area < 1e-12 or not lines:
            return
        self.unread.update(key for key, value in UNREAD.items() if style[key] not in (value, "0"))
        self.n_shapes += 1
        self.n_corners += sum(len(line) for line, _ in lines)
        if self.n_shapes > MAX_SHAPES or self.n_corners > outlines.MAX_CORNERS:
            raise ValueError(
                f"it marks more than {MAX_SHAPES:,} shapes, or {outlines.MAX_CORNERS:,} corners"
            )
        drawn = [shapely.LineString([*line, line[0]]) for line, _ in lines]
        if is_painted(style["fill"], style["fill-opacity"]):
            rings = [metres(line) for line, _ in lines if len(line) > 2]
            first = shapely.Polygon(rings[0] if rings else None)
            if len(rings) > 1 or not first.is_valid:
                self.meetings = outlines.check_meetings(drawn, self.meetings)
                first = outlines.area_of(rings, style["fill-rule"] == "evenodd")
            shapes.append(first)
        has_stroke = is_painted(style["stroke"], style["stroke-opacity"])
        width = style["stroke-width"] if has_stroke else "0"
        width = _size("stroke-width", width, float(style["font-size"]))
        if width > 0:
            size = self.scale[0] * (1 if is_fixed else area**0.5)
            half = max(width, outlines.GRID / size) / 2
            self.meetings = outlines.check_meetings(drawn, self.meetings)
            to_metres = (lambda points: points * self.scale) if is_fixed else metres
            for line, is_closed in lines:
                line = apply(place.matrix, line) if is_fixed else line
                stroke = _stroke(line, is_closed, half, style)
                shapes.append(shapely.transform(stroke, to_metres))
        self.shapes[place.kind] += [shape for shape in shapes if not shape.is_empty]

    def _outline(self, name, own, of) -> list[tuple[np.ndarray, bool]]:
        """Returns the lines (P, 2) of a shape, and whether each is closed; none for a group."""
        if name in SHAPES:
            shape, keys = SHAPES[name]
            return _lines(shape(*(of(key, own.get(DEFAULTS.get(key), 0)) for key in keys)))
        if name in ("polygon", "polyline"):
            points = safe.points(own.get("points", ""))
            return [(points, name == "polygon")] if len(points) > 1 else []
        if name == "image":
            self.unread["image"] += 1
        if name != "path" or not own.get("d"):
            return []
        self.n_characters += len(own["d"])
        if self.n_characters > MAX_PATHS:
            raise ValueError(f"its marked paths have more than {MAX_PATHS:,} characters")
        try:
            return _lines(own["d"])
        except (IndexError, TypeError, AttributeError, ZeroDivisionError) as error:
            raise ValueError(f"the path {own['d'][:30]!r} cannot be read") from error


def _matches(parts, chain) -> bool:
    """True if a selector fits the last of the chain."""

    def fits(part, node) -> bool:
        return part[1] in (None, "*", node[0]) and node[1].issuperset(part[2])

    if not fits(parts[-1], chain[-1]):
        return False
    at = len(chain) - 1
    for part, after in zip(parts[-2::-1], parts[::-1]):
        at -= 1
        while at >= 0 and not fits(part, chain[at]):
            at = -1 if after[0] else at - 1
        if at < 0:
            return False
    return True


def _stroke(line, is_closed, half, style) -> BaseGeometry:
    """Returns the area within `half` of a line (P, 2), with the style's caps and joins."""
    is_step = np.abs(np.roll(line, -1, 0) - line).max(1) > 1e-9 * np.abs(line).max()
    is_step[-1] |= not is_closed
    cap: Any = CAPS.get(style["stroke-linecap"], "flat")
    if is_step.sum() < 2:  # a dot has caps alone
        return shapely.Point(line[0]).buffer(half, cap_style=cap)
    line = line[is_step]
    join: Any = style["stroke-linejoin"]
    closes = is_closed and len(np.unique(line, axis=0)) > 2
    if is_closed and not closes:  # there and back, with a join at either end
        cap = "round" if join == "round" else "flat"
    path = (shapely.LinearRing if closes else shapely.LineString)(line)
    limit = max(1.0, length(style["stroke-miterlimit"]))
    corners = np.array(path.coords) @ (1, 1j)
    steps = np.diff(np.append(corners, corners[1:2]) if closes else corners)
    cosines = (steps[1:] * steps[:-1].conj() / np.abs(steps[1:] * steps[:-1])).real
    is_sharp = limit**2 * (1 + cosines) < 2 - 1e-9  # for the mitre limit
    if join in ("round", "bevel") or not is_sharp.any():
        join = join if join in ("round", "bevel") else "mitre"
        return path.buffer(half, cap_style=cap, join_style=join, mitre_limit=limit)
    if closes:  # begins and ends within its first step
        middle = line[:2].mean(0, keepdims=True)
        line = np.concatenate([middle, line[1:], line[:1], middle])
    cuts = [0, *is_sharp.nonzero()[0] + 1, len(line) - 1]  # GEOS would not bevel sharp corners
    pieces = [shapely.LineString(line[a : b + 1]) for a, b in zip(cuts, cuts[1:])]
    pens: dict = dict(cap_style="flat", join_style="mitre", mitre_limit=limit)
    area = path.buffer(half, cap_style=cap, join_style="bevel")
    return shapely.union_all([area, *(piece.buffer(half, **pens) for piece in pieces)])


def _go_on(curve, before) -> None:
    """Has a curve of `S` or `T` go on from its own kind alone; svgelements does from both."""
    first, last = ("control1", "control2") if isinstance(curve, CubicBezier) else 2 * ("control",)
    point = getattr(before, last) if type(before) is type(curve) else curve.start
    setattr(curve, first, point.reflected_across(curve.start))


def _lines(path) -> list[tuple[np.ndarray, bool]]:
    """Returns the lines of a path, or of what makes one, with its curves flattened."""
    lines, points = [], []
    segments = [*Path(path), Move((0, 0))]
    for before, segment in zip([None, *segments], segments):
        if isinstance(segment, (CubicBezier, QuadraticBezier)) and segment.smooth:
            _go_on(segment, before)
        if isinstance(segment, (Move, Close)):
            is_closed = isinstance(segment, Close)
            if len(points) > 1 or is_closed and isinstance(before, Move):
                lines.append((np.array(points), is_closed))
            points = points[:1] if is_closed else [tuple(segment.end)]
        elif isinstance(segment, Line):
            points.append(tuple(segment.end))
        else:
            with np.errstate(all="ignore"):  # what is not finite is refused below
                points += [tuple(row) for row in np.asarray(segment.npoint(CURVE))[1:].tolist()]
    for line, _ in lines:
        if not np.isfinite(line).all() or np.abs(line).max() > safe.MAX_COORDINATE:
            raise ValueError("a coordinate of a path is not finite, or too large")
    return lines
