"""The report of studies that were never run: what it says, what it refuses, and that nothing in it is markup."""

import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest
from synthetic_study import HOSTILE, PLAN, RATES, VIT, episode_rows, failed_row, study_rows, write_study

from lerobot_constructskill.scripts.report import ReportConfig, report
from lerobot_constructskill.study.plan import Setting, StudyPlan, Variant
from lerobot_constructskill.study.report.answer import answer, status
from lerobot_constructskill.study.report.collect import collect
from lerobot_constructskill.study.report.wording import p_value, roman, signed
from lerobot_constructskill.study.rows import read_rows
from lerobot_constructskill.study.stats.comparisons import Verdict

REPOSITORY = Path(__file__).parents[2]

SMALL = StudyPlan(
    name="small",
    settings={"fixed": Setting(data="configs/generate/fast.yaml")},
    variants={"one": Variant(policy=VIT, seeds=2), "two": Variant(policy=VIT, seeds=2)},
    episodes=2,
)


class Reader(HTMLParser):
    """Tags, attributes and text of a page."""

    def __init__(self, page: str):
        super().__init__()
        self.tags, self.links, self.text = [], [], []
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.links += [value for name, value in attrs if name in ("src", "href", "srcset", "poster", "data")]

    def handle_data(self, data):
        self.text.append(data)


def findings_of(plan: StudyPlan, rows, folder: Path):
    return collect(plan, read_rows(write_study(folder, plan, rows) / "rows.parquet"))


def test_page_holds_the_papers_tables_and_every_figure(study):
    reader = Reader((study / "report.html").read_text())
    text = re.sub(r"\s+", " ", " ".join(reader.text))
    for words in ("Table I.", "Table II.", "DINOv2 ViT-S/14, first 3 seeds", "Position ± 0.10 m", "Scripted expert"):
        assert words in text
    figures = {path.name for path in (study / "figures").iterdir()}
    names = [f"{setting}_{kind}" for setting in RATES for kind in ("outcomes", "seeds", "error", "ranking")]
    assert figures == {f"{name}.{suffix}" for name in [*names, "detectable_difference"] for suffix in ("png", "pdf")}
    assert reader.tags.count("img") == len(names) + 1


def test_every_variant_is_validated_on_every_set_of_the_setting(study):
    markdown = (study / "report.md").read_text()
    fixed, moved = (part for part in markdown.split("Error on what is held out of each set")[1:])
    for part in (fixed, moved):
        assert "| configuration | trained on | fast | fast\\_noise\\_free |\n|---|---|---:|---:|\n" in part
    (row,) = [line for line in fixed.splitlines() if line.startswith("| No noise injection | fast\\_noise\\_free |")]
    on_noisy, on_noise_free = (float(cell.split("[")[0].replace("\\", "")) for cell in row.split("|")[3:5])
    assert on_noise_free == pytest.approx(on_noisy / 2, abs=0.01)
    assert "fast_noise_free" in (study / "report.html").read_text()


def test_page_is_one_file_without_script(study):
    reader = Reader((study / "report.html").read_text())
    assert "script" not in reader.tags and "table" in reader.tags
    outside = [link for link in reader.links if not link.startswith(("data:", "#", "figures/"))]
    assert outside == ["videos/large.mp4"]
    assert reader.tags.count("video") == 1


def test_everything_is_escaped(study):
    page, markdown = (study / "report.html").read_text(), (study / "report.md").read_text()
    assert HOSTILE in " ".join(Reader(page).text).replace("  ", " ")
    assert "<script" not in page + markdown
    (line,) = [line for line in markdown.splitlines() if "alert" in line and line.startswith("|")]
    assert len(re.findall(r"(?<!\\)\|", line)) == 5
    assert "\\*żółć\\*" in line and "煉瓦" in line


def test_report_says_what_is_missing_and_what_failed(study):
    markdown = (study / "report.md").read_text()
    assert "1 of 82 runs is missing" in markdown
    assert "1 run failed and counts as a seed" in markdown
    (row,) = [line for line in markdown.splitlines() if line.startswith("| CLIP ViT-B/16 |")][:1]
    assert "/9" in row


@pytest.fixture(scope="module")
def findings(tmp_path_factory):
    return findings_of(PLAN, study_rows(), tmp_path_factory.mktemp("complete"))


def test_the_answer_is_made_from_the_numbers(findings):
    assert status(findings) is None
    (_, fixed), (_, moved) = answer(findings)
    best = max(findings.settings[0].tables[0].lines, key=lambda line: line.outcomes["placed"].counts)
    assert f"{best.label} placed the object in {best.outcomes['placed'].counts.met} of 10 seeds" in fixed
    assert "DINOv2 ViT-S/14 beats ViT-Tiny/16" in fixed
    assert "does not show that a policy sees" in fixed and "policy sees" not in moved
    assert "Seeds succeed in some of their episodes here" in moved


