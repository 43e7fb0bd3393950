"""A submission: what its author says of it, and an episode a row with the actions that were executed.

submission.yaml   `Declaration`: the policy, its settings, versions, and the hash of the other file
episodes.parquet  `SCHEMA`
"""

import hashlib
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field, fields, replace
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import yaml

from lerobot_constructskill.artifacts.folders import staged
from lerobot_constructskill.board.protocol import PHYSICS, SUITES, Setting, class_of
from lerobot_constructskill.board.strangers import Plain, read_files
from lerobot_constructskill.bounds import UNSEEN, Among, NotEmpty, Pattern, Seed, check
from lerobot_constructskill.contract import OBS_TYPES, STAGES, TASKS, get_task
from lerobot_constructskill.envs.actions import within_reach
from lerobot_constructskill.envs.recording import ACTIONS, Outcome, compressed
from lerobot_constructskill.errors import InputError, first_line, plural
from lerobot_constructskill.files import Yaml, bounded_memory, to_text

DECLARATION, EPISODES = "submission.yaml", "episodes.parquet"

MOST = {DECLARATION: 1 << 16, EPISODES: 64 << 20}
"""Bytes that a file of a submission may have."""

MOST_ROWS, MOST_SETTINGS, MOST_ACTIONS = 50_000, 32, 1 << 30
"""Episodes and settings of a submission, and bytes of its actions unpacked."""

SLACK = 256 << 20
"""Bytes that reading takes beside what is read."""

VERSION = 1

LINE = Pattern(rf"(?=.*\S)[^{UNSEEN}]{{1,300}}", "one line of text, of at most 300 characters")
Line = Annotated[str, LINE]
Link = Annotated[str, Pattern(r"https://[A-Za-z0-9./_~%#?=&:+-]{1,300}", "an address that begins with https://")]
Hash = Annotated[str, Pattern("[0-9a-f]{64}", "a SHA-256 in hexadecimal digits")]
NAME = Pattern("[a-z0-9][a-z0-9_]{0,39}", "a name of a-z, 0-9 and '_'")

OBSERVES = ("pixels", "pixels_agent_pos", "privileged", "nothing")
"""What a policy sees: an `obs_type`, the simulator's own state (an expert), or nothing at all."""


@dataclass(frozen=True)
class About:
    """What a submission must say of its policy.

    Args:
        name: what the board calls it.
        submitter: who answers for it.
        policy: its type, and its size where that matters.
        revision: commit or hash by which its checkpoints are found.
        data: what it was trained on, by name and revision; "none".
        training: how, and how its training seeds were chosen.
        compute: on what, and for how long.
        observes: one of `OBSERVES`.
        url: where its checkpoints are.
        notes: what else a reader must know.

    Raises:
        InputError: a field is no line of text.
    """

    name: Line
    submitter: Line
    policy: Line
    revision: Line
    data: Line
    training: Line
    compute: Line
    observes: Annotated[str, Among(OBSERVES)]
    url: Link | None = None
    notes: Line | None = None

    def __post_init__(self):
        check(self)


@dataclass(frozen=True)
class Declaration:
    """submission.yaml.

    Args:
        about: the policy.
        suite: a name in `protocol.SUITES`.
        settings: name to setting; those of the suite, or others.
        training_seeds: of the runs that are in it.
        backend: what simulated and rendered.
        versions: of what decides what an action does: packages, and the make of the processor.
        episodes_sha256: hash of episodes.parquet.
        version: of this format.

    Raises:
        InputError: a field cannot be that.
    """

    about: About
    suite: Annotated[str, Among(tuple(SUITES))]
    settings: dict[str, Setting]
    training_seeds: Annotated[list[Seed], NotEmpty()]
    backend: Line
    versions: dict[str, str]
    episodes_sha256: Hash
    version: Annotated[int, Among((VERSION,))] = VERSION

    def __post_init__(self):
        check(self)
        if not self.settings or len(self.settings) > MOST_SETTINGS:
            raise InputError(f"settings must be 1 to {MOST_SETTINGS}, not {len(self.settings)}.")
        if bad := [name for name in self.settings if not NAME.allows(name)]:
            raise InputError(f"A setting's name must be {NAME.meaning}, not {bad[0][:100]!a}.")
        for name, setting in self.settings.items():
            self._check_setting(name, setting)
        if len(set(self.training_seeds)) < len(self.training_seeds):
            raise InputError("training_seeds must differ.")
        if self.episodes > MOST_ROWS or self.most_bytes > MOST_ACTIONS:
            raise InputError(
                f"A submission has at most {MOST_ROWS:,} episodes, and {MOST_ACTIONS:,} bytes of actions."
            )
        for package, number in self.versions.items():
            check_line(package, "versions")
            check_line(number, "versions")

    def _check_setting(self, name: str, setting: Setting) -> None:
        called = {task: (task, setting.perturbation) for task in TASKS}
        called |= {one: (of.task, of.perturbation) for one, of in SUITES[self.suite].settings.items()}
        own = setting.task, setting.perturbation
        if own != (meant := called.get(name, own)):
            raise InputError(f"The setting {name} must be of the task {''.join(meant)}, or have another name than it.")
        control = replace(setting, perturb="", perturb_seed=0).compared
        if setting.perturbation and control not in [one.compared for one in self.settings.values()]:
            raise InputError(
                f"The setting {name} must have its control beside it: a setting of the same task, length and starts "
                "without a perturbation."
            )

    @property
    def settings_class(self) -> str:
        return class_of(self.suite, self.settings, self.training_seeds)

    @property
    def episodes(self) -> int:
        return len(self.training_seeds) * sum(setting.episodes for setting in self.settings.values())

    @property
    def most_bytes(self) -> int:
        """Of all actions, unpacked, if every episode ran to its end."""
        return len(self.training_seeds) * sum(
            4 * width(setting) * setting.episodes * setting.episode_length for setting in self.settings.values()
        )

    def starts(self) -> Iterator[tuple[str, int, int]]:
        """Setting, training seed and evaluation seed of every episode that is to be there."""
        for name, setting in self.settings.items():
            for seed, start in product(self.training_seeds, setting.starts):
                yield name, seed, start


