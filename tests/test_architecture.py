"""The rooms of the package and the arrows between them, read from the sources: imports run downward only."""

import ast
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = "lerobot_constructskill"
ROOT = Path(__file__).parents[1] / PACKAGE
SIMULATOR = {"sapien", "mani_skill", "mplib"}

# What a room, or a file with a row of its own, may import of ours, a room or a file of one; its own room and
# these six go without saying.
EVERYWHERE = ("bounds", "errors", "files", "lerobot_internals", "progress", "threads")
ARROWS = {
    "bounds": (),
    "errors": (),
    "files": (),
    "lerobot_internals": (),
    "progress": (),
    "threads": (),
    "presets": (),
    "parsing": ("presets",),
    "policy_types": ("parsing",),
    "other_tasks": (),
    "wordings": (),
    "contract": ("other_tasks", "wordings"),
    "cameras": ("contract",),
    "interface": ("cameras", "contract"),
    "artifacts": (),
    "policies": (),
    "perturbations": ("contract",),
    "plans": ("contract", "presets"),
    "sim": ("contract", "perturbations", "plans"),
    "envs": ("contract", "interface", "perturbations", "plans"),
    "envs.actions": ("contract",),
    "envs.recording": ("artifacts", "contract", "perturbations"),
    "plugin": ("envs", "policies"),
    "demos": ("artifacts", "contract", "interface", "plans"),
    "demos.demonstrate": ("contract", "envs"),
    "demos.node": ("artifacts", "envs"),
    "demos.shards": ("artifacts", "contract", "envs"),
    "dataset": ("artifacts", "contract", "demos", "interface", "parsing", "training.recipe"),
    "features": ("artifacts", "cameras", "contract", "policies"),
    "features.trainer": ("artifacts", "policies", "training"),
    "rollout": ("contract",),
    "rollout.agents": ("contract", "policy_types"),
    "rollout.lockstep": ("artifacts.pools", "contract", "envs", "perturbations", "plans"),
    "rollout.references": ("contract", "demos"),
    "rollout.simulators": ("artifacts", "envs"),
    "training": ("artifacts",),
    "training.checkpoints": ("artifacts", "contract"),
    "training.heldout": ("artifacts", "rollout"),
    "training.recipe": ("contract",),
    "training.trainers": ("artifacts", "policy_types"),
    "dagger": ("artifacts", "contract", "demos", "envs", "parsing", "rollout", "training"),
    "study": ("artifacts", "training"),
    "study.rows": ("artifacts", "envs.recording"),
    "study.spec": ("artifacts", "training"),
    "study.plan": ("contract", "dagger", "demos", "envs", "parsing", "policy_types", "rollout", "training"),
    "study.runs": (
        "artifacts",
        "contract",
        "dagger",
        "demos",
        "envs",
        "perturbations",
        "plans",
        "rollout",
        "training",
    ),
    "board": ("contract", "perturbations"),
    "board.submission": ("artifacts", "contract", "envs.recording", "perturbations"),
    "board.verification": ("artifacts", "envs.recording"),
    "board.copies": ("contract", "envs.actions", "envs.recording"),
    "board.recipe": ("contract", "presets", "study.rows"),
    "board.explained": ("analysis.stats", "contract", "perturbations"),
    "board.retrain": ("artifacts", "contract", "envs.recording", "parsing", "study"),
    "board.from_recordings": ("envs.recording", "study.rows"),
    "board.replay": ("artifacts", "envs"),
    "board.rerun": ("analysis.stats", "contract"),
    "board.recovered": ("artifacts", "envs.recording"),
    "board.causes": ("demos",),
    "board.forks": ("artifacts",),
    "board.takeover": ("contract", "demos", "envs"),
    "board.recover": ("demos", "envs"),
    "board.losses": ("analysis.report.formats", "analysis.stats"),
    "board.films": ("artifacts", "contract"),
    "board.entries": ("analysis.stats", "contract", "plans"),
    "board.exports": ("artifacts", "contract"),
    "board.site": ("analysis.report.formats", "artifacts", "contract"),
    "analysis": (),
    "analysis.stats": ("study.rows",),
    "analysis.report": ("artifacts", "parsing", "presets", "study.rows", "study.spec", "study.timing"),
    "comparison": (
        "analysis.report.formats",
        "analysis.stats",
        "contract",
        "envs.recording",
        "perturbations",
        "study.rows",
    ),
    "comparison.evaluate": ("contract", "envs.recording", "rollout", "training"),
    "scripts": (
        "analysis",
        "artifacts",
        "board",
        "comparison",
        "contract",
        "dagger",
        "dataset",
        "demos",
        "envs",
        "features",
        "parsing",
        "plans",
        "policies",
        "presets",
        "rollout",
        "study",
        "training.recipe",
    ),
}
# Arrows of functions: the simulator is born on first use.
LAZY_ARROWS = {"envs": ("sim",)}

# Files that name every package they may import.
EXTERNALS = {
    "bounds": {"torch"},
    "errors": set(),
    "files": {"pyarrow", "pydantic", "yaml"},
    "lerobot_internals": set(),
    "progress": {"av", "tqdm"},
    "threads": {"torch"},
    "other_tasks": set(),
    "wordings": set(),
    "contract": set(),
    "cameras": {"numpy"},
    "interface": {"numpy"},
    "presets": set(),
    "perturbations": set(),
    "artifacts": {"ray"},
    "artifacts.tables": {"pyarrow"},
    "board": {"huggingface_hub", "jinja2", "markupsafe", "numpy", "pandas", "pyarrow", "yaml"},
    "comparison": {"numpy", "pandas"},
    "analysis": set(),
    "analysis.stats": {"numpy", "pandas", "scipy", "statsmodels"},
    "analysis.report": {"PIL", "jinja2", "markupsafe", "matplotlib", "numpy", "pandas"},
}


