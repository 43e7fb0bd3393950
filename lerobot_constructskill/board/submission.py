"""A submission: what its author declares, and an episode a row with the actions that were executed.

submission.yaml   `declaration.Declaration`: the policy, its settings, versions, and the hash of the other file
episodes.parquet  `SCHEMA`
recipe.yaml       where there is one: the study that made its policies (`recipe`)
"""

import hashlib
import os
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import yaml

from lerobot_constructskill.artifacts.folders import staged
from lerobot_constructskill.artifacts.revisions import PREFIX
from lerobot_constructskill.artifacts.tables import Parquet
from lerobot_constructskill.board.copies import near_copy
from lerobot_constructskill.board.declaration import DECLARED, LINE, Declaration, Trained
from lerobot_constructskill.contract import MAX_PLACEMENTS, STAGES, get_task
from lerobot_constructskill.envs.recording import ACTIONS, DECIDING, OUTCOME, Episode, to_rows, write_recordings
from lerobot_constructskill.errors import DISTRIBUTION, InputError, MissingError, plural
from lerobot_constructskill.files import bounded_memory, read_bytes, read_parquet, to_text
from lerobot_constructskill.perturbations import Perturbation

DECLARATION_FILE, EPISODES_FILE, RECIPE_FILE = "submission.yaml", "episodes.parquet", "recipe.yaml"

MOST = {DECLARATION_FILE: 1 << 16, EPISODES_FILE: 64 << 20, RECIPE_FILE: 1 << 16}
"""Bytes that a file of a submission may have."""

SLACK = 256 << 20
"""Bytes that reading takes beside what is read."""


@dataclass
class Claim(Episode):
    """An episode as the author of a submission says that it went.

    Args:
        setting, training_seed: of the submission, to which it belongs.
        error: why it never ran to its end; it then has no actions and counts as failed.
    """

    setting: str = ""
    training_seed: int = 0
    error: str | None = None

    @property
    def key(self) -> tuple[str, int, int]:
        return self.setting, self.training_seed, self.evaluation_seed

    @property
    def label(self) -> str:
        """How sentences call it."""
        return f"{self.setting}, training seed {self.training_seed}, start {self.evaluation_seed}"


SCORES = ("placements", "chain", "drops", "knocks", "collisions")
"""Counts of an episode that executing its actions again must reproduce, where they are told: older files lack them."""

OLDER = ("evaluation_seed", *OUTCOME, "setting", "training_seed", "error", "actions")
COLUMNS = (*OLDER[:-1], *SCORES, OLDER[-1])
NULLABLE = ("lift_step", "place_step", "error", *SCORES)
TYPES = Parquet("a submission's episodes", Claim, ACTIONS).schema
SCHEMA = pa.schema([TYPES.field(name).with_nullable(name in NULLABLE) for name in COLUMNS])
"""Of episodes.parquet. What else an episode has is declared."""


@dataclass(frozen=True)
class Submission:
    """A submission that is whole: every declared episode is there once, and says nothing impossible.

    Args:
        declaration: what its author says.
        claims: its episodes.
        sha256: hash of submission.yaml, which names the hashes of the other files, so that it stands for all of it.
        recipe: text of recipe.yaml; None without one. Nothing of it is looked at until the recipe is asked for.
    """

    declaration: Declaration
    claims: list[Claim]
    sha256: str
    recipe: str | None = None


