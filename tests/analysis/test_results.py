"""The published results are what their rows say."""

import importlib.util
import json
import re
import shutil
from itertools import chain
from pathlib import Path, PurePosixPath

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread
from synthetic_study import SMALL, episode_rows, failed_row, missing_row, missing_rows, planned, write_study

from lerobot_constructskill.analysis.report import figures
from lerobot_constructskill.analysis.report.page import write_report
from lerobot_constructskill.parsing import read_fields
from lerobot_constructskill.study.rows import ran, read_rows

ROOT = Path(__file__).parents[2]
RESULTS = sorted(path.parent for path in (ROOT / "results").glob("*/study.yaml"))


SPEC = importlib.util.spec_from_file_location("render", ROOT / "results" / "render.py")
render = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(render)


def one_and_nightly_the_others() -> list:
    first, *others = RESULTS
    return [first, *(pytest.param(folder, marks=pytest.mark.nightly) for folder in others)]


def load(path: Path) -> dict:
    return read_fields(path)


def last(data: str | None) -> str | None:
    """A configuration of demonstrations by the last part of its name or path."""
    return data and PurePosixPath(data).name.removesuffix(".yaml")


def variant(fields: dict) -> dict:
    policy = {name: value for name, value in fields["policy"].items() if name != "backbone_precision"}
    return {
        "policy": policy,
        "data": last(fields.get("data")),
        "settings": fields.get("settings"),
        "training": fields.get("training") or {},
    }


@pytest.mark.parametrize("folder", RESULTS, ids=lambda folder: folder.name)
def test_a_published_study_is_one_of_configs_with_as_many_seeds_or_fewer(folder):
    """Its precision is the kind of CPU's, and not compared."""
    study, config = load(folder / "study.yaml"), load(ROOT / "configs" / "study" / f"{folder.name}.yaml")
    for part in ("name", "episodes"):
        assert study[part] == config[part]
    for part, default in {
        "eval_seed": 1000,
        "demonstrations": "shared",
        "starts": "shared",
        "seeds_a_draw": 1,
    }.items():
        assert study.get(part, default) == config.get(part, default)
    assert config.get("training", {}).items() <= study["training"].items()
    for name, setting in config["settings"].items():
        assert study["settings"][name]["env"] == setting["env"]
        assert last(study["settings"][name]["data"]) == last(setting["data"])
    for part in ("settings", "variants", "references"):
        assert study[part].keys() == config.get(part, {}).keys()
    for name, fields in config["variants"].items():
        assert variant(study["variants"][name]) == variant(fields)
        assert study["variants"][name]["seeds"] <= fields.get("seeds", 10)


@pytest.mark.slow
@pytest.mark.parametrize("folder", one_and_nightly_the_others(), ids=lambda folder: folder.name)
def test_a_published_report_is_made_of_its_rows(folder, tmp_path, monkeypatch):
    """Its text and the figures in it; to draw those of errors, which are not published, would take longest."""
    monkeypatch.setattr(figures, "error_figure", lambda setting, episodes: Figure((1, 1)))
    copy = shutil.copytree(folder, tmp_path / folder.name, ignore=lambda *_: ("figures", "report.md"))
    write_report(copy)
    text = (folder / "report.md").read_text()
    assert (copy / "report.md").read_text() == text
    for figure in re.findall(r"\]\((figures/.+)\)", text):
        assert np.array_equal(imread(copy / figure), imread(folder / figure))


@pytest.mark.parametrize("folder", RESULTS, ids=lambda folder: folder.name)
def test_a_tables_command_makes_as_many_seeds_as_were_made(folder):
    rows, text = ran(read_rows(folder / "rows.parquet")), (folder / "report.md").read_text().replace("\\", "")
    variants = load(ROOT / "configs" / "study" / f"{folder.name}.yaml")["variants"]
    commands = re.findall(rf"constructskill-study {folder.name} --only=(\w+)/(\w+)(?: --seeds=(\d+))?</code>", text)
    assert len(commands) == len({setting for setting, *_ in commands}) > 0
    for setting, variant, seeds in commands:
        made = rows[(rows["setting"] == setting) & (rows["variant"] == variant)]["training_seed"].nunique()
        assert int(seeds or variants[variant].get("seeds", 10)) == made or not (made or seeds)


LONG = ("README.md", "docs/results.md", "results/language/notes.md")
PAGES = {str(page.relative_to(ROOT)): page for page in render.PAGES}


@pytest.mark.parametrize(
    "page", [pytest.param(page, marks=[pytest.mark.slow] if page in LONG else []) for page in PAGES]
)
def test_the_numbers_of_a_page_are_those_of_the_rows(page):
    assert render.render(PAGES[page]) == PAGES[page].read_text(), "run: python results/render.py"
    assert not render.literals(PAGES[page])


def test_a_number_that_comes_from_no_rows_is_found(tmp_path):
    link = f'[precise]({ROOT}/results/precise/report.md "tile_to_grid/precise")'
    page = tmp_path / "page.md"
    page.write_text(f"| task | placed | rows |\n|---|---:|---|\n| tile | 1/500 | {link} |\n| other | 3/500 | |\n")
    assert f"| tile | 397/500 | {link} |" in render.render(page)
    assert render.literals(page) == ["| other | 3/500 | |"]


