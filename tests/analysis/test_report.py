"""The report of studies that were never run: what it says, what it refuses, and that nothing in it is markup."""

import json
import re
import subprocess
import sys
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pandas as pd
import pytest
from synthetic_study import (
    HOSTILE,
    RATES,
    SMALL,
    STUDY,
    episode_rows,
    failed_row,
    missing_row,
    missing_rows,
    planned,
    study_rows,
    write_study,
)

from lerobot_constructskill.analysis.report import figures
from lerobot_constructskill.analysis.report.figures import seeds_figure
from lerobot_constructskill.analysis.report.formats import p_value, signed, times
from lerobot_constructskill.analysis.report.page import read_study, write_report
from lerobot_constructskill.analysis.report.summarize import summarize
from lerobot_constructskill.analysis.stats.comparisons import Conclusion
from lerobot_constructskill.analysis.stats.power import detectable_spread_ratio
from lerobot_constructskill.errors import InputError, MissingError
from lerobot_constructskill.study.rows import Draws

REPOSITORY = Path(__file__).parents[2]


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


def findings_of(study: dict, rows, folder: Path, **analysis):
    _, section, table = read_study(write_study(folder, study, rows, **analysis))
    return summarize(section, table, Draws())


@pytest.fixture
def no_figures(monkeypatch):
    """Figures take most of a report's time."""
    monkeypatch.setattr(figures, "save", lambda figure, path: None)


@pytest.mark.slow
def test_page_holds_the_papers_tables_and_every_figure(study):
    reader = Reader((study / "report.html").read_text())
    text = re.sub(r"\s+", " ", " ".join(reader.text))
    for words in ("10 training seeds each", "DINOv2 ViT-S/14, first 3 seeds", "Position ± 0.10 m", "Scripted expert"):
        assert words in text
    drawn = {"seeds.png", *(f"{setting}_error.png" for setting in RATES)}
    assert {path.name for path in (study / "figures").iterdir()} == drawn
    assert {link for link in reader.links if "figures" in link} == {f"figures/{name}" for name in drawn}
    assert (study / "study.yaml").read_text() in "".join(reader.text)


@pytest.mark.slow
def test_the_time_of_each_stage_is_in_minutes_and_for_a_run(study):
    assert "| training | 10 | 10 | 63 |" in (study / "report.md").read_text()


@pytest.mark.slow
def test_each_table_has_the_command_that_makes_its_lines_again(study):
    """A study that is not one of ours is made from its file."""
    text = " ".join(" ".join(Reader((study / "report.html").read_text()).text).split())
    for setting, task in (("fixed", "brick_to_bin"), ("moved", "brick_to_bin_shifted")):
        command = f"constructskill-study study.yaml --only={setting}/dinov2"
        assert f"Task {task}. A line of the table is made again by, in this folder, {command}" in text
    ours = (REPOSITORY / "results" / "base_camera" / "report.md").read_text().replace("\\", "")
    assert "<code>constructskill-study base_camera --only=brick_to_bin_shifted/heat_maps</code>" in ours


@pytest.mark.slow
def test_the_page_and_its_markdown_hold_the_same_cells(study):
    page = re.findall(r"<t[hd](?: [^>]*)?>(.*?)</t[hd]>", (study / "report.html").read_text())
    rows = [line for line in (study / "report.md").read_text().splitlines() if re.match(r"\|(?!---)", line)]
    markdown = [cell.strip() for row in rows for cell in re.split(r"(?<!\\)\|", row)[1:-1]]
    assert [" ".join(unescape(cell).split()) for cell in page] == [
        " ".join(unescape(re.sub(r"\\(.)", r"\1", cell)).split()) for cell in markdown
    ]


@pytest.mark.slow
def test_films_and_error_figures_are_on_the_page_alone(study):
    assert re.findall(r"\]\(([^)]+)\)", (study / "report.md").read_text()) == ["figures/seeds.png"]