def write_submission(
    root: Path,
    claims: Iterable[Claim],
    recipe: str | None = None,
    trained: Mapping[str, Any] | None = None,
    **declared: Any,
) -> Submission:
    """Write a submission's folder, whole or not at all, and read it again as anyone would.

    Args:
        recipe: text of recipe.yaml.
        trained: fields of `Trained` but for the hash, where there is a recipe.
        declared: fields of `Declaration` but for the hash.

    Raises:
        TakenError: the folder exists.
        InputError: it would be refused.
    """
    made = None if recipe is None else Trained(_sha256(recipe.encode()), **trained or {})
    unhashed = Declaration(**declared, episodes_sha256="0" * 64, trained=made)  # refused before anything is written
    with staged(root) as folder:
        write_recordings(claims, folder / EPISODES_FILE, SCHEMA)
        if recipe is not None:
            (folder / RECIPE_FILE).write_text(recipe, encoding="utf-8")
        plain = asdict(replace(unhashed, episodes_sha256=_sha256((folder / EPISODES_FILE).read_bytes())))
        (folder / DECLARATION_FILE).write_text(
            yaml.safe_dump(plain, sort_keys=False, allow_unicode=True, width=119), encoding="utf-8"
        )
        return read_submission(folder)


def read_submission(root: Path) -> Submission:
    """Open a submission.

    Raises:
        MissingError: one of its files is not there.
        InputError: it is not what a submission is; the message says where.
    """
    content = _read_files(root)
    declaration = DECLARED.parse(to_text(content[DECLARATION_FILE], DECLARATION_FILE), DECLARATION_FILE)
    named = {EPISODES_FILE: declaration.episodes_sha256}
    named |= {RECIPE_FILE: declaration.trained.recipe_sha256} if declaration.trained else {}
    for name in sorted(content.keys() - {DECLARATION_FILE} | named.keys()):
        if name not in content or _sha256(content[name]) != named.get(name):
            raise InputError(f"{name} is not the file that {DECLARATION_FILE} names: its hash differs.")
    _check_versions(declaration.versions)
    claims = _read_claims(root / EPISODES_FILE, declaration)
    for claim in claims:
        _check(claim)
    _check_copies(declaration, claims)
    recipe = to_text(content[RECIPE_FILE], RECIPE_FILE) if RECIPE_FILE in content else None
    return Submission(declaration, claims, _sha256(content[DECLARATION_FILE]), recipe)


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _read_files(root: Path) -> dict[str, bytes]:
    """The bytes of a submission's files. A folder that holds anything else, a link for instance, is refused."""
    if root.is_symlink() or not root.is_dir():
        raise MissingError(f"'{root}' is not the folder of a submission.")
    found = os.listdir(root)
    if absent := [name for name in (DECLARATION_FILE, EPISODES_FILE) if name not in found]:
        raise MissingError(f"'{root}' is not a submission: {absent[0]} is missing.")
    if others := sorted(set(found) - set(MOST)):
        raise InputError(f"'{root}' holds {others[0]!a}; a submission is {', '.join(MOST)}, and nothing else.")
    return {name: read_bytes(root / name, most, links=False) for name, most in MOST.items() if name in found}


def _check_versions(versions: dict[str, str]) -> None:
    """Refuse a submission that does not say which simulator and which of our code it was made with."""
    said = {DISTRIBUTION if name.startswith(PREFIX) else name for name in versions}
    if absent := [name for name in (DISTRIBUTION, *DECIDING) if name not in said]:
        raise InputError(f"versions must say with which {absent[0]} it was made, as every recording does.")


def _read_claims(path: Path, declaration: Declaration) -> list[Claim]:
    """The rows of a file, once its size and its columns are known to be right, with what is declared of each."""
    try:
        with bounded_memory(2 * declaration.most_bytes + SLACK):
            table = read_parquet(path, most=declaration.most_bytes + SLACK)
    except MemoryError:
        raise InputError(f"{EPISODES_FILE} unpacks to more than its episodes can hold.") from None
    if table.schema.remove_metadata() not in (SCHEMA, pa.schema([SCHEMA.field(name) for name in OLDER])):
        raise InputError(f"{EPISODES_FILE} does not have the columns of a submission.")
    if table.num_rows != declaration.episodes:
        raise InputError(
            f"{EPISODES_FILE} has {table.num_rows:,} episodes; {DECLARATION_FILE} declares "
            f"{declaration.episodes:,} ({plural(len(declaration.training_seeds), 'training seed')})."
        )
    rows = to_rows(table)
    _check_keys(declaration, [(row["setting"], row["training_seed"], row["evaluation_seed"]) for row in rows])
    return [Claim(**row, **declaration.settings[row["setting"]].environment) for row in rows]


