"""What is known of a submission once somebody has verified it: a file for each entry of a board."""

import json
import os
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any, Literal, NotRequired, TypedDict

from lerobot_constructskill.artifacts.folders import write_text
from lerobot_constructskill.artifacts.locks import locked
from lerobot_constructskill.artifacts.processor import processor
from lerobot_constructskill.board.protocol import CLAIMED, LEVELS
from lerobot_constructskill.envs.recording import deciding
from lerobot_constructskill.files import Json


class Verification(TypedDict):
    """Which submission was verified, how far, when first, with which versions and on which machines."""

    submission: str
    level: Literal[LEVELS]
    date: date
    versions: dict[str, str]
    machines: NotRequired[list[str]]  # before 2026-11-24 none was named
    rerun: NotRequired[dict[str, Any]]


VERIFICATION = Json("a verdict of constructskill-verify", Verification)


def read_verification(path: Path, submission: str) -> dict[str, Any]:
    """What a file records of the submission with this hash; empty without a file, or where it is of another one.

    Raises:
        InputError: the file is no verdict.
    """
    if not os.path.lexists(path):
        return {}
    found = {"machines": []} | VERIFICATION.read(path)
    return found if found["submission"] == submission else {}


def record_verification(path: Path, submission: str, level: str, rerun: dict[str, Any] | None = None) -> None:
    """Record a verification of the submission with this hash, here and now.

    What else is known of the submission stays: the first date, other machines, a re-run.
    """
    versions = {name: value for name, value in deciding().items() if name != "processor"}  # the make is no version
    facts = {"submission": submission, "level": level, "versions": versions} | ({"rerun": rerun} if rerun else {})
    lock = path.with_name(f".{path.name}.lock")
    with locked(lock):  # of two at once the second adds to what the first has written
        before = read_verification(path, submission)
        if LEVELS.index(before.get("level", CLAIMED)) > LEVELS.index(level):
            facts |= {name: before[name] for name in ("level", "rerun") if name in before}
        earlier = before["machines"] if before.get("versions") == versions else []
        first = {"date": before.get("date", datetime.now(UTC).date().isoformat())}
        facts = first | facts | {"machines": list(dict.fromkeys([*earlier, processor()]))}
        write_text(path, json.dumps(facts, indent=2) + "\n")
        lock.unlink()
