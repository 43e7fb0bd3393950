"""The board's entries that are made of published studies.

What an entry's runs executed is kept beside their study's rows, in `results/NAME/recordings`, from piece to piece and
machine to machine. When all of it is there, the entry is written and replayed, and the recordings go.
"""

import json
import re
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import pandas as pd

from lerobot_constructskill.artifacts.folders import replaced
from lerobot_constructskill.artifacts.store import Store
from lerobot_constructskill.board import from_recordings
from lerobot_constructskill.board.declaration import Declaration
from lerobot_constructskill.board.protocol import LEVEL, PERTURBED_AXES
from lerobot_constructskill.board.submission import read_submission
from lerobot_constructskill.envs.recording import RECORDINGS
from lerobot_constructskill.errors import UserError
from lerobot_constructskill.scripts.console import say
from lerobot_constructskill.scripts.verify import VerifyConfig, verify
from lerobot_constructskill.study.rows import NOT_RUN, ROWS, read_rows
from lerobot_constructskill.study.runs import Run

KEPT = "recordings"


@dataclass(frozen=True)
class Part:
    """What an entry is made of: a variant of a study in some of its settings."""

    study: str
    variant: str
    settings: tuple[str, ...]

    def holds(self, run: Run) -> bool:
        return run.arm.name == self.variant and run.arm.setting in self.settings

    def shares(self, other: "Part") -> bool:
        """Whether a run is in both."""
        return (self.study, self.variant) == (other.study, other.variant) and bool(
            {*self.settings} & {*other.settings}
        )

    def rows(self, folder: Path) -> pd.DataFrame:
        """A row for each of its runs in a study's folder."""
        rows = read_rows(folder / ROWS).drop_duplicates(["setting", "variant", "training_seed"])
        return rows[(rows["variant"] == self.variant) & rows["setting"].isin(self.settings)]

    def is_whole(self, folder: Path) -> bool:
        """Whether each of its runs has failed, or what it executed is kept."""
        if not (folder / ROWS).is_file():
            return False
        rows = self.rows(folder)
        finished = rows[rows["error_kind"].isna()]
        return (
            {*rows["setting"]} == {*self.settings}
            and NOT_RUN not in {*rows["error_kind"]}
            and all(kept(folder, run).is_file() for run in finished["run"])
        )


JOINTS = ("brick_on_brick", "tile_to_grid", "tenon_to_mortise")
LADDER = tuple(f"brick_to_bin_{clearance}mm" for clearance in (40, 20, 10, 5, 3))
PERTURBED = ("control", *(f"{axis}_{LEVEL}" for axis in PERTURBED_AXES))

ENTRIES = {
    "joints_precise": Part("precise", "precise", JOINTS),
    "ladder_precise": Part("precise", "precise", LADDER),
    "precise_turned": Part("precise", "more", ("brick_to_bin_turned",)),
    "precise_shifted": Part("perturbed", "precise", ("control",)),
    "precise_perturbed": Part("perturbed", "precise", PERTURBED),
    "act_shifted": Part("other_policies", "act", ("shifted",)),
    "diffusion_shifted": Part("other_policies", "diffusion", ("shifted",)),
}
"""Folder in `board/entries` to what it is made of."""


def kept(folder: Path, run: str) -> Path:
    """Where a study's folder keeps what a run executed: laid out as a store is."""
    return folder / KEPT / Run.kind / run / RECORDINGS


def keep(folder: Path, study: str, runs: Iterable[Run], store: Store) -> None:
    """Copy to a study's folder what runs executed of which an entry is made; what older runs executed goes."""
    own = of(study)
    for run in runs:
        made, copy = store.folder(run) / RECORDINGS, kept(folder, run.digest)
        if made.is_file() and any(entry.holds(run) for entry in own.values()):
            with replaced(copy) as partial:
                shutil.copyfile(made, partial)
    _remove_others(folder, own.values())


def of(study: str) -> dict[str, Part]:
    """The entries that are made of a study, by name."""
    return {name: entry for name, entry in ENTRIES.items() if entry.study == study}


def whole(folder: Path, study: str) -> list[str]:
    """The entries of a study that can be written. Those that share runs are written together, and then these go."""
    entries = of(study)
    lacking = [entry for entry in entries.values() if not entry.is_whole(folder)]
    return [name for name, entry in entries.items() if not any(map(entry.shares, lacking))]


def write_entries(names: Sequence[str], folder: Path, study: str, board: Path, commit: str) -> list[str]:
    """Write entries that are made of a study, and return those that were written.

    An entry says of itself what the one before it said, but for the commit and the processors. It is replayed. What
    was found of when the episodes of the one before were lost is removed. One that is refused, as its runs are of
    different makes of processors or end otherwise, stays as it was, and the reason is printed.

    Args:
        names: some that `whole` returns.
        commit: that has the entries' rows.
    """
    own, written = of(study), []
    for name in names:
        root = board / "entries" / name
        with TemporaryDirectory(dir=board) as scratch:
            made = Path(scratch) / name
            try:
                _write(own[name], folder, read_submission(root).declaration, commit, made)
                say(verify(VerifyConfig(made, record=board / "verified")))
            except UserError as error:
                say(f"No new entry {name}: {error}")
                continue
            root.rename(Path(scratch) / "before")
            made.rename(root)
        (board / "recovered" / f"{name}.parquet").unlink(missing_ok=True)
        written.append(name)
    return written


def drop(folder: Path, study: str, names: Sequence[str]) -> None:
    """Remove from a study's folder the recordings of some entries that no other one needs."""
    _remove_others(folder, [entry for name, entry in of(study).items() if name not in names])


def _remove_others(folder: Path, entries: Iterable[Part]) -> None:
    """Remove the recordings of runs that are in none of some entries."""
    needed = {run for entry in entries for run in entry.rows(folder)["run"].dropna()}
    for path in (folder / KEPT / Run.kind).glob("*"):
        if path.name not in needed:
            shutil.rmtree(path)


def _write(entry: Part, folder: Path, before: Declaration, commit: str, root: Path) -> None:
    rows, settings = entry.rows(folder), before.settings
    processors = sorted({json.loads(versions)["processor"] for versions in rows["versions"].dropna()})
    said = {
        "revision": f"study {entry.study} of results/{entry.study}, variant {entry.variant}, commit {commit}",
        "compute": f"2 cores of {' and '.join(processors)}, no GPU",
    }
    said["policy"] = re.sub(r" in (bfloat16|float32)", "", before.about.policy)  # that of the processors before
    about = from_recordings.with_draws(replace(before.about, **said), folder)
    recorded = from_recordings.recorded_by_study(folder, folder / KEPT, entry.variant, settings, entry.settings)
    made = from_recordings.trained_by_study(folder, entry.variant, settings, entry.settings)
    from_recordings.submit(root, about, before.suite, settings, *recorded, made)
