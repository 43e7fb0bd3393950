"""Makes the site's pages of the code: tasks, commands, the Python interface and the leaderboard."""

import io
import re
import sys
import tomllib
from collections import defaultdict
from contextlib import redirect_stdout, suppress
from importlib.metadata import EntryPoint
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import griffe

from lerobot_constructskill.analysis.report.page import read_study
from lerobot_constructskill.analysis.stats.outcomes import count, runs_of
from lerobot_constructskill.board.exports import TABLE
from lerobot_constructskill.board.films import FILMS
from lerobot_constructskill.board.protocol import BOARD_SUITES
from lerobot_constructskill.board.site import write_board
from lerobot_constructskill.contract import FPS, SHIPPED, Task
from lerobot_constructskill.study.rows import read_environments

INTERFACE = {
    "Contract": ["contract"],
    "Environments": ["envs.configuration_constructskill", "envs.gym_env", "perturbations"],
    "Policy": [
        "policies.frozen_vit.configuration_frozen_vit.FrozenViTChunkConfig",
        "policies.frozen_vit.modeling_frozen_vit.FrozenViTChunkPolicy",
    ],
    "Demonstrations": ["demos.expert", "demos.pick_place", "demos.precise", "demos.noise", "demos.recorder"],
    "Rollouts": ["rollout.agents", "rollout.lockstep", "rollout.references"],
    "Studies": ["study.spec", "training.recipe", "training.trainers", "study.rows"],
    "Statistics": [
        f"analysis.stats.{name}"
        for name in ("outcomes", "intervals", "comparisons", "correlation", "judgement", "power")
    ],
}
"""Title of a page to the public modules and classes on it."""

BASES = {"PickPlaceEnv": "lerobot_constructskill.sim.scene", "StrictPlaceEnv": "lerobot_constructskill.sim.strict"}
"""Scenes whose success conditions the docstrings of tasks refer to, to their modules."""


def pages(root: Path) -> dict[str, str | bytes]:
    """Name of a file to its content."""
    outcomes = policies(root)
    tasks = {f"docs/tasks/{name}.md": task_page(task, outcomes[name]) for name, task in SHIPPED.items()}
    interface = {
        f"site/python/{title.lower()}.md": "\n\n".join([f"# {title}", *map(documented, names)])
        for title, names in INTERFACE.items()
    }
    scripts = tomllib.loads((root / "pyproject.toml").read_text())["project"]["scripts"]
    return {**tasks, **interface, **board(root), "site/commands.md": commands(scripts)}


def documented(name: str) -> str:
    """The text that mkdocstrings replaces by the docstrings of a module or class of the package."""
    return f"::: lerobot_constructskill.{name}"


def task_page(task: Task, outcomes: list[str]) -> str:
    """A task's page; `outcomes` are rows of its table of policies."""
    head = "| policy | seeds that lifted | seeds that placed | episodes placed | study |\n|---|---:|---:|---:|---|"
    return f"""# {task.name}

“{task.instruction}”

<video controls muted loop playsinline preload="metadata" src="../films/{task.name}.mp4"></video>

The scripted expert: the policy's view, and a close-up.

`--env.task={task.name}`; in ManiSkill `{task.env_id}`. An episode has at most {task.horizon} steps
({task.horizon / FPS:.0f} s). Observations, actions, the expert's success and known limits: [Tasks](../tasks.md).

## Policies

{"\n".join([head, *outcomes]) if outcomes else "No policy has been trained on this task yet."}

{conditions(*task.scene.split(":"))}
"""


def conditions(module: str, scene: str) -> str:
    """The parts of a scene's docstring, and the success conditions of those scenes that it names."""
    text = griffe.load(module)[scene].docstring.value.partition("Args:")[0]
    text = re.sub(r"^\*\*(.+):\*\*$", r"## \1\n", text, flags=re.MULTILINE).strip()
    bases = dict.fromkeys(re.findall(r"`(\w+Env)`", text))
    named = {base: conditions(BASES[base], base).partition("## Success Conditions\n")[2].strip() for base in bases}
    return "\n\n".join([text, *(f"`{base}`:\n\n{success}" for base, success in named.items())])


def policies(root: Path) -> dict[str, list[str]]:
    """Task to rows of its table of policies, from the published studies, references among them."""
    outcomes = defaultdict(list)
    for folder in sorted(path.parent for path in root.glob("results/*/study.yaml")):
        name, analysis, rows = read_study(folder)
        envs, runs = read_environments(folder), runs_of(rows[rows["error_kind"].isna()])
        for (setting, variant), own in runs.groupby(["setting", "variant"]):
            lifted, placed = ("{}/{}".format(*count(own[f"{criterion}_rate"])) for criterion in ("lifted", "placed"))
            perturbed = envs[setting].get("perturb")
            policy = analysis.label(variant) + (f", `{perturbed}`" if perturbed else "")
            cells = (policy, lifted, placed, f"{own['placed'].sum()}/{own['episodes'].sum()}")
            link = f"[{name}](../../results/{folder.name}/report.md)"
            outcomes[envs[setting]["task"]].append(f"| {' | '.join(cells)} | {link} |")
    return outcomes


def commands(scripts: dict[str, str]) -> str:
    """The help of every command."""
    texts = [f"## {name}\n\n```text\n{help_of(name, scripts[name])}```" for name in sorted(scripts)]
    return "\n\n".join(["# Commands", *texts])


def help_of(name: str, target: str) -> str:
    """The text that a command prints for `--help`."""
    main, printed = EntryPoint(name, target, "console_scripts").load(), io.StringIO()
    with (
        redirect_stdout(printed),
        suppress(SystemExit),
        patch.object(sys, "argv", [name, "--help"]),
        patch.dict("os.environ", COLUMNS="100"),
    ):
        main()
    return printed.getvalue()


def board(root: Path) -> dict[str, str | bytes]:
    """The pages, the table and those films that `constructskill-board` made, and a page that leads to them."""
    with TemporaryDirectory() as folder:
        out = Path(folder)
        (out / FILMS).symlink_to(root / "outputs" / "board" / FILMS)
        pages = write_board(root / "board", out, documentation="../docs/leaderboard.html")
        films = {out / path for page in pages for path in re.findall(rf'href="({FILMS}/[^"]+)"', page.read_text())}
        made = [*pages, out / TABLE, *sorted(films)]
        files: dict[str, str | bytes] = {f"board/{path.relative_to(out)}": path.read_bytes() for path in made}
    suites = "\n".join(
        f"- [`{name}`](../board/{name}.html): {', '.join(BOARD_SUITES[name].settings)}" for name in BOARD_SUITES
    )
    files["site/board.md"] = (
        "# The board\n\nA page for each suite, with every entry's interval over training seeds and the outcome of "
        f"every episode:\n\n{suites}\n\n[All entries](../board/index.html), and every episode of them as "
        f"[one table](../board/{TABLE}). How an entry is made and checked: [Leaderboard](../docs/leaderboard.md)."
    )
    return files
