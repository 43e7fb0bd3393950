"""Makes a submission from recorded episodes: of a study's runs, or of folders that `$CONSTRUCTSKILL_RECORD` named."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from lerobot_constructskill.board.declaration import OBSERVES, About
from lerobot_constructskill.board.protocol import BoardSetting, environment_key
from lerobot_constructskill.board.recipe import recipe_of, trained_by
from lerobot_constructskill.board.submission import Claim, Submission, write_submission
from lerobot_constructskill.bounds import seed_of
from lerobot_constructskill.envs.recording import RECORDINGS, Episode, read_recordings
from lerobot_constructskill.errors import InputError, MissingError, one_line
from lerobot_constructskill.study.rows import NOT_RUN, ROWS, check_folder, read_draws, read_environments, read_rows

type Recorded = dict[int, list[Episode]]
"""Training seed to the episodes of its policy."""

type Failures = dict[int, str]
"""Training seed to why its run never finished."""


def recorded_in(root: Path) -> Recorded:
    """Read a folder that has a folder of recordings for each training seed: `seed_0`, `seed_1`, ...

    Raises:
        MissingError: there is no such folder.
        InputError: a file in one is no recording, or a folder is no training seed's.
    """
    recorded = {}
    for folder in sorted(root.glob("seed_*")):
        seed = seed_of(folder)
        # A name that begins with a dot is of a file that was never finished.
        files = sorted(folder.rglob("[!.]*.parquet", case_sensitive=False))
        recorded[seed] = [episode for file in files for episode in read_recordings(file)]
    if not recorded:
        raise MissingError(f"'{root}' has no folder seed_0, seed_1, ... of recordings.")
    return recorded


def recorded_by_study(
    root: Path,
    store: Path,
    variant: str,
    settings: Mapping[str, BoardSetting],
    chosen: Sequence[str] | None = None,
) -> tuple[Recorded, Failures]:
    """Read what a variant's runs executed where a submission's `settings` are evaluated, and why some failed.

    Args:
        chosen: the study's settings whose runs are meant, where several evaluate alike; all by default.

    Raises:
        MissingError: the study, or what one of its runs executed, is not there.
        InputError: the study has no such variant, or not where one of the settings is, or twice there.
    """
    check_folder(root)
    rows = read_rows(root / ROWS)
    own = rows[rows["variant"] == variant].fillna({"error_kind": "", "error": ""})
    if own.empty:
        raise InputError(f"The study has no variant '{variant}'; it has: {', '.join(rows['variant'].unique())}.")
    own = own[own["setting"].isin(_alike(root, own["setting"].unique(), settings, chosen))]
    recorded: Recorded = {int(seed): [] for seed in own["training_seed"]}
    failures: Failures = {}
    for row in own.drop_duplicates(["setting", "training_seed"]).itertuples():
        path = store / "runs" / str(row.run) / RECORDINGS
        if row.error_kind == NOT_RUN:
            raise MissingError(f"The study has not run {row.setting}/{variant}/seed_{row.training_seed} yet.")
        if row.error_kind:
            failures[int(row.training_seed)] = one_line(row.error)[:300]
        elif not path.is_file():
            raise MissingError(
                f"'{path}' is missing: give the store in which the run was made; runs from before actions were kept "
                "cannot be replayed."
            )
        else:
            recorded[int(row.training_seed)] += read_recordings(path)
    return recorded, failures


def trained_by_study(
    root: Path, variant: str, settings: Mapping[str, BoardSetting], chosen: Sequence[str] | None = None
) -> tuple[str, dict[str, Any]]:
    """The recipe of a study's variant, and what the study made by it: fields of `Trained` without the recipe's hash.

    Raises:
        InputError: the recipe names a file, or a setting's policies are not the study's.
    """
    rows = read_rows(root / ROWS)
    own = rows[rows["variant"] == variant]
    places = _places(root)
    theirs = _alike(root, own["setting"].unique(), settings, chosen)
    named = {environment_key(**setting.environment): name for name, setting in settings.items()}
    called = {named[places[one]]: one for one in theirs}
    if absent := [name for name in settings if name not in called]:
        raise InputError(f"the study has no setting that evaluates as {absent[0]}")
    own = own[own["setting"].isin(theirs)]
    return recipe_of(root, variant, called), trained_by(own, called, sorted(map(int, own["training_seed"].unique())))


def with_draws(about: About, study: Path) -> About:
    """What is said of a policy, with what its study's folder says of its demonstrations.

    Raises:
        InputError: the two contradict each other, or there are several draws of several seeds each.
    """
    draws = read_draws(study)
    if draws.groups_seeds and about.is_policy:
        raise InputError(
            f"Of the study, {draws.seeds_a_draw} training seeds share a draw of demonstrations; the seeds of an entry "
            "learn from one draw, or each from its own."
        )
    made = draws.demonstrations
    if about.demonstrations not in (None, made):
        raise InputError(f"about.demonstrations is {about.demonstrations}, but those of the study are {made}.")
    return replace(about, demonstrations=made) if about.is_policy else about


def _alike(
    root: Path, ran: Iterable[str], settings: Mapping[str, BoardSetting], chosen: Sequence[str] | None
) -> list[str]:
    """Those settings of a study that a variant `ran` in and that evaluate as one of `settings` does."""
    places = _places(root)
    if unknown := [name for name in chosen or () if name not in places]:
        raise InputError(f"The study has no setting '{unknown[0]}'; it has: {', '.join(places)}.")
    asked = [environment_key(**setting.environment) for setting in settings.values()]
    ran = {name: places[name] for name in ran if name in (chosen or places)}
    alike = {name: place for name, place in ran.items() if place in asked}
    if not alike:
        raise InputError(f"It was evaluated in none of {_told(asked)}, but in {_told(ran.values())}.")
    one_of_each = {place: name for name, place in alike.items()}
    if len(one_of_each) < len(alike):
        raise InputError(
            f"Some settings of the study evaluate alike ({', '.join(alike)}): say whose runs are meant, such as "
            f"--study_settings=[{','.join(one_of_each.values())}]."
        )
    return list(alike)


def _places(root: Path) -> dict[str, tuple[str, int, str]]:
    """Where each setting of a study is evaluated, as `environment_key` has it."""
    return {
        name: environment_key(
            env["task"], env.get("episode_length"), env.get("perturb", ""), env.get("perturb_seed", 0)
        )
        for name, env in read_environments(root).items()
    }


def _told(places: Iterable[tuple[str, int, str]]) -> str:
    return ", ".join(f"{task}{label} ({length} steps)" for task, length, label in dict.fromkeys(places))


def submit(
    root: Path,
    about: About,
    suite: str,
    settings: Mapping[str, BoardSetting],
    recorded: Recorded,
    failures: Failures,
    made: tuple[str, Mapping[str, Any]] | None = None,
) -> Submission:
    """Write a submission of what was recorded.

    Args:
        failures: training seeds whose missing episodes failed, and why; they stay in the denominator.
        made: the recipe and what it made, as `trained_by_study` returns them.

    Raises:
        TakenError: `root` exists.
        InputError: an episode is missing or was recorded twice, or they do not belong together.
    """
    seeds = sorted(recorded.keys() | failures.keys())
    claims = []
    for seed in seeds:
        for name, setting in settings.items():
            place = environment_key(**setting.environment)
            there = [one for one in recorded.get(seed, []) if environment_key(**one.environment) == place]
            if not there and seed not in failures:
                _check_length(recorded.get(seed, []), name, setting, seed)
            starts = [one.evaluation_seed for one in there]
            for start in setting.starts:
                found = [one for one in there if one.evaluation_seed == start]
                missing = Claim(start, setting=name, training_seed=seed, error=failures.get(seed))
                claims.append(_claim(found, missing, setting, starts))
    ended = [claim for claim in claims if claim.error is None]
    if not ended:
        raise InputError("Nothing was recorded.")
    poorer = OBSERVES[: OBSERVES.index(about.observes)] if about.is_policy else ()
    if shown := {*poorer} & {claim.obs_type for claim in ended}:
        raise InputError(
            f"about.observes is {about.observes}, but the policy was shown {min(shown)}: it can observe no more."
        )
    recipe, trained = made or (None, None)
    return write_submission(
        root,
        claims,
        recipe,
        trained,
        about=about,
        suite=suite,
        settings=dict(settings),
        training_seeds=seeds,
        backend=_only({claim.backend for claim in ended}, "backends"),
        versions=json.loads(_only({claim.versions for claim in ended}, "versions of packages or makes of processors")),
    )


def _check_length(episodes: Iterable[Episode], name: str, setting: BoardSetting, seed: int) -> None:
    """Refuse episodes of a setting that were recorded with another limit of steps, which is easily forgotten."""
    task, asked, perturbed = environment_key(**setting.environment)
    for there, length, label in (environment_key(**one.environment) for one in episodes):
        if (there, label) == (task, perturbed) and length != asked:
            raise InputError(
                f"{name}, training seed {seed}, was recorded with at most {length} steps an episode, not {asked}: "
                f"evaluate it with --env.episode_length={asked}."
            )


def _claim(found: Sequence[Episode], missing: Claim, setting: BoardSetting, there: Sequence[int]) -> Claim:
    """The claim of a recorded episode, or `missing`, which says why it was not; `there` are its seed's starts."""
    if len({one.flat.tobytes() for one in found}) > 1:
        raise InputError(f"{missing.label} was recorded twice, with different actions; record into an empty folder.")
    if found:
        return Claim(**vars(found[0]), setting=missing.setting, training_seed=missing.training_seed)
    if missing.error is None:
        of = f"(task {setting.task}, {setting.episode_length} steps)"
        if there and not {*there} & {*setting.starts}:
            raise InputError(
                f"{missing.label} was not recorded {of}: starts {min(there)} to {max(there)} were, and "
                f"{setting.starts[0]} to {setting.starts[-1]} are asked for; for other starts give --settings."
            )
        raise InputError(
            f"{missing.label} was not recorded {of}; evaluate it, or say in --failures why training seed "
            f"{missing.training_seed} failed."
        )
    return missing


def _only(different: set[str], what: str) -> str:
    if len(different) > 1:
        raise InputError(
            f"The episodes were recorded with several {what}: {' and '.join(sorted(different))}; record them with one."
        )
    return different.pop()
