"""What there is of a study: its runs as one table of rows, its videos, and what is missing or failed, and why.

A run counts as made where the store has it, and also where the table in the study's folder has its rows already: so
anyone who has the folder of a published study can continue it, without its checkpoints and on another kind of machine.
"""

import json
import shutil
from collections.abc import Sequence
from dataclasses import asdict, replace
from itertools import groupby
from pathlib import Path
from typing import Any

from lerobot_constructskill.artifacts.folders import replaced
from lerobot_constructskill.artifacts.store import Store
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.study.rows import NOT_RUN, ROWS, EpisodeRow, Row, load_rows, write_rows
from lerobot_constructskill.study.runs import EPISODES, FILMED_SEED, VIDEO, Run, told_in
from lerobot_constructskill.study.spec import video_path
from lerobot_constructskill.study.validate import heldout
from lerobot_constructskill.training.heldout import known_error


class Table:
    """The rows of a study's runs, in the study's order; what has been read is kept.

    Args:
        root: the study's folder.
        runs: its runs.
        store: where they are made.
        replaces: whether rows that were made of something else stand until a run of their setting and variant is made,
            and then go.
        stored: the runs whose rows may come from the store, others have those of the folder; None for all.
    """

    def __init__(
        self,
        root: Path,
        runs: Sequence[Run],
        store: Store,
        replaces: bool = False,
        stored: Sequence[Run] | None = None,
    ):
        self.root, self.runs, self.store, self.replaces = root, runs, store, replaces
        self._of_store = {run.id for run in (runs if stored is None else stored)}
        file = root / ROWS
        before = [row for row in load_rows(file) if row.error_kind != NOT_RUN] if file.exists() else []
        by_run = groupby(before, key=lambda row: (row.setting, row.variant, row.run))
        self._before = {key: list(rows) for key, rows in by_run}
        self._made: dict[str, list[Row]] = {}

    def missing(self) -> list[Run]:
        """The runs that have not been made."""
        return [run for run in self.runs if self.made(run) is None]

    def untold(self) -> list[Run]:
        """The runs of which the table in the folder had no rows, whatever the store has."""
        return [run for run in self.runs if not any(self._rows_before(run, failed) for failed in (False, True))]

    def failed(self) -> list[Run]:
        """The runs that were made and failed."""
        return [run for run in self.runs if (rows := self.made(run)) and rows[0].error_kind]

    def made(self, run: Run) -> list[Row] | None:
        """The rows of a run: those that the table in the folder had if it finished there, or else the store's.

        Returns:
            None for a run that is to be made.

        Raises:
            InputError: the run's folder in the store holds something else.
        """
        if run.id not in self._made and (rows := self._rows_before(run) or self._stored(run)):
            is_ours = rows[0].run == run.digest and run.id in self._of_store  # and of no other kind of machine
            columns = _names(run) | (self._heldout_errors(run) if is_ours else {})
            self._made[run.id] = [replace(row, **columns) for row in rows]
        return self._made.get(run.id)

    def _rows_before(self, run: Run, failed: bool = False) -> list[Row] | None:
        """The rows of a run that the table in the folder had, if it finished, or if it failed."""
        before = (self._before[key] for key in _keys(run) if key in self._before)
        return next((rows for rows in before if bool(rows[0].error_kind) == failed), None)

    def _stored(self, run: Run) -> list[Row]:
        """The rows of a run in the store; none where it does not have the run."""
        if run.id not in self._of_store or not self.store.has(run):
            return []
        file = self.store.folder(run) / EPISODES
        if not file.is_file():
            raise InputError(f"{file.parent} has no episodes, so it is not a run of this package: move it away.")
        first, *others = [Row(**asdict(row), **_names(run)) for row in load_rows(file, EpisodeRow)]
        video = str(video_path(run.arm.setting, run.arm.name)) if self._is_filmed(run) else None
        return [replace(first, video=video), *others]

    def outdated(self, run: Run) -> Row | None:
        """A row that the table in the folder had of this run, made of something else than it would be made of now."""
        return next(iter(self._outdated(run)), None)

    def _outdated(self, run: Run) -> list[Row]:
        ours = _keys(run)
        alike = (rows for key, rows in self._before.items() if key[:2] == ours[0][:2] and key not in ours)
        return [row for rows in alike for row in rows if row.training_seed == run.seed]

    def lost(self) -> list[str]:
        """The names of the runs of the table in the folder that neither this study nor the store has.

        One that failed is not lost where this study has a run of that name: now its weights may be there. Neither is
        one that the study has a run of in its place, where the table replaces such rows.
        """
        ours, names = {key for run in self.runs for key in _keys(run)}, {run.id for run in self.runs}
        gone = [rows for key, rows in self._before.items() if key not in ours and not self._is_stored(key[-1])]
        lost = {
            f"{row.setting}/{row.variant}/seed_{row.training_seed}": row.error_kind for rows in gone for row in rows
        }
        return [name for name, failed in lost.items() if not ((failed or self.replaces) and name in names)]

    def _is_stored(self, name: str | None) -> bool:
        return bool(name and self.store.spec(Run.kind, name))

    def forget_failure(self, run: Run) -> None:
        """Discard a run that failed, so that it is made anew, unless somebody has done so."""
        with self.store.claim([run]):
            self._made.pop(run.id, None)
            if (rows := self.made(run)) and rows[0].error_kind:
                self.store.discard(run)
                self._made.pop(run.id)

    def read_again(self) -> None:
        """Forget what has been read: held-out errors have been measured since."""
        self._made.clear()

    def write(self) -> None:
        """Write the table and the videos into the study's folder."""
        for run in self.runs:
            if self._is_filmed(run):
                self._copy_video(run)
        anew = {run.arm.id for run in self.runs if self.made(run)}
        write_rows([row for run in self.runs for row in self._rows(run, run.arm.id in anew)], self.root / ROWS)

    def _rows(self, run: Run, is_begun: bool) -> list[Row]:
        """The rows of a run; of one that is to be made, a row that says so, why it failed before, or what it replaces.

        Args:
            is_begun: whether some run of its setting and variant has been made.
        """
        if rows := self.made(run):
            return rows
        if failed := self._rows_before(run, failed=True):
            return [replace(row, **_names(run)) for row in failed]
        if self.replaces and not is_begun and (older := self._outdated(run)):
            return older
        seeds = {"training_seed": run.seed, "evaluation_seed": run.arm.starts.start}
        return [Row(run=run.digest, **seeds, episode=0, error_kind=NOT_RUN, **_names(run))]

    def _heldout_errors(self, run: Run) -> dict[str, Any]:
        """Columns for the run's error on what is held out of all demonstrations of its setting, where it is known."""
        if run.checkpoints is None or not self.store.has(run.checkpoints):
            return {}
        errors = {data.name: known_error(heldout(run, data), self.store) for data in run.arm.validated_on}
        errors = {name: error for name, error in errors.items() if error is not None}
        own = errors.get(run.arm.validated_on[0].name)
        return {"heldout_mse_m2": own, "heldout_mse_m2_by_data": json.dumps(errors)} if errors else {}

    def _is_filmed(self, run: Run) -> bool:
        return run.seed == FILMED_SEED and (self.store.folder(run) / VIDEO).exists()

    def _copy_video(self, run: Run) -> None:
        video, copy = self.store.folder(run) / VIDEO, self.root / video_path(run.arm.setting, run.arm.name)
        if not copy.exists() or copy.stat().st_mtime != video.stat().st_mtime:
            with replaced(copy) as partial:
                shutil.copy2(video, partial)


def _keys(run: Run) -> list[tuple[str, str, str]]:
    """By what the rows of a run are found in the table in the folder: its setting, its variant and its digests."""
    return [(run.arm.setting, run.arm.name, name) for name in run.digests]


def _names(run: Run) -> dict[str, Any]:
    arm = run.arm
    return {
        "setting": arm.setting,
        "variant": arm.name,
        "role": arm.role,
        "episodes": len(arm.starts),
        "task": arm.env["task"],
        "instruction": told_in(arm.env),
        "demonstrations": arm.demonstrations and arm.demonstrations.name,
    }
