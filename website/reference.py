"""Pages of the reference: the fields of every command as it parses them, and the Python interface by mkdocstrings."""

import argparse
import re
import sys
import tomllib
from importlib import import_module
from pathlib import Path
from unittest.mock import patch

from griffe import Docstring

INTERFACE = {
    "Contract": ["contract"],
    "Environments": ["plugin", "envs.configuration_constructskill", "envs.gym_env", "perturbations"],
    "Policy": [
        "policies.frozen_vit.configuration_frozen_vit.FrozenViTChunkConfig",
        "policies.frozen_vit.modeling_frozen_vit.FrozenViTChunkPolicy",
    ],
    "Demonstrations": ["demos.expert", "demos.pick_place", "demos.precise", "demos.noise", "demos.recorder"],
    "Rollouts": ["rollout.agents", "rollout.lockstep", "rollout.references"],
    "Studies": ["study.spec", "training.recipe", "training.trainers", "study.rows"],
    "Statistics": [
        f"analysis.stats.{name}" for name in ("outcomes", "intervals", "comparisons", "correlation", "power", "spread")
    ],
}
"""What is public: a page's title to the modules and classes on it."""


class SeenError(BaseException):
    """Carries a command's parser out of it, past whatever handles its errors."""


def pages(root: Path) -> dict[str, str]:
    """Name of a page to its Markdown."""
    project = tomllib.loads((root / "pyproject.toml").read_text())["project"]
    python = {
        f"site/python/{title.lower()}.md": "\n\n".join([f"# {title}", *map(interface, names)])
        for title, names in INTERFACE.items()
    }
    return {"site/install.md": install(root, project), "site/commands.md": commands(project["scripts"]), **python}


def interface(name: str) -> str:
    """mkdocstrings' word for a module or class; of a module that imports others for their effect, the docstring."""
    alone = "\n    options: {members: false}" if name == "plugin" else ""
    return f"::: lerobot_constructskill.{name}{alone}"


def install(root: Path, project: dict) -> str:
    """The README's section, and what each extra brings."""
    section = (root / "README.md").read_text().partition("## Install\n")[2].partition("\n## ")[0]
    extras = [f"| `{name}` | {', '.join(packages)} |" for name, packages in project["optional-dependencies"].items()]
    table = "\n".join(["| extra | packages |", "|---|---|", *extras])
    section = re.sub(r"\]\((?!\w+:|#)", "](../", section)
    return f"# Install\n{section}\n## Extras\n\n{table}\n"


def commands(scripts: dict[str, str]) -> str:
    """A section for each but `constructskill`, which parses nothing and starts the others."""
    head = (
        "# Commands\n\nFields as the commands parse them, with their defaults. `--help` of each says the same; "
        "`constructskill` lists them all, and `constructskill film` is `constructskill-film`.\n"
    )
    return "\n".join([head, *(command(name, scripts[name]) for name in sorted(scripts) if "-" in name)])


def command(name: str, target: str) -> str:
    """A command's section: what it does, and a table for each group of its fields."""
    module = import_module(target.partition(":")[0])
    groups = [group for group in parser_of(module, name)._action_groups if group._group_actions]
    parts = [f"## {name}\n", sentence(module.__doc__.partition(": ")[2].strip())]
    for group in groups:
        about, arguments = described(group.description or "")
        rows = [field(action, arguments) for action in group._group_actions if not is_common(action)]
        if rows:
            parts += [about, "\n".join(["| field | default | meaning |", "|---|---|---|", *dict.fromkeys(rows)])]
    return "\n\n".join(part for part in parts if part) + "\n"


def parser_of(module, name: str) -> argparse.ArgumentParser:
    """The parser that a command's `main` makes."""

    def stop(parser, *_, **__):
        raise SeenError(parser)

    with patch.object(argparse.ArgumentParser, "parse_known_args", stop), patch.object(sys, "argv", [name, "--help"]):
        try:
            module.main()
        except SeenError as seen:
            return seen.args[0]
    raise RuntimeError(f"{name} parses nothing.")


def described(text: str) -> tuple[str, dict[str, str]]:
    """A docstring's prose, and what it says of each argument."""
    prose, arguments = [], {}
    for section in Docstring(_dedented(text)).parse("google", warnings=False):
        if section.kind.value == "text":
            prose.append(section.value)
        elif section.kind.value == "parameters":
            arguments |= {one.name: one.description for one in section.value}
    return "\n\n".join(prose), arguments


def _dedented(text: str) -> str:
    first, _, rest = text.partition("\n")
    margin = min((len(line) - len(line.lstrip()) for line in rest.splitlines() if line.strip()), default=0)
    return "\n".join([first.strip(), *(line[margin:] for line in rest.splitlines())])


def is_common(action: argparse.Action) -> bool:
    return action.dest in ("help", "config_path") or "Config file for" in (action.help or "")


def field(action: argparse.Action, arguments: dict[str, str]) -> str:
    name = action.option_strings[-1] if action.option_strings else action.dest
    said = (action.help or "").replace("%(default)s", "").strip()
    said = said if said else arguments.get(name.rpartition(".")[2].lstrip("-"), "")
    default = "" if action.default in (None, argparse.SUPPRESS) else f"`{action.default}`"
    return f"| `{name}` | {_cell(default)} | {_cell(said)} |"


def _cell(text: str) -> str:
    return re.sub(r"(?<!\\)\|", r"\\|", " ".join(text.split()))


def sentence(text: str) -> str:
    return text[:1].upper() + text[1:]
