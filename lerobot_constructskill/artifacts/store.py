"""Nodes, each found by a digest of what makes it, and the store that makes the missing ones.

<store>/<kind>/<digest>/spec.json   beside the content; log.txt after failures
<store>/logs/<kind>-<digest>.txt    the same log while the node is in the making, and after a failure
"""

import json
import logging
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Any, ClassVar, NotRequired, TypedDict

from lerobot_constructskill.artifacts.code import check_unedited
from lerobot_constructskill.artifacts.digests import digest
from lerobot_constructskill.artifacts.failures import Failure
from lerobot_constructskill.artifacts.folders import staged, sweep
from lerobot_constructskill.artifacts.locks import locked
from lerobot_constructskill.artifacts.pools import DIED, cores, open_pool
from lerobot_constructskill.errors import InputError, MachineError, MissingError, TakenError
from lerobot_constructskill.files import Json, read_text
from lerobot_constructskill.progress import Progress, quiet

NOTED = re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d$")
"""The line above an exception in a log."""

LONGEST = 1 << 30
"""Largest size of a log, in bytes."""

SPEC, LOG = "spec.json", "log.txt"

INPUTS, VERSIONS, LINEAGE = "inputs", "versions", "lineage"
"""Keys of a specification: digests of what the node is made of, its code, and specifications of all its ancestors."""


class Spec(TypedDict):
    inputs: NotRequired[dict[str, str]]
    versions: dict[str, str]
    lineage: NotRequired[dict[str, dict[str, Any]]]


SPECIFICATION = Json("the specification of what a store keeps", Spec)

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Machine:
    """Where nodes are made and by how many processes. Nothing of it shows in what they hold.

    Args:
        workers: processes that generate demonstrations and simulate in rounds of DAgger.
        simulators: processes that simulate evaluation episodes; one per core by default.
        together: episodes of a round that run at the same time.
    """

    workers: int = 1
    simulators: int | None = None
    together: int = 8


class Node:
    """Something that can be made, and made again with the same bytes. Its subclasses are frozen dataclasses.

    Two nodes are equal where their digests are. A digest holds all that the bytes depend on and nothing else: not
    labels, paths or numbers of processes.
    """

    kind: ClassVar[str]
    """The store's folder for such nodes."""
    keeps: ClassVar[str | None] = None
    """Name of a folder for finished parts, beside the unfinished node; it outlives a kill."""
    is_passing: ClassVar[bool] = False
    """Whether the store does not keep the node: it is written anew for each node that is made of it."""
    is_single_threaded: bool = False
    """Whether `make` keeps one core busy, so that several nodes are made at the same time."""
    parts: tuple["Node", ...] = ()
    """The data sets that a merged data set consists of, in order."""

    def facts(self) -> Mapping[str, Any]:
        """The node's own settings: plain values, every default written out."""
        raise NotImplementedError

    def versions(self) -> Mapping[str, str]:
        """The code that makes it, as it is now: package or room to version."""
        raise NotImplementedError

    @property
    def inputs(self) -> Mapping[str, "Node"]:
        """The nodes that it is made of, by the name of their role."""
        return {}

    def make(self, folder: Path, inputs: Mapping[str, Path], machine: Machine) -> None:
        """Write the node to `folder`, a path that does not exist yet, from the folders of its inputs."""
        raise NotImplementedError

    @cached_property
    def spec(self) -> dict[str, Any]:
        """All that the bytes depend on.

        Raises:
            InputError: the node is made of itself.
        """
        try:
            made_of = {name: one.digest for name, one in self.inputs.items()}
        except RecursionError:
            raise InputError(f"One of the {self.kind} is made of itself.") from None
        return {**self.facts(), **({INPUTS: made_of} if made_of else {}), VERSIONS: dict(self.versions())}

    @cached_property
    def lineage(self) -> dict[str, dict[str, Any]]:
        """The specifications of all that it is made of, by digest."""
        found, unseen = {}, [*self.inputs.values()]
        while unseen:
            one = unseen.pop()
            if one.digest not in found:
                found[one.digest] = one.spec
                unseen += one.inputs.values()
        return found

    @cached_property
    def digest(self) -> str:
        return digest(self.spec)

    @property
    def repo_id(self) -> str:
        """What the node is called as a data set, where it is one."""
        return f"local/{self.digest}"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Node) and (self.kind, self.digest) == (other.kind, other.digest)

    def __hash__(self) -> int:
        return hash((self.kind, self.digest))


