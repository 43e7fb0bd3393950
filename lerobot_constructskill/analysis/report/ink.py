"""What figures are drawn with: colours for light and dark paper, type, and the files a drawing becomes."""

import io
import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import matplotlib
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image


@dataclass(frozen=True)
class Ink:
    """Colours of one paper.

    Args:
        paper, text, muted, rule: background, writing, secondary writing, hairlines.
        ramp: from nothing to everything, for cells.
        alarm: failed runs.
        series: one colour a variant (Okabe and Ito 2008, without yellow), safe for colour-blind readers.
    """

    paper: str
    text: str
    muted: str
    rule: str
    ramp: tuple[str, ...]
    alarm: str
    series: tuple[str, ...]


LIGHT = Ink(
    paper="#ffffff",
    text="#1c2024",
    muted="#667078",
    rule="#d5dade",
    ramp=("#eef1f4", "#9fc3e0", "#1d5b94"),
    alarm="#b8400a",
    series=("#0072b2", "#d55e00", "#009e73", "#b0579a", "#d08a00", "#3a9fd6", "#5c6670"),
)
DARK = Ink(
    paper="#14181b",
    text="#e3e7ea",
    muted="#97a2aa",
    rule="#363e44",
    ramp=("#20272c", "#2f6390", "#8cc4f2"),
    alarm="#f08a56",
    series=("#4ba8e0", "#f0854a", "#3cc79c", "#dd8fc6", "#e8b04a", "#9fd3f2", "#a8b2ba"),
)
MARKERS = ("o", "s", "^", "D", "v", "P", "X", ">")
"""One more than `series` has colours, so that their pairs repeat after 56 variants only."""

IN_QUOTES = " /:=;,'()[]{}<>!*@+$?|"
"""What may stand in the URI of an attribute in double quotes as it is."""

WIDTH = 9.2
"""Inches: at 100 dots an inch, the width of the page's text."""

STYLE = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlepad": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.8,
    "lines.linewidth": 1.8,
    "legend.frameon": False,
    "text.parse_math": False,
    "svg.fonttype": "path",
    "svg.hashsalt": "constructskill",
}

SHADES = 64
"""Colours of a figure's PNG, which looks the same with them in a third of the room."""


@dataclass(frozen=True)
class Drawing:
    """A figure of the report, drawn by a function of the ink.

    Args:
        name: its file's stem.
        caption: what it shows and how to read it.
        draw: makes the figure.
    """

    name: str
    caption: str
    draw: Callable[[Ink], Figure]


@dataclass(frozen=True)
class Picture:
    """A drawing on both papers, as data URIs for a page that fetches nothing. Name and caption are the drawing's."""

    name: str
    caption: str
    light: Markup
    dark: Markup


def picture(drawing: Drawing, folder: Path) -> Picture:
    """Draw `drawing` on both papers, and write the light one to `folder` as `<name>.png`."""
    png, light = encoded(drawing, LIGHT, _png, _svg)
    (dark,) = encoded(drawing, DARK, _svg)
    (folder / f"{drawing.name}.png").write_bytes(png)
    return Picture(drawing.name, drawing.caption, _uri(light), _uri(dark))


def encoded(drawing: Drawing, ink: Ink, *encoders: Callable[[Figure], bytes]) -> list[bytes]:
    """One figure as the bytes of a file of each kind, the same at every call."""
    with styled(ink), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing")  # labels may hold any script
        figure = drawing.draw(ink)
        FigureCanvasAgg(figure).draw()
        figure.set_layout_engine("none")  # laid out once, for all files
        return [encode(figure) for encode in encoders]


def _png(figure: Figure) -> bytes:
    drawn, target = io.BytesIO(), io.BytesIO()
    figure.savefig(drawn, format="png", dpi=200)
    Image.open(drawn).convert("RGB").quantize(SHADES).save(target, format="png", optimize=True)
    return target.getvalue()


def _svg(figure: Figure) -> bytes:
    target = io.BytesIO()
    figure.savefig(target, format="svg", metadata={"Date": None})  # the same bytes whenever it is written
    return target.getvalue()


def _uri(svg: bytes) -> Markup:
    """An SVG of Matplotlib's as the text of an attribute in double quotes, which it cannot end.

    That is two thirds of its base64. The labels are drawn as paths, and named in comments alone, which are left out.
    """
    lines = re.sub(r"<!--.*?-->", "", svg.decode(), flags=re.DOTALL)
    text = " ".join(lines.split()).replace('"', "'")
    return Markup(f"data:image/svg+xml,{quote(text, safe=IN_QUOTES)}")


@contextmanager
def styled(ink: Ink) -> Iterator[None]:
    colours = {
        "figure.facecolor": ink.paper,
        "axes.facecolor": ink.paper,
        "savefig.facecolor": ink.paper,
        "text.color": ink.text,
        "axes.labelcolor": ink.text,
        "axes.titlecolor": ink.text,
        "axes.edgecolor": ink.muted,
        "xtick.color": ink.muted,
        "ytick.color": ink.muted,
        "xtick.labelcolor": ink.text,
        "ytick.labelcolor": ink.text,
        "grid.color": ink.rule,
        "hatch.color": ink.alarm,
    }
    with matplotlib.rc_context(STYLE | colours):
        yield


def panels(height: float, rows: int = 1, columns: int = 2, **shared) -> tuple[Figure, list[Axes]]:
    """A figure of the page's width, `height` inches tall, and its axes in reading order."""
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    return figure, list(figure.subplots(rows, columns, squeeze=False, **shared).flat)