def test_a_mean_counts_each_seed_that_ran_in_all_of_its_settings(tmp_path):
    study = SMALL | {"settings": {"fixed": SMALL["settings"]["fixed"], "moved": SMALL["settings"]["fixed"]}}
    study |= {"analysis": {"means": {"both, again": ["fixed", "moved"]}}}
    rows = [
        row
        for run in planned(study)
        for row in (
            [missing_row(study, run)]
            if run == ("moved", "one", 1)
            else episode_rows(study, run, 2, 1 + (run[0] == "moved") * run[2])
        )
    ]
    page, report_file = tmp_path / "page.md", f"{write_study(tmp_path, study, rows)}/report.md"
    page.write_text(f'[]({report_file} "placed both, again/one") []({report_file} "each both, again/two")\n')
    assert [one["text"] for one in render.LINK.finditer(render.render(page))] == ["2/4", "2, 3"]
    page.write_text(f'| spread, by chance | rows |\n|---|---|\n| | [small]({report_file} "both, again/two") |\n')
    assert "| 12.5, " in render.render(page)  # 2 and 3 of 4


def test_a_draw_counts_once_and_one_that_lacks_a_seed_not_yet(tmp_path):
    study = SMALL | {"variants": {"one": {"seeds": 6}}, "episodes": 10}
    study |= {"demonstrations": "own", "starts": "own", "seeds_a_draw": 2}
    runs = [*planned(study)]
    rows = [episode_rows(study, run, 10, placed) for run, placed in zip(runs, [0, 0, 2, 3, 6, 7], strict=True)]
    page = tmp_path / "page.md"

    def tell(rows) -> str:
        report_file = f"{write_study(tmp_path, study, rows)}/report.md"
        page.write_text(
            "| seeds that placed | placed | rows |\n|---|---|---|\n"
            f'| | | [small]({report_file} "fixed/one") |\n\n[]({report_file} "worst fixed/one")\n'
        )
        return render.render(page)

    text = tell([*chain(*rows)])
    assert "| 2/3 draws | 18/60 |" in text and "[0](" in text
    text = tell([*chain(*rows[:4]), failed_row(study, runs[4], "broken"), *rows[5]])
    assert "| 2/3 draws | 12/60 |" in text, "a failed seed placed in no episode"
    assert "| 1/2 draws | 5/40 |" in tell([*chain(*rows[:5]), missing_row(study, runs[5])])


def test_a_failed_run_of_a_mean_placed_in_none_of_its_episodes(tmp_path):
    study = SMALL | {"settings": {"fixed": SMALL["settings"]["fixed"], "moved": SMALL["settings"]["fixed"]}}
    study |= {"analysis": {"means": {"both": ["fixed", "moved"]}}}
    runs = [*planned(study)]
    rows = [failed_row(study, runs[0], "broken"), *(row for run in runs[1:] for row in episode_rows(study, run, 2, 1))]
    page = tmp_path / "page.md"
    seeds = study["variants"]["one"]["seeds"]
    page.write_text(f'[]({write_study(tmp_path, study, rows)}/report.md "placed both/one")\n')
    assert f"[{2 * seeds - 1}/{4 * seeds}]" in render.render(page)
    failed = [failed_row(study, run, "broken") for run in runs]
    page.write_text(f'[]({write_study(tmp_path, study, failed)}/report.md "placed fixed/one")\n')
    assert f"[0/{2 * seeds}]" in render.render(page)


def test_minutes_are_of_a_set_its_features_and_one_seed(tmp_path):
    root = write_study(tmp_path, SMALL, missing_rows(SMALL))
    page = tmp_path / "page.md"
    page.write_text(f'| minutes | rows |\n|---|---|\n| | [small]({root}/report.md "fixed/one") |\n')
    rows = [*chain(*(episode_rows(SMALL, run, 2, 1) for run in planned(SMALL)))]
    write_study(tmp_path, SMALL, rows)
    assert "| – |" in render.render(page)
    took = {"demonstrations": {"seconds": 600, "nodes": 2}, "training": {"seconds": 360}}
    lines = [{"arm": "fixed/one", "stage": stage, "runs": 3, **fields} for stage, fields in took.items()]
    (Path(root) / "timings.jsonl").write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    assert "| 5, –, 2 |" in render.render(page)


def test_a_mistyped_word_of_a_link_is_refused(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(f'[5]({ROOT}/results/precise/report.md "plcaed tile_to_grid/precise")\n')
    with pytest.raises(SystemExit, match="names plcaed tile_to_grid/precise"):
        render.render(page)


def test_an_arm_that_nobody_made_is_no_number(tmp_path):
    page, small = tmp_path / "page.md", f"{write_study(tmp_path, SMALL, missing_rows(SMALL))}/report.md"
    page.write_text(f'[]({small} "placed fixed/one")\n')
    assert render.render(page) == f'[not run yet]({small} "placed fixed/one")\n'
    page.write_text(f'[]({small} "placed fixed/nothing")\n')
    with pytest.raises(SystemExit, match=r"names fixed/nothing, which its study does not have"):
        render.render(page)
    page.write_text('[](walls/report.md "placed course_of_three/precise")\n')
    assert render.render(page).startswith("[not run yet]"), "a study without rows"
    study = SMALL | {"settings": SMALL["settings"] | {"later": SMALL["settings"]["fixed"]}}
    write_study(tmp_path, study, missing_rows(SMALL))
    page.write_text(
        "| | placed | lifted | rows |\n|---|---|---|---|\n"
        f'| [1]({small} "draws later/one") | | | [s]({small} "later/one") |\n'
    )
    assert "| not run yet | – |" in render.render(page) and "[0](" in render.render(page), "a setting without rows"
    page.write_text('[](wals/report.md "placed course_of_three/precise")\n')
    with pytest.raises(SystemExit, match="names wals, which is no study"):
        render.render(page)
