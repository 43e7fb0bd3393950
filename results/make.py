"""Makes the published results, a piece of a study at a time: `make results`.

A piece is a setting of a study, or one draw of it. Its rows, times, report and the numbers in pages are committed
before the next one begins, so that a killed run, or a clone on another machine, makes only what is left. The board's
entries that are made of studies (`entries.py`) are written and committed with their last piece.

    python results/make.py --status            # what is left, and roughly how long it takes
    python results/make.py --only=precise      # the pieces whose names fit, or begin so
    python results/make.py --minutes=120       # begin no piece after so long
    python results/make.py --executor=ray      # the runs of a piece on a cluster
    python results/make.py --discard           # remove demonstrations and features that no piece needs any more
"""

import json
import subprocess
import time
from argparse import RawDescriptionHelpFormatter
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cached_property
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryDirectory

from entries import drop, keep, whole, write_entries
from render import PAGES, make_of, render

from lerobot_constructskill.analysis.report.page import write_report
from lerobot_constructskill.artifacts.folders import write_text
from lerobot_constructskill.artifacts.processor import processor
from lerobot_constructskill.artifacts.store import Node, Store
from lerobot_constructskill.errors import InputError, plural
from lerobot_constructskill.lerobot_internals import load_plugins
from lerobot_constructskill.parsing import parse
from lerobot_constructskill.presets import find
from lerobot_constructskill.scripts.console import Parser, edge, say
from lerobot_constructskill.scripts.study import StudyConfig, text_of
from lerobot_constructskill.study.estimates import Estimates
from lerobot_constructskill.study.plan import list_runs
from lerobot_constructskill.study.rows import NOT_RUN, ROWS, Row, load_rows, read_rows
from lerobot_constructskill.study.runs import Run
from lerobot_constructskill.study.session import run_study
from lerobot_constructskill.study.spec import Options, Study
from lerobot_constructskill.study.table import Table

ROOT = Path(__file__).parents[1]

STUDIES = (
    "paper",
    "representation",
    "precise",
    "draws",
    "base_camera",
    "dart_dagger",
    "perturbed",
    "language",
    "walls",
    "other_policies",
)
"""What the benchmark stands on, in the order in which it is made."""

SOURCES = ("lerobot_constructskill", "configs")
"""Folders whose uncommitted edits would be in rows, and in no commit that makes these rows again."""

TRAINS_TOGETHER = "frozen_vit"
"""The policy type whose seeds train together. One of another type takes long, and is a piece by itself."""

BULKY = ("demonstrations", "features", "rounds", "dagger")
"""Kinds of nodes that can be removed once their runs are made: the features of a draw take 12 GB."""


type Name = tuple[str, str, int]
"""Setting, variant and training seed of a run."""


@dataclass(frozen=True)
class Piece:
    """What is made and committed at once.

    Args:
        study: name of a shipped study.
        name: of the piece: study/setting, and what else tells it from the others of that setting.
        runs: its runs, made or not.
    """

    study: str
    name: str
    runs: Sequence[Run]

    @property
    def only(self) -> str:
        return ",".join(run.id for run in self.runs)

    @property
    def setting(self) -> str:
        return self.runs[0].arm.setting

    @property
    def names(self) -> set[Name]:
        return {(run.arm.setting, run.arm.name, run.seed) for run in self.runs}


def pieces_of(name: str, study: Study) -> Iterator[Piece]:
    """The pieces of a study, in its order."""
    draws = study.draws
    is_many = any(draws.of(seed) for of in study.variants.values() for seed in of.training_seeds)

    def title(run: Run) -> str:
        parts = [name, run.arm.setting]
        if run.arm.learner and run.arm.learner.config.type != TRAINS_TOGETHER:
            parts.append(run.arm.name)
        return "/".join([*parts, f"draw_{draws.of(run.seed)}"] if is_many else parts)

    runs = list_runs(study)
    order = {one: number for number, one in enumerate(dict.fromkeys(map(title, runs)))}
    for one, own in groupby(sorted(runs, key=lambda run: order[title(run)]), key=title):
        yield Piece(name, one, list(own))