@pytest.mark.slow
def test_every_variant_is_validated_on_every_set_of_the_setting(study):
    markdown = (study / "report.md").read_text()
    fixed, moved = (part for part in markdown.split("Error on what is held out of each set")[1:])
    for part in (fixed, moved):
        assert "| configuration | trained on | fast | fast\\_noise\\_free |\n|---|---|---:|---:|\n" in part
    (row,) = [line for line in fixed.splitlines() if line.startswith("| No noise injection | fast\\_noise\\_free |")]
    on_noisy, on_noise_free = (float(cell.split("[")[0].replace("\\", "")) for cell in row.split("|")[3:5])
    assert on_noise_free == pytest.approx(on_noisy / 2, abs=0.01)
    assert "fast_noise_free" in (study / "report.html").read_text()


@pytest.mark.slow
def test_page_has_no_script_and_refers_only_to_its_folder(study):
    reader = Reader((study / "report.html").read_text())
    assert "script" not in reader.tags and "table" in reader.tags
    beside = [link for link in reader.links if not link.startswith(("data:,", "#"))]
    assert all((study / unquote(link)).is_file() for link in beside)
    assert [link for link in beside if "figures" not in link] == ["videos/a%20%26%20b.mp4", "videos/large.mp4"]


@pytest.mark.slow
def test_everything_is_escaped(study):
    page, markdown = (study / "report.html").read_text(), (study / "report.md").read_text()
    assert HOSTILE in " ".join(Reader(page).text).replace("  ", " ")
    assert "<script" not in page + markdown
    (line,) = [line for line in markdown.splitlines() if "alert" in line and line.startswith("|")]
    assert len(re.findall(r"(?<!\\)\|", line)) == 5
    assert "\\*żółć\\*" in line and "煉瓦" in line


@pytest.mark.slow
def test_report_says_what_is_missing_and_what_failed(study):
    markdown = (study / "report.md").read_text()
    assert "1 of 92 runs are missing" in markdown
    (row,) = [line for line in markdown.splitlines() if line.startswith("| clip: CLIP ViT-B/16 (1 failed run) |")]
    assert "/9" in row


@pytest.mark.slow
def test_report_says_which_spread_so_many_seeds_find(study):
    """Of ten seeds each, and of three against ten."""
    markdown = (study / "report.md").read_text()
    spreads = markdown.split("### The same comparisons of the spread over seeds")[1].split("\n\n")[1].splitlines()
    found = {line.split("|")[1].strip(): line.split("|")[-2].strip() for line in spreads}
    expected = {times(detectable_spread_ratio(10, seeds)) for seeds in (3, 10)}
    assert len(expected) == 2 and {*found.values()} >= expected, found


def test_a_run_that_was_not_made_is_neither_a_failure_nor_a_zero(tmp_path):
    runs = list(planned(SMALL))
    rows = [row for run in runs[:3] for row in episode_rows(SMALL, run, 2, 2)] + [missing_row(SMALL, runs[3])]
    (setting,) = (findings := findings_of(SMALL, rows, tmp_path)).settings
    one, two = setting.variants
    assert (findings.planned, findings.missing) == (4, 1)
    assert (two.seeds, len(two.failures), len(two.runs)) == (2, 0, 1)
    assert two.success["placed"].counts == (1, 1) and two.success["placed"].mean.value == 1
    assert [(pair.counts_a, pair.counts_b) for pair in setting.comparisons["placed"]] == [((2, 2), (1, 1))]
    assert findings.failures == []


def test_a_reference_that_was_not_made_is_missing(tmp_path):
    study = SMALL | {"references": {"expert": 1}}
    rows = [row for run in planned(study) for row in episode_rows(study, run, 2, 2)]
    findings = findings_of(study, [missing_row(study, ("fixed", "expert", 0)), *rows], tmp_path)
    assert (findings.missing, findings.planned_references) == (1, 1)
    assert findings.settings[0].references[0].absence == "not run yet"


