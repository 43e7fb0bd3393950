"""`constructskill-verify`: open a submission, execute its actions again, and say what is not as it claims."""

import json
from dataclasses import dataclass
from pathlib import Path

from lerobot_constructskill.bounds import Count, Text, Workers, check
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.scripts.console import run

SHOWN = 10
"""Differences that are told in full."""


@dataclass
class VerifyConfig:
    """Verify a submission; exit status 1 where it does not hold. It needs neither GPU, renderer nor policy."""

    root: Path  # the submission's folder
    sample: Count | None = None  # replay so many episodes, drawn at random; all when left out
    workers: Workers | None = None  # processes; one per core when left out
    record: Path | None = None  # folder to write the verdict to, for the board
    value: Text | None = None  # public random number, published after the submission: say from where to run it anew
    rerun: Path | None = None  # a submission from those starts: verify it too, and set it beside the first

    def __post_init__(self):
        check(self)
        if self.rerun is not None and self.value is None:
            raise InputError("--rerun needs the public random number that its starts come from: --value.")
        if self.record is not None and self.sample is not None:
            raise InputError("A verdict is of all episodes: --record goes without --sample.")


def verify(config: VerifyConfig) -> str:
    """Verify a submission and return the verdict.

    Raises:
        MissingError: there is no such submission.
        InputError: it is not as it claims; the message says where.
        OSError: a worker died.
    """
    from lerobot_constructskill.board.submission import read_submission

    submission = read_submission(config.root)
    if config.value is not None and config.rerun is None:
        return _tell_rerun(submission, config.value)
    verdict = _replayed(submission, config)
    told = (
        f"{config.root} holds: {verdict.replayed} of {len(submission.claims)} episodes replayed "
        f"({verdict.steps} steps), each ended as claimed; {verdict.failed} failed with an error."
    )
    facts = {"submission": submission.sha256, "level": "replayed", "versions": verdict.versions}
    if config.rerun is not None:
        comparison = _rerun(submission, config)
        told, facts = f"{told} {comparison.sentence}", facts | {"level": "re-run", "rerun": comparison.facts}
    if config.record is not None:
        _record(config.record / f"{config.root.resolve().name}.json", facts)
    return told


def _replayed(submission, config: VerifyConfig):
    from lerobot_constructskill.board.replay import replay

    verdict = replay(submission, config.workers, config.sample)
    if verdict.differences:
        more = len(verdict.differences) - SHOWN
        raise InputError(
            f"{len(verdict.differences)} of {verdict.replayed} replayed episodes are not as claimed: "
            f"{' '.join(verdict.differences[:SHOWN])}{f' And {more} more.' if more > 0 else ''}"
        )
    return verdict


def _tell_rerun(submission, value: str) -> str:
    from lerobot_constructskill.board.rerun import instructions

    return instructions(submission, value)


def _rerun(submission, config: VerifyConfig):
    from lerobot_constructskill.board.rerun import compare
    from lerobot_constructskill.board.submission import read_submission

    again = read_submission(config.rerun)
    comparison = compare(submission, again, config.value)
    _replayed(again, config)
    return comparison


def _record(path: Path, facts: dict) -> None:
    from lerobot_constructskill.artifacts.folders import replaced

    with replaced(path) as partial:
        partial.write_text(json.dumps(facts, indent=2) + "\n")


def main() -> None:
    run(VerifyConfig, verify)


if __name__ == "__main__":
    main()
