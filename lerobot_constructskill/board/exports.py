"""Exports of the board: one Parquet file, LeRobot's eval_info.json, the Hub's .eval_results, and vla-eval's board."""

import json
from collections.abc import Iterable
from contextlib import suppress
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import yaml

from lerobot_constructskill.artifacts.folders import replaced, write_text
from lerobot_constructskill.board.entries import Entry
from lerobot_constructskill.board.protocol import CLAIMED, STANDARD
from lerobot_constructskill.board.recovered import TABLE as RECOVERED
from lerobot_constructskill.board.submission import SCHEMA, Claim
from lerobot_constructskill.contract import LOOSE, REWARD_LIFTED, REWARD_PLACED, SUITES

TABLE, EXPORTS = "board.parquet", "exports"
EVAL_INFO, EVAL_RESULTS = "eval_info.json", ".eval_results/constructskill.yaml"


LOST = ("last_step", "last_step_extra", "lost", "is_hopeless")
"""Columns of `recovered.Recovery`, null where an episode placed or was not searched."""

COLUMNS = pa.schema(
    [
        *((name, pa.string()) for name in ("entry", "sha256", "suite", "class", "level", "task")),
        *(SCHEMA.field(name) for name in SCHEMA.names if name != "actions"),
        *(RECOVERED.schema.field(name).with_nullable(True) for name in LOST),
    ]
)
"""Of the table: the same types whatever entries there are."""


def write_table(entries: Iterable[Entry], path: Path) -> None:
    """Every episode of every entry, a row each, without its actions, and where it was lost if it failed."""
    rows = [
        {
            "entry": entry.name,
            "sha256": entry.submission.sha256,
            "suite": entry.declaration.suite,
            "class": entry.declaration.settings_class,
            "level": entry.level,
            "task": claim.task,
            **{name: getattr(claim, name) for name in SCHEMA.names if name in COLUMNS.names},
            **{name: getattr(entry.recoveries.get(claim.key), name, None) for name in LOST},
        }
        for entry in entries
        for claim in entry.submission.claims
    ]
    with replaced(path) as partial:
        pq.write_table(pa.Table.from_pylist(rows, COLUMNS), partial, compression="zstd")


def eval_info(entry: Entry, seed: int) -> dict[str, Any]:
    """What `lerobot-eval` would have written of one training seed, but for times and films.

    LeRobot's comparison of two such files pairs tasks by their group and number.
    """
    per_task = [
        {**_place(entry, setting), "metrics": _metrics(standing.claims[seed])}
        for setting, standing in entry.standings.items()
    ]
    groups: dict[str, list[dict]] = {}
    for task in per_task:
        groups.setdefault(task["task_group"], []).append(task)
    per_group = {group: _aggregate(tasks) for group, tasks in groups.items()}
    return {"per_task": per_task, "per_group": per_group, "overall": _aggregate(per_task)}


def _place(entry: Entry, setting: str) -> dict[str, Any]:
    """A setting's group and number, as `lerobot-eval` gives them; a custom setting is a group by itself."""
    said = entry.declaration
    if said.settings_class != STANDARD:
        return {"task_group": setting, "task_id": 0}
    task, label = said.settings[setting].task, said.settings[setting].perturbation
    if task in (suite := SUITES.get(said.suite, ())):
        return {"task_group": said.suite + label, "task_id": suite.index(task)}
    return {"task_group": LOOSE + label, "task_id": 0}


def _metrics(claims: list[Claim]) -> dict[str, list]:
    rewards = [_rewards(claim) for claim in claims]
    return {
        "sum_rewards": [sum(own) for own in rewards],
        "max_rewards": [max(own, default=0.0) for own in rewards],
        "successes": [claim.placed for claim in claims],
        "video_paths": [],
    }


def _rewards(claim: Claim) -> list[float]:
    """The reward of every step: that of the stage reached by then."""
    lifted, placed = (inf if step is None else step for step in (claim.lift_step, claim.place_step))
    steps = range(1, claim.steps + 1)
    return [REWARD_PLACED if step >= placed else REWARD_LIFTED if step >= lifted else 0.0 for step in steps]


