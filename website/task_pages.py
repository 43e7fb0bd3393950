"""A page for each task of the contract, of its row, its scene's docstring, and what was measured on it."""

import ast
import json
import re
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import pandas as pd
import yaml

from lerobot_constructskill.analysis.report.page import read_study
from lerobot_constructskill.analysis.stats.intervals import clopper_pearson
from lerobot_constructskill.analysis.stats.outcomes import Counts, count, seed_outcomes
from lerobot_constructskill.contract import (
    ACTION_SCALE,
    CAMERAS,
    FPS,
    GRIPPER,
    IMAGE_SIZE,
    OBS_TYPES,
    SHIPPED,
    STATE_NAMES,
    SUITES,
    Task,
)
from lerobot_constructskill.study.rows import VARIANT

BASES = {"PickPlaceEnv": "lerobot_constructskill.sim.scene", "StrictPlaceEnv": "lerobot_constructskill.sim.strict"}
"""Scenes whose conditions the docstrings of tasks name."""


def pages(root: Path) -> dict[str, str]:
    """Name of a page to its Markdown."""
    outcomes = baselines(root)
    limits = known_limits((root / "docs" / "tasks.md").read_text())
    experts = json.loads((root / "benchmarks" / "experts.json").read_text())
    return {
        f"docs/tasks/{name}.md": page(task, experts.get(name), outcomes, limits[name])
        for name, task in SHIPPED.items()
    }


def with_links(markdown: str) -> str:
    """The table of tasks, where each name leads to the task's page."""
    names = "|".join(SHIPPED)
    return re.sub(
        rf"^\| `({names})` \|", lambda row: f"| [`{row[1]}`](tasks/{row[1]}.md) |", markdown, flags=re.MULTILINE
    )


def known_limits(markdown: str) -> dict[str, str]:
    """Task to what stands of it in the chapter's last section."""
    section = markdown.partition("## Known limits")[2].partition("\n## ")[0]
    return dict(re.findall(r"^\| `(\w+)` \| (.+) \|$", section, flags=re.MULTILINE))


def page(task: Task, expert: dict | None, outcomes: pd.DataFrame, limits: str) -> str:
    suites = ", ".join(f"`{suite}`" for suite, names in SUITES.items() if task.name in names)
    parts = [
        f"# {task.name}",
        f"“{task.instruction}”",
        f'<video controls muted loop playsinline preload="metadata" src="../films/{task.name}.mp4"></video>',
        "The scripted expert: the policy's view, and a close-up.",
        conditions(*task.scene.split(":")),
        "## Observation and action",
        observations(),
        actions(task),
        f"`--env.task={task.name}`"
        + (f", or with others of its suite {suites}" if suites else ", in no suite")
        + f". An episode has at most {task.horizon:,} steps ({task.horizon / FPS:.0f} s). "
        f"ManiSkill's name is `{task.env_id}`.",
        "## Expert",
        expert_text(task, expert),
        "## Policies",
        policies(outcomes[outcomes["task"] == task.name]),
        "## Known limits",
        limits,
    ]
    return "\n\n".join(parts) + "\n"


def observations() -> str:
    rows = ["| observation | shape | in `--env.obs_type` |", "|---|---|---|"]
    for name, camera in CAMERAS.items():
        kinds = ", ".join(f"`{kind}`" for kind, names in OBS_TYPES.items() if name in names)
        where = "on the hand" if camera.mount else "fixed"
        rows.append(f"| `{camera.key}`, {where} | {IMAGE_SIZE} x {IMAGE_SIZE} RGB | {kinds} |")
    numbers = ", ".join(f"`{name}`" for name in STATE_NAMES)
    rows.append(f"| `observation.state`: {numbers} (m, rad) | {len(STATE_NAMES)} | `pixels_agent_pos` |")
    return "\n".join(rows)


