"""What a comparison can read without running anything: a study's folder, recordings, and `lerobot-eval`'s results."""

from collections.abc import Sequence
from itertools import chain
from pathlib import Path

import pandas as pd

from lerobot_constructskill.comparison.sides import MAKER, Conditions, Outcomes, Side, merge_versions, read_versions
from lerobot_constructskill.contract import LOOSE, SUITES
from lerobot_constructskill.envs.recording import RECORDINGS, STARTING, Episode, read_recordings
from lerobot_constructskill.errors import InputError, plural
from lerobot_constructskill.lerobot_internals import EVALUATED
from lerobot_constructskill.study.rows import NOT_RUN, ROWS, STUDY, check_folder, read_environments, read_rows

EVAL_INFO = "eval_info.json"
"""What `lerobot-eval` writes into its output folder."""


def read_study(root: Path, arm: str) -> Side:
    """The training seeds of a setting/variant, or setting/reference, of a study's folder that have been run.

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
    return Side(
        name=f"{root}:{arm}",
        kind=f"{plural(rows['training_seed'].nunique(), 'training seed')} of a study",
        env=_env(root, arm.partition("/")[0]),
        seeds=[_outcomes(own) for _, own in rows.groupby("training_seed", sort=True)],
        versions=merge_versions(
            read_versions(None if pd.isna(text) else text, backend=None if pd.isna(backend) else backend)
            for text, backend in rows[["versions", "backend"]].drop_duplicates().itertuples(index=False)
        ),
    )


def _env(root: Path, setting: str) -> dict:
    envs = read_environments(root)
    if setting not in envs:
        raise InputError(f"'{root / STUDY}' does not say how '{setting}' is evaluated.")
    return envs[setting]


def _outcomes(rows: pd.DataFrame) -> Outcomes | None:
    if rows["error_kind"].notna().any():
        return None
    if rows["placed"].isna().any() or rows["evaluation_seed"].duplicated().any():
        raise InputError(f"The rows of {rows['variant'].iloc[0]} lack a placement, or have two of one start.")
    return {int(start): bool(placed) for start, placed in zip(rows["evaluation_seed"], rows["placed"], strict=True)}


def recordings_in(folder: Path) -> list[Path]:
    """The files in a folder that recordings may be in: a study's run has one, $CONSTRUCTSKILL_RECORD many."""
    whole = folder / RECORDINGS
    return [whole] if whole.is_file() else sorted(folder.glob("[!.]*.parquet"))


def read_recorded(name: str, folders: Sequence[Path]) -> Side:
    """Episodes that were recorded by $CONSTRUCTSKILL_RECORD, a folder for each training seed.

    Raises:
        InputError: a file is no recording, a folder has two of one start, or the episodes differ in their conditions.
    """
    by_folder = {folder: list(chain(*map(read_recordings, recordings_in(folder)))) for folder in folders}
    every = [one for recordings in by_folder.values() for one in recordings]
    envs = [{name: getattr(one, name) for name in STARTING} for one in every]
    for env in envs:
        if different := Conditions.of(envs[0]).differences(Conditions.of(env)):
            raise InputError(f"The recordings of '{name}' differ in {', '.join(different)}; a side needs one of each.")
    return Side(
        name=name,
        kind=f"recordings of {plural(len(folders), 'training seed')}",
        env=envs[0],
        seeds=[_recorded(folder, recordings) for folder, recordings in by_folder.items()],
        versions=merge_versions(_versions_of(one) for one in every),
    )


def _versions_of(recording: Episode) -> dict[str, str]:
    told = read_versions(recording.versions, backend=recording.backend)
    return {MAKER if name == "processor" else name: value for name, value in told.items()}


def _recorded(folder: Path, recordings: list[Episode]) -> Outcomes:
    starts = [one.evaluation_seed for one in recordings]
    if twice := [start for start in starts if starts.count(start) > 1]:
        raise InputError(
            f"'{folder}' has two recordings of start {twice[0]}: record each training seed into a folder of its own."
        )
    return {one.evaluation_seed: one.placed for one in recordings}


def read_evaluated(name: str, folders: Sequence[Path], first_start: int | None, task: str | None, label: str) -> Side:
    """Episodes of one task in output folders of `lerobot-eval`, one for each training seed.

    LeRobot writes whether each episode succeeded. Its start, task, length and observation it does not write: whoever
    calls has to know them.

    Args:
        first_start: the `--seed` that `lerobot-eval` was given; episode i starts from that plus i.
        task: the task, where there is more than one in the folders.
        label: of the perturbation, which LeRobot keeps in the names of its results.

    Raises:
        InputError: a folder's file is not `lerobot-eval`'s, has not that task, or no start is given.
    """
    if first_start is None:
        raise InputError(
            f"'{name}' is of lerobot-eval, which does not write from which starts it evaluated: add --seed, as it was "
            "given to lerobot-eval (1000 where it was not)."
        )
    successes = [_successes(folder / EVAL_INFO, task, label) for folder in folders]
    seeds = [dict(enumerate(own, first_start)) for own in successes]
    return Side(name=name, kind=f"lerobot-eval's results of {plural(len(folders), 'training seed')}", seeds=seeds)


def _successes(file: Path, task: str | None, label: str) -> list[bool]:
    told = EVALUATED.read(file)["per_task"]
    results = {(one["task_group"], one["task_id"]): one["metrics"]["successes"] for one in told}
    if len(results) < len(told):
        raise InputError(f"'{file}' has two results of one task.")
    suites = {f"{suite}{label}": tasks for suite, tasks in SUITES.items()}
    ours = {key: own for key, own in results.items() if key[0] in suites or key[0] == f"{LOOSE}{label}"}
    if len(ours) == 1 and next(iter(ours))[0] == f"{LOOSE}{label}":
        return next(iter(ours.values()))
    for (suite, number), own in ours.items():
        if suites.get(suite, ())[number : number + 1] == (task,) and number >= 0:
            return own
    found = ", ".join(f"{suite} {number}" for suite, number in results)
    raise InputError(f"{file} has no result that is of {task or 'one task'}{label} for certain; it has: {found}.")
