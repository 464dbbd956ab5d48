"""How pictures look: colours of the two themes, and settings that hold inside a ``with`` block."""

import contextlib
import dataclasses
from collections.abc import Iterator
from contextvars import ContextVar

__all__ = ["AGENTS", "Style", "Theme", "current", "styled"]

#: Colours of agents, by their number: distinct for most kinds of colour blindness (after Okabe and
#: Ito), and on both themes.
AGENTS = "#0f8bd8", "#e8602c", "#12a37f", "#c95aa6", "#d9a400", "#7b6fd6", "#35b3c9", "#a8703f"


@dataclasses.dataclass(frozen=True)
class Theme:
    """Colours in sRGB."""

    page: str
    text: str
    faint: str  # labels, frames, the scale bar
    outside: str
    floor: str
    unseen: str  # floor that no agent has seen, where that counts
    hatch: str
    unseen_wall: str
    wall: tuple[float, float]  # least and greatest brightness of walls


THEMES = {
    "light": Theme(
        page="#ffffff",
        text="#1d2430",
        faint="#6b7483",
        outside="#dde1e8",
        floor="#fffdf6",
        unseen="#e9ebef",
        hatch="#d3d7de",
        unseen_wall="#a9b0bc",
        wall=(0.25, 0.8),
    ),
    "dark": Theme(
        page="#12161d",
        text="#eef1f6",
        faint="#98a2b3",
        outside="#171c25",
        floor="#394353",
        unseen="#252c38",
        hatch="#303846",
        unseen_wall="#566073",
        wall=(0.55, 1.0),
    ),
}


@dataclasses.dataclass(frozen=True)
class Style:
    """Settings of pictures.

    Attributes:
        theme: "light" or "dark".
        dpi: pixels per inch; at 100, most pictures are 640 x 720 pixels.
        title: above the picture.
        note: added to a picture's line of numbers, such as an episode's return.
    """

    theme: str = "light"
    dpi: float = 100
    title: str | None = None
    note: str = ""

    @property
    def colours(self) -> Theme:
        """Returns the colours of the theme."""
        return THEMES[self.theme]


_STYLE: ContextVar[Style] = ContextVar("style", default=Style())  # noqa: B039  (it is frozen)


def current() -> Style:
    """Returns the style of pictures that are made here."""
    return _STYLE.get()


@contextlib.contextmanager
def styled(**settings) -> Iterator[Style]:
    """Changes the style of pictures that are made inside the block; see :class:`Style`."""
    style = dataclasses.replace(current(), **settings)
    if style.theme not in THEMES:
        raise ValueError(f"theme must be light or dark, but {style.theme!r} was given")
    token = _STYLE.set(style)
    try:
        yield style
    finally:
        _STYLE.reset(token)