ABOUT = Yaml("what is said of a policy", About, Plain)
SETTINGS = Yaml("a list of settings", dict[str, Setting], Plain)
DECLARED = Yaml("the declaration of a submission", Declaration, Plain)


def check_line(value: str, where: str) -> None:
    if not LINE.allows(value):
        raise InputError(f"{where} must be lines of text, not {value[:100]!a}.")


def width(setting: Setting) -> int:
    """Numbers of an action."""
    return len(get_task(setting.task).action_names)


@dataclass
class Claim(Outcome):
    """An episode as its author says that it went; fields beyond `Outcome`'s:

    Args:
        setting, training_seed: whose it is.
        error: why it never ran to its end; it then has no actions and counts as failed.
        actions: executed, (steps * A) float32.
    """

    setting: str = ""
    training_seed: int = 0
    error: str | None = None
    actions: np.ndarray = field(default_factory=lambda: np.zeros(0, np.float32))

    @property
    def key(self) -> tuple[str, int, int]:
        return self.setting, self.training_seed, self.evaluation_seed

    @property
    def outcome(self) -> Outcome:
        return Outcome(**{one.name: getattr(self, one.name) for one in fields(Outcome)})

    @property
    def where(self) -> str:
        return f"{self.setting}, training seed {self.training_seed}, start {self.evaluation_seed}"


_ARROW = {str: pa.string(), int: pa.int64(), bool: pa.bool_(), np.ndarray: ACTIONS}
_OPTIONAL = {"lift_step": pa.int64(), "place_step": pa.int64(), "error": pa.string()}

SCHEMA = pa.schema(
    [
        pa.field(one.name, _OPTIONAL.get(one.name) or _ARROW[one.type], nullable=one.name in _OPTIONAL)
        for one in fields(Claim)
    ]
)


@dataclass(frozen=True)
class Submission:
    """A submission that is whole: every declared episode is there once, and says nothing impossible.

    Args:
        declaration: what its author says.
        claims: its episodes.
        sha256: hash of submission.yaml, which names that of the episodes: it stands for all of it.
    """

    declaration: Declaration
    claims: list[Claim]
    sha256: str


def write_submission(root: Path, claims: Iterable[Claim], **declared: Any) -> Submission:
    """Write a submission's folder, whole or not at all, and read it again as anyone would.

    Args:
        declared: fields of `Declaration` but for the hash.

    Raises:
        TakenError: the folder exists.
        InputError: it would be refused.
    """
    unhashed = Declaration(**declared, episodes_sha256="0" * 64)  # refuses what is wrong before anything is written
    with staged(root) as folder:
        folder.mkdir()
        columns = [vars(claim) for claim in claims]
        table = pa.Table.from_pylist(columns, schema=SCHEMA)
        pq.write_table(table, folder / EPISODES, **compressed("actions"))
        hashed = hashlib.sha256((folder / EPISODES).read_bytes()).hexdigest()
        plain = asdict(replace(unhashed, episodes_sha256=hashed))
        (folder / DECLARATION).write_text(
            yaml.safe_dump(plain, sort_keys=False, allow_unicode=True, width=119), encoding="utf-8"
        )
        submission = read_submission(folder)
    return submission


def read_submission(root: Path) -> Submission:
    """Open a submission.

    Raises:
        MissingError: one of its files is not there.
        InputError: it is not what a submission is; the message says where.
    """
    content = read_files(root, MOST)
    declaration = DECLARED.parse(to_text(content[DECLARATION], DECLARATION), DECLARATION)
    if hashlib.sha256(content[EPISODES]).hexdigest() != declaration.episodes_sha256:
        raise InputError(f"{EPISODES} is not the file that {DECLARATION} was written with: its hash differs.")
    claims = _claims(_table(content[EPISODES], declaration))
    _check_starts(declaration, claims)
    for claim in claims:
        _check(claim, declaration.settings[claim.setting])
    _check_copies(declaration, claims)
    return Submission(declaration, claims, hashlib.sha256(content[DECLARATION]).hexdigest())


