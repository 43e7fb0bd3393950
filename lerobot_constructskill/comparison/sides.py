"""The sides of a comparison: training seeds of a policy, where they were evaluated, and the result of each start."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from glob import glob
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from lerobot_constructskill.analysis.stats.outcomes import by_unit
from lerobot_constructskill.contract import OBS_TYPES, get_task
from lerobot_constructskill.envs.recording import RECORDINGS, STARTING, Episode, read_recordings
from lerobot_constructskill.errors import InputError, MissingError, plural
from lerobot_constructskill.lerobot_internals import LAST_CHECKPOINT
from lerobot_constructskill.perturbations import Perturbation
from lerobot_constructskill.study.rows import (
    ROWS,
    STUDY,
    Draws,
    check_folder,
    merged,
    ran,
    read_draws,
    read_environments,
    read_means,
    read_rows,
)

Placements = Mapping[int, bool]
"""Start (seed of an evaluation episode) to whether the episode placed the object."""

IN_STUDY, CHECKPOINT, RECORDED = "study", "checkpoint", "recordings"
"""Kinds of sources."""

EVERY = "*"
"""In place of a setting: every one that is not perturbed."""

CONTENTS = (
    (CHECKPOINT, Path(), "config.json"),
    (CHECKPOINT, LAST_CHECKPOINT, "config.json"),
    (CHECKPOINT, Path("pretrained_model"), "config.json"),
    (RECORDED, Path(), "[!.]*.parquet"),
)
"""Kind, inner folder, and a file in it."""


@dataclass(frozen=True)
class Side:
    """One side of a comparison.

    Args:
        name: what the user called it.
        kind: what it was read from, such as "10 training seeds of a study".
        env: keyword arguments of the `ConstructSkillEnv` that it was evaluated in.
        seeds: placements of each training seed; None for a seed whose training or evaluation failed.
        versions: packages, processor and simulator that its episodes were made with.
        draws: which training seeds share demonstrations; None if that is not known.
        numbers: the training seeds' numbers, in the order of `seeds`; empty if they are not known.
        learnt_from: hashes of the demonstrations; empty if they are not known.
    """

    name: str
    kind: str
    env: Mapping[str, Any]
    seeds: list[Placements | None]
    versions: dict[str, str]
    draws: Draws | None = None
    numbers: Sequence[int] = ()
    learnt_from: Sequence[str] = ()

    @property
    def covered(self) -> str | None:
        """What intervals over its units cover; None if that is not known."""
        return self.draws.covered if self.draws else None

    def units(self, rates: Sequence[float]) -> np.ndarray:
        """The rates that a comparison counts: of each training seed, or of each draw if draws differ in data."""
        return by_unit(rates, [*map(self.draws.unit, self.numbers)]) if self.draws else np.array(rates)

    @property
    def unit(self) -> str:
        """What a comparison counts, as a word."""
        return "draw" if self.draws and self.draws.groups_seeds else "seed"

    @property
    def starts_of_each(self) -> list[set[int]]:
        """Starts of each seed, none for one that failed."""
        return [set(placed or ()) for placed in self.seeds]

    @property
    def failed_draws(self) -> int:
        """How many draws, or seeds where each is one, failed whole."""
        return int((self.units([bool(placed) for placed in self.seeds]) == 0).sum())

    @property
    def starts(self) -> set[int] | None:
        """Starts that all training seeds were evaluated from; None if every seed failed."""
        finished = [set(placed) for placed in self.seeds if placed is not None]
        return set.intersection(*finished) if finished else None


def are_apart(each: Sequence[set[int]]) -> bool:
    """Whether seeds have starts in which no two draws share any.

    Args:
        each: starts of each seed; none for one that failed.
    """
    different = {frozenset(starts) for starts in each if starts}
    is_apart = len(different) > 1 and sum(map(len, different)) == len(set.union(*each))
    return is_apart and len({*map(len, different)}) == 1


def conditions(env: Mapping[str, Any]) -> dict[str, Any]:
    """Everything that must be equal for two episodes from the same start to be comparable.

    Args:
        env: keyword arguments of `ConstructSkillEnv`; missing ones have its defaults.

    Raises:
        InputError: there is no such task, perturbation or observation.
    """
    task, obs_type = get_task(env["task"]), env.get("obs_type") or next(iter(OBS_TYPES))
    perturbation = Perturbation(env.get("perturb") or "", env.get("perturb_seed") or 0)
    perturbation.check(task)
    if obs_type not in OBS_TYPES:
        raise InputError(f"obs_type must be one of {', '.join(OBS_TYPES)}, not '{obs_type}'.")
    return {
        "task": task.name,
        "episode_length": env.get("episode_length") or task.horizon,
        "obs_type": obs_type,
        "perturbation": perturbation.label,
    }


def check_equal(who: str, one: Mapping[str, Any], other: Mapping[str, Any]) -> None:
    """Check that two environments have equal conditions.

    Raises:
        InputError: they differ; the message begins with `who`.
    """
    one, other = conditions(one), conditions(other)
    different = [
        f"{name} ({one[name] or 'none'}, {other[name] or 'none'})" for name in one if one[name] != other[name]
    ]
    if different:
        raise InputError(f"{who} cannot be compared: they differ in {', '.join(different)}.")


@dataclass(frozen=True)
class Source:
    """Where a side is read from.

    Args:
        name: what the user typed.
        kind: `IN_STUDY`, `CHECKPOINT` or `RECORDED`.
        folders: the study's folder, or one folder for each training seed.
        arm: setting/variant of a study; for several settings */variant or mean/variant, as `settings_of` reads it.
        recorded: the recordings of each folder, where they were read.
    """

    name: str
    kind: str
    folders: tuple[Path, ...]
    arm: str = ""
    recorded: Mapping[Path, Sequence[Episode]] | None = field(default=None, compare=False)

    @property
    def setting(self) -> str:
        return self.arm.rpartition("/")[0]

    @property
    def variant(self) -> str:
        return self.arm.rpartition("/")[2]


def find(text: str) -> Source:
    """Find the source of a side.

    Args:
        text: a study's folder, ":" and setting/variant; or folders separated by commas, or patterns such as
            `outputs/mine/train/seed_*`, of checkpoints, of `lerobot-train` or of recordings.

    Raises:
        MissingError: there is no such folder.
        InputError: the folders hold nothing of this, are of several kinds, or one is named twice.
    """
    parts = text.split(":")
    for n in range(len(parts), 0, -1):  # a folder's name can have a colon, and so can that of a mean
        if (root := Path(":".join(parts[:n])) / STUDY).is_file():
            return Source(text, IN_STUDY, (root.parent,), ":".join(parts[n:]))
    found: list[tuple[str, Path]] = []
    for pattern in text.split(","):
        folders = sorted(Path(name) for name in glob(pattern.strip()) if Path(name).is_dir())
        if not folders:
            raise MissingError(f"There is no folder '{pattern.strip()}'.")
        found += map(_recognize, folders)
    kinds, folders = zip(*found, strict=True)
    if len(set(kinds)) > 1:
        raise InputError(f"'{text}' is of several kinds ({', '.join(sorted({*kinds}))}); a side is of one kind.")
    if len({folder.resolve() for folder in folders}) < len(folders):
        raise InputError(f"'{text}' names a folder twice; each training seed counts once.")
    return Source(text, kinds[0], folders)


def _recognize(folder: Path) -> tuple[str, Path]:
    """The kind of a folder, and the folder in it to read."""
    for kind, inner, file in CONTENTS:
        if any((folder / inner).glob(file)):
            return kind, folder / inner
    raise InputError(
        f"'{folder}' is no checkpoint (config.json), no output of lerobot-train ({LAST_CHECKPOINT}), and has no "
        "recordings (*.parquet)."
    )


def read_study(root: Path, arm: str) -> Side:
    """Read those training seeds of a study's setting/variant, or setting/reference, that were run.

    Raises:
        MissingError: the folder is not that of a study.
        InputError: its files cannot be read, or it has no such variant, or no run of it.
    """
    check_folder(root)
    rows = read_rows(root / ROWS)
    arms = rows["setting"] + "/" + rows["variant"]
    if arm not in set(arms):
        known = ", ".join(dict.fromkeys(arms))
        raise InputError(f"'{root}' has no variant '{arm}'; name one as in {root}:setting/variant; it has: {known}.")
    rows = ran(rows[arms == arm])
    if rows.empty:
        raise InputError(f"No run of '{arm}' in '{root}' has been made.")
    setting, envs = arm.partition("/")[0], read_environments(root)
    if setting not in envs:
        raise InputError(f"'{root / STUDY}' does not say how '{setting}' is evaluated.")
    made_with = rows[["versions", "backend"]].drop_duplicates().fillna("").itertuples(index=False)
    return Side(
        name=f"{root}:{arm}",
        kind=f"{plural(rows['training_seed'].nunique(), 'training seed')} of a study",
        env=envs[setting],
        seeds=[_placements_of_rows(own) for _, own in rows.groupby("training_seed", sort=True)],
        versions=merged(_versions(text, backend) for text, backend in made_with),
        draws=read_draws(root),
        numbers=sorted(int(number) for number in rows["training_seed"].unique()),
        learnt_from=sorted({*rows["dataset_sha256"].dropna()}),
    )


class Place(NamedTuple):
    """Where episodes that are compared are run: the task, and the label of its perturbation."""

    task: str
    perturbation: str = ""

    def __str__(self) -> str:
        return self.task + self.perturbation


def place_of(env: Mapping[str, Any]) -> Place:
    """The place of an environment, or of a recording's fields. Raises as `conditions` does."""
    return Place(*(conditions(env)[name] for name in ("task", "perturbation")))


