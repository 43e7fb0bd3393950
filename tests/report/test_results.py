"""The published results are what their rows say, and their rows are of the plans in configs/study."""

import shutil
from dataclasses import replace
from pathlib import Path

import draccus
import pytest

from lerobot_constructskill.policies.frozen_vit import precision
from lerobot_constructskill.scripts.report import ReportConfig, report
from lerobot_constructskill.scripts.study import StudyConfig
from lerobot_constructskill.study.checkpoints import settle_precision
from lerobot_constructskill.study.report.ink import Drawing
from lerobot_constructskill.study.report.page import read_study

ROOT = Path(__file__).parents[2]
RESULTS = sorted(path.parent for path in (ROOT / "results").glob("*/plan.yaml"))
LARGEST = 5_000_000


@pytest.mark.parametrize("folder", RESULTS, ids=lambda folder: folder.name)
def test_a_published_study_is_one_of_configs_on_one_of_the_two_kinds_of_cpu(folder, monkeypatch):
    plan, _ = read_study(folder)
    config = draccus.parse(StudyConfig, ROOT / "configs" / "study" / f"{plan.name}.yaml", args=[])
    cuts = [None, *sorted({variant.seeds for variant in plan.variants.values()})]
    possible = set()
    for has_bfloat16 in (False, True):
        monkeypatch.setattr(precision, "_cpu_multiplies_bfloat16", lambda has=has_bfloat16: has)
        possible |= {settle_precision(replace(config, seeds=seeds).plan).sha256 for seeds in cuts}
    assert plan.sha256 in possible


@pytest.mark.parametrize("folder", RESULTS, ids=lambda folder: folder.name)
def test_a_published_report_is_made_of_its_rows(folder, tmp_path, monkeypatch):
    """Its Markdown, that is: the figures are not drawn, which takes most of a report's time."""
    monkeypatch.setattr(Drawing, "encoded", lambda *_: b"")
    copy = shutil.copytree(folder, tmp_path / folder.name)
    report(ReportConfig(copy))
    assert (copy / "report.md").read_text() == (folder / "report.md").read_text()
    assert sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) < LARGEST