@pytest.fixture(scope="module")
def findings(tmp_path_factory):
    return findings_of(STUDY, study_rows(), tmp_path_factory.mktemp("complete"))


@pytest.mark.slow
def test_tables_group_by_seeds_and_repeat_the_baseline(findings):
    backbones, ablations = findings.settings[0].groups
    assert (backbones.seeds, backbones.baseline, ablations.seeds) == (10, None, 3)
    assert list(ablations.baseline.runs["training_seed"]) == [0, 1, 2]


def test_training_seeds_may_begin_anywhere(tmp_path):
    """Choices are made on seeds of their own, which are not reported."""
    chosen = [("fixed", "one", seed) for seed in range(100, 103)]
    rows = [row for run in chosen for row in episode_rows(SMALL, run, 2, 2)]
    rows += [row for run in list(planned(SMALL))[2:] for row in episode_rows(SMALL, run, 2, 0)]
    (setting,) = (findings := findings_of(SMALL, rows, tmp_path)).settings
    _, second = setting.groups
    assert list(second.baseline.runs["training_seed"]) == [100, 101]
    assert second.baseline.success["placed"].counts == (2, 2)
    figure = seeds_figure(findings)
    placed = figure.axes[1]
    assert [label.get_text() for label in placed.get_xticklabels()] == ["0", "1", "100", "101", "102"]
    numbers = {text.get_text() for text in placed.texts}
    assert numbers == {"2", "0", "3/3", "0/2"}, "every cell has its run"


def test_a_setting_of_which_nothing_is_made_is_not_drawn_unless_all_are(tmp_path):
    """Its table says so, and an empty panel says no more."""
    study = SMALL | {"settings": SMALL["settings"] | {"later": next(iter(SMALL["settings"].values()))}}
    rows = {run: episode_rows(study, run, 2, 2) for run in planned(study) if run[0] != "later"}
    later = [missing_row(study, run) for run in planned(study) if run[0] == "later"]
    titles = [
        axis.get_title() for axis in seeds_figure(findings_of(study, [*sum(rows.values(), []), *later], tmp_path)).axes
    ]
    assert titles == ["fixed: lifted", "fixed: placed"]
    nothing = findings_of(study, [missing_row(study, run) for run in planned(study)], tmp_path)
    assert len(seeds_figure(nothing).axes) == 4


def test_what_a_setting_is_read_with_comes_from_the_rows(findings):
    fixed, moved = findings.settings
    assert fixed.data_sets == ["fast", "fast_noise_free"]
    assert [line.demonstrations for line in moved.variants] == ["fast"] * 4 + ["fast_noise_free"]
    assert [line.name for line in fixed.variants] == list(STUDY["variants"])
    assert (findings.episodes, findings.first_seed, findings.planned, findings.planned_references) == (
        10,
        1000,
        82,
        10,
    )
    assert (fixed.declared, moved.declared) == (6 + 1, 3 + 1)


@pytest.mark.slow
def test_a_label_an_order_and_alpha_change_the_page_and_no_number(tmp_path, no_figures):
    """Not even one by resampling."""
    root = write_study(tmp_path)
    rows = (root / "rows.parquet").read_bytes()

    def page(**analysis) -> list[str]:
        write_study(root, **analysis)
        (root / "rows.parquet").write_bytes(rows)
        write_report(root)
        return (root / "report.html").read_text().split("<details>")[0].splitlines()

    first = page()
    labels = STUDY["analysis"]["labels"] | {"dinov2": "Renamed"}
    assert [line.replace("Renamed", "DINOv2 ViT-S/14") for line in page(labels=labels)] == first
    # The first variant is also the one whose first seeds stand beside ablations, so it stays first.
    ordered = page(order=["dinov2", "vit_tiny"])
    assert ordered != first
    rows_of = [sorted(line for line in text if line.startswith("<tr>")) for text in (first, ordered)]
    assert rows_of[0] == rows_of[1]
    strict = page(alpha=1e-9)
    assert "<td>better</td>" in "".join(first) and "<td>better</td>" not in "".join(strict)