def is_of_several(source: Source) -> bool:
    """Whether a side names several settings of a study, whatever number of them was run."""
    return source.kind == IN_STUDY and source.setting in (EVERY, *read_means(source.folders[0]))


def settings_of(source: Source) -> dict[str, Place]:
    """The settings that a study's side names and its variant ran in, in the study's order.

    "*" is every setting that is not perturbed; a name of the study's `analysis.means` is the settings of that mean.

    Raises:
        MissingError, InputError: as `read_study` does; or "*" would count a task twice.
    """
    root = source.folders[0]
    check_folder(root)
    envs = read_environments(root)
    if not is_of_several(source):  # `read_study` tells of a setting that is not there
        return {source.setting: place_of(envs[source.setting])} if source.setting in envs else {}
    rows = read_rows(root / ROWS)
    own = rows[rows["variant"] == source.variant]
    if own.empty:
        known = ", ".join(rows["variant"].unique())
        raise InputError(f"'{root}' has no variant '{source.variant}'; it has: {known}.")
    named = envs if source.setting == EVERY else read_means(root)[source.setting]
    there = ran(own)["setting"].unique()
    places = {name: place_of(envs[name]) for name in named if name in there}
    if source.setting != EVERY:
        return places
    found = {name: place for name, place in places.items() if not place.perturbation}
    if twice := [name for name, place in found.items() if [*found.values()].count(place) > 1]:
        raise InputError(
            f"'{source.name}' would count {found[twice[0]]} more than once ({', '.join(twice)}): name settings under "
            f"analysis.means in the study's file, and that mean in place of '{EVERY}'."
        )
    return found


