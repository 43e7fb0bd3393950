"""From what was recorded to a submission: a study's runs, or folders that `$CONSTRUCTSKILL_RECORD` named."""

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from lerobot_constructskill.board.protocol import Setting, where
from lerobot_constructskill.board.submission import About, Claim, Submission, write_submission
from lerobot_constructskill.envs.recording import RECORDINGS, Recording, read_recordings
from lerobot_constructskill.errors import InputError, MissingError
from lerobot_constructskill.study.rows import NOT_RUN, ROWS, check_folder, read_environments, read_rows

SEED = r"seed_([0-9]{1,9})"

type Piles = dict[int, list[Recording]]
"""Training seed to what its policy did."""

type Failures = dict[int, str]
"""Training seed to why its run never finished."""


def recorded_in(root: Path) -> Piles:
    """What `root` holds, in a folder `seed_0`, `seed_1`, ... for each training seed.

    Raises:
        MissingError: there is no such folder.
        InputError: a file in one is no recording, or a folder is no training seed's, or another one is as well.
    """
    folders: dict[int, Path] = {}
    for path in sorted(root.glob("seed_*")):
        found = re.fullmatch(SEED, path.name)
        if found is None:
            raise InputError(f"'{path}' is of no training seed: name it seed_0, seed_1, ..., or move it away.")
        if (other := folders.setdefault(int(found[1]), path)) != path:
            raise InputError(f"'{other}' and '{path}' are of the same training seed: name one otherwise.")
    if not folders:
        raise MissingError(f"'{root}' has no folder seed_0, seed_1, ... of recordings.")
    return {seed: list(_recordings(folder)) for seed, folder in folders.items()}


def _recordings(folder: Path) -> Iterator[Recording]:
    """What its files hold. A name that begins with a dot is of a file that was never finished."""
    for path in sorted(folder.rglob("[!.]*")):
        if path.suffix.lower() == ".parquet":
            yield from read_recordings(path)


def of_study(
    root: Path, store: Path, variant: str, settings: Mapping[str, Setting], chosen: Sequence[str] | None = None
) -> tuple[Piles, Failures]:
    """What a variant's runs did where a submission's `settings` are evaluated, and why some failed.

    Args:
        chosen: the study's settings whose runs are meant, where several evaluate alike; all by default.

    Raises:
        MissingError: the study, or what one of its runs executed, is not there.
        InputError: the study has no such variant, or not where one of the settings is, or twice there.
    """
    check_folder(root)
    rows = read_rows(root / ROWS)
    own = rows[rows["variant"] == variant]
    if own.empty:
        raise InputError(f"The study has no variant '{variant}'; it has: {', '.join(rows['variant'].unique())}.")
    own = own[own["setting"].isin(_alike(root, variant, own["setting"].unique(), settings, chosen))]
    piles: Piles = {}
    failures: Failures = {}
    for row in own.drop_duplicates(["setting", "training_seed"]).itertuples():
        pile = piles.setdefault(int(row.training_seed), [])
        kind = row.error_kind if isinstance(row.error_kind, str) else None  # null is pandas' own
        if kind == NOT_RUN:
            raise MissingError(f"The study has not run {row.setting}/{variant}/seed_{row.training_seed} yet.")
        if kind:
            failures[int(row.training_seed)] = " ".join(str(row.error).split())[:300]
            continue
        path = store / "runs" / str(row.run) / RECORDINGS
        if not path.is_file():
            raise MissingError(
                f"'{path}' is missing: give the store in which the run was made; runs from before actions were kept "
                "cannot be replayed."
            )
        pile += read_recordings(path)
    return piles, failures