def test_seeds_of_a_draw_count_once_and_the_spread_is_split(tmp_path, no_figures):
    drawn = SMALL | {"variants": {"one": {"seeds": 6}}, "episodes": 10}
    placed = [9, 8, 2, 3, 6, 7]
    rows = [
        replace(row, evaluation_seed=row.evaluation_seed + 10 * (seed // 2))
        for seed, count in enumerate(placed)
        for row in episode_rows(drawn, ("fixed", "one", seed), lifted=10, placed=count)
    ]
    said = {}
    for shared in (True, False):
        root = tmp_path / str(shared)
        of = drawn if shared else drawn | {"demonstrations": "own", "starts": "own", "seeds_a_draw": 2}
        write_study(root, of, rows)
        said[shared] = write_report(root) and (root / "report.md").read_text()
    assert (
        "hold for other training seeds, with the same demonstrations and starts" in said[True]
        and "draws.png" not in said[True]
    )
    assert "hold for other draws of demonstrations, other starts and other training seeds" in said[False]
    assert "What the spread between runs is made of" in said[False] and "figures/fixed_draws.png" in said[False]
    assert "6/6 (54–100 %)" in said[True] and "3/3 (29–100 %)" in said[False]
    assert "| draws that placed |" in said[False] and "a draw counts once" in said[False]
    assert "3 draws of demonstrations, 2 training seeds on each" in said[False]
    assert re.search(r"one \| 5\.8 \(.*\) \| 2\.5 \|", said[False]), "the worst draw"
    mean = {shared: re.search(r"5\.8 \(([\d.]+)–([\d.]+)\)", text).groups() for shared, text in said.items()}
    assert float(mean[False][0]) < float(mean[True][0]) and float(mean[False][1]) > float(mean[True][1])
    lacks = [row for row in rows if row.training_seed < 5] + [missing_row(drawn, ("fixed", "one", 5))]
    write_study(tmp_path / "lacks", drawn | {"demonstrations": "own", "starts": "own", "seeds_a_draw": 2}, lacks)
    write_report(tmp_path / "lacks")
    text = (tmp_path / "lacks" / "report.md").read_text()
    assert re.search(r"one \| 5\.7 \(.*\) \| 2\.5 \|", text), "(8.5 + 2.5 + 6) / 3, not (9 + 8 + 2 + 3 + 6) / 5"
    assert "1 of 6 runs are missing" in text and "3/3 (29–100 %)" in text


def test_walls_are_told_by_their_chains_and_where_these_break(tmp_path, no_figures):
    def laid(chain):
        of_all = (
            dict.fromkeys(("length", "level", "line")) if chain < 3 else {"length": 2.0, "level": -1.0, "line": 0.5}
        )
        return json.dumps({"errors": [[4.0 if chain == 3 else 2.0, 0.0, 0.0, 0.0, 0.0]] * 3} | of_all)

    chains = {("one", 0): (3, 0), ("one", 1): (1, 1), ("two", 0): (0, 0), ("two", 1): (0, 0)}
    rows = []
    for row in study_rows(SMALL):
        chain = chains[row.variant, row.training_seed][row.episode]
        rows.append(replace(row, chain=chain, placements=chain, measures=laid(chain)))
    write_report(write_study(tmp_path, SMALL, rows))
    text = (tmp_path / "report.md").read_text()
    assert "| one | 1.25 \\[1.00–1.50\\] | 1.25 | 1, 2, 0, 1 | 4.0 | 2.0 | 1.0 | 0.5 |" in text
    assert "| two | 0.00 \\[0.00–0.00\\] | 0.00 | 4, 0, 0, 0 | – | – | – | – |" in text


@pytest.mark.slow
def test_declared_comparisons_are_the_family(tmp_path):
    findings = findings_of(STUDY, study_rows(), tmp_path, comparisons=[["clip", "dinov2"], ["augreg", "dinov2"]])
    fixed, moved = findings.settings
    assert [(pair.a, pair.b) for pair in fixed.comparisons["placed"]] == [
        ("clip", "dinov2"),
        ("augreg", "dinov2"),
    ]
    assert moved.declared == 1  # augreg does not run there


@pytest.mark.parametrize(
    ("sweeps", "said"),
    [
        ({"clip": ["fixed", "moved"]}, "The sweep or mean 'clip' needs a name that nothing else in the study has."),
        ({"a": ["fixed", "moved"], "b": ["moved", "fixed"]}, "'fixed' begins the sweep 'a' and must not be varied"),
    ],
)
def test_a_sweep_has_a_name_and_a_beginning_of_its_own(sweeps, said, tmp_path):
    with pytest.raises(InputError, match=re.escape(said)):
        findings_of(STUDY, study_rows(), tmp_path, sweeps=sweeps)


ONE_VARIANT = STUDY | {"variants": {"dinov2": {"seeds": 10}}, "analysis": {}}


@pytest.mark.slow
@pytest.mark.parametrize("study, sections", [(STUDY, ["fixed", "moved"]), (ONE_VARIANT, ["fixed"])])
def test_a_sweep_is_one_table_and_one_figure_in_place_of_sections_that_compare_nothing(study, sections, tmp_path):
    names = [*study["variants"], *study["references"]]
    findings = findings_of(study, study_rows(study), tmp_path, sweeps={"position": ["fixed", "moved"]})
    assert [setting.name for setting in findings.sections] == sections
    labels = study["analysis"].get("labels", {})
    assert findings.swept_labels == [labels.get(name, name) for name in names]
    drawn = {path.name for path in files(tmp_path)}
    assert drawn >= {"sweeps.png", "seeds.png", *(f"{setting}_error.png" for setting in sections)}
    assert ("moved_error.png" in drawn) == ("moved" in sections)
    lines = [line for line in (tmp_path / "report.md").read_text().splitlines() if line.startswith("| position |")]
    ran = [(s.label, line.success["placed"]) for name in names
           for s in findings.settings for line in s.everything if line.name == name]  # fmt: skip
    assert len(lines) == len(ran) == 2 * len(names) - ("augreg" in names)
    for line, (setting, placed) in zip(lines, ran, strict=True):
        assert f"| {setting} |" in line and f"| {10 * placed.mean.value:.1f}" in line
    page = Reader((tmp_path / "report.html").read_text())
    assert "Along each sweep" in page.text and "#sweeps" in page.links
    assert ("#moved" in page.links) == ("moved" in sections)


@pytest.mark.slow
def test_a_mean_over_tasks_is_of_seeds_that_ran_in_all_and_pools_no_episodes(tmp_path, no_figures):
    rows = [row for row in study_rows() if (row.setting, row.variant, row.training_seed) != ("moved", "clip", 4)]
    (mean,) = findings_of(STUDY, rows, tmp_path, means={"both": ["fixed", "moved"]}).means
    found = {one.name: one for one in mean.variants}
    shares = {
        setting: pd.Series([row.placed for row in own]).mean()
        for setting in ("fixed", "moved")
        if (own := [row for row in rows if (row.setting, row.variant) == (setting, "dinov2")])
    }
    assert found["dinov2"].success["placed"].mean.value == pytest.approx(np.mean([*shares.values()]))
    assert [len(found[name].runs) for name in ("dinov2", "clip", "augreg")] == [10, 9, 0]
    assert 0 < found["clip"].success["placed"].chance < 0.5, "of the seeds that ran in both"
    assert not mean.drawn and not mean.walls, "a split and a wall are of one task"
    assert ("dinov2", "clip") in {(pair.a, pair.b) for pair in mean.comparisons["placed"]}
    assert "## both" in (Path(write_report(tmp_path)).parent / "report.md").read_text()


def test_in_a_sweep_variants_with_the_same_label_are_one_line(tmp_path):
    study = STUDY | {
        "variants": {"clip": {"seeds": 10, "settings": ["fixed"]}, "dinov2": {"seeds": 10, "settings": ["moved"]}}
    }
    labels = {"clip": "Either", "dinov2": "Either"}
    findings = findings_of(
        study,
        study_rows(study),
        tmp_path,
        sweeps={"position": ["fixed", "moved"]},
        labels=labels,
        order=[],
        comparisons=[],
    )
    assert findings.swept_labels.count("Either") == 1
    (sweep,) = findings.sweeps
    assert [(setting.name, line.name) for setting, line in sweep.find("Either")] == [
        ("fixed", "clip"),
        ("moved", "dinov2"),
    ]


@pytest.mark.parametrize(
    ("analysis", "said"),
    [
        ({"comparisons": [["one", "b"]]}, "Unknown variant in comparisons 'b'; the study has: one, two."),
        ({"order": ["b"]}, "Unknown variant in order 'b'; the study has: one, two."),
        ({"labels": {"b": "B"}}, "Unknown name in labels 'b'; the study has: one, two, fixed."),
        ({"comparisons": [["one"]]}, "A comparison must be a pair of variants"),
        ({"comparisons": [["one", "one"]]}, "A comparison must be a pair of variants"),
        ({"sweeps": {"axis": ["fixed", "moved"]}}, "Unknown setting in sweeps 'moved'; the study has: fixed."),
        ({"sweeps": {"axis": ["fixed"]}}, "must be two settings or more, each once; 'axis' is ['fixed']"),
        ({"alpha": 1.0}, "analysis.alpha must be a finite number above 0 and at most 0.5, not 1.0"),
        ({"alpha": float("nan")}, "analysis.alpha must be a finite number above 0 and at most 0.5, not nan"),
        ({"alhpa": 0.1}, "alhpa"),
    ],
)
def test_an_analysis_that_does_not_fit_is_refused_in_a_sentence(analysis, said, tmp_path):
    with pytest.raises(InputError, match=re.escape(said)):
        write_report(write_study(tmp_path, SMALL, missing_rows(SMALL), **analysis))


@pytest.mark.slow
def test_report_is_the_same_twice(tmp_path):
    rows = [row for run in planned(SMALL) for row in episode_rows(SMALL, run, 1, run[2])]
    root = write_study(tmp_path, SMALL, rows)
    first, second = ({path: path.read_bytes() for path in files(root)} for _ in range(2))
    assert first == second and len(first) == 5


def files(root: Path) -> list[Path]:
    write_report(root)
    return [path for path in root.rglob("*") if path.is_file()]


@pytest.mark.slow
@pytest.mark.parametrize("met", [0, 2])
def test_studies_at_the_ends(met, tmp_path):
    """All or none of the seeds succeed, no run has a held-out error, and nothing can be told apart."""
    rows = [row for run in planned(SMALL) for row in episode_rows(SMALL, run, met, met)]
    (setting,) = findings_of(SMALL, rows, tmp_path).settings
    assert [pair.conclusion for pair in setting.comparisons["placed"]] == [Conclusion.INCONCLUSIVE]
    assert setting.correlations[0][1]["placed"] is None
    write_report(tmp_path)
    assert not list((tmp_path / "figures").glob("*_error.*"))


@pytest.mark.parametrize(("kind", "error"), [("machine", "Out of memory."), ("weights", "clip_vitb16: log in.")])
def test_a_variant_that_could_not_run_is_never_a_zero(kind, error, tmp_path, no_figures):
    rows = episode_rows(SMALL, ("fixed", "one", 0), 2, 2) + episode_rows(SMALL, ("fixed", "one", 1), 2, 0)
    rows += [failed_row(SMALL, ("fixed", "two", seed), error, kind) for seed in range(2)]
    findings = findings_of(SMALL, rows, tmp_path)
    one, two = findings.settings[0].variants
    assert one.success["placed"].counts.met == 1
    assert not two.success and two.absence == "no run finished"
    assert findings.settings[0].comparisons["placed"] == []
    write_report(tmp_path)
    markdown = (tmp_path / "report.md").read_text()
    assert "| two | no run finished |" in markdown
    assert error.replace("_", "\\_") in markdown.split("## Failed runs")[1]


def test_a_study_without_any_run_gets_a_report(tmp_path):
    write_report(write_study(tmp_path, SMALL, missing_rows(SMALL)))
    markdown = (tmp_path / "report.md").read_text()
    assert "4 of 4 runs are missing" in markdown and "| one | not run yet |" in markdown


def test_what_cannot_be_reported_is_refused_in_a_sentence(tmp_path):
    rows = episode_rows(SMALL, ("fixed", "one", 0), 1, 1)
    with pytest.raises(InputError, match="is in the rows twice"):
        write_report(write_study(tmp_path / "twice", SMALL, rows + rows[:1]))
    longer = episode_rows(SMALL | {"episodes": 5}, ("fixed", "one", 1), 1, 1)
    with pytest.raises(InputError, match="runs of 2 and of 5 episodes"):
        write_report(write_study(tmp_path / "mixed", SMALL, rows + longer))
    with pytest.raises(InputError, match="has no rows"):
        write_report(write_study(tmp_path / "empty", SMALL, []))
    with pytest.raises(InputError, match="Setting 'fixed' has no variant"):
        write_report(write_study(tmp_path / "bare", SMALL, episode_rows(SMALL, ("fixed", "expert", 0), 2, 2)))


@pytest.mark.parametrize("name", ["study.yaml", "rows.parquet"])
def test_a_folder_that_is_no_studys_is_refused_in_a_sentence(name, tmp_path):
    root = write_study(tmp_path, SMALL, missing_rows(SMALL))
    for content in ("name: [small", "- small", "analysis: {}", ""):
        (root / name).write_text(content)
        with pytest.raises(InputError, match=f"{name}' (is not a study's file|cannot be read): "):
            write_report(root)
    (root / name).unlink()
    with pytest.raises(MissingError, match=f"'{root}' is not the folder of a study: {name} is missing."):
        write_report(root)


def test_numbers_as_they_are_written():
    assert [p_value(p) for p in (0.00001, 0.0031, 0.087, 0.65)] == ["< 0.0001", "0.0031", "0.087", "0.65"]
    assert [signed(value, 2) for value in (0.2, -0.2, -0.001)] == ["+0.20", "−0.20", "0.00"]


COMMAND = """
import sys
sys.argv = ["constructskill-report", "--root={root}"]
from lerobot_constructskill.scripts.report import report
report.main()
print({{"torch", "lerobot", "sapien", "mani_skill"}} & set(sys.modules))
"""


@pytest.mark.slow
def test_command_imports_neither_torch_nor_lerobot_nor_simulator(tmp_path):
    write_study(tmp_path, SMALL, missing_rows(SMALL))
    code = COMMAND.format(root=tmp_path)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=REPOSITORY)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == [f"Report written to {tmp_path / 'report.html'}", "set()"]


def test_rows_of_a_setting_that_the_study_lacks_are_refused(tmp_path):
    rows = [row for run in planned(SMALL) for row in episode_rows(SMALL, run, 1, 1)]
    root = write_study(tmp_path, SMALL | {"settings": {"other": SMALL["settings"]["fixed"]}}, rows)
    with pytest.raises(InputError, match=r"has no setting 'fixed', which rows in rows\.parquet are of"):
        write_report(root)
