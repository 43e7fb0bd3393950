"""Runs a study: what is missing is executed, what is finished is kept, and its table is always whole."""

import fcntl
import json
import os
import platform
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import draccus
import pandas as pd
import yaml

from lerobot_constructskill.errors import InputError, TakenError
from lerobot_constructskill.parsing import decode
from lerobot_constructskill.pools import open_pool
from lerobot_constructskill.progress import Progress
from lerobot_constructskill.staging import replaced
from lerobot_constructskill.study.checkpoints import Job
from lerobot_constructskill.study.jobs import execute
from lerobot_constructskill.study.plan import Run, StudyPlan
from lerobot_constructskill.study.prepare import Store
from lerobot_constructskill.study.rows import Row, merge_rows, read_rows, write_rows
from lerobot_constructskill.study.timing import seconds_by_stage

PLAN, ROWS, PROVENANCE = "plan.yaml", "rows.parquet", "provenance.json"


@dataclass(frozen=True)
class Options:
    """How a study is run; none of it shows in its results.

    Args:
        together: policies evaluated in lockstep.
        executor: "processes" (this machine) or "ray" (extra `distributed`; a cluster needs the study's folder and the
            store on a file system that all its machines share).
        workers: jobs at a time on Ray.
        retry_failed: run again what failed before.
    """

    together: int = 10
    executor: str = "processes"
    workers: int = 1
    retry_failed: bool = False


def run_study(plan: StudyPlan, root: Path, store: Store, options: Options) -> pd.DataFrame:
    """Run what is missing of a study and return its rows.

    Raises:
        ValueError: the folder holds another plan's results.
        FileExistsError: another process is running this study.
        OSError: a simulator's process died.
    """
    with _claimed(root):
        _write_plan(plan, root)
        earlier, start = _wall_time(root), time.monotonic()
        runs = [*plan.reference_runs, *plan.runs]
        finished = [run for run in runs if _is_finished(root, run, options)]
        with Progress(total=len(runs), initial=len(finished), desc=plan.name, unit="run") as progress:
            for run, rows in _execute(_jobs(plan, root, store, runs, finished, options.together), options):
                write_rows(rows, _row_file(root, run))
                _merge(root, runs)
                _write_provenance(root, earlier + time.monotonic() - start)
                progress.update()
                progress.set_postfix_str(run.id)
        _merge(root, runs)
        _write_provenance(root, earlier + time.monotonic() - start)
        return read_rows(root / ROWS)


def _jobs(
    plan: StudyPlan, root: Path, store: Store, runs: list[Run], finished: list[Run], together: int
) -> Iterator[Job]:
    missing = [run for run in runs if run not in finished]
    for _, group in groupby(missing, key=lambda run: (run.setting, run.is_reference, run.variant)):
        seeds = list(group)
        for first in range(0, len(seeds), together):
            yield Job(plan, tuple(seeds[first : first + together]), root, store)


def _execute(jobs: Iterator[Job], options: Options) -> Iterator[tuple[Run, list[Row]]]:
    if options.executor == "processes":
        for job in jobs:
            yield from execute(job)
        return
    from concurrent.futures import as_completed

    with open_pool(options.executor, options.workers) as submit:
        for future in as_completed([submit(_execute_whole, job) for job in jobs]):
            yield from future.result()


def _execute_whole(job: Job) -> list[tuple[Run, list[Row]]]:
    import lerobot_constructskill.plugin  # noqa: F401  another machine has not registered the policy yet

    return list(execute(job))


@contextmanager
def _claimed(root: Path) -> Iterator[None]:
    root.mkdir(parents=True, exist_ok=True)
    with (root / ".lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise TakenError(f"Another process is running the study in {root} at this moment.") from None
        yield


def _write_plan(plan: StudyPlan, root: Path) -> None:
    path = root / PLAN
    if path.exists() and decode(StudyPlan, yaml.safe_load(path.read_text())).sha256 != plan.sha256:
        raise InputError(f"{root} holds the results of another plan ({path}): name another folder for this one.")
    with replaced(path) as partial:
        partial.write_text(yaml.safe_dump(draccus.encode(plan), sort_keys=False))


def _row_file(root: Path, run: Run) -> Path:
    return root / "results" / run.id / ROWS


def _is_finished(root: Path, run: Run, options: Options) -> bool:
    path = _row_file(root, run)
    return path.exists() and not (options.retry_failed and read_rows(path)["error"].notna().any())


def _merge(root: Path, runs: list[Run]) -> None:
    """Put the rows there are into the study's table, in the plan's order."""
    merge_rows(filter(Path.exists, (_row_file(root, run) for run in runs)), root / ROWS)


def _processor() -> str:
    """The processor's name, which Linux keeps where Python does not look."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def _wall_time(root: Path) -> float:
    """Seconds that earlier sessions of the study took, up to the last run that each finished."""
    path = root / PROVENANCE
    return json.loads(path.read_text())["wall time, s"] if path.exists() else 0


def _write_provenance(root: Path, seconds: float) -> None:
    """Say where the study ran, and for how long in all."""
    stages = {f"of which {stage}, s": round(total) for stage, total in seconds_by_stage(root).items()}
    facts = {"wall time, s": round(seconds), **stages, "machine": f"{os.cpu_count()} cores, {_processor()}"}
    with replaced(root / PROVENANCE) as partial:
        partial.write_text(json.dumps(facts, indent=2) + "\n")