class Maker:
    """Makes pieces of studies in a checkout.

    Args:
        root: the checkout, whose folder results/ is written and committed.
        store: where runs are made.
        options: how; `only` is each piece's own.
    """

    def __init__(self, root: Path, store: Path, studies: Sequence[str] = STUDIES, **options):
        self.root, self.store, self.options = root, Store(store.absolute()), options
        self._refused: set[str] = set()  # entries of the board, in this process
        self.configs = {name: parse(StudyConfig, [], find("study", name)) for name in studies}

    def folder(self, study: str) -> Path:
        return self.root / "results" / study

    @cached_property
    def every(self) -> list[Piece]:
        """All pieces."""
        return [piece for name, config in self.configs.items() for piece in pieces_of(name, config.study)]

    @cached_property
    def _runs(self) -> dict[str, list[Run]]:
        """All runs of each study."""
        return {study: [run for one in self.every if one.study == study for run in one.runs] for study in self.configs}

    def pieces(self, only: str = "") -> list[Piece]:
        """All pieces, or those whose names fit a pattern or begin with it.

        Raises:
            InputError: no piece does.
        """
        chosen = [
            one
            for one in self.every
            if not only or fnmatchcase(one.name, only) or f"{one.name}/".startswith(f"{only}/")
        ]
        if not chosen:
            raise InputError(f"--only={only} fits no piece; the first one is {self.every[0].name}.")
        return chosen

    def due(self, pieces: Iterable[Piece]) -> Iterator[tuple[Piece, list[Run]]]:
        """Each piece with the runs whose rows its study's folder lacks, if any.

        What a killed process made is among them. A study's rows are read once for all its pieces that follow.
        """
        for study, own in groupby(pieces, key=lambda piece: piece.study):
            together = list(own)
            runs = [run for piece in together for run in piece.runs]
            absent = {run.id for run in Table(self.folder(study), runs, self.store).untold()}
            yield from ((piece, [run for run in piece.runs if run.id in absent]) for piece in together)

    def status(self, pieces: Sequence[Piece]) -> str:
        """A line for each piece that is to be made, and their number."""
        times = self.times()
        due = [(piece, runs) for piece, runs in self.due(pieces) if runs]
        lines = [self.told(piece, runs, times) for piece, runs in due]
        return "\n".join([*lines, _total(pieces, len(due), times)])

    def total(self, pieces: Sequence[Piece]) -> str:
        """The last line of that."""
        times = self.times()
        due = [times.tell(piece.study, runs) for piece, runs in self.due(pieces) if runs]
        return _total(pieces, len(due), times)

    def told(self, piece: Piece, runs: Sequence[Run], times: Estimates) -> str:
        """What is to be made of a piece, how long it takes, and whether its setting has rows of other processors."""
        made = {
            digest for run in self._runs[piece.study] if run.arm.setting == piece.setting for digest in run.digests
        }
        file = self.folder(piece.study) / ROWS
        rows = read_rows(file) if file.is_file() else None
        versions = [] if rows is None else rows[rows["run"].isin(made)]["versions"].dropna().unique()
        others = {make_of(json.loads(one)["processor"]) for one in versions} - {make_of(processor())}
        told = f"{piece.name}: {plural(len(runs), 'run')}, {times.tell(piece.study, runs)}"
        return f"{told}; rows of {piece.setting} are of {' and '.join(sorted(others))}" if others else told

    def times(self) -> Estimates:
        """How long runs take, by what is in the folders of all studies now."""
        folders = {study: self.folder(study) for study in self.configs}
        return Estimates(folders, self._runs, self.store)

    def is_committed(self, piece: Piece) -> bool:
        """Whether its rows are in a commit, and no entry of its study waits to be written.

        They are not where a process was killed before that.
        """
        return not self._due_entries(piece.study) and not piece.names & self._uncommitted(piece.study)

    def _due_entries(self, study: str) -> list[str]:
        return [name for name in whole(self.folder(study), study) if name not in self._refused]

    def _uncommitted(self, study: str) -> set[Name]:
        """The runs of a study whose rows are in no commit."""
        file = self.folder(study) / ROWS
        if not file.is_file() or not self._git("status", "--porcelain", "--", file):
            return set()
        now = _by_run(load_rows(file))
        with TemporaryDirectory() as scratch:
            copy = Path(scratch) / file.name
            copy.write_bytes(self._committed(file))
            before = _by_run(load_rows(copy)) if copy.stat().st_size else {}
        return {run for run, rows in now.items() if before.get(run) != rows and rows[0].error_kind != NOT_RUN}

    def _committed(self, file: Path) -> bytes:
        """A file as it is in the last commit; nothing if it is not there."""
        if not self._git("ls-tree", "HEAD", "--", file):
            return b""
        return self._output("show", f"HEAD:{file.relative_to(self.root).as_posix()}")

    def make(self, piece: Piece) -> None:
        """Make what is missing of a piece, write its pages and commit them.

        Raises:
            InputError: git could not commit it, or would commit with it what something else has written.
        """
        self._check(piece)
        config, folder = self.configs[piece.study], self.folder(piece.study)
        folder.mkdir(parents=True, exist_ok=True)
        options = Options(only=piece.only, replace=True, **self.options)
        run_study(config.study, text_of(config), folder, self.store, options)
        self.publish(piece)

    def discard(self) -> None:
        """Remove the demonstrations and features that no piece needs any more."""
        left = [
            run for piece, runs in self.due(self.every) if runs or not self.is_committed(piece) for run in piece.runs
        ]
        done = _bulky([run for piece in self.every for run in piece.runs]) - _bulky(left)
        for node in filter(self.store.has, done):
            with self.store.claim([node]):
                self.store.discard(node)

    def publish(self, piece: Piece) -> None:
        """Write the report of a piece's study and the numbers in pages, and commit them with its rows.

        Then write the entries of the board that it was the last piece of, and commit these.
        """
        write_report(self.folder(piece.study))
        for page in self._pages:
            write_text(page, render(page))
        folder, board = self.folder(piece.study), self.root / "board"
        _remove_unseen(folder / "figures", self._pages)
        keep(folder, piece.study, piece.runs, self.store)
        self._commit(f"Results: {piece.name}", folder, *self._pages)
        due, commit = self._due_entries(piece.study), self._git("rev-parse", "--short", "HEAD").strip()
        for name in due:  # a process may have been killed while it replaced one
            if not (board / "entries" / name).exists():
                self._git("checkout", "HEAD", "--", board / "entries" / name)
        written = write_entries(due, folder, piece.study, board, commit)
        self._refused |= {*due} - {*written}
        if written:
            kept = (board / name for name in ("entries", "recovered", "verified"))
            self._commit(f"Board: {', '.join(written)}", *filter(Path.exists, kept))
            drop(folder, piece.study, written)
            self._commit(f"Recordings of {', '.join(written)} are on the board", folder)

    @property
    def _pages(self) -> list[Path]:
        return [self.root / page.relative_to(ROOT) for page in PAGES]

    def _check(self, piece: Piece) -> None:
        """Refuse, before the hours that a piece takes, what would spoil its commit."""
        self._git("var", "GIT_COMMITTER_IDENT")
        if not self._git("branch", "--show-current"):
            raise InputError(
                "No branch is checked out, so that commits would be lost: `git switch -c NAME` makes one."
            )
        for name in ("MERGE_HEAD", "CHERRY_PICK_HEAD", "index.lock"):
            if (file := self.root / self._git("rev-parse", "--git-path", name).strip()).exists():
                raise InputError(f"Something else is going on in git: finish it first (`git status`; {file}).")
        if edited := self._git("status", "--porcelain", "--", *SOURCES).splitlines():
            raise InputError(f"Commit your edits first, so that a commit makes the rows again: {edited[0][3:]}")
        for page in self._pages:
            now, before = page.read_text(encoding="utf-8"), self._committed(page).decode()
            if now != before and now != render(page, before):  # what a killed process leaves
                raise InputError(f"Commit your edits first: {page.relative_to(self.root)} is committed with the rows.")
        for study in self.configs:
            waiting = self._uncommitted(study) - piece.names
            if other := next((one for one in self.every if one.study == study and one.names & waiting), None):
                raise InputError(
                    f"{other.name} has rows that are in no commit: make it first (`--only={other.name}`)."
                )

    def _commit(self, message: str, *paths: Path) -> None:
        self._git("add", "--all", "--", *paths)
        if self._git("diff", "--cached", "--name-only", "--", *paths):
            self._git("commit", "--quiet", f"--message={message}", "--", *paths)

    def _git(self, *arguments) -> str:
        return self._output(*arguments).decode()

    def _output(self, *arguments) -> bytes:
        """What git prints.

        Raises:
            InputError: it refuses, with its reason.
        """
        done = subprocess.run(["git", "-C", self.root, *arguments], check=False, capture_output=True)
        if done.returncode:
            said = done.stderr.decode(errors="replace").strip()
            reason = next((line for line in said.splitlines() if line.startswith(("fatal: ", "error: "))), said)
            raise InputError(f"`git {arguments[0]}` refuses: {reason.partition(': ')[2] or reason}")
        return done.stdout