def _recordings(folder: Path) -> list[Episode]:
    whole = folder / RECORDINGS  # a study's run has this file alone, $CONSTRUCTSKILL_RECORD writes many
    files = [whole] if whole.is_file() else sorted(folder.glob("[!.]*.parquet"))
    return list(chain(*map(read_recordings, files)))


def _placements_of_rows(rows: pd.DataFrame) -> Placements | None:
    if rows["error_kind"].notna().any():
        return None
    if rows["placed"].isna().any() or rows["evaluation_seed"].duplicated().any():
        raise InputError(f"The rows of {rows['variant'].iloc[0]} lack a placement, or have two of one start.")
    return dict(zip(rows["evaluation_seed"].astype(int), rows["placed"].astype(bool), strict=True))


def _versions(text: str, backend: str) -> dict[str, str]:
    return json.loads(text or "{}") | ({"backend": backend} if backend else {})


def read(source: Source) -> Side:
    """Read a side that needs no evaluation: a study's, or recordings in a folder for each training seed.

    Raises:
        InputError: as `read_study` does; or a file is no recording, a folder has two of one start, or the episodes
            differ in their conditions.
    """
    if source.kind == IN_STUDY:
        return read_study(source.folders[0], source.arm)
    by_folder = read_recorded(source)
    return recorded_side(source.name, f"recordings of {plural(len(by_folder), 'training seed')}", by_folder)


def read_recorded(source: Source) -> Mapping[Path, Sequence[Episode]]:
    """The recordings in each folder of a source, of any number of tasks. Raises as `read` does."""
    return source.recorded or {folder: _recordings(folder) for folder in source.folders}


def recorded_side(name: str, kind: str, by_folder: Mapping[Path, Sequence[Episode]]) -> Side:
    """Make a side of recordings, by the folder of each training seed. Raises as `read` does."""
    recordings = list(chain(*by_folder.values()))
    envs = [{name: getattr(one, name) for name in STARTING} for one in recordings]
    for env in envs:
        check_equal(f"The recordings of '{name}'", envs[0], env)
    for folder, own in by_folder.items():
        starts = [one.evaluation_seed for one in own]
        if twice := [start for start in starts if starts.count(start) > 1]:
            raise InputError(
                f"'{folder}' has two recordings of start {twice[0]}: record each training seed into its own folder."
            )
    versions = merged(_versions(one.versions, one.backend) for one in recordings)
    if "processor" in versions:
        versions["processor's maker"] = versions.pop("processor")  # in a study's rows, "processor" is its full name
    seeds = [{one.evaluation_seed: one.placed for one in own} for own in by_folder.values()]
    return Side(name, kind, envs[0], seeds, versions)
