"""What is known of a submission once somebody has verified it: a file for each entry of a board."""

import json
import os
from collections.abc import Mapping
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any, Literal, NotRequired, TypedDict

from lerobot_constructskill.artifacts.folders import write_text
from lerobot_constructskill.artifacts.locks import locked
from lerobot_constructskill.artifacts.processor import processor
from lerobot_constructskill.board.protocol import CLAIMED, LEVELS, RERUN, RETRAINED
from lerobot_constructskill.envs.recording import deciding
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.files import Json

RATES_OF = {RERUN: "rerun", RETRAINED: "retrained"}
"""The field of a verdict that shows a level's rates."""


class Rates(TypedDict):
    """Share of the episodes of each setting that placed, as submitted and made anew."""

    settings: dict[str, tuple[float, float]]


class Rerun(Rates):
    """A re-run, and the public value that its starts come from."""

    value: str


class Retrained(Rates):
    """Training again, whether weights and episodes were the same to the bit, and the weights that it started from."""

    exact: bool
    starts_from: NotRequired[str]


class Verification(TypedDict):
    """Which submission was verified, how far, when first, with which versions and on which machines."""

    submission: str
    level: Literal[LEVELS]
    date: date
    versions: dict[str, str]
    machines: NotRequired[list[str]]  # before 2026-11-24 none was named
    rerun: NotRequired[Rerun]
    retrained: NotRequired[Retrained]


VERIFICATION = Json("a verdict of constructskill-verify", Verification)


def read_verification(path: Path, submission: str) -> dict[str, Any]:
    """What a file records of the submission with this hash; empty without a file, or where it is of another one.

    Raises:
        InputError: the file is no verdict, or it does not show the rates of the level that it names.
    """
    if not os.path.lexists(path):
        return {}
    found: dict[str, Any] = {"machines": [], **VERIFICATION.read(path)}
    if (shown := RATES_OF.get(found["level"])) and not found.get(shown, {}).get("settings"):
        raise InputError(f"'{path}' says {found['level']}, and does not show its rates: record it anew.")
    return found if found["submission"] == submission else {}


def record_verification(path: Path, submission: str, level: str, **shown: Any) -> None:
    """Record a verification of the submission with this hash, here and now.

    What else is known of the submission stays: the first date, other machines, a higher level and its rates.

    Args:
        shown: the fields named in `RATES_OF`, those that were found.
    """
    versions = {name: value for name, value in deciding().items() if name != "processor"}  # the make is no version
    facts = {"submission": submission, "level": level, "versions": versions}
    lock = path.with_name(f".{path.name}.lock")
    with locked(lock):  # of two at once the second adds to what the first has written
        before = read_verification(path, submission)
        facts["level"] = max(level, before.get("level", CLAIMED), key=LEVELS.index)
        facts |= {name: before[name] for name in RATES_OF.values() if name in before} | shown
        earlier = before["machines"] if before.get("versions") == versions else []
        first = {"date": before.get("date", datetime.now(UTC).date().isoformat())}
        facts = first | facts | {"machines": list(dict.fromkeys([*earlier, processor()]))}
        write_text(path, json.dumps(facts, indent=2) + "\n")
        lock.unlink()


def different(there: Mapping[str, str], here: Mapping[str, str]) -> dict[str, tuple[str, str]]:
    """The packages and rooms that have another version there than here, and both versions."""
    return {name: (there.get(name, "unknown"), own) for name, own in here.items() if there.get(name) != own}
