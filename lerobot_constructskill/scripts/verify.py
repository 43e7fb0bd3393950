"""`constructskill-verify`: execute the actions of a submission again, and say which outcomes are not as claimed."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from lerobot_constructskill.artifacts.pools import EXECUTORS
from lerobot_constructskill.bounds import Among, Count, Text, Workers, check
from lerobot_constructskill.errors import InputError, plural
from lerobot_constructskill.scripts.console import command


@dataclass
class VerifyConfig:
    """Verify a submission; exit status 1 if an outcome is not as claimed.

    A replay needs no GPU, renderer or policy. Training again needs what the training needed.
    """

    root: Path  # the submission's folder
    sample: Count | None = None  # number of episodes to replay, drawn at random; default: all
    workers: Workers | None = None  # processes; default: one per core
    record: Path | None = None  # folder to write the verdict to, for the board
    value: Text | None = None  # ROUND:RANDOMNESS of drand, newer than the submission: print how to make a re-run
    rerun: Path | None = None  # a submission from those starts: verify it too, and compare the two
    retrain: bool = False  # also make its policies again from its recipe, and compare; the same command continues
    made_in: Path = Path("outputs/retrained")  # where that is made; nothing else may have been made there
    executor: Annotated[str, Among(EXECUTORS)] = "processes"  # where that is made: here, or on a Ray cluster
    allow_code: list[Text] = field(default_factory=list)  # DIST==VERSION of other packages whose code a recipe may run

    def __post_init__(self):
        check(self)
        if self.rerun is not None and self.value is None:
            raise InputError("--rerun needs --value, the public random number that its starts come from.")
        if self.value is not None and self.rerun is None and (self.record, self.sample) != (None, None):
            raise InputError(
                "--value alone replays nothing: give --record or --sample with --rerun, or without --value."
            )
        if self.retrain and self.value is not None:
            raise InputError("--retrain and --value are two verifications: one after the other, each records its own.")
        if self.allow_code and not self.retrain:
            raise InputError("--allow_code is of --retrain: nothing else runs code of a recipe.")
        if self.record is not None and self.sample is not None:
            raise InputError("A verdict is about all episodes: --record cannot be combined with --sample.")


@command("constructskill-verify --root=board/entries/NAME --sample=20")
def verify(config: VerifyConfig) -> str:
    """Verify a submission and return the verdict.

    Raises:
        MissingError: there is no such submission.
        InputError: it is not as it claims; the message says where.
        OSError: a worker died.
    """
    from lerobot_constructskill.artifacts.pools import cores
    from lerobot_constructskill.board.entries import check_original
    from lerobot_constructskill.board.protocol import REPLAYED, RERUN, RETRAINED, PublicValue
    from lerobot_constructskill.board.replay import replay_submission
    from lerobot_constructskill.board.rerun import check_later, compare_rerun, describe, instructions
    from lerobot_constructskill.board.submission import read_submission
    from lerobot_constructskill.board.verification import read_verification, record_verification

    submission = read_submission(config.root)
    value = None if config.value is None else PublicValue.of(config.value)
    if value and config.rerun is None:
        return instructions(submission, value)
    check_original(config.root)
    study = None
    if config.retrain:  # which alone looks at a recipe, and loads the policies of other packages
        from lerobot_constructskill.board.retrain import retrain, study_of
        from lerobot_constructskill.study.spec import Options

        study = study_of(submission, config.allow_code)
    verdict = config.record and config.record / f"{config.root.resolve().name}.json"
    shown: dict[str, Any] = {}
    level, told = REPLAYED, ""
    if value and config.rerun:  # compared before anything is replayed, which takes minutes
        if verdict:
            check_later(value, read_verification(verdict, submission.sha256).get("date"))
        again = read_submission(config.rerun)
        rates = compare_rerun(submission, again, value)
        replay_submission(again, config.workers, config.sample)
        level, shown["rerun"] = RERUN, {"value": str(value), "settings": rates}
        told = f" Placed, on its own starts and on fresh ones: {describe(rates)}."
    replayed = replay_submission(submission, config.workers, config.sample)
    if study:
        options = Options(workers=config.workers or cores(), executor=config.executor)
        made = retrain(submission, study, config.made_in, options)
        level, shown["retrained"] = RETRAINED, made.shown
        told = f" {made.told}"
    if verdict:
        record_verification(verdict, submission.sha256, level, **shown)
    failed = sum(claim.error is not None for claim in submission.claims)
    return (
        f"{config.root} holds: {len(replayed)} of {len(submission.claims)} episodes replayed "
        f"({plural(sum(claim.steps for claim in replayed), 'step')}), each ended as claimed; {failed} failed with an "
        f"error.{told}"
    )
