"""The level retrained: an entry's recipe makes demonstrations, features and policies again, and these are compared."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_constructskill.artifacts.code import code_of
from lerobot_constructskill.artifacts.revisions import PREFIX
from lerobot_constructskill.artifacts.store import Store
from lerobot_constructskill.board.declaration import Trained
from lerobot_constructskill.board.protocol import BoardSetting, environment_key
from lerobot_constructskill.board.recipe import read_recipe, starts_from
from lerobot_constructskill.board.rerun import confirm, describe
from lerobot_constructskill.board.submission import Claim, Submission
from lerobot_constructskill.board.verification import different
from lerobot_constructskill.contract import OBS_TYPES, get_task
from lerobot_constructskill.envs.recording import RECORDINGS, read_recordings
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.lerobot_internals import load_plugins
from lerobot_constructskill.parsing import decode
from lerobot_constructskill.study.plan import list_runs
from lerobot_constructskill.study.rows import Row, merged
from lerobot_constructskill.study.runs import Run
from lerobot_constructskill.study.session import run_study
from lerobot_constructskill.study.spec import Options, Study
from lerobot_constructskill.study.table import Table

AGAIN = "trained again"
NO_RECIPE = "It has no recipe: only what constructskill-submit made of a study can be trained again."


@dataclass(frozen=True)
class TrainedAgain:
    """What training again came to.

    Args:
        rates: for each setting the share of episodes that placed, as submitted and trained again.
        others: what else this machine or this package has than the first, and both; empty where all weights and
            episodes are the same to the last bit.
        starts_from: weights on the Hub that the policies start from, NAME@COMMIT; empty where these are new.
    """

    rates: dict[str, tuple[float, float]]
    others: dict[str, tuple[str, str]]
    starts_from: str

    @property
    def shown(self) -> dict[str, Any]:
        """It as a verdict shows it."""
        origin = {"starts_from": self.starts_from} if self.starts_from else {}
        return {"exact": not self.others, "settings": self.rates} | origin

    @property
    def told(self) -> str:
        """It as sentences."""
        origin = (
            f" Training starts from {self.starts_from}; training again does not check these weights."
            if self.starts_from
            else ""
        )
        return self._compared + origin

    @property
    def _compared(self) -> str:
        if not self.others:
            return "Trained again, all weights and episodes are the same to the last bit."
        why = "; ".join(f"{name} {there:.200} there, {here} here" for name, (there, here) in self.others.items())
        return f"Trained again with other things ({why}), so compared by seeds: {describe(self.rates, AGAIN)}."


def study_of(submission: Submission, allowed: Sequence[str] = ()) -> Study:
    """The study that a submission's recipe says, checked before anything is made.

    Args:
        allowed: `DIST==VERSION` of other packages whose code may run.

    Raises:
        InputError: it has no recipe, or the recipe is of something else or needs code that is not allowed.
    """
    if submission.recipe is None:
        raise InputError(NO_RECIPE)
    load_plugins()  # a policy may be of another package; ours brings the environment
    study = decode(Study, read_recipe(submission.recipe))
    runs = list_runs(study)
    _check_code(runs, allowed)
    _check_runs(submission, study, runs)
    return study


def retrain(submission: Submission, study: Study, root: Path, options: Options) -> TrainedAgain:
    """Make all that a submission's recipe says, and compare. After a kill the same call continues.

    With the same packages, rooms and processor, weights and episodes must be the same to the last bit. Elsewhere a
    permutation test over training seeds decides, as for a re-run.

    Args:
        study: as `study_of` returns it.
        root: where it is made: a store for all recipes, which nothing else was made in, and a study for each.
        options: how it is made: the processes that generate demonstrations, and the executor.

    Raises:
        InputError: the submission has no recipe, or its recipe makes others.
        OSError: a simulator's process died.
    """
    if (trained := submission.declaration.trained) is None:
        raise InputError(NO_RECIPE)
    store, text = Store((root / "store").absolute()), submission.recipe or ""
    table = run_study(study, text, root.absolute() / submission.sha256[:16], store, options)
    (variant,) = study.variants.values()
    return _compare(submission, trained, table, starts_from(variant.policy))


def _check_code(runs: Sequence[Run], allowed: Sequence[str]) -> None:
    """Refuse code of other packages that is not allowed by name and version."""
    for run in runs:
        task, learner = get_task(run.arm.env["task"]), run.arm.learner
        policy = [type(one).__module__ for one in (learner.config, learner.trainer)] if learner else []
        needed = code_of(task.scene, task.expert, *policy)
        for name, version in needed.items():
            wanted = f"{name}=={version.partition(', ')[0]}"
            if not name.startswith(PREFIX) and wanted not in allowed:
                raise InputError(
                    f"The recipe runs code of another package, {name}: --allow_code=[{wanted}] allows that."
                )


def _check_runs(submission: Submission, study: Study, runs: Sequence[Run]) -> None:
    """Refuse a recipe that does not make the submission's policies, where and from where they were evaluated."""
    declaration = submission.declaration
    if len(study.variants) > 1 or study.references:
        raise InputError("A recipe has one variant, and nothing beside it.")
    seeds = {(name, seed) for name in declaration.settings for seed in declaration.training_seeds}
    if {(run.arm.setting, run.seed) for run in runs} != seeds:
        raise InputError("The recipe has not the settings and training seeds of the submission.")
    for run in runs:
        setting, env = declaration.settings[run.arm.setting], run.arm.env
        there = environment_key(env["task"], env["episode_length"], env["perturb"], env["perturb_seed"])
        if there != environment_key(**setting.environment) or not {*setting.starts} <= {*run.arm.starts}:
            raise InputError(f"The recipe evaluates {run.arm.setting} otherwise than the submission does.")
        said, shown = declaration.about.observes, env["obs_type"]
        if said in OBS_TYPES and [*OBS_TYPES].index(shown) > [*OBS_TYPES].index(said):  # each shows more than the last
            raise InputError(f"The recipe shows its policies {shown}; the submission says {said}.")


