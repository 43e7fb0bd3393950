"""What there is of a study: its runs as one table of rows, its videos, and what is missing or failed, and why.

A run counts as made where the store has it, and also where the table in the study's folder has its rows already: so
anyone who has the folder of a published study can continue it, without its checkpoints and on another kind of machine.
"""

import json
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from itertools import groupby
from pathlib import Path
from typing import Any

from lerobot_constructskill.artifacts.folders import replaced
from lerobot_constructskill.artifacts.store import Store
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.study.rows import NOT_RUN, ROWS, EpisodeRow, Row, load_rows, write_rows
from lerobot_constructskill.study.runs import EPISODES, FILMED_SEED, VIDEO, Run
from lerobot_constructskill.study.spec import video_path
from lerobot_constructskill.study.validate import measured

HELDOUT = ("heldout_mse_m2", "heldout_mse_m2_by_data")
"""Columns of `Row` that follow from a run's checkpoint: on the setting's own demonstrations, and on each by name."""


class Table:
    """The rows of a study's runs, in the study's order; what has been read is kept.

    Args:
        root: the study's folder.
        runs: its runs.
        store: where they are made.
    """

    def __init__(self, root: Path, runs: Sequence[Run], store: Store):
        self.root, self.runs, self.store = root, runs, store
        self._made: dict[str, list[EpisodeRow]] = {}
        self._rows: dict[str, list[Row]] = {}
        self._kept = _run_so_far(root / ROWS)

    def missing(self) -> list[Run]:
        """The runs that have not been made."""
        return [run for run in self.runs if self.episodes(run) is None]

    def failed(self) -> list[Run]:
        return [run for run in self.runs if (rows := self.episodes(run)) and rows[0].error_kind]

    def episodes(self, run: Run) -> list[EpisodeRow] | None:
        """The rows of a run; None if it has not been made.

        Raises:
            InputError: its folder holds something else.
        """
        name, kept = run.digest, self._kept_rows(run)
        if kept and kept[0].run != name:  # of another kind of machine: what is published stays as it is
            return kept
        if name not in self._made and self.store.has(run):
            file = self.store.folder(run) / EPISODES
            if not file.is_file():
                raise InputError(f"{file.parent} has no episodes, so it is not a run of this package: move it away.")
            self._made[name] = load_rows(file, EpisodeRow)
        made = self._made.get(name)
        return kept if kept and (made is None or made[0].error_kind) else made

    def _kept_rows(self, run: Run, failed: bool = False) -> list[Row] | None:
        """The rows of a run that the table in the folder had, if it ran to its end, or if it failed."""
        kept = (self._kept[key] for key in _keys(run) if key in self._kept)
        return next((rows for rows in kept if bool(rows[0].error_kind) == failed), None)

    def outdated(self, run: Run) -> Row | None:
        """A row that the table in the folder had of this run, made of something else than it would be made of now."""
        ours = _keys(run)
        alike = (rows[0] for key, rows in self._kept.items() if key[:2] == ours[0][:2] and key not in ours)
        return next((row for row in alike if row.training_seed == run.seed), None)

    def lost(self) -> list[str]:
        """The runs of the table in the folder that neither this study nor the store has.

        One that failed is not lost where this study has a run of that name: now its weights may be there.
        """
        ours, names = {key for run in self.runs for key in _keys(run)}, {run.id for run in self.runs}
        gone = [
            row
            for key, rows in self._kept.items()
            if key not in ours and not (key[-1] and self.store.spec(Run.kind, key[-1]))
            for row in rows
            if not (row.error_kind and _name_of(row) in names)
        ]
        return list(dict.fromkeys(map(_name_of, gone)))

    def forget_failure(self, run: Run) -> None:
        """Discard a run that failed, so that it is made anew, unless somebody has done so."""
        with self.store.claim([run]):
            self._made.pop(run.digest, None)
            if (rows := self.episodes(run)) and rows[0].error_kind:
                self.store.discard(run)
                self._made.pop(run.digest)

    def write(self) -> None:
        """Write the table and the videos into the study's folder."""
        write_rows([row for run in self.runs for row in self._rows_of(run)], self.root / ROWS)

    def write_anew(self) -> None:
        """The same, with held-out errors as they are by now."""
        self._rows.clear()
        self.write()

    def _rows_of(self, run: Run) -> list[Row]:
        if run.id not in self._rows and self.episodes(run) is not None:
            self._rows[run.id] = list(self._made_rows(run))
        if rows := self._rows.get(run.id):
            return rows
        failed = self._kept_rows(run, failed=True)  # a row until it is made again: it is not run here, but it was
        return [replace(row, **_names(run)) for row in failed] if failed else [self._missing_row(run)]

    def _missing_row(self, run: Run) -> Row:
        seeds = {"training_seed": run.seed, "evaluation_seed": run.arm.evaluation["seed"]}
        return Row(run=run.digest, **seeds, episode=0, error_kind=NOT_RUN, **_names(run))

    def _made_rows(self, run: Run) -> Iterator[Row]:
        if isinstance(self.episodes(run)[0], Row):  # of the table in the folder
            yield from (replace(row, **_names(run)) for row in self.episodes(run))
            return
        common = _names(run) | self._heldout_errors(run)
        for row in self.episodes(run):
            yield Row(**asdict(row), **common, video=self._video(run) if row.episode == 0 else None)

    def _heldout_errors(self, run: Run) -> dict[str, Any]:
        """The run's error on what is held out of all demonstrations of its setting, as two columns of its rows.

        They are those of the table in the folder where the checkpoint has been removed since.
        """
        if run.checkpoints is None:
            return {}
        if not self.store.has(run.checkpoints):
            kept = self._kept_rows(run)
            return {name: getattr(kept[0], name) for name in HELDOUT} if kept else {}
        errors = {data.name: measured(run, data, self.store) for data in run.arm.validated_on}
        errors = {name: error for name, error in errors.items() if error is not None}
        own, every = HELDOUT
        return {own: errors.get(run.arm.validated_on[0].name), every: json.dumps(errors)} if errors else {}

    def _video(self, run: Run) -> str | None:
        """Copy the run's video beside the table and return its path there."""
        video = self.store.folder(run) / VIDEO
        if run.seed != FILMED_SEED or not video.exists():
            return None
        path = video_path(run.arm.setting, run.arm.name)
        if not (self.root / path).exists() or (self.root / path).stat().st_mtime != video.stat().st_mtime:
            with replaced(self.root / path) as partial:
                shutil.copy2(video, partial)
        return str(path)


def _run_so_far(file: Path) -> dict[tuple[str, str, str | None], list[Row]]:
    """The rows of each run in a study's table that was made, failed or not, by setting, variant and digest."""
    rows = [row for row in load_rows(file, Row) if row.error_kind != NOT_RUN] if file.exists() else []
    by_run = groupby(rows, key=lambda row: (row.setting, row.variant, row.run))
    return {key: list(episodes) for key, episodes in by_run}


def _name_of(row: Row) -> str:
    """`Run.id` of a row's run."""
    return f"{row.setting}/{row.variant}/seed_{row.training_seed}"


def _keys(run: Run) -> list[tuple[str, str, str]]:
    """What the rows of a run may be found by in `_run_so_far`."""
    return [(run.arm.setting, run.arm.name, name) for name in run.digests]


def _names(run: Run) -> dict[str, Any]:
    arm = run.arm
    return {
        "setting": arm.setting,
        "variant": arm.name,
        "role": arm.role,
        "episodes": arm.evaluation["episodes"],
        "demonstrations": arm.demonstrations and arm.demonstrations.name,
    }
