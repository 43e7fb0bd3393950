"""`constructskill-verify`: execute the actions of a submission again, and say which outcomes are not as claimed."""

import json
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from lerobot_constructskill.bounds import Count, Text, Workers, check
from lerobot_constructskill.errors import InputError, plural
from lerobot_constructskill.scripts.console import run

SHOWN = 10
"""Differences that are told in full."""

_OTHER_MAKE = (
    " Makes of processors differ in the last bits of physics, on which an episode seldom depends: verify it on the "
    "make that it was made on."
)


@dataclass
class VerifyConfig:
    """Verify a submission; exit status 1 if an outcome is not as claimed. It needs no GPU, renderer or policy."""

    root: Path  # the submission's folder
    sample: Count | None = None  # number of episodes to replay, drawn at random; default: all
    workers: Workers | None = None  # processes; default: one per core
    record: Path | None = None  # folder to write the verdict to, for the board
    value: Text | None = None  # public random number, newer than the submission: print how to make a re-run
    rerun: Path | None = None  # a submission from those starts: verify it too, and compare the two

    def __post_init__(self):
        check(self)
        if self.rerun is not None and self.value is None:
            raise InputError("--rerun needs --value, the public random number that its starts come from.")
        if self.value is not None and self.rerun is None and (self.record, self.sample) != (None, None):
            raise InputError(
                "--value alone replays nothing: give --record or --sample with --rerun, or without --value."
            )
        if self.record is not None and self.sample is not None:
            raise InputError("A verdict is about all episodes: --record cannot be combined with --sample.")


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
    rerun = _compared(submission, config) if config.rerun is not None else None
    verdict = _replayed(submission, config)
    told = (
        f"{config.root} holds: {verdict.replayed} of {len(submission.claims)} episodes replayed "
        f"({plural(verdict.steps, 'step')}), each ended as claimed; {verdict.failed} failed with an error."
    )
    facts = {"submission": submission.sha256, "level": "replayed", "versions": verdict.versions}
    if rerun is not None:
        again, comparison = rerun
        _replayed(again, config)
        comparison.confirm()
        told, facts = f"{told} {comparison.sentence}", facts | {"level": "re-run", "rerun": comparison.facts}
    if config.record is not None:
        _record(config.record / f"{config.root.resolve().name}.json", facts)
    return told


def _record(path: Path, facts: dict) -> None:
    """Write what was found. What else is known of the submission stays: the first date, other machines, a re-run."""
    from lerobot_constructskill.artifacts.locks import locked

    lock = path.with_name(f".{path.name}.lock")
    with locked(lock):  # of two at once the second adds to what the first has written
        _add(path, facts)
        lock.unlink()


def _add(path: Path, facts: dict) -> None:
    from lerobot_constructskill.artifacts.folders import write_text
    from lerobot_constructskill.artifacts.processor import processor
    from lerobot_constructskill.board.entries import read_verdict
    from lerobot_constructskill.board.protocol import CLAIMED, LEVELS

    before = read_verdict(path, {"submission": facts["submission"]})
    facts = {"date": before.get("date", datetime.now(UTC).date().isoformat())} | facts
    if LEVELS.index(before.get("level", CLAIMED)) > LEVELS.index(facts["level"]):
        facts |= {name: before[name] for name in ("level", "rerun") if name in before}
    earlier = before["machines"] if before.get("versions") == facts["versions"] else []
    machines = list(dict.fromkeys([*earlier, processor()]))
    write_text(path, json.dumps(facts | {"machines": machines}, indent=2) + "\n")


def _replayed(submission, config: VerifyConfig):
    from lerobot_constructskill.artifacts.processor import make
    from lerobot_constructskill.board.replay import replay

    verdict = replay(submission, config.workers, config.sample)
    if verdict.differences:
        more = len(verdict.differences) - SHOWN
        raise InputError(
            f"{len(verdict.differences)} of {verdict.replayed} replayed episodes are not as claimed: "
            f"{' '.join(verdict.differences[:SHOWN])}{f' And {more} more.' if more > 0 else ''}"
            f"{'' if submission.declaration.versions.get('processor') == make() else _OTHER_MAKE}"
        )
    return verdict


def _tell_rerun(submission, value: str) -> str:
    from lerobot_constructskill.board.rerun import instructions

    return instructions(submission, value)


def _compared(submission, config: VerifyConfig):
    """The re-run and what it says of the submission, before either is replayed, which takes minutes."""
    from lerobot_constructskill.board.rerun import compare
    from lerobot_constructskill.board.submission import read_submission

    again = read_submission(config.rerun)
    return again, compare(submission, again, config.value)


def main() -> None:
    run(VerifyConfig, verify)


if __name__ == "__main__":
    main()