def _alike(
    root: Path, variant: str, ran: Iterable[str], settings: Mapping[str, Setting], chosen: Sequence[str] | None
) -> list[str]:
    """Those settings of a study, among those that a variant `ran` in, that evaluate where one of `settings` does."""
    study = _environments(root)
    if unknown := [name for name in chosen or () if name not in study]:
        raise InputError(f"The study has no setting '{unknown[0]}'; it has: {', '.join(study)}.")
    asked = [setting.where for setting in settings.values()]
    alike: dict[tuple, list[str]] = {}
    ran = [name for name in ran if name in study and name in (chosen or study)]
    for name in ran:
        if study[name] in asked:
            alike.setdefault(study[name], []).append(name)
    if not alike:
        raise InputError(
            f"'{variant}' was evaluated in none of {_told(asked)}, but in {_told(study[name] for name in ran)}."
        )
    if several := [names for names in alike.values() if len(names) > 1]:
        raise InputError(
            f"{' and '.join(several[0])} of the study evaluate alike: say whose runs are meant, such as "
            f"--study_settings=[{','.join(names[-1] for names in alike.values())}]."
        )
    return [name for (name,) in alike.values()]


def _environments(root: Path) -> dict[str, tuple[str, int, str]]:
    """Where each of a study's settings evaluates, as `Setting.where`."""
    return {
        name: where(env["task"], env.get("episode_length"), env.get("perturb", ""), env.get("perturb_seed", 0))
        for name, env in read_environments(root).items()
    }


def _told(places: Iterable[tuple[str, int, str]]) -> str:
    return ", ".join(f"{task}{label} ({length} steps)" for task, length, label in dict.fromkeys(places))


def submit(
    root: Path, about: About, suite: str, settings: Mapping[str, Setting], piles: Piles, failures: Failures
) -> Submission:
    """Write a submission of what was recorded.

    Args:
        failures: training seeds whose missing episodes failed, and why; they stay in the denominator.

    Raises:
        TakenError: `root` exists.
        InputError: an episode is missing or was recorded twice, or they do not belong together.
    """
    claims, used = [], []
    for seed, pile in sorted(({seed: [] for seed in failures} | piles).items()):
        for name, setting in settings.items():
            found = _by_start(pile, setting)
            claims += [_claim(name, setting, seed, start, found, failures.get(seed)) for start in setting.starts]
            used += [one for start in setting.starts for one in found.get(start, [])]
    if not used:
        raise InputError("Nothing was recorded.")
    if about.observes == "pixels_agent_pos" and "pixels" in {one.obs_type for one in used}:
        raise InputError(
            "about.observes is pixels_agent_pos, but the policy was shown pixels: it can observe no more."
        )
    return write_submission(
        root,
        claims,
        about=about,
        suite=suite,
        settings=dict(settings),
        training_seeds=sorted(piles.keys() | failures.keys()),
        backend=_one({one.backend for one in used}, "backends"),
        versions=_versions(used),
    )


def _versions(recordings: Iterable[Recording]) -> dict[str, str]:
    return json.loads(_one({one.versions for one in recordings}, "versions of packages or makes of processors"))


def _one(different: set[str], what: str) -> str:
    if len(different) > 1:
        raise InputError(
            f"The episodes were recorded with several {what}: {' and '.join(sorted(different))}; record them with one."
        )
    return different.pop()


def _by_start(pile: Iterable[Recording], setting: Setting) -> dict[int, list[Recording]]:
    """The recordings of a setting, by the seed of their start."""
    found: dict[int, list[Recording]] = {}
    for one in pile:
        if where(one.task, one.episode_length, one.perturb, one.perturb_seed) == setting.where:
            found.setdefault(one.evaluation_seed, []).append(one)
    return found


def _claim(name: str, setting: Setting, seed: int, start: int, pile: dict, failure: str | None) -> Claim:
    where = f"{name}, training seed {seed}, start {start}"
    found = pile.get(start, [])
    if not found and failure:
        return Claim(start, setting=name, training_seed=seed, error=failure)
    if not found:
        raise InputError(
            f"{where} was not recorded (task {setting.task}, {setting.episode_length} steps); evaluate it, or say in "
            f"--failures why training seed {seed} failed."
        )
    if len({one.flat.tobytes() for one in found}) > 1:
        raise InputError(f"{where} was recorded twice, with different actions; record into an empty folder.")
    went = {key: value for key, value in vars(found[0]).items() if key in vars(Claim(start)) and key != "actions"}
    return Claim(**went, setting=name, training_seed=seed, actions=found[0].flat)
