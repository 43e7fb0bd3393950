"""Draws two pictures of a data set: the phases, and the paths of the end effector."""

from itertools import islice
from pathlib import Path

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from lerobot_constructskill.artifacts.folders import replaced
from lerobot_constructskill.dataset.dataset import DataSet
from lerobot_constructskill.dataset.frames import pictures
from lerobot_constructskill.demos.expert import Phase

COLOURS = dict(zip(Phase, ("#0072B2", "#56B4E9", "#000000", "#E69F00", "#D55E00", "#009E73"), strict=True))
"""Okabe and Ito's, which colour-blind readers tell apart."""

SHEET_EPISODES, PATH_EPISODES = 3, 20


def contact_sheet(data: DataSet, path: Path) -> None:
    """A row for each of some episodes and cameras: the start of each phase that it has, and the last frame."""
    episodes = _firsts(data, SHEET_EPISODES)
    spans = [data.spans()[episode] for episode in episodes]
    lines = [(camera, _starts(data, span)) for span in spans for camera in data.cameras]
    wanted = {row for _, rows in lines for row in rows if row is not None}
    shown = {
        camera: {row: picture for row, picture in islice(pictures(data, camera), max(wanted) + 1) if row in wanted}
        for camera in data.cameras
    }
    titles = [*Phase, "last frame"]
    figure = Figure(figsize=(1.6 * len(titles), 1.75 * len(lines)), layout="constrained")
    axes = figure.subplots(len(lines), len(titles), squeeze=False)
    for index, (camera, rows) in enumerate(lines):
        for axis, row, title in zip(axes[index], rows, titles, strict=True):
            axis.set(xticks=[], yticks=[])
            if row is not None:
                axis.imshow(shown[camera][row])
            if index == 0:
                axis.set_title(title, fontsize=9, color=COLOURS.get(title, "black"))
        axes[index, 0].set_ylabel(
            f"{camera.split('.')[-1]}, episode {episodes[index // len(data.cameras)]}", fontsize=8
        )
    _save(figure, path)


def trajectories(data: DataSet, path: Path) -> None:
    """Paths of some episodes' end effector from above and from the side, coloured by phase, and the first bin."""
    position, phases = data.column("sim.tcp_pose")[:, :3], data.column("phase")
    spans = [data.spans()[episode] for episode in _firsts(data, PATH_EPISODES)]
    figure = Figure(figsize=(9, 4.2), layout="constrained")
    for axis, (across, up), title in zip(figure.subplots(1, 2), ((0, 1), (1, 2)), ("from above", "side"), strict=True):
        center, extent = data.column("sim.bin_position")[0], data.column("sim.bin_interior")[0]
        corner = [center[i] - extent[i] / 2 for i in (across, up)]
        axis.add_patch(Rectangle(corner, extent[across], extent[up], facecolor="#dddddd", label="bin"))
        for span in spans:
            points = position[span][:, [across, up]]
            pieces = np.stack([points[:-1], points[1:]], axis=1)
            colours = [COLOURS[Phase(phase)] for phase in phases[span][:-1]]
            axis.add_collection(LineCollection(pieces, colors=colours, linewidths=0.7))
        axis.autoscale_view()
        axis.set(xlabel=f"{'xyz'[across]} (m)", ylabel=f"{'xyz'[up]} (m)", aspect="equal", adjustable="datalim")
        axis.set_title(f"{title}, {len(spans)} of {len(data.episodes)} demonstrations", fontsize=10)
    for phase, colour in COLOURS.items():
        axis.plot([], [], color=colour, label=phase)
    figure.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=7, fontsize=8, frameon=False)
    _save(figure, path)


def _starts(data: DataSet, span: slice) -> list[int | None]:
    """The rows where an episode's phases begin, none for one that it does not have, and its last row."""
    own = data.column("phase")[span]
    begins = [own == phase for phase in Phase]
    return [*(span.start + int(one.argmax()) if one.any() else None for one in begins), span.stop - 1]


def _firsts(data: DataSet, most: int) -> list[int]:
    """The first episodes of each task, so many in all at most."""
    each = max(1, most // len(data.blocks))
    return [episode for block in data.blocks for episode in block.episodes[:each]][:most]


def _save(figure: Figure, path: Path) -> None:
    with replaced(path) as partial:
        figure.savefig(partial, dpi=110, pil_kwargs={"quality": 90})