def _table(content: bytes, declaration: Declaration) -> pa.Table:
    """The rows, once their number, their columns and their sizes are known to be right."""
    try:
        with bounded_memory(2 * declaration.most_bytes + SLACK):
            file = pq.ParquetFile(pa.BufferReader(content), page_checksum_verification=False)
            if not file.schema_arrow.remove_metadata().equals(SCHEMA):
                raise InputError(f"{EPISODES} does not have the columns of a submission.")
            if file.metadata.num_rows != declaration.episodes:
                raise InputError(
                    f"{EPISODES} has {file.metadata.num_rows:,} episodes; {DECLARATION} declares "
                    f"{declaration.episodes:,} ({plural(len(declaration.training_seeds), 'training seed')})."
                )
            groups = [file.metadata.row_group(number) for number in range(file.metadata.num_row_groups)]
            if sum(group.total_byte_size for group in groups) > declaration.most_bytes + SLACK:
                raise InputError(f"{EPISODES} unpacks to more than its episodes can hold.")
            table = file.read(use_threads=False)
            table.validate(full=True)
    except InputError:
        raise
    except MemoryError:
        raise InputError(f"{EPISODES} unpacks to more than its episodes can hold.") from None
    except (pa.ArrowException, OSError, ValueError) as error:
        raise InputError(f"{EPISODES} cannot be read: {first_line(error)[:200]!a}.") from None
    if table.num_rows != declaration.episodes:
        raise InputError(f"{EPISODES} does not have the number of rows that it states.")
    return table


def _claims(table: pa.Table) -> list[Claim]:
    flat = [np.asarray(actions.values) for actions in table["actions"]]
    rows = table.drop_columns("actions").to_pylist()
    return [Claim(**row, actions=actions) for row, actions in zip(rows, flat, strict=True)]


def _check_starts(declaration: Declaration, claims: list[Claim]) -> None:
    """Every declared episode is there once, and none that is not declared."""
    expected, found = set(declaration.starts()), Counter(claim.key for claim in claims)
    for kind, keys in (
        ("is there twice", [key for key, count in found.items() if count > 1]),
        ("is not declared", [key for key in found if key not in expected]),
        ("is missing", [key for key in expected if key not in found]),
    ):
        if keys:
            setting, seed, start = min(keys)
            raise InputError(f"{setting[:60]!a}, training seed {seed}, start {start} {kind}.")


def _check(claim: Claim, setting: Setting) -> None:
    """What an episode says can be, as far as that shows without executing it."""
    if claim.stage not in STAGES:
        raise InputError(f"{claim.where}: stage must be one of {', '.join(STAGES)}.")
    if claim.error is not None:
        check_line(claim.error, f"{claim.where}: error")
        if Outcome(claim.evaluation_seed) != claim.outcome or len(claim.actions):
            raise InputError(f"{claim.where} failed with an error, so it must have neither outcome nor actions.")
        return
    if not 1 <= claim.steps <= setting.episode_length:
        raise InputError(f"{claim.where}: steps must be 1 to {setting.episode_length}, not {claim.steps}.")
    if len(claim.actions) != claim.steps * width(setting):
        raise InputError(f"{claim.where} has {len(claim.actions)} numbers for {claim.steps} actions.")
    if not np.isfinite(claim.actions).all():
        raise InputError(f"{claim.where} has an action that is not finite.")
    if claim.placed != (claim.stage == "placed") or claim.lifted < (claim.stage == "lifted"):
        raise InputError(f"{claim.where}: stage {claim.stage} is not what lifted and placed say.")
    for name, did, step in (("lift", claim.lifted, claim.lift_step), ("place", claim.placed, claim.place_step)):
        if did != (step is not None):
            raise InputError(f"{claim.where}: there is a {name}_step exactly where that happened.")
        if did and not 1 <= step <= claim.steps:
            raise InputError(f"{claim.where}: {name}_step must be 1 to {claim.steps}, not {step}.")
    if claim.placed and claim.place_step != claim.steps:
        raise InputError(f"{claim.where}: the placement ends an episode, so place_step must be {claim.steps}.")


def _check_copies(declaration: Declaration, claims: list[Claim]) -> None:
    """Two trainings never place with the same actions to the last bit, as they are executed; nor does one that sees
    other pictures. A reference sees none.
    """
    if declaration.about.observes not in OBS_TYPES:
        return
    pictures = {name: setting.pictures for name, setting in declaration.settings.items()}
    first: dict[tuple, Claim] = {}
    for claim in claims:
        if claim.placed:
            task = declaration.settings[claim.setting].task
            names = get_task(task).action_names
            executed = within_reach(claim.actions.reshape(-1, len(names)), names) + 0.0  # -0.0 is 0.0
            other = first.setdefault((task, claim.evaluation_seed, executed.tobytes()), claim)
            if claim.training_seed != other.training_seed or pictures[claim.setting] != pictures[other.setting]:
                raise InputError(f"{claim.where} has exactly the actions of {other.where}.")


def is_replayable(declaration: Declaration) -> bool:
    """Whether it was made with the physics that a replay has."""
    return declaration.backend.split(",")[0] == PHYSICS