def _compare(submission: Submission, trained: Trained, table: Table, origin: str) -> TrainedAgain:
    rows = {(run.arm.setting, run.seed): table.made(run) or [] for run in table.runs}
    rates = _rates(submission, rows)
    versions = [one.versions for own in rows.values() for one in own if one.versions]
    here = merged(map(json.loads, versions))
    if others := different(trained.made_with, here):
        return TrainedAgain(confirm(rates, "training seeds", AGAIN), others, origin)
    if unlike := next(_unlike(submission, trained, table), None):
        raise InputError(
            f"Trained again with the same versions on the same kind of processor, {unlike}. So the recipe, a seed or "
            "the episodes are others than it says, unless this machine renders other pictures (another Mesa)."
        )
    shares = {name: (float(own.mean()), float(again.mean())) for name, (own, again) in rates.items()}
    return TrainedAgain(shares, {}, origin)


def _unlike(submission: Submission, trained: Trained, table: Table) -> Iterator[str]:
    """What is not the same to the last bit: of each training seed its weights, then its episodes."""
    for run in table.runs:
        name, seed = run.arm.setting, run.seed
        where, number = f"training seed {seed} of {name}", submission.declaration.training_seeds.index(seed)
        if {row.weights_sha256 for row in table.made(run) or ()} != {trained.weights[name][number]}:
            yield f"{where} has other weights"
        file = table.store.folder(run) / RECORDINGS
        there = {one.evaluation_seed: one for one in read_recordings(file)} if file.exists() else {}
        for claim in submission.claims:
            if (claim.setting, claim.training_seed) == (name, seed):
                again = there.get(claim.evaluation_seed)
                is_same = claim.error if again is None else np.array_equal(claim.flat, again.flat)
                if not is_same:
                    yield f"{where} acts otherwise from start {claim.evaluation_seed}"
                elif again and (again.lifted, again.placed) != (claim.lifted, claim.placed):
                    yield f"{where} ends otherwise from start {claim.evaluation_seed}"


def _rates(
    submission: Submission, rows: Mapping[tuple[str, int], list[Row]]
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """For each setting the share of its starts from which each training seed placed, as submitted and again."""
    found, seeds = {}, submission.declaration.training_seeds
    for name, setting in submission.declaration.settings.items():
        claims = [one for one in submission.claims if one.setting == name]
        again = [row for seed in seeds for row in rows[name, seed]]
        found[name] = _shares(claims, seeds, setting), _shares(again, seeds, setting)
    return found


def _shares(episodes: Sequence[Claim | Row], seeds: Sequence[int], setting: BoardSetting) -> np.ndarray:
    """The share of a setting's starts from which each training seed placed; an episode that failed did not."""
    placed = {(one.training_seed, one.evaluation_seed): bool(one.placed) for one in episodes}
    return np.array([np.mean([placed.get((seed, start), False) for start in setting.starts]) for seed in seeds])
