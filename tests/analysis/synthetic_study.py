"""A study that was never run: its file, and deterministic rows for it in the shapes that real rows come in."""

import json
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path

import numpy as np
import yaml

from lerobot_constructskill.study.rows import NOT_RUN, REFERENCE, SIGHTLESS, VARIANT, Row, write_rows

RATES = {"fixed": 1.0, "moved": 0.25}

# What a label or an error text may hold, and must not do.
HOSTILE = "</style><script>alert('x')</script> | *żółć* `$\\frac$` 煉瓦 \"quoted\" & so on"

STUDY = {
    "name": "synthetic",
    "settings": {
        "fixed": {"data": "fast", "env": {"task": "brick_to_bin"}},
        "moved": {"data": "fast", "env": {"task": "brick_to_bin_shifted"}},
    },
    "variants": {
        "dinov2": {"seeds": 10},
        "clip": {"seeds": 10},
        "vit_tiny": {"seeds": 10},
        "augreg": {"seeds": 10, "settings": ["fixed"]},
        "no_chunk": {"seeds": 3},
        "noise_free": {"seeds": 3, "data": "fast_noise_free"},
    },
    "references": {"no_op": 1, "random": 10, "replay": 10, "blind": 10, "expert": 1},
    "episodes": 10,
    "eval_seed": 1000,
    "analysis": {
        "labels": {
            "fixed": "Fixed pose",
            "moved": "Position ± 0.10 m",
            "dinov2": "DINOv2 ViT-S/14",
            "clip": "CLIP ViT-B/16",
            "vit_tiny": "ViT-Tiny/16",
            "augreg": "ViT-Tiny (AugReg)",
            "no_chunk": "No action chunking",
            "noise_free": "No noise injection",
            "replay": "Open-loop replay of one demonstration",
            "expert": "Scripted expert",
        }
    },
}

SMALL = {
    "name": "small",
    "settings": {"fixed": {"data": "fast", "env": {"task": "brick_to_bin"}}},
    "variants": {"one": {"seeds": 2}, "two": {"seeds": 2}},
    "references": {},
    "episodes": 2,
    "eval_seed": 1000,
}

# Variant: (chance that a seed lifts, that a lifting seed places, held-out error in m2).
SKILL = {
    "dinov2": (1.0, 0.7, 0.92e-4),
    "clip": (0.6, 0.8, 0.82e-4),
    "vit_tiny": (0.3, 0.3, 1.47e-4),
    "augreg": (0.2, 0.5, 1.45e-4),
    "no_chunk": (0.3, 1.0, 0.98e-4),
    "noise_free": (0.0, 0.0, 0.31e-4),
}
REFERENCE_SKILL = {"no_op": 0.0, "random": 0.0, "replay": 1.0, "blind": 1.0, "untrained": 0.4, "expert": 1.0}

Run = tuple[str, str, int]
"""Setting, variant and training seed."""


def planned(study: dict) -> Iterator[Run]:
    """Every run of a variant."""
    for setting in study["settings"]:
        for name, variant in study["variants"].items():
            if setting in variant.get("settings", study["settings"]):
                yield from ((setting, name, seed) for seed in range(variant["seeds"]))


def episode_rows(study: dict, run: Run, lifted: int, placed: int, **fields) -> list[Row]:
    """The rows of one run: `lifted` and `placed` of the study's episodes."""
    common = _common(study, run) | {
        "dataset_sha256": "d" * 64,
        "environment_sha256": "e" * 64,
        "backend": "physx_cpu, cpu rendering",
        "versions": '{"lerobot": "0.6.1", "torch": "2.10"}',
    }
    return [
        Row(
            evaluation_seed=study["eval_seed"] + i,
            episode=i,
            lifted=i < lifted,
            placed=i < placed,
            stage="placed" if i < placed else "lifted" if i < lifted else "none",
            place_step=180 + run[2] if i < placed else None,
            steps=250,
            **(common | fields),
        )
        for i in range(study["episodes"])
    ]


def failed_row(study: dict, run: Run, error: str, kind: str = "fault") -> Row:
    return Row(evaluation_seed=study["eval_seed"], episode=0, error_kind=kind, error=error, **_common(study, run))


def missing_row(study: dict, run: Run) -> Row:
    return Row(evaluation_seed=study["eval_seed"], episode=0, error_kind=NOT_RUN, **_common(study, run))


def missing_rows(study: dict) -> list[Row]:
    """The table of a study of which nothing has been run."""
    return [missing_row(study, run) for run in planned(study)]


def _common(study: dict, run: Run) -> dict:
    setting, name, seed = run
    data = study["variants"].get(name, {}).get("data", study["settings"][setting]["data"])
    role = VARIANT if name in study["variants"] else SIGHTLESS if name in ("replay", "blind") else REFERENCE
    return {
        "run": f"{setting}-{name}-{seed}",
        "setting": setting,
        "variant": name,
        "role": role,
        "training_seed": seed,
        "episodes": study["episodes"],
        "demonstrations": data if role != REFERENCE else None,
    }


def study_rows(study: dict = STUDY) -> list[Row]:
    """Rows of every run and reference of `study`, the same at every call."""
    rng, episodes = np.random.default_rng(0), study["episodes"]
    rows = []
    for run in planned(study):
        setting, name, _ = run
        lifts, places, error = SKILL.get(name, (0.5, 0.5, 1e-4))
        share = RATES.get(setting, 1.0)
        lifted = episodes * (rng.random() < lifts) if share == 1 else rng.binomial(episodes, lifts * share)
        placed = lifted * (rng.random() < places) if share == 1 else rng.binomial(lifted, places * share)
        mse = error * rng.uniform(0.95, 1.08)
        by_data = json.dumps({"fast": mse, "fast_noise_free": mse / 2})
        rows += episode_rows(study, run, lifted, placed, heldout_mse_m2=mse, heldout_mse_m2_by_data=by_data)
    for setting in study["settings"]:
        for name in study["references"]:
            solved = int(episodes * REFERENCE_SKILL[name] * (1 if setting == "fixed" else 0.1))
            rows += episode_rows(study, (setting, name, 0), solved, solved)
    return rows


def write_study(root: Path, study: dict = STUDY, rows: list[Row] | None = None, **analysis) -> Path:
    """Write the files of a study's folder that `constructskill-report` reads, with fields of `analysis` replaced."""
    root.mkdir(parents=True, exist_ok=True)
    study = deepcopy(study)
    study["analysis"] = study.get("analysis", {}) | analysis
    (root / "study.yaml").write_text(yaml.safe_dump(study, sort_keys=False, allow_unicode=True))
    write_rows(study_rows(study) if rows is None else rows, root / "rows.parquet")
    return root
