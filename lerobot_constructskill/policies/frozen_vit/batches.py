"""Batches of frames without pictures, and of patch features, in a fraction of the time.

LeRobot reads a batch frame by frame, and for each frame `datasets` copies the description of all columns three times,
which takes longer than training on the batch (`benchmarks/keypoints.py`). PyTorch's loader asks a data set first for a
whole batch, by `__getitems__`; LeRobot's data set has no such method.
"""

from collections.abc import Sequence
from typing import Any
from weakref import WeakKeyDictionary

import torch
from lerobot.datasets import LeRobotDataset
from torch import Tensor

_frames: "WeakKeyDictionary[LeRobotDataset, _Frames]" = WeakKeyDictionary()
"""Data set to its frames, where these are numbers alone."""


def read_whole_batches() -> None:
    """From now on loaders of this process read frames without pictures from memory; others as before.

    Worker processes that a loader spawns are not reached, so this is for `num_workers: 0`.
    """
    if not hasattr(LeRobotDataset, "__getitems__"):
        LeRobotDataset.__getitems__ = _read


def _read(dataset: LeRobotDataset, indices: Sequence[int]) -> list[dict[str, Any]]:
    """The frames of a batch, equal to `[dataset[index] for index in indices]`."""
    kinds = {feature["dtype"] for feature in dataset.features.values()}
    is_own = type(dataset).__getitem__ is LeRobotDataset.__getitem__
    if not is_own or not all(hasattr(torch, kind) for kind in kinds):
        return [dataset[index] for index in indices]
    frames = _frames.get(dataset)
    if frames is None or frames.source is not dataset.hf_dataset:
        frames = _frames[dataset] = _Frames(dataset)
    return frames.read(torch.tensor(indices))


class Rows:
    """Rows of a tensor, whose batches lie in the same memory one after another.

    A batch of patch features is tens of megabytes, and fresh memory for as much in every step costs page faults.
    """

    def __init__(self) -> None:
        self.memory = torch.empty(0)

    def read(self, values: Tensor, rows: Tensor) -> Tensor:
        """Rows (B,) of values (N, ...). The next call overwrites them, so a step ends before it."""
        if self.memory.dtype != values.dtype or self.memory.device != values.device:
            self.memory = values.new_empty(0)
        shape = len(rows), *values.shape[1:]
        return torch.index_select(values, 0, rows.to(values.device), out=self.memory.resize_(shape))


class _Frames:
    """All frames of a data set of numbers: a kilobyte each."""

    def __init__(self, dataset: LeRobotDataset):
        self.source, meta = dataset.hf_dataset, dataset.meta
        rows = self.source.with_format("numpy")
        columns = {name: torch.from_numpy(rows[name][:]) for name in rows.column_names}
        # As torch.tensor makes them of Python's numbers.
        self.columns = {name: all_.float() if all_.is_floating_point() else all_ for name, all_ in columns.items()}
        deltas = dataset.reader.delta_indices or {}
        self.deltas = {name: torch.tensor(steps) for name, steps in deltas.items()}
        self.tasks = [meta.tasks.iloc[number].name for number in range(len(meta.tasks))]
        numbers = columns["index"]
        self.row_of = torch.full((int(numbers.max()) + 1,), -1).index_put_((numbers,), torch.arange(len(numbers)))
        self.first, self.stop = (torch.tensor(meta.episodes[f"dataset_{bound}_index"]) for bound in ("from", "to"))

    def read(self, rows: Tensor) -> list[dict[str, Any]]:
        """Frames (B,) as `LeRobotDataset` gives them, each a copy."""
        batch = {name: column[rows] for name, column in self.columns.items()}
        tasks = [self.tasks[number] for number in batch["task_index"]]
        first, last = (bound[batch["episode_index"]][:, None] for bound in (self.first, self.stop - 1))
        asked = {name: batch["index"][:, None] + deltas for name, deltas in self.deltas.items()}
        batch |= {f"{name}_is_pad": (index < first) | (index > last) for name, index in asked.items()}
        for name, index in asked.items():
            batch[name] = self.columns[name][self.row_of[index.clamp(first, last)]]
        frames = zip(*(column.unbind() for column in batch.values()), strict=True)
        return [
            dict(zip(batch, frame, strict=True)) | {"task": task} for frame, task in zip(frames, tasks, strict=True)
        ]
