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


#: Fields of the themes "light" and "dark".
FIELDS: dict = {
    "page": ("#ffffff", "#12161d"),
    "text": ("#1d2430", "#eef1f6"),
    "faint": ("#6b7483", "#98a2b3"),
    "outside": ("#dde1e8", "#171c25"),
    "floor": ("#fffdf6", "#394353"),
    "unseen": ("#e9ebef", "#252c38"),
    "hatch": ("#d3d7de", "#303846"),
    "unseen_wall": ("#a9b0bc", "#566073"),
    "wall": ((0.25, 0.8), (0.55, 1.0)),
}
THEMES = {
    theme: Theme(**{name: values[i] for name, values in FIELDS.items()})
    for i, theme in enumerate(("light", "dark"))
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
