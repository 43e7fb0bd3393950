"""What there is of a study and what its command would make, without making anything."""

import json
from collections import Counter
from collections.abc import Sequence
from itertools import groupby

from lerobot_constructskill.artifacts.differences import differences, versions_that_differ
from lerobot_constructskill.artifacts.revisions import BEFORE
from lerobot_constructskill.artifacts.store import LOG
from lerobot_constructskill.errors import plural
from lerobot_constructskill.study.estimates import Estimates
from lerobot_constructskill.study.runs import Run
from lerobot_constructskill.study.table import Table

SHOWN = 3
"""Changes that are named; more are counted."""


def status(table: Table, chosen: Sequence[Run], retry_failed: bool = False) -> str:
    """Tell of the chosen runs: a line for each variant and reference of each setting, and what would be made of it.

    Args:
        chosen: those that the command is asked for.
        retry_failed: whether it makes failed runs again.
    """
    due = [run for run in chosen if (rows := table.made(run)) is None or (retry_failed and rows[0].error_kind)]
    lines, times = [], Estimates({"": table.root}, {"": table.runs}, table.store)
    for name, alike in groupby(chosen, key=lambda run: run.arm.id):
        runs = list(alike)
        lines += [f"{name}: {_counts(table, runs)}", *_failures(table, runs)]
        if own := [run for run in due if run.arm.id == name]:
            lines.append(f"    to make: {_seeds(own)}, {times.tell('', own)}")
    return "\n".join([*lines, _total(table, due, times)])


def _counts(table: Table, runs: Sequence[Run]) -> str:
    made = [rows for run in runs if (rows := table.made(run))]
    failed = sum(bool(rows[0].error_kind) for rows in made)
    counts = f"{len(made) - failed} finished, {failed} failed, {len(runs) - len(made)} missing"
    changes = Counter(filter(None, (_changed(table, run) for run in runs if not table.made(run))))
    told = [f"{number} made before with another {what}" for what, number in changes.items()]
    return f"{counts} ({'; '.join(told)})" if told else counts


def _changed(table: Table, run: Run) -> str | None:
    """What is not as it was when the folder's table got rows of this run; None if it has none."""
    row = table.outdated(run)
    if row is None:
        return None
    made = table.store.spec(run.kind, row.run) if row.run else None
    if made:
        changed = differences(made, run)
    else:  # a published folder has the rows alone
        told = json.loads(row.versions) if row.versions else {}
        if BEFORE in told.values():
            return f"code, {BEFORE}"
        changed = versions_that_differ(told, run.spec["versions"])
    more = f" and {len(changed) - SHOWN} more" if len(changed) > SHOWN else ""
    return ", ".join(changed[:SHOWN]) + more if changed else "specification"


def _failures(table: Table, runs: Sequence[Run]) -> list[str]:
    """A line for each reason."""
    failed = [(run, rows[0]) for run in runs if (rows := table.made(run)) and rows[0].error_kind]
    lines = []
    for (kind, error), alike in groupby(failed, key=lambda one: (one[1].error_kind, one[1].error)):
        own = [run for run, _ in alike]
        log = table.store.folder(own[0]) / LOG
        lines.append(f"    {_seeds(own)} ({kind}): {error} (log: {log})")
    return lines


def _seeds(runs: Sequence[Run]) -> str:
    return f"{'seed' if len(runs) == 1 else 'seeds'} {', '.join(str(run.seed) for run in runs)}"


def _total(table: Table, due: Sequence[Run], times: Estimates) -> str:
    if not due:
        return "Nothing to make."
    used = {run.arm.demonstrations.name: run.arm.demonstrations for run in due if run.arm.demonstrations}
    absent = [name for name, data in used.items() if not table.store.has(data.node)]
    first = f"; first the demonstrations: {', '.join(absent)}" if absent else ""
    return f"To make: {plural(len(due), 'run')}, {times.total()}{first}"