def _aggregate(tasks: list[dict]) -> dict[str, Any]:
    of = {name: [one for task in tasks for one in task["metrics"][name]] for name in tasks[0]["metrics"]}
    return {
        "avg_sum_reward": float(np.mean(of["sum_rewards"])),
        "avg_max_reward": float(np.mean(of["max_rewards"])),
        "pc_success": 100 * float(np.mean(of["successes"])),
        "n_episodes": len(of["successes"]),
        "video_paths": [],
    }


def eval_results(entry: Entry, dataset_id: str) -> str:
    """`.eval_results/constructskill.yaml` for the repository of an entry's checkpoints.

    Args:
        dataset_id: the benchmark's repository on the Hub, whose eval.yaml names a task `<suite>_<setting>` for each.

    Source: https://huggingface.co/docs/hub/eval-results.
    """
    from huggingface_hub import EvalResultEntry, eval_result_entries_to_yaml

    said = entry.declaration
    seeds = f"mean of {len(said.training_seeds)} training seeds, {entry.level}, {said.settings_class}"
    results = [
        EvalResultEntry(
            dataset_id=dataset_id,
            task_id=f"{said.suite}_{setting}",
            value=round(100 * standing.placed.value, 2),
            notes=f"{said.about.name}; per cent placed, {seeds}; submission {entry.submission.sha256[:16]}",
        )
        for setting, standing in entry.standings.items()
    ]
    return yaml.safe_dump(eval_result_entries_to_yaml(results), sort_keys=False, allow_unicode=True)


def harness_board(entries: Iterable[Entry], day: str) -> dict[str, Any]:
    """leaderboard.json of vla-evaluation-harness, whose keepers still have to register the benchmark.

    No overall score is given: the protocol has no number that hides the tasks. Only standard policies that were
    replayed are in it.

    Args:
        day: when, ISO 8601.
    """
    results = [
        {
            "model": entry.name,
            "display_name": entry.declaration.about.name,
            "benchmark": f"constructskill_{entry.declaration.suite}",
            "weight_type": "finetuned",
            "overall_score": None,
            "task_scores": {name: round(100 * one.placed.value, 2) for name, one in entry.standings.items()},
            "curated_by": "constructskill-api",
            "date_added": entry.verdict["date"],
            "notes": f"{len(entry.declaration.training_seeds)} training seeds; {entry.level} by "
            "constructskill-verify.",
        }
        for entry in entries
        if _is_official(entry)
    ]
    return {"last_updated": day, "results": results}


def _is_official(entry: Entry) -> bool:
    """Whether an entry is a policy on the suite's own settings, whose names others know, and was replayed."""
    return entry.declaration.settings_class == STANDARD and not entry.is_reference and entry.level != CLAIMED


def write_exports(entries: list[Entry], out: Path, day: str, dataset_id: str | None) -> None:
    """Write the table of all entries, and in `exports` a folder for each entry and a file of all.

    What earlier calls wrote there is removed first, as an entry may have been withdrawn; other files stay.
    """
    write_table(entries, out / TABLE)
    exports = out / EXPORTS
    for file in [*exports.glob(f"*/seed_*/{EVAL_INFO}"), *exports.glob(f"*/{EVAL_RESULTS}")]:
        file.unlink()
        with suppress(OSError):  # a folder is not empty
            file.parent.rmdir()
            file.parents[1].rmdir()
    write_text(exports / "leaderboard.json", json.dumps(harness_board(entries, day), indent=2) + "\n")
    for entry in entries:
        for seed in entry.declaration.training_seeds:
            text = json.dumps(eval_info(entry, seed), indent=2) + "\n"
            write_text(exports / entry.name / f"seed_{seed}" / EVAL_INFO, text)
        if dataset_id and _is_official(entry):
            write_text(exports / entry.name / EVAL_RESULTS, eval_results(entry, dataset_id))
