"""Contacts between rooms, and their doors and openings. Lengths are integer centimetres."""

from collections.abc import Callable, Iterable, Sequence
from itertools import combinations
from typing import NamedTuple

from megastep.geometries.homes.partition import Room
from megastep.geometries.homes.plan import Style
from megastep.geometries.homes.portable_generator import PortableGenerator

# Probability of each width of a door.
DOORS = {60: 0.06, 65: 0.12, 70: 0.16, 75: 0.18, 80: 0.24, 85: 0.14, 90: 0.10}
SMALL = ("bath", "closet", "lobby", "storage")  # rooms with doors of at most 80 cm
MAX_SMALL = 80
STUB = 5  # cm of wall beside a door in a corner
IN_CORNER = 0.70  # fraction of doors in a corner; the others are anywhere
MIN_CONTACT = 95  # cm of clear wall that a door needs
LOOPS = 0.45  # fraction of cheap contacts outside the tree that become doors too
FULL = 0.45  # fraction of connections without a door that take the whole wall
OPENING = (100, 240)  # cm; width of the others
REACH = 25  # cm; a wall this close to the end of another leaves less of it to open


def _of_pairs(table) -> dict[frozenset, float]:
    return {frozenset(p.split()): value for value, ps in table.items() for p in ps.split(", ")}


# Probability that a connection of two kinds of rooms has no door.
OPEN = _of_pairs(
    {
        0.7: "living kitchen",
        0.6: "living entry, kitchen entry, living room, kitchen room",
        0.4: "entry room, entry lobby",
        0.2: "bedroom closet, entry closet, bedroom room",
    }
)
# Cost of a connection in the spanning tree: cheap ones become doors.
COSTS = _of_pairs(
    {
        0.05: "living kitchen",
        0.25: "bedroom closet",
        0.7: "bath living",
        0.8: "bath bedroom",
        1.5: "bedroom",
        2.0: "closet, closet storage, storage, closet bath, storage bath",
        3.0: "bath, bath kitchen",
    }
)
COST_ENTRY, COST_LIVING, COST = 0.15, 0.3, 1.0
CHEAP = 0.8  # the maximum cost of a loop


class Contact(NamedTuple):
    """A straight wall between rooms a and b, from low to high on the line `at` of `axis`."""

    axis: int
    at: int
    low: int
    high: int
    a: int
    b: int


class Opening(NamedTuple):
    """A gap in the wall of a contact, from low to high, with or without a door."""

    contact: Contact
    low: int
    high: int
    door: bool


def contacts(rooms: Sequence[Room]) -> list[Contact]:
    """Returns every Contact between two of the rooms. Collinear pieces are merged."""
    pieces = []
    for (i, room), (j, other) in combinations(enumerate(rooms), 2):
        for r in room.region:
            for s in other.region:
                for axis in (0, 1):
                    low, high = max(r[1 - axis], s[1 - axis]), min(r[3 - axis], s[3 - axis])
                    if low < high and (r[axis + 2] == s[axis] or s[axis + 2] == r[axis]):
                        at = r[axis + 2] if r[axis + 2] == s[axis] else r[axis]
                        pieces.append((i, j, axis, at, low, high))
    merged = []
    for i, j, axis, at, low, high in sorted(pieces):
        if merged and merged[-1] == (axis, at, merged[-1].low, low, i, j):
            merged[-1] = merged[-1]._replace(high=high)
        else:
            merged.append(Contact(axis, at, low, high, i, j))
    return merged


def clear(contact: Contact, others: Iterable[Contact], depth: Callable) -> tuple[int, int]:
    """Returns the part (low, high) of a contact that no other wall meets."""
    low, high = contact.low, contact.high
    for other in others:
        if other.axis != contact.axis and other.low - REACH <= contact.at <= other.high + REACH:
            before, after = depth(other)
            if abs(other.at - contact.low) <= REACH:
                low = max(low, other.at + after)
            elif abs(other.at - contact.high) <= REACH:
                high = min(high, other.at - before)
    return low, high


def _cost(*kinds) -> float:
    other = COST_ENTRY if "entry" in kinds else COST_LIVING if "living" in kinds else COST
    return COSTS.get(frozenset(kinds), other)


def connections(
    rooms: Sequence[Room], spans: dict[Contact, tuple[int, int]], generator: PortableGenerator
) -> tuple[float, list[Contact]] | None:
    """Chooses the contacts to open: a cheapest spanning tree of the rooms, and some loops.

    `spans` has the clear (low, high) of every contact. Returns (mean cost of the tree, [contact]),
    or None if no tree reaches every room.
    """
    longest = {}
    for contact, (low, high) in spans.items():
        pair = contact.a, contact.b
        if high - low >= MIN_CONTACT and high - low > longest.get(pair, (0, None))[0]:
            longest[pair] = high - low, contact
    edges = sorted(
        (_cost(rooms[a].kind, rooms[b].kind) + generator.uniform(0, 0.15), contact)
        for (a, b), (_, contact) in longest.items()
    )
    parts = list(range(len(rooms)))
    tree, cheap, total = [], [], 0.0
    for cost, contact in edges:
        a, b = parts[contact.a], parts[contact.b]
        if a == b:
            cheap += [contact] if cost < CHEAP else []
            continue
        parts = [b if part == a else part for part in parts]
        tree.append(contact)
        total += cost
    if len(set(parts)) > 1:
        return None
    loops = [contact for contact in cheap if generator.chance(LOOPS)]
    return total / (len(rooms) - 1), tree + loops


def opening(
    contact: Contact,
    span: tuple[int, int],
    kinds: tuple[str, str],
    generator: PortableGenerator,
    style: Style,
) -> Opening:
    """Draws an Opening within the clear span of a contact between rooms of two kinds."""
    low, high = span
    open_plan = generator.chance(OPEN.get(frozenset(kinds), 0.0) * style.open_plan)
    if open_plan:
        if generator.chance(FULL):
            return Opening(contact, low, high, False)
        width = generator.between(*OPENING, step=5)
    else:
        is_small = any(kind in SMALL for kind in kinds)
        widths = [width for width in DOORS if not is_small or width <= MAX_SMALL]
        weights = [DOORS[width] * (1 + style.narrow * (90 - width) ** 2 / 100) for width in widths]
        width = widths[generator.pick(weights)]
    spare = high - low - width - 2 * STUB
    if spare < 0:
        return Opening(contact, low, high, False)
    in_corner = generator.chance(IN_CORNER)
    offset = generator.below(2) * spare if in_corner else generator.between(0, spare)
    return Opening(contact, low + STUB + offset, low + STUB + offset + width, not open_plan)
