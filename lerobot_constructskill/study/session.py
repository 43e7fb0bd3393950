"""Runs a study: what is missing is made, what is there is kept, and its table is always whole."""

import json
import logging
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from fnmatch import fnmatchcase
from itertools import batched, groupby
from pathlib import Path
from typing import Any

from lerobot_constructskill.artifacts.folders import write_text
from lerobot_constructskill.artifacts.locks import locked
from lerobot_constructskill.artifacts.pools import cores, open_pool
from lerobot_constructskill.artifacts.processor import processor
from lerobot_constructskill.artifacts.store import Machine, Store
from lerobot_constructskill.errors import InputError, plural
from lerobot_constructskill.lerobot_internals import load_plugins
from lerobot_constructskill.progress import Progress
from lerobot_constructskill.study.plan import list_runs
from lerobot_constructskill.study.rows import KNOWN, PROVENANCE, STUDY, WALL_TIME
from lerobot_constructskill.study.runs import Job, Run, make_runs
from lerobot_constructskill.study.spec import Options, Study
from lerobot_constructskill.study.table import Table
from lerobot_constructskill.study.validate import validate
from lerobot_constructskill.training.trainers import flush_denormals

logger = logging.getLogger(__name__)


def run_study(study: Study, text: str, root: Path, store: Store, options: Options) -> Table:
    """Make what is missing of a study and return its table.

    Args:
        text: what `study.yaml` in the study's folder is to say, for the report.
        root: the study's folder; its runs are in the store, which other studies may share.

    Raises:
        TakenError: another process is running the study in this folder.
        InputError: nothing can be run with a field of the study, or no run is called as `options.only` says.
        OSError: a simulator's process died, or another thing that is no run's fault.
    """
    flush_denormals()
    runs = list_runs(study)
    chosen = choose(runs, options.only)
    with locked(root / ".lock", taken=f"Another process is running the study in {root} at this moment."):
        # What is published is committed piece by piece: what the store has of others is theirs.
        table = Table(root, runs, store, options.replace, chosen if options.replace else None)
        _check_nothing_is_lost(table)
        write_text(root / STUDY, text)
        facts = root / PROVENANCE
        earlier, start = KNOWN.read(facts) if facts.exists() else {}, time.monotonic()
        for run in chosen:
            if options.retry_failed:
                table.forget_failure(run)
            elif table.made(run):
                with store.claim([run]):  # one by one: each holds a file open
                    pass  # which tidies up after a process that was killed when it was whole
        missing = [run for run in chosen if table.made(run) is None]
        table.write()
        with Progress(total=len(chosen), initial=len(chosen) - len(missing), desc=study.name, unit="run") as progress:
            for run in _execute(_jobs(missing, root, store, options), options):
                table.write()
                _write_provenance(root, earlier, time.monotonic() - start)
                progress.update()
                progress.set_postfix_str(run.id)
        asked_for = {run.id for run in chosen}
        others = [run for run in runs if run.id not in asked_for]
        validate(chosen, others, store, Machine(options.workers), root)
        if missing:
            _write_provenance(root, earlier, time.monotonic() - start)
        table.read_again()
        table.write()
        return table


def _check_nothing_is_lost(table: Table) -> None:
    if lost := table.lost():
        can_replace = {*lost} <= {run.id for run in table.runs}
        other = "--replace=true to make them anew" if can_replace else "move the folder away"
        raise InputError(
            f"{table.root} has rows of {plural(len(lost), 'run')}, such as {lost[0]}, that are not of this study as "
            f"it is, or of other versions of packages or weights, and {table.store.root} does not keep them: they "
            f"would be lost. Give another --root, or {other}."
        )


def choose(runs: Sequence[Run], only: str) -> list[Run]:
    """The runs whose `setting/variant/seed_N` fits a pattern of `only` or lies under it; without patterns, all."""
    if not only:
        return list(runs)
    chosen = set()
    for one in only.split(","):
        either = one.strip(), f"{one.strip()}/*"
        fitting = {run.id for run in runs if any(fnmatchcase(run.id, pattern) for pattern in either)}
        if not fitting:
            raise InputError(f"--only={one} matches no run; the study's first run is {runs[0].id}.")
        chosen |= fitting
    return [run for run in runs if run.id in chosen]


def _jobs(missing: Sequence[Run], root: Path, store: Store, options: Options) -> Iterator[Job]:
    simulators = max(1, cores() // options.workers) if options.executor == "ray" else None  # jobs share the cores
    machine = Machine(options.workers, simulators)
    different = dict.fromkeys(missing)  # two names may be of one thing
    for _, seeds in groupby(different, key=lambda run: run.arm.id):
        for some in batched(seeds, options.together):  # noqa: B911  the last one may be shorter
            yield Job(some, store, root, machine)


def _execute(jobs: Iterator[Job], options: Options) -> Iterator[Run]:
    """Make the runs of all jobs. What the machine does to one leaves the others alone, and is raised at the end."""
    stopped: list[Exception] = []
    if options.executor == "processes":
        for job in jobs:
            with _noted(stopped):
                yield from make_runs(job)
    else:
        from concurrent.futures import as_completed

        with open_pool(options.executor, options.workers) as submit:
            for future in as_completed([submit(_make_all, job) for job in jobs]):
                made, lost = future.result()
                stopped += lost
                yield from made
    if stopped:
        raise stopped[0]


@contextmanager
def _noted(stopped: list[Exception]) -> Iterator[None]:
    """Add what the machine does to one job to a list, and go on with the next one."""
    try:
        yield
    except (OSError, MemoryError, RuntimeError) as error:
        logger.warning(
            "Machine error; these runs are skipped, and the same command makes them: %s", " ".join(str(error).split())
        )
        stopped.append(error)


def _make_all(job: Job) -> tuple[list[Run], list[Exception]]:
    """In another process: the runs that were made, and what stopped the others."""
    flush_denormals()
    load_plugins()  # another machine does not know other packages' references yet
    made, stopped = [], []
    with _noted(stopped):
        for run in make_runs(job):
            made.append(run)
    return made, stopped


def _write_provenance(root: Path, earlier: Mapping[str, Any], seconds: float) -> None:
    """Say where the study ran, on every machine, and for how long in all; what else it says stays.

    Args:
        earlier: what it said when this session began.
        seconds: how long this session has taken.
    """
    machines = [*earlier.get("machine", "").split("; "), f"{os.cpu_count()} cores, {processor()}"]
    facts = {
        **earlier,
        WALL_TIME: round(earlier.get(WALL_TIME, 0) + seconds),
        "machine": "; ".join(dict.fromkeys(one for one in machines if one)),
    }
    write_text(root / PROVENANCE, json.dumps(facts, indent=2) + "\n")