@dataclass(frozen=True)
class Import:
    """One imported module, absolute; `eager` where importing the file runs it."""

    target: str
    eager: bool


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


SOURCES = {module_name(path): path for path in sorted(ROOT.rglob("*.py"))}


def targets(node: ast.Import | ast.ImportFrom, path: Path) -> Iterator[str]:
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
        return
    base = node.module or ""
    if node.level:
        package = path.relative_to(ROOT.parent).parent.parts
        base = ".".join((*package[: len(package) - node.level + 1], *filter(None, [base])))
    for alias in node.names:
        inner = f"{base}.{alias.name}"
        yield inner if inner in SOURCES else base


def is_type_checking(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)


def imports(path: Path, node: ast.AST | None = None, eager: bool = True) -> Iterator[Import]:
    for child in ast.iter_child_nodes(node or ast.parse(path.read_text())):
        if isinstance(child, ast.Import | ast.ImportFrom):
            yield from (Import(target, eager) for target in targets(child, path))
        else:
            lazy = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda) or is_type_checking(child)
            yield from imports(path, child, eager and not lazy)


def row(module: str, table: dict) -> str | None:
    """The longest entry of a table that a module lies in."""
    inner = module.removeprefix(f"{PACKAGE}.")
    return max((key for key in table if f"{inner}.".startswith(f"{key}.")), key=len, default=None)


def room(module: str) -> str:
    return module.removeprefix(PACKAGE).removeprefix(".").split(".")[0]


def is_ours(target: str) -> bool:
    return target.split(".")[0] == PACKAGE


@pytest.mark.parametrize("module", SOURCES)
def test_arrows_point_downward(module: str) -> None:
    own = row(module, ARROWS)
    assert own is not None or module == PACKAGE, f"{module} is in no room of the table"
    for found in imports(SOURCES[module]):
        if not is_ours(found.target) or room(found.target) in (room(module), *EVERYWHERE):
            continue
        allowed = (*ARROWS[own], *(() if found.eager else LAZY_ARROWS.get(own, ())))
        assert row(found.target, dict.fromkeys(allowed)), f"{module} imports {found.target}"


def test_every_arrow_is_in_use() -> None:
    """Nor is any package listed that nobody imports."""
    used: set[tuple[str, str | None]] = set()
    for module, path in SOURCES.items():
        if own := row(module, ARROWS):
            allowed = dict.fromkeys((*ARROWS[own], *LAZY_ARROWS.get(own, ())))
            used |= {(own, row(found.target, allowed)) for found in imports(path) if is_ours(found.target)}
        if own := row(module, EXTERNALS):
            used |= {(own, found.target.split(".")[0]) for found in imports(path)}
    tables = (ARROWS, LAZY_ARROWS, EXTERNALS)
    assert not {(own, one) for table in tables for own, those in table.items() for one in those} - used


@pytest.mark.parametrize("module", SOURCES)
def test_simulator_stays_in_its_room(module: str) -> None:
    names = {found.target.split(".")[0] for found in imports(SOURCES[module])}
    assert room(module) == "sim" or not names & SIMULATOR


@pytest.mark.parametrize("module", [module for module in SOURCES if row(module, EXTERNALS)])
def test_listed_externals_only(module: str) -> None:
    names = {found.target.split(".")[0] for found in imports(SOURCES[module]) if not is_ours(found.target)}
    assert names <= EXTERNALS[row(module, EXTERNALS)] | set(sys.stdlib_module_names)


def test_a_policy_is_read_through_the_door_that_loads_plugins() -> None:
    """Whoever read one by LeRobot alone would not know the policies of others, unless they were imported before."""
    by_lerobot = ("PreTrainedConfig.from_pretrained", "decode(PreTrainedConfig", "register_third_party_plugins()")
    texts = {module: path.read_text() for module, path in SOURCES.items()}
    readers = {module for module, text in texts.items() if any(one in text for one in by_lerobot)}
    doctor = f"{PACKAGE}.scripts.doctor"  # whose script looks at LeRobot's own discovery
    assert readers == {f"{PACKAGE}.policy_types", doctor}


def test_no_room_meets_environments_and_policies() -> None:
    rooms = {
        module: {room(found.target) for found in imports(path) if is_ours(found.target)}
        for module, path in SOURCES.items()
        if room(module) in ("demos", "dataset", "features", "envs", "policies")
    }
    both = {module for module, met in rooms.items() if {"envs", "policies"} <= met | {room(module)}}
    assert not both


INERT = [module for module, path in SOURCES.items() if path.name == "__init__.py" and path.parent.name != "sim"]
"""All but the simulator's, which names Vulkan's drivers before any of its modules can import SAPIEN."""


@pytest.mark.parametrize("module", INERT)
def test_init_is_inert(module: str) -> None:
    body = ast.parse(SOURCES[module].read_text()).body
    assert not [node for node in body if not (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant))]


def test_every_folder_is_a_package() -> None:
    assert not [path for path in SOURCES.values() if not (path.parent / "__init__.py").is_file()]


def test_no_import_circle() -> None:
    graph = {
        module: {found.target for found in imports(path) if found.target in SOURCES} - {PACKAGE}
        for module, path in SOURCES.items()
    }
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(f"import circle: {' -> '.join(error.args[1])}")
