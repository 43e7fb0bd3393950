"""Batches of frames without pictures, and of patch features, in a fraction of the time.

LeRobot reads a batch frame by frame, and for each frame `datasets` copies the description of all columns three times:
64 frames take 90 ms of a core, twice what training on them takes. PyTorch's loader asks a data set first for
`__getitems__`, a whole batch, which LeRobot's has not.
"""

from collections.abc import Sequence
from typing import Any
from weakref import WeakKeyDictionary

import torch
from lerobot.datasets import LeRobotDataset
from torch import Tensor

_frames: "WeakKeyDictionary[LeRobotDataset, _Frames | None]" = WeakKeyDictionary()
"""Data set to its frames, None where frames have pictures."""


def read_whole_batches() -> None:
    """From now on loaders of this process read frames without pictures from memory; others as before."""
    if not hasattr(LeRobotDataset, "__getitems__"):
        LeRobotDataset.__getitems__ = _read


def _read(dataset: LeRobotDataset, indices: Sequence[int]) -> list[dict[str, Any]]:
    """The frames of a batch, equal to `[dataset[index] for index in indices]`."""
    if dataset not in _frames:
        kinds = {feature["dtype"] for feature in dataset.features.values()}
        _frames[dataset] = _Frames(dataset) if all(hasattr(torch, kind) for kind in kinds) else None
    frames = _frames[dataset]
    return [dataset[index] if frames is None else frames.read(index) for index in indices]


class Rows:
    """Rows of a tensor, whose batches lie in the same memory one after another.

    A batch of patch features is tens of megabytes, and fresh memory for as much in every step costs page faults.
    """

    def __init__(self) -> None:
        self.memory = torch.empty(0)

    def read(self, values: Tensor, rows: Tensor) -> Tensor:
        """Rows (B,) of values (N, ...), until the next are read."""
        if self.memory.dtype != values.dtype or self.memory.device != values.device:
            self.memory = values.new_empty(0)
        shape = len(rows), *values.shape[1:]
        return torch.index_select(values, 0, rows.to(values.device), out=self.memory.resize_(shape))


class _Frames:
    """All frames of a data set of numbers: a kilobyte each."""

    def __init__(self, dataset: LeRobotDataset):
        rows, meta = dataset.hf_dataset.with_format("numpy"), dataset.meta
        columns = {name: torch.from_numpy(rows[name][:]) for name in rows.column_names}
        # As torch.tensor makes them of Python's numbers.
        self.columns = {name: all_.float() if all_.is_floating_point() else all_ for name, all_ in columns.items()}
        self.deltas = {
            name: torch.tensor([round(delta * meta.fps) for delta in deltas])
            for name, deltas in (dataset.delta_timestamps or {}).items()
        }
        self.tasks = [meta.tasks.iloc[number].name for number in range(len(meta.tasks))]
        numbers = columns["index"]
        self.row_of = torch.full((int(numbers.max()) + 1,), -1).index_put_((numbers,), torch.arange(len(numbers)))
        self.first, self.stop = (torch.tensor(meta.episodes[f"dataset_{bound}_index"]) for bound in ("from", "to"))

    def read(self, row: int) -> dict[str, Any]:
        """One frame as `LeRobotDataset` gives it."""
        frame: dict[str, Any] = {name: column[row] for name, column in self.columns.items()}
        episode = frame["episode_index"]
        first, last = self.first[episode], self.stop[episode] - 1
        asked = {name: frame["index"] + deltas for name, deltas in self.deltas.items()}
        frame |= {f"{name}_is_pad": (index < first) | (index > last) for name, index in asked.items()}
        for name, index in asked.items():
            frame[name] = self._rows(name, index.clamp(first, last))
        return frame | {"task": self.tasks[frame["task_index"]]}

    def _rows(self, name: str, indices: Tensor) -> Tensor:
        return self.columns[name][self.row_of[indices]]