def test_tables_group_by_seeds_and_repeat_the_baseline(findings):
    backbones, ablations = findings.settings[0].tables
    assert (backbones.seeds, backbones.baseline, ablations.seeds) == (10, None, 3)
    assert list(ablations.baseline.runs["training_seed"]) == [0, 1, 2]


def test_report_is_the_same_twice(tmp_path):
    rows = [row for run in SMALL.runs for row in episode_rows(SMALL, run.setting, run.variant, run.seed, 1, run.seed)]
    root = write_study(tmp_path, SMALL, rows)
    first, second = ({path: path.read_bytes() for path in files(root)} for _ in range(2))
    assert first == second and len(first) > 8


def files(root: Path) -> list[Path]:
    report(ReportConfig(root))
    return [path for path in root.rglob("*") if path.is_file()]


@pytest.mark.parametrize("met", [0, 2])
def test_studies_at_the_ends(met, tmp_path):
    """All or none of the seeds succeed, no run has a held-out error, and nothing can be told apart."""
    rows = [row for run in SMALL.runs for row in episode_rows(SMALL, run.setting, run.variant, run.seed, met, met)]
    (setting,) = findings_of(SMALL, rows, tmp_path).settings
    assert [pair.verdict for pair in setting.comparisons["placed"]] == [Verdict.INCONCLUSIVE]
    assert setting.correlations["placed"][0][1] is None
    report(ReportConfig(tmp_path))
    assert not list((tmp_path / "figures").glob("*_error.*"))


@pytest.mark.parametrize(
    ("error", "shown", "said"),
    [
        ("Out of memory.", "no run finished: Out of memory.", "No run of two (fixed) finished."),
        (
            "FileNotFoundError: No weights for clip_vitb16: log in to the Hub.",
            "weights not available",
            "Weights not available: two.",
        ),
    ],
)
def test_a_variant_that_could_not_run_is_never_a_zero(error, shown, said, tmp_path):
    rows = episode_rows(SMALL, "fixed", "one", 0, 2, 2) + episode_rows(SMALL, "fixed", "one", 1, 2, 0)
    rows += [failed_row(SMALL, "fixed", "two", seed, error) for seed in range(2)]
    findings = findings_of(SMALL, rows, tmp_path)
    one, two = findings.settings[0].lines
    assert one.outcomes["placed"].counts.met == 1
    assert not two.outcomes and two.absence == shown
    assert findings.settings[0].comparisons["placed"] == []
    assert status(findings) == said
    report(ReportConfig(tmp_path))
    markdown = (tmp_path / "report.md").read_text()
    assert f"| two | {shown.replace('_', chr(92) + '_')} |" in markdown
    assert error.replace("_", "\\_") in markdown.split("## Failed runs")[1]


def test_a_study_without_any_run_gets_a_report(tmp_path):
    report(ReportConfig(write_study(tmp_path, SMALL, [])))
    markdown = (tmp_path / "report.md").read_text()
    assert "4 of 4 runs are missing" in markdown and "No run has finished." in markdown


def test_what_cannot_be_reported_is_refused_in_a_sentence(tmp_path):
    rows = episode_rows(SMALL, "fixed", "one", 0, 1, 1)
    with pytest.raises(ValueError, match="come from another plan"):
        report(ReportConfig(write_study(tmp_path / "foreign", PLAN, rows)))
    with pytest.raises(ValueError, match="stands in the rows twice"):
        report(ReportConfig(write_study(tmp_path / "twice", SMALL, rows + rows[:1])))
    with pytest.raises(FileNotFoundError, match="plan.yaml is missing"):
        report(ReportConfig(tmp_path))
    broken = write_study(tmp_path / "broken", SMALL, rows)
    (broken / "plan.yaml").write_text("name: small\nfoo: 1\n")
    with pytest.raises(ValueError, match="is not a study's plan"):
        report(ReportConfig(broken))


def test_numbers_as_they_are_written():
    assert [p_value(p) for p in (0.00001, 0.0031, 0.087, 0.65)] == ["< 0.0001", "0.0031", "0.087", "0.65"]
    assert [signed(value, 2) for value in (0.2, -0.2, -0.001)] == ["+0.20", "−0.20", "0.00"]
    assert [roman(number) for number in (1, 4, 9, 14, 40)] == ["I", "IV", "IX", "XIV", "XL"]


COMMAND = """
import sys
sys.argv = ["constructskill-report", "--root={root}"]
from lerobot_constructskill.scripts.report import main
main()
print({{"torch", "lerobot", "sapien", "mani_skill"}} & set(sys.modules))
"""


def test_command_imports_neither_torch_nor_lerobot_nor_simulator(tmp_path):
    write_study(tmp_path, SMALL, [])
    code = COMMAND.format(root=tmp_path)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=REPOSITORY)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == [f"Report written to {tmp_path / 'report.html'}", "set()"]
