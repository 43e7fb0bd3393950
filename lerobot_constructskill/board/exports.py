"""The board's rows for others: one parquet file, LeRobot's eval_info.json, .eval_results, and vla-eval's board."""

import json
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import fields
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
from lerobot_constructskill.board.submission import Claim
from lerobot_constructskill.contract import REWARD_LIFTED, REWARD_PLACED

TABLE, EXPORTS = "board.parquet", "exports"


def write_table(entries: Iterable[Entry], path: Path) -> None:
    """Every episode of every entry, a row each, without its actions."""
    rows = [
        {
            "entry": entry.name,
            "sha256": entry.submission.sha256,
            "suite": entry.said.suite,
            "class": entry.said.settings_class,
            "level": entry.level,
            "task": entry.said.settings[claim.setting].task,
            **{one.name: getattr(claim, one.name) for one in fields(Claim) if one.name != "actions"},
        }
        for entry in entries
        for claim in entry.submission.claims
    ]
    with replaced(path) as partial:
        pq.write_table(pa.Table.from_pylist(rows), partial, compression="zstd")


def eval_info(entry: Entry, seed: int) -> dict[str, Any]:
    """What `lerobot-eval` would have written of one training seed; times and films are not known."""
    per_task = [
        {"task_group": setting, "task_id": 0, "metrics": _metrics(standing.claims[seed])}
        for setting, standing in entry.standings.items()
    ]
    groups = {task["task_group"]: _aggregate([task]) for task in per_task}
    return {"per_task": per_task, "per_group": groups, "overall": _aggregate(per_task)}


def _metrics(claims: list[Claim]) -> dict[str, list]:
    return {
        "sum_rewards": [sum(_rewards(claim)) for claim in claims],
        "max_rewards": [max(_rewards(claim)) for claim in claims],
        "successes": [claim.placed for claim in claims],
        "video_paths": [],
    }


def _rewards(claim: Claim) -> list[float]:
    """The reward of every step: the stage reached by then. An episode that failed with an error has none of it."""
    lifted, placed = (inf if step is None else step for step in (claim.lift_step, claim.place_step))
    steps = range(1, max(claim.steps, 1) + 1)
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

    about = entry.said.about
    seeds = f"mean of {len(entry.said.training_seeds)} training seeds, {entry.level}, {entry.said.settings_class}"
    results = [
        EvalResultEntry(
            dataset_id=dataset_id,
            task_id=f"{entry.said.suite}_{setting}",
            value=round(100 * standing.placed.value, 2),
            notes=f"{about.name}; per cent placed, {seeds}; submission {entry.submission.sha256[:16]}",
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
            "display_name": entry.said.about.name,
            "benchmark": f"constructskill_{entry.said.suite}",
            "weight_type": "finetuned",
            "overall_score": None,
            "task_scores": {name: round(100 * one.placed.value, 2) for name, one in entry.standings.items()},
            "curated_by": "constructskill-api",
            "date_added": entry.verdict["date"],
            "notes": f"{len(entry.said.training_seeds)} training seeds; {entry.level} by constructskill-verify.",
        }
        for entry in entries
        if _is_official(entry)
    ]
    return {"last_updated": day, "results": results}


def _is_official(entry: Entry) -> bool:
    """Whether it is a policy on the suite's own settings, whose names others know, and was replayed."""
    return entry.said.settings_class == STANDARD and not entry.is_reference and entry.level != CLAIMED


def write_exports(entries: list[Entry], out: Path, day: str, dataset_id: str | None) -> None:
    """Write all of them: a folder for each entry in `exports`, and the files that are of all."""
    write_table(entries, out / TABLE)
    for gone in {path.name for path in (out / EXPORTS).glob("*/")} - {entry.name for entry in entries}:
        _withdraw(out / EXPORTS / gone)
    _write(out / EXPORTS / "leaderboard.json", json.dumps(harness_board(entries, day), indent=2))
    for entry in entries:
        folder = out / EXPORTS / entry.name
        for seed in entry.said.training_seeds:
            _write(folder / f"seed_{seed}" / "eval_info.json", json.dumps(eval_info(entry, seed), indent=2))
        results = folder / ".eval_results" / "constructskill.yaml"
        if dataset_id and _is_official(entry):
            _write(results, eval_results(entry, dataset_id))
        elif not _is_official(entry):
            results.unlink(missing_ok=True)  # of when it was


def _withdraw(folder: Path) -> None:
    """Remove what was written of an entry that is no longer there, and nothing else."""
    for file in (*folder.glob("seed_*/eval_info.json"), folder / ".eval_results" / "constructskill.yaml"):
        file.unlink(missing_ok=True)
        with suppress(OSError):  # it holds something of somebody's, or is not there
            file.parent.rmdir()
    with suppress(OSError):
        folder.rmdir()


def _write(path: Path, text: str) -> None:
    write_text(path, text.rstrip() + "\n")
