"""What figures are drawn with: colours, type, and the files that a drawing becomes."""

import io
import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import matplotlib
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from lerobot_constructskill.artifacts.folders import replaced

PAPER, TEXT, MUTED, RULE = "#ffffff", "#1c2024", "#667078", "#d5dade"
"""Background, writing, secondary writing, hairlines."""

RAMP = ("#eef1f4", "#9fc3e0", "#1d5b94")
"""From nothing to everything, for cells."""

ALARM = "#b8400a"
"""Of failed runs."""

SERIES = ("#0072b2", "#d55e00", "#009e73", "#b0579a", "#d08a00", "#3a9fd6", "#5c6670")
"""One colour a variant (Okabe and Ito 2008, without yellow), safe for colour-blind readers."""

MARKERS = ("o", "s", "^", "D", "v", "P", "X", ">")
"""One more than `SERIES` has colours, so that their pairs repeat after 56 variants only."""

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
    "figure.facecolor": PAPER,
    "axes.facecolor": PAPER,
    "savefig.facecolor": PAPER,
    "text.color": TEXT,
    "axes.labelcolor": TEXT,
    "axes.titlecolor": TEXT,
    "axes.edgecolor": MUTED,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": TEXT,
    "ytick.labelcolor": TEXT,
    "grid.color": RULE,
    "hatch.color": ALARM,
}

SHADES = 64
"""Colours of a figure's PNG, which looks the same with them in a third of the room."""


@dataclass(frozen=True)
class Drawing:
    """A figure of the report.

    Args:
        name: its file's stem.
        caption: what it shows and how to read it.
        draw: makes the figure.
    """

    name: str
    caption: str
    draw: Callable[[], Figure]


@dataclass(frozen=True)
class Picture:
    """A drawing as a data URI, for a page that fetches nothing. Name and caption are the drawing's."""

    name: str
    caption: str
    source: Markup


def picture(drawing: Drawing, folder: Path) -> Picture:
    """Draw `drawing`, and write it to `folder` as `<name>.png` as well."""
    png, svg = encoded(drawing, _png, _svg)
    with replaced(folder / f"{drawing.name}.png") as partial:
        partial.write_bytes(png)
    return Picture(drawing.name, drawing.caption, _uri(svg))


def encoded(drawing: Drawing, *encoders: Callable[[Figure], bytes]) -> list[bytes]:
    """One figure as the bytes of a file of each kind, the same at every call."""
    with matplotlib.rc_context(STYLE), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing")  # labels may hold any script
        figure = drawing.draw()
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


def panels(height: float, rows: int = 1, columns: int = 2, **shared) -> tuple[Figure, list[Axes]]:
    """A figure of the page's width, `height` inches tall, and its axes in reading order."""
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    return figure, list(figure.subplots(rows, columns, squeeze=False, **shared).flat)