@dataclass(frozen=True)
class Store:
    """A folder of nodes, for all studies and for all machines that share it."""

    root: Path

    def get(self, node: Node, machine: Machine = Machine()) -> Path:  # noqa: B008  it is immutable
        """The folder of a node. What is missing of it, and of what it is made of, is made.

        Raises:
            InputError: something else is in its place, or the node is made of itself.
            MachineError: code was edited while it was at work, or the disk is full.
            Exception: whatever making a node raises.
        """
        for one in dict.fromkeys([*self._due(node), node]):  # the node itself to be tidied up after a kill
            with self.claim([one]) as missing:
                if missing:
                    self._make(one, machine)
        return self.folder(node)

    def _make(self, node: Node, machine: Machine) -> None:
        with self.writing(node) as folder:
            inputs = {name: self._input(one, folder.with_name(name), machine) for name, one in node.inputs.items()}
            node.make(folder, inputs, machine)

    def _input(self, node: Node, beside: Path, machine: Machine) -> Path:
        """The folder of an input; a passing one is written beside the node that is made of it."""
        if not node.is_passing:
            return self.get(node, machine)
        node.make(beside, {name: self.get(one, machine) for name, one in node.inputs.items()}, machine)
        return beside

    def _due(self, node: Node) -> list[Node]:
        """What is missing for a node, in an order in which it can be made; the node itself is last."""
        made_of, unseen = {}, [node]
        while unseen:
            one = unseen.pop()
            if one not in made_of and (one.is_passing or not self.has(one)):
                made_of[one] = list(one.inputs.values())
                unseen += made_of[one]
        order = TopologicalSorter(made_of).static_order()
        return [one for one in order if one in made_of and not one.is_passing]

    def get_all(self, nodes: Sequence[Node], machine: Machine) -> dict[Node, Failure]:
        """Make what is missing of several nodes, and return why some could not be made; the others are made.

        Nodes that keep one core busy are made at the same time, a process for each core.
        """
        missing = [one for one in dict.fromkeys(nodes) if not self.has(one)]
        beside = [one for one in missing if one.is_single_threaded]
        if min(len(beside), cores()) < 2:
            beside = []
        failed: dict[Node, Failure] = {}
        for one in missing:
            for due in self._due(one):
                if due not in beside and (failure := failed.get(due) or self._attempt(due, machine)):
                    failed[one] = failed[due] = failure
                    break
        failed |= self._make_beside([one for one in beside if one not in failed], machine)
        return {one: failed[one] for one in missing if one in failed}

    def _make_beside(self, nodes: Sequence[Node], machine: Machine) -> dict[Node, Failure]:
        """Make nodes in processes of their own, and return why some could not be made."""
        if not nodes:
            return {}
        failed, died = {}, []
        with (
            open_pool("processes", max(2, min(len(nodes), cores()))) as submit,
            Progress(total=len(nodes), desc=nodes[0].kind, unit="node") as bar,
        ):
            for one, future in [(one, submit(_attempt_quietly, self, one, machine)) for one in nodes]:
                try:
                    failed[one] = future.result()
                except BrokenExecutor:
                    died.append(one)
                bar.update()
        if len(nodes) == 1 and died:
            return {nodes[0]: Failure.of(MachineError(DIED))}
        for one in died:  # one process ends all of a pool: the others have done nothing
            failed |= self._make_beside([one], machine)
        return {one: failure for one, failure in failed.items() if failure}

    def _attempt(self, node: Node, machine: Machine) -> Failure | None:
        try:
            self.get(node, machine)
        except Exception as error:  # whatever a policy, its weights or its data set may raise
            return Failure.of(error)
        return None

    def folder(self, node: Node) -> Path:
        """Where a node is, or will be."""
        return self.root / node.kind / node.digest

    def has(self, node: Node) -> bool:
        """Whether a node has been made.

        Raises:
            InputError: something else is in its place.
        """
        folder = self.folder(node)
        if not folder.exists():
            return False
        made = _read_spec(folder / SPEC) or {}
        if {key: value for key, value in made.items() if key != LINEAGE} != json.loads(json.dumps(node.spec)):
            raise InputError(f"{folder} was not made by this version of the package: move it away.")
        return True

    def spec(self, kind: str, name: str) -> Spec | None:
        """The specification of the node with this digest, with its lineage; None where it has not been made."""
        return _read_spec(self.root / kind / name / SPEC)

    @contextmanager
    def claim(self, nodes: Sequence[Node]) -> Iterator[list[Node]]:
        """Wait until no other process makes any of `nodes`, and yield those that are still to be made."""
        different = sorted(dict.fromkeys(nodes), key=lambda node: (node.kind, node.digest))
        with ExitStack() as stack:
            for node in different:  # all in one order, or two processes would wait for each other
                self._enter(stack, self.root / "locks" / f"{node.kind}-{node.digest}")
            missing = [node for node in dict.fromkeys(nodes) if not self.has(node)]
            for node in different:
                self._tidy(node, node in missing)
            yield missing

    @staticmethod
    def _enter(stack: ExitStack, lock: Path) -> None:
        try:
            stack.enter_context(locked(lock, taken="It is in use."))
        except TakenError:
            logger.warning("Waiting for another process, which makes %s.", lock.name)
            stack.enter_context(locked(lock))

    @contextmanager
    def writing(self, node: Node) -> Iterator[Path]:
        """Yield a path to write a claimed node's folder to, as `staged` does; specification and log are added.

        Raises:
            MachineError: the code that makes the node was edited since its digest was asked for.
        """
        with staged(self.folder(node), node.keeps) as folder:
            yield folder
            check_unedited(node.spec[VERSIONS], node.versions())
            log = self.log(node)
            if log.exists():
                shutil.copy(log, folder / LOG)
            spec = node.spec | ({LINEAGE: node.lineage} if node.lineage else {})
            (folder / SPEC).write_text(json.dumps(spec, indent=2, sort_keys=True) + "\n", encoding="utf-8")
        log.unlink(missing_ok=True)

    def log(self, node: Node) -> Path:
        """The log of a node: its failures so far. It moves into the node's own folder when that is there."""
        return self.root / "logs" / f"{node.kind}-{node.digest}.txt"

    def notes(self, node: Node) -> int:
        """How many failures the log of a missing node holds."""
        log = self.log(node)
        return sum(map(bool, map(NOTED.match, read_text(log, LONGEST).splitlines()))) if log.exists() else 0

    def note(self, node: Node, failure: Failure) -> None:
        """Add a failure's traceback to the log."""
        log = self.log(node)
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("a", encoding="utf-8", errors="backslashreplace") as file:
            file.write(f"{datetime.now():%Y-%m-%d %H:%M:%S}\n{failure.traceback}\n")

    def discard(self, node: Node) -> None:
        """Remove a node that the caller has claimed, so that it is made anew."""
        if self.folder(node).exists():
            self.folder(node).rename(self._doomed(node))  # at once, where removing takes its time
        shutil.rmtree(self._doomed(node), ignore_errors=True)

    def _tidy(self, node: Node, is_missing: bool) -> None:
        """Remove what a process left that was killed after it had written or discarded the node."""
        shutil.rmtree(self._doomed(node), ignore_errors=True)
        if not is_missing:
            sweep(self.folder(node))
            self.log(node).unlink(missing_ok=True)

    def _doomed(self, node: Node) -> Path:
        return self.root / node.kind / f".{node.digest}.discarded"


def _attempt_quietly(store: Store, node: Node, machine: Machine) -> Failure | None:
    """`Store._attempt` in another process, without bars: they would mix with those of the others."""
    with quiet():
        return store._attempt(node, machine)


def _read_spec(path: Path) -> Spec | None:
    try:
        return SPECIFICATION.read(path)
    except (MissingError, InputError):
        return None
