"""Everything made is found by what made it: a specification, its digest, a folder.

    <store>/<kind>/<digest>/spec.json   beside whatever the artefact holds, log.txt among it where something was said
    <store>/logs/<kind>-<digest>.txt    the same log while the artefact is in the making, and after a failure

Whatever does not show in an artefact's bytes (labels, paths, numbers of workers) is no part of its specification.
"""

import json
import logging
import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Any, TypedDict

from lerobot_constructskill.artifacts.digests import digest
from lerobot_constructskill.artifacts.folders import staged, sweep
from lerobot_constructskill.artifacts.locks import locked
from lerobot_constructskill.errors import InputError, MissingError, TakenError, full_traceback
from lerobot_constructskill.files import Json, read_text


class _Spec(TypedDict, total=False):
    seed: int
    training: dict[str, Any]


NOTED = re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d$")
"""The line above an exception in a log."""

LONGEST = 1 << 30
"""Bytes of a log."""

SPEC, LOG = "spec.json", "log.txt"

SPECIFICATION = Json("the specification of what a store keeps", _Spec)

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Artifact:
    """Something that can be made, and made again alike.

    Args:
        kind: the store's folder for such things, "demonstrations" for instance.
        spec: plain values: all that its bytes depend on, with every default resolved.
    """

    kind: str
    spec: Mapping[str, Any]

    @cached_property
    def digest(self) -> str:
        return digest(self.spec)


@dataclass(frozen=True)
class Store:
    """A folder of artefacts, for all studies and for all machines that share it."""

    root: Path

    def folder(self, artifact: Artifact) -> Path:
        """Where an artefact is, or will be."""
        return self.root / artifact.kind / artifact.digest

    def has(self, artifact: Artifact) -> bool:
        """Whether it has been made.

        Raises:
            InputError: something else is in its place.
        """
        folder = self.folder(artifact)
        if not folder.exists():
            return False
        if _read_spec(folder / SPEC) != json.loads(json.dumps(artifact.spec)):
            raise InputError(f"{folder} was not made by this version of the package: move it away.")
        return True

    def spec(self, kind: str, name: str) -> Mapping[str, Any] | None:
        """The specification of what has this digest; None where it has not been made."""
        return _read_spec(self.root / kind / name / SPEC)

    def keeps(self, kind: str, name: str) -> bool:
        """Whether something of this digest has been made, whatever its specification."""
        return (self.root / kind / name).is_dir()

    def obtain(self, artifact: Artifact, make: Callable[[Path], None], keep: str | None = None) -> Path:
        """The folder of an artefact, which `make` writes to the path that it is given, where it is not there.

        Args:
            keep: as of `staged`.
        """
        with self.claim([artifact]) as missing:
            for one in missing:
                with self.writing(one, keep) as folder:
                    make(folder)
        return self.folder(artifact)

    @contextmanager
    def claim(self, artifacts: Sequence[Artifact]) -> Iterator[list[Artifact]]:
        """Wait until nobody else makes any of `artifacts`, and yield those that are still to be made."""
        different = {(artifact.kind, artifact.digest): artifact for artifact in artifacts}
        with ExitStack() as stack:
            for kind, name in sorted(different):  # all in one order, or two processes would wait for each other
                self._enter(stack, self.root / "locks" / f"{kind}-{name}")
            missing = [artifact for artifact in different.values() if not self.has(artifact)]
            for artifact in different.values():
                self._tidy(artifact, artifact in missing)
            yield missing

    @staticmethod
    def _enter(stack: ExitStack, lock: Path) -> None:
        try:
            stack.enter_context(locked(lock, taken="It is in use."))
        except TakenError:
            logger.warning("Waiting for another process, which makes %s.", lock.name)
            stack.enter_context(locked(lock))

    @contextmanager
    def writing(self, artifact: Artifact, keep: str | None = None) -> Iterator[Path]:
        """Yield a path to write the artefact's folder to, as `staged` does; its specification and log are added."""
        with staged(self.folder(artifact), keep) as folder:
            yield folder
            log = self.log(artifact)
            if log.exists():
                shutil.copy(log, folder / LOG)
            (folder / SPEC).write_text(json.dumps(artifact.spec, indent=2, sort_keys=True) + "\n", encoding="utf-8")
        log.unlink(missing_ok=True)

    def log(self, artifact: Artifact) -> Path:
        """What was said while the artefact was made; in its own folder once it is there."""
        return self.root / "logs" / f"{artifact.kind}-{artifact.digest}.txt"

    def notes(self, artifact: Artifact) -> int:
        """How many exceptions its log holds while it is not made."""
        log = self.log(artifact)
        return sum(map(bool, map(NOTED.match, read_text(log, LONGEST).splitlines()))) if log.exists() else 0

    def note(self, artifact: Artifact, error: BaseException) -> None:
        """Add an exception's whole traceback to the log."""
        log = self.log(artifact)
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("a", encoding="utf-8") as file:
            file.write(f"{datetime.now():%Y-%m-%d %H:%M:%S}\n{full_traceback(error)}\n")

    def discard(self, artifact: Artifact) -> None:
        """Remove an artefact that the caller has claimed, so that it is made anew."""
        self.folder(artifact).rename(self._doomed(artifact))  # at once, where removing takes its time
        shutil.rmtree(self._doomed(artifact), ignore_errors=True)

    def _tidy(self, artifact: Artifact, is_missing: bool) -> None:
        """Remove what a process left that was killed when the artefact was whole, or gone, already."""
        shutil.rmtree(self._doomed(artifact), ignore_errors=True)
        if not is_missing:
            sweep(self.folder(artifact))
            self.log(artifact).unlink(missing_ok=True)

    def _doomed(self, artifact: Artifact) -> Path:
        return self.root / artifact.kind / f".{artifact.digest}.discarded"


def _read_spec(path: Path) -> Any:
    try:
        return SPECIFICATION.read(path)
    except (MissingError, InputError):
        return None