def actions(task: Task) -> str:
    rows = ["| action | unit |", "|---|---|"]
    for name in task.action_names:
        unit = "rad" if name.removeprefix("d") in ("roll", "pitch", "yaw") else "m"
        bound = f"{unit} in a step, at most {ACTION_SCALE} either way"
        rows.append(f"| `{name}` | {'+1 open, -1 closed' if name == GRIPPER else bound} |")
    return "\n".join(rows)


def conditions(module: str, scene: str) -> str:
    """The three parts of a scene's docstring, and the conditions of those scenes that it names."""
    text = docstring(module, scene).partition("Args:")[0]
    text = re.sub(r"^\*\*(.+):\*\*$", r"## \1\n", text, flags=re.MULTILINE)
    named = list(dict.fromkeys(re.findall(r"`(\w+Env)`", text)))
    return "\n\n".join([text.strip(), *(f"`{name}`:\n\n{success(name)}" for name in named)])


def success(base: str) -> str:
    text = docstring(BASES[base], base)
    return text.partition("**Success Conditions:**")[2].partition("Args:")[0].strip()


@cache
def docstring(module: str, name: str) -> str:
    """A class's docstring, without the simulator that its module imports."""
    tree = ast.parse(Path(find_spec(module).origin).read_text(encoding="utf-8"))
    return next(ast.get_docstring(node) for node in tree.body if isinstance(node, ast.ClassDef) and node.name == name)


def expert_text(task: Task, measured: dict | None) -> str:
    name, command = task.expert.partition(":")[2], f"`python benchmarks/experts.py {task.name}`"
    yields = (
        f"Under the noise of a data set at least {task.noisy_yield:.0%} of the attempts succeed; the others are "
        "discarded."
    )
    if measured is None:
        return f"`{name}`; {command} has not measured it yet. {yields}"
    states, succeeded = measured["states"], measured["states"] - len(measured["failed"])
    _, low, high = clopper_pearson(Counts(succeeded, states))
    return (
        f"`{name}` succeeds, without noise, in {succeeded} of {states} initial states (95 % Clopper-Pearson interval "
        f"{low:.1%} to {high:.1%}), in at most {measured['longest']} steps. {yields}\n\n"
        f"Measured by {command}: {measured['machine']}"
    )


def policies(outcomes: pd.DataFrame) -> str:
    if outcomes.empty:
        return "No policy has been trained on this task yet."
    rows = ["| policy | seeds that lifted | seeds that placed | episodes placed | study |", "|---|---:|---:|---:|---|"]
    for one in outcomes.itertuples():
        episodes = f"{one.episodes_placed}/{one.episodes}"
        link = f"[{one.study}](../../results/{one.study}/report.md)"
        rows.append(f"| {one.label} | {one.lifted} | {one.placed} | {episodes} | {link} |")
    return "Counted from the rows of every published study, floors and ceilings among them.\n\n" + "\n".join(rows)


def baselines(root: Path) -> pd.DataFrame:
    """One line for each study, setting and variant or reference that was run."""
    return pd.DataFrame([line for path in sorted(root.glob("results/*/study.yaml")) for line in lines(path.parent)])


def lines(folder: Path) -> list[dict]:
    heading, rows = read_study(folder)
    settings = yaml.safe_load((folder / "study.yaml").read_text())["settings"]
    runs = seed_outcomes(rows[rows["error_kind"].isna()])
    roles = rows.groupby("variant")["role"].first()
    groups = sorted(runs.groupby(["setting", "variant"], sort=False), key=lambda group: roles[group[0][1]] != VARIANT)
    return [
        {
            "task": settings[setting]["env"].get("task", "brick_to_bin"),
            "study": heading.name,
            "label": heading.analysis.label(variant),
            "lifted": "{}/{}".format(*count(own, "lifted")),
            "placed": "{}/{}".format(*count(own, "placed")),
            "episodes_placed": own["placed"].sum(),
            "episodes": own["episodes"].sum(),
        }
        for (setting, variant), own in groups
    ]
