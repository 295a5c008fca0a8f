"""Figures as inline SVG whose colours are the page's: they follow it from light to dark."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final

import matplotlib as mpl
from markupsafe import Markup

mpl.use("Agg")  # before pyplot: there is no screen
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

INK: Final = "#0a0b01"
FAINT: Final = "#0a0b02"
GRID: Final = "#0a0b03"
BLUE: Final = "#0a0b04"
ORANGE: Final = "#0a0b05"
GREEN: Final = "#0a0b06"
PURPLE: Final = "#0a0b07"
RED: Final = "#0a0b08"
PAPER: Final = "#0a0b09"

_VARIABLES: Final = {
    INK: "ink",
    FAINT: "faint",
    GRID: "grid",
    BLUE: "blue",
    ORANGE: "orange",
    GREEN: "green",
    PURPLE: "purple",
    RED: "red",
    PAPER: "paper",
}
"""Colours that stand for the style sheet's; nothing else is drawn in them."""

_STYLE: Final[dict[Any, Any]] = {
    "svg.fonttype": "none",  # text stays text: small, selectable, in the page's font
    "font.size": 9.0,
    "axes.edgecolor": GRID,
    "axes.labelcolor": FAINT,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "xtick.color": GRID,
    "ytick.color": GRID,
    "xtick.labelcolor": FAINT,
    "ytick.labelcolor": FAINT,
    "text.color": INK,
    "legend.frameon": False,
    "legend.labelcolor": INK,
    "legend.fontsize": 8.5,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "lines.solid_capstyle": "round",
}

_PROLOGUE: Final = re.compile(r"^.*?(?=<svg)", re.DOTALL)
_METADATA: Final = re.compile(r"<metadata>.*?</metadata>", re.DOTALL)
_SIZE: Final = re.compile(r'(<svg[^>]*?) width="[^"]*"([^>]*?)', re.DOTALL)
_HEIGHT: Final = re.compile(r'(<svg[^>]*?) height="[^"]*"', re.DOTALL)
_NAMESPACES: Final = re.compile(r' xmlns(:xlink)?="[^"]*"')
_IDS: Final = re.compile(r'(\bid="|url\(#|href="#)')


@dataclass(frozen=True)
class Svg:
    """A figure for the page."""

    markup: Markup
    alt: str
    """What it shows, in words."""


@contextmanager
def figure_style(name: str) -> Iterator[None]:
    """Within it figures are drawn in the page's style.

    Args:
        name: Of the figure, another for each on the page; the same figure then has the same bytes.
    """
    with mpl.rc_context({**_STYLE, "svg.hashsalt": name}):
        yield


def to_svg(figure: Figure, name: str, alt: str) -> Svg:
    """Closes a figure and gives it as an element of the page.

    Args:
        figure: Drawn within `figure_style`.
        name: The same name.
        alt: What it shows, in words.
    """
    file = io.StringIO()
    figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    plt.close(figure)
    text = _METADATA.sub("", _PROLOGUE.sub("", file.getvalue()))
    text = _HEIGHT.sub(r"\1", _SIZE.sub(r"\1\2", text, count=1), count=1)
    text = _NAMESPACES.sub("", text)
    text = _IDS.sub(lambda found: f"{found[1]}{name}-", text)
    text = text.replace("xlink:href", "href")
    for colour, variable in _VARIABLES.items():
        text = text.replace(colour, f"var(--{variable})")
    label = Markup('<svg role="img" aria-label="{}"').format(alt)
    # matplotlib wrote the rest, and escaped what it was given.
    return Svg(Markup(text.replace("<svg", str(label), 1)), alt)  # noqa: S704