def _check_keys(declaration: Declaration, keys: list[tuple[str, int, int]]) -> None:
    """Every declared episode is there once, and none that is not declared."""
    expected, found = declaration.keys, Counter(keys)
    for kind, wrong in (
        ("is there twice", [key for key, count in found.items() if count > 1]),
        ("is not declared", found.keys() - expected),
        ("is missing", expected - found.keys()),
    ):
        if wrong:
            setting, seed, start = min(wrong)
            raise InputError(f"{setting[:60]!a}, training seed {seed}, start {start} {kind}.")


def _check(claim: Claim) -> None:
    """Refuse an episode that contradicts itself, as far as that shows without executing it."""
    for holds, rule in _rules(claim) if claim.error is None else _rules_of_failed(claim):
        if not holds:
            raise InputError(f"{claim.label}: {rule}.")


def _rules_of_failed(claim: Claim) -> list[tuple[bool, str]]:
    names = (*OUTCOME, *SCORES)
    is_empty = _values(claim, names) == _values(Episode(claim.evaluation_seed), names) and not len(claim.flat)
    return [
        (LINE.allows(claim.error), f"error must be {LINE.meaning}"),
        (is_empty, "an episode with an error has neither outcome nor actions"),
    ]


def _rules(claim: Claim) -> list[tuple[bool, str]]:
    """Whether each rule for an episode that ran to its end holds, and the rule."""
    numbers, steps, stage = len(get_task(claim.task, claim.action).action_names), claim.steps, claim.stage
    return [
        (stage in STAGES, f"stage must be one of {', '.join(STAGES)}"),
        (1 <= steps <= claim.episode_length, f"steps must be 1 to {claim.episode_length}"),
        (len(claim.flat) == steps * numbers, f"each action must have {numbers} numbers"),
        (np.isfinite(claim.flat).all(), "actions must be finite"),
        (
            claim.placed == (stage == "placed") and claim.lifted >= (stage == "lifted"),
            f"stage {stage} is not what lifted and placed say",
        ),
        (
            all(value is None or value >= 0 for value in _values(claim, SCORES)),
            f"{', '.join(SCORES)} must be 0 or more",
        ),
        (
            (claim.chain or 0) <= (claim.placements or 0) <= MAX_PLACEMENTS,
            f"chain must be at most placements, and these at most {MAX_PLACEMENTS}",
        ),
        *_rules_of_step("lift", claim.lifted, claim.lift_step, steps),
        *_rules_of_step("place", claim.placed, claim.place_step, steps),
        (
            not claim.placed or claim.place_step == steps,
            f"the placement ends an episode, so place_step must be {steps}",
        ),
    ]


def _values(episode: Episode, names: Iterable[str]) -> list[Any]:
    return [getattr(episode, name) for name in names]


def _rules_of_step(name: str, happened: bool, step: int | None, steps: int) -> list[tuple[bool, str]]:
    return [
        (happened == (step is not None), f"there is a {name}_step exactly where that happened"),
        (step is None or 1 <= step <= steps, f"{name}_step must be 1 to {steps}"),
    ]


def _check_copies(declaration: Declaration, claims: list[Claim]) -> None:
    """Refuse policies of two training seeds that place with nearly the same actions, as they are executed.

    So is one that places with nearly the same actions though it was shown other pictures. A reference sees none.
    """
    if declaration.about.is_policy and (pair := near_copy(claims, claims, _is_one_policy)):
        raise InputError(f"{pair[0].label} has the actions of {pair[1].label}, or nearly.")


def _is_one_policy(one: Claim, other: Claim) -> bool:
    """Whether two episodes from one start are of one policy that was shown the same."""
    acted = [(claim.training_seed, Perturbation(claim.perturb, claim.perturb_seed).pictures) for claim in (one, other)]
    return acted[0] == acted[1]
