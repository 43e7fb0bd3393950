"""One reported study for every test that reads or looks at a report."""

import dataclasses
import json
from pathlib import Path

import pytest
from synthetic_study import HOSTILE, STUDY, failed_row, missing_row, study_rows, write_study

from lerobot_constructskill.analysis.report.page import write_report
from lerobot_constructskill.study.timing import TIMINGS


@pytest.fixture(scope="session")
def study(tmp_path_factory) -> Path:
    """A study with a failed run, one that has not been made, and two videos."""
    root = tmp_path_factory.mktemp("study")
    lost = {("fixed", "clip", 2), ("fixed", "clip", 8)}
    rows = [row for row in study_rows() if (row.setting, row.variant, row.training_seed) not in lost]
    rows.append(failed_row(STUDY, ("fixed", "clip", 2), HOSTILE))
    rows.append(missing_row(STUDY, ("fixed", "clip", 8)))
    for index, video in ((0, "videos/a & b.mp4"), (200, "videos/large.mp4"), (100, "../outside.mp4")):
        (root / "videos").mkdir(exist_ok=True)
        (root / video).write_bytes(b"film" if index == 0 else bytes(3 * 1024**2))
        rows[index] = dataclasses.replace(rows[index], video=video)
    (root / "provenance.json").write_text(json.dumps({"wall_time": "3 h", "cpu": HOSTILE}))
    took = {"arm": "fixed/clip", "stage": "training", "runs": 10, "seconds": 630}
    (root / TIMINGS).write_text(json.dumps(took) + "\n")
    write_study(root, rows=rows)
    write_report(root)
    return root
