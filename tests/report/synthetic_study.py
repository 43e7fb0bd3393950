"""A study that was never run: deterministic rows for a plan, in the shapes that real rows come in."""

import json
from pathlib import Path

import draccus
import numpy as np
import yaml

from lerobot_constructskill.study.plan import Setting, StudyPlan, Variant
from lerobot_constructskill.study.rows import Row, write_rows

VIT = {"type": "frozen_vit", "backbone": "dinov2_vits14"}
RATES = {"fixed": 1.0, "moved": 0.25}

# What a label or an error text may hold, and must not do.
HOSTILE = "</style><script>alert('x')</script> | *żółć* `$\\frac$` 煉瓦 \"quoted\" & so on"

PLAN = StudyPlan(
    name="synthetic",
    settings={
        "fixed": Setting(data="configs/generate/fast.yaml", label="Fixed pose"),
        "moved": Setting(data="configs/generate/fast.yaml", label="Position ± 0.10 m"),
    },
    variants={
        "dinov2": Variant(policy=VIT, label="DINOv2 ViT-S/14"),
        "clip": Variant(policy=VIT, label="CLIP ViT-B/16"),
        "vit_tiny": Variant(policy=VIT, label="ViT-Tiny/16"),
        "augreg": Variant(policy=VIT, label="ViT-Tiny (AugReg)", settings=["fixed"]),
        "no_chunk": Variant(policy=VIT, seeds=3, label="No action chunking"),
        "noise_free": Variant(
            policy=VIT, seeds=3, label="No noise injection", data="configs/generate/fast_noise_free.yaml"
        ),
    },
    references={"no_op": 1, "random": 10, "replay": 10, "blind": 10, "expert": 1},
)

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


def episode_rows(plan: StudyPlan, setting: str, variant: str, seed: int, lifted, placed, **fields) -> list[Row]:
    """The rows of one run: `lifted` and `placed` episodes of `plan.episodes`."""
    common = {
        "plan_sha256": plan.sha256,
        "setting": setting,
        "variant": variant,
        "is_reference": variant in REFERENCE_SKILL,
        "training_seed": seed,
        "dataset_sha256": "d" * 64,
        "environment_sha256": "e" * 64,
        "backend": "physx_cpu, cpu rendering",
        "versions": '{"lerobot": "0.6.1", "torch": "2.10"}',
    } | fields
    return [
        Row(
            evaluation_seed=plan.eval_seed + i,
            episode=i,
            lifted=i < lifted,
            placed=i < placed,
            stage="placed" if i < placed else "lifted" if i < lifted else "none",
            place_step=180 + seed if i < placed else None,
            steps=250,
            **common,
        )
        for i in range(plan.episodes)
    ]


def failed_row(plan: StudyPlan, setting: str, variant: str, seed: int, error: str) -> Row:
    return Row(plan.sha256, setting, variant, variant in REFERENCE_SKILL, seed, plan.eval_seed, 0, error=error)


def study_rows(plan: StudyPlan = PLAN) -> list[Row]:
    """Rows of every run and reference of `plan`, the same at every call."""
    rng = np.random.default_rng(0)
    rows = []
    for run in plan.runs:
        lifts, places, error = SKILL.get(run.variant, (0.5, 0.5, 1e-4))
        share = RATES.get(run.setting, 1.0)
        lifted = plan.episodes * (rng.random() < lifts) if share == 1 else rng.binomial(plan.episodes, lifts * share)
        placed = lifted * (rng.random() < places) if share == 1 else rng.binomial(lifted, places * share)
        mse = error * rng.uniform(0.95, 1.08)
        by_data = json.dumps({data: mse / (i + 1) for i, data in enumerate(plan.data_of(run.setting))})
        errors = {"heldout_mse_m2": mse, "heldout_mse_m2_by_data": by_data}
        rows += episode_rows(plan, run.setting, run.variant, run.seed, lifted, placed, **errors)
    for setting in plan.settings:
        for reference in plan.references:
            solved = plan.episodes * REFERENCE_SKILL[reference] * (1 if setting == "fixed" else 0.1)
            rows += episode_rows(plan, setting, reference, 0, solved, solved)
    return rows


def write_study(root: Path, plan: StudyPlan = PLAN, rows: list[Row] | None = None) -> Path:
    """Write the files of a study's folder that `constructskill-report` reads."""
    root.mkdir(parents=True, exist_ok=True)
    (root / "plan.yaml").write_text(yaml.safe_dump(draccus.encode(plan), sort_keys=False))
    write_rows(study_rows(plan) if rows is None else rows, root / "rows.parquet")
    return root