def _total(pieces: Sequence[Piece], due: int, times: Estimates) -> str:
    left = f"; the others: {times.total()}" if due else ""
    return f"{len(pieces) - due} of {plural(len(pieces), 'piece')} made{left}"


def _by_run(rows: Iterable[Row]) -> dict[Name, list[Row]]:
    found: dict[Name, list[Row]] = defaultdict(list)
    for row in rows:
        found[row.setting, row.variant, row.training_seed].append(row)
    return found


def _bulky(nodes: Sequence[Node]) -> set[Node]:
    """What some nodes are made of, and can be removed."""
    found: set[Node] = set()
    for node in nodes:
        own = node.inputs.values()
        found |= {one for one in own if one.kind in BULKY} | _bulky([*own])
    return found


def _remove_unseen(figures: Path, pages: Sequence[Path]) -> None:
    """Remove the figures of a study that neither its report nor a page shows."""
    report_text = (figures.parent / "report.md").read_text(encoding="utf-8")
    seen = report_text + "".join(page.read_text(encoding="utf-8") for page in pages)
    for figure in figures.glob("*.png"):
        if f"figures/{figure.name})" not in seen:
            figure.unlink()


def main() -> None:
    """Make what is left, as the command line says."""
    parser = Parser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="pieces whose names fit this pattern, or begin so")
    parser.add_argument("--status", action="store_true", help="make nothing, say what is left")
    parser.add_argument("--minutes", type=float, help="begin no piece after so many")
    parser.add_argument("--store", type=Path, default=ROOT / "outputs" / "store", help="where runs are made")
    parser.add_argument(
        "--discard", action="store_true", help="remove demonstrations and features when they are used up"
    )
    parser.add_argument("--executor", default="processes", help="processes or ray")
    parser.add_argument("--workers", type=int, default=2, help="processes that generate demonstrations")
    asked = parser.parse_args()
    load_plugins()
    maker = Maker(ROOT, asked.store, executor=asked.executor, workers=asked.workers)
    pieces, start = maker.pieces(asked.only), time.monotonic()
    if asked.status:
        say(maker.status(pieces))
        return
    say(maker.total(pieces))
    if asked.discard:
        maker.discard()
    for piece, runs in maker.due(pieces):
        if not runs and maker.is_committed(piece):
            continue
        if asked.minutes is not None and time.monotonic() - start > 60 * asked.minutes:
            say(f"Stopped before {piece.name}; the same command continues there")
            return
        say(maker.told(piece, runs, maker.times()) if runs else f"{piece.name}: to be committed")
        maker.make(piece)
        if asked.discard:
            maker.discard()
    say("All is made")


if __name__ == "__main__":
    with edge():
        main()
