"""`constructskill-report`: make tables, figures and a page from the rows of a study."""

from dataclasses import dataclass
from pathlib import Path

from lerobot_constructskill.bounds import Checked
from lerobot_constructskill.scripts.console import command


@dataclass
class ReportConfig(Checked):
    """Write report.html, report.md and figures/ into a study's folder.

    The folder holds rows.parquet and study.yaml, whose settings say which tasks the rows are of, and whose section
    `analysis` says how they are read. It may hold provenance.json, one JSON object of names and values to show. A
    study need not be complete.
    """

    root: Path  # the study's folder


@command("constructskill-report --root=outputs/study/smoke")
def report(config: ReportConfig) -> str:
    from lerobot_constructskill.analysis.report.page import write_report

    return f"Report written to {write_report(config.root)}"
