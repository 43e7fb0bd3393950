"""Finds a side of a comparison from what the user typed, and reads those that need no evaluation."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from glob import glob
from itertools import chain
from pathlib import Path
from typing import Any

import pandas as pd

from lerobot_constructskill.comparison.sides import Placements, Side, check_equal, conditions, merge_versions
from lerobot_constructskill.contract import LOOSE, SUITES
from lerobot_constructskill.envs.recording import RECORDINGS, STARTING, Episode, read_recordings
from lerobot_constructskill.errors import InputError, MissingError, plural
from lerobot_constructskill.lerobot_internals import EVALUATED as EVAL_INFO
from lerobot_constructskill.lerobot_internals import LAST_CHECKPOINT
from lerobot_constructskill.study.rows import NOT_RUN, ROWS, STUDY, check_folder, read_environments, read_rows

IN_STUDY, CHECKPOINT, RECORDED, EVALUATED = "study", "checkpoint", "recordings", "lerobot-eval"
"""Kinds of sources."""

CONTENTS = (
    (CHECKPOINT, Path(), "config.json"),
    (CHECKPOINT, LAST_CHECKPOINT, "config.json"),
    (CHECKPOINT, Path("pretrained_model"), "config.json"),
    (RECORDED, Path(), "[!.]*.parquet"),
    (EVALUATED, Path(), "eval_info.json"),
)
"""Kind, inner folder, and a file in it. Recordings come first, as they say more than results of `lerobot-eval`."""


@dataclass(frozen=True)
class Source:
    """Where a side is read from.

    Args:
        name: what the user typed.
        kind: `IN_STUDY`, `CHECKPOINT`, `RECORDED` or `EVALUATED`.
        folders: the study's folder, or one folder for each training seed.
        arm: setting/variant of a study.
    """

    name: str
    kind: str
    folders: tuple[Path, ...]
    arm: str = ""


def find(text: str) -> Source:
    """Find the source of a side.

    Args:
        text: a study's folder, ":" and setting/variant; or folders separated by commas, or patterns such as
            `outputs/mine/train/seed_*`, of checkpoints, of `lerobot-train`, of `lerobot-eval` or of recordings.

    Raises:
        MissingError: there is no such folder.
        InputError: the folders hold nothing of this, are of several kinds, or one is named twice.
    """
    root, _, arm = text.rpartition(":") if ":" in text else (text, "", "")
    if (Path(root) / STUDY).is_file():
        return Source(text, IN_STUDY, (Path(root),), arm)
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
        f"'{folder}' is no checkpoint (config.json), no output of lerobot-train ({LAST_CHECKPOINT}) or lerobot-eval "
        "(eval_info.json), and has no recordings (*.parquet)."
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
    rows = rows[(arms == arm) & (rows["error_kind"].fillna("") != NOT_RUN)]
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
        versions=merge_versions(_versions(text, backend) for text, backend in made_with),
    )


def _placements_of_rows(rows: pd.DataFrame) -> Placements | None:
    if rows["error_kind"].notna().any():
        return None
    if rows["placed"].isna().any() or rows["evaluation_seed"].duplicated().any():
        raise InputError(f"The rows of {rows['variant'].iloc[0]} lack a placement, or have two of one start.")
    return dict(zip(rows["evaluation_seed"].astype(int), rows["placed"].astype(bool), strict=True))


def _versions(text: str, backend: str) -> dict[str, str]:
    return json.loads(text or "{}") | ({"backend": backend} if backend else {})


def read_recorded(name: str, folders: Sequence[Path]) -> Side:
    """Read episodes that $CONSTRUCTSKILL_RECORD wrote, in a folder for each training seed.

    Raises:
        InputError: a file is no recording, a folder has two of one start, or the episodes differ in their conditions.
    """
    by_folder = {}
    for folder in folders:
        whole = folder / RECORDINGS  # a study's run has this file alone, $CONSTRUCTSKILL_RECORD writes many
        files = [whole] if whole.is_file() else sorted(folder.glob("[!.]*.parquet"))
        by_folder[folder] = list(chain(*map(read_recordings, files)))
    return recorded_side(name, f"recordings of {plural(len(folders), 'training seed')}", by_folder)


def recorded_side(name: str, kind: str, by_folder: Mapping[Path, Sequence[Episode]]) -> Side:
    """Make a side of recordings, by the folder of each training seed. Raises as `read_recorded` does."""
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
    versions = merge_versions(_versions(one.versions, one.backend) for one in recordings)
    if "processor" in versions:
        versions["processor's maker"] = versions.pop("processor")  # in a study's rows, "processor" is its full name
    seeds = [{one.evaluation_seed: one.placed for one in own} for own in by_folder.values()]
    return Side(name, kind, envs[0], seeds, versions)


def read_evaluated(name: str, folders: Sequence[Path], first_start: int | None, env: Mapping[str, Any]) -> Side:
    """Read episodes of one task from output folders of `lerobot-eval`, one for each training seed.

    LeRobot writes whether each episode succeeded. It does not write starts, episode length and observation.

    Args:
        first_start: the `--seed` that `lerobot-eval` was given; episode i starts from that plus i.
        env: keyword arguments of the `ConstructSkillEnv` that it evaluated in.

    Raises:
        InputError: a folder's file is not `lerobot-eval`'s, lacks the task, or no start is given.
    """
    if first_start is None:
        raise InputError(
            f"'{name}' is of lerobot-eval, which does not write from which starts it evaluated: add --seed, as it was "
            "given to lerobot-eval (1000 where it was not)."
        )
    seeds = [dict(enumerate(_successes(folder / "eval_info.json", env), first_start)) for folder in folders]
    return Side(name=name, kind=f"lerobot-eval's results of {plural(len(folders), 'training seed')}", seeds=seeds)


def _successes(file: Path, env: Mapping[str, Any]) -> list[bool]:
    """Successes of the task, whose perturbation LeRobot keeps in the names of its results."""
    task, label = env["task"], conditions(env)["perturbation"]
    results = EVAL_INFO.read(file)["per_task"]
    found = {(one["task_group"], one["task_id"]): one["metrics"]["successes"] for one in results}
    if len(found) < len(results):
        raise InputError(f"'{file}' has two results of one task.")
    ours = [key for key in found if key[0] in {f"{suite}{label}" for suite in (*SUITES, LOOSE)}]
    of_task = [(f"{suite}{label}", tasks.index(task)) for suite, tasks in SUITES.items() if task in tasks]
    if len(ours) == 1 and ours[0][0] == f"{LOOSE}{label}":
        of_task += ours  # a single task outside of the suites, whose name LeRobot does not write
    for key in ours:
        if key in of_task:
            return found[key]
    said = ", ".join(f"{suite} {number}" for suite, number in found)
    raise InputError(f"{file} has no result that is of {task}{label} for certain; it has: {said}.")
