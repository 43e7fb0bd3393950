"""The rooms of the package and their revisions: whatever decides bytes is in a room, and no change goes unrecorded."""

import json
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml

from lerobot_constructskill.artifacts import revisions as module
from lerobot_constructskill.artifacts.code import code_of
from lerobot_constructskill.artifacts.revisions import PACKAGE, TABLE, read_table, revisions, sources
from lerobot_constructskill.errors import InputError, MachineError

INERT = {
    *("__init__.py", "py.typed", "plugin.py", "analysis", "artifacts", "board", "comparison", "dataset", "scripts"),
    # What these make of a user's words stands in specifications, and what they refuse is not made.
    *(
        "bounds.py",
        "errors.py",
        "files.py",
        "parsing.py",
        "policy_types.py",
        "presets.py",
        "progress.py",
        "threads.py",
    ),
    *(
        f"study/{name}.py"
        for name in ("__init__", "estimates", "plan", "rows", "session", "spec", "status", "table", "timing")
    ),
    *("features/__init__.py", "study/validate.py"),  # the latter measures by `rollout`
    *("plans/ifc.py", "plans/picture.py"),
}
"""Files and folders that cannot change the bytes of anything that is made."""

REPOSITORY = Path(__file__).parents[2]
DEMOS = "lerobot_constructskill.demos.expert"


@pytest.fixture
def copy(tmp_path, monkeypatch) -> Path:
    """A copy of the package, in which files may be edited, and whose revisions are told."""
    folder = tmp_path / "lerobot_constructskill"
    shutil.copytree(PACKAGE, folder, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(module, "PACKAGE", folder)
    monkeypatch.setattr(module, "LOOKED_AT_S", 1e-9)
    monkeypatch.setattr(module, "TABLE", folder / TABLE.relative_to(PACKAGE))
    return folder


def edit(path: Path, before: str, after: str) -> None:
    text = path.read_text()
    assert before in text
    path.write_text(text.replace(before, after, 1))


def test_every_file_is_in_one_room_or_decides_nothing():
    held = [path for room in read_table().values() for path in paths_of(room)]
    inert = {path for path in PACKAGE.rglob("*") if any((PACKAGE / one) in (path, *path.parents) for one in INERT)}
    every = {path for path in PACKAGE.rglob("*") if path.is_file() and "__pycache__" not in path.parts}
    assert len(held) == len({*held}) and not inert & {*held}
    assert not every - inert - {*held}, "put them into a room of revisions.json, or say why they decide nothing"


def test_no_change_of_a_room_is_unrecorded():
    changed = [name for name, room in read_table().items() if sources(room) != room["sources"]]
    recorder = "python -m lerobot_constructskill.artifacts.revisions"
    assert not changed, f"record it: {recorder} --raise ROOM, if it makes other bytes, or --keep ROOM"


def test_a_room_stands_on_what_it_imports():
    sys.path.insert(0, str(REPOSITORY / "tests"))
    from test_architecture import SOURCES, imports

    rooms = read_table()
    room_of = {path: name for name, room in rooms.items() for path in paths_of(room)}
    for name, room in rooms.items():
        told = {one.removeprefix("constructskill.") for one in revisions(*(dotted(path) for path in paths_of(room)))}
        targets = {found.target for path in paths_of(room) if path.suffix == ".py" for found in imports(path)}
        met = {room_of.get(SOURCES[target]) for target in targets if target in SOURCES} - {None}
        assert met <= told | {*room["takes"]}, name
        assert {*room["stands_on"], *room["takes"]} <= rooms.keys() and name in told


def paths_of(room) -> list[Path]:
    return [PACKAGE / name for name in sources(room)]


def dotted(path: Path) -> str:
    return ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)


def test_tests_hold_what_a_room_makes():
    assert all(room["held_by"] for room in read_table().values())
    assert all((REPOSITORY / test).is_file() for room in read_table().values() for test in room["held_by"])


@pytest.mark.parametrize(
    ("before", "after", "counts"),
    [
        ('"""', '"""Said otherwise. ', False),
        ("import numpy as np\n", "import numpy as np  # for arrays\n\n\n", False),
        ("    gain: Gain = 1.0", "    gain: float = 1.0", True),
        ("    gain: Gain = 1.0", "    gain: Gain = 1.1", True),
    ],
    ids=["a docstring", "a comment", "an annotation", "a number"],
)
def test_what_is_said_and_laid_out_does_not_count(before, after, counts, copy):
    as_it_was = revisions(DEMOS)
    edit(copy / "demos" / "expert.py", before, after)
    now = revisions(DEMOS)
    assert {name for name in now if now[name] != as_it_was[name]} == ({"constructskill.demos"} if counts else set())
    assert now["constructskill.demos"].endswith(", edited: demos/expert.py") == counts


def test_a_file_that_is_new_or_gone_is_an_edit(copy):
    (copy / "demos" / "more.py").write_text("X = 1\n")
    assert revisions(DEMOS)["constructskill.demos"].endswith(", edited: demos/more.py")
    (copy / "demos" / "more.py").write_text("X = [\n")
    assert revisions(DEMOS)["constructskill.demos"].endswith(", edited: demos/more.py"), "half written"
    (copy / "demos" / "more.py").rename(copy / "demos" / ".more.py.swp")
    assert "edited" not in revisions(DEMOS)["constructskill.demos"], "of an editor"
    (copy / "demos" / "link.py").symlink_to("nowhere.py")
    assert "edited" not in revisions(DEMOS)["constructskill.demos"], "a link to nothing"
    (copy / "demos" / "state.py").unlink()
    assert revisions(DEMOS)["constructskill.demos"].endswith(", edited: demos/state.py")


def test_an_edit_is_seen_in_a_second(copy, monkeypatch):
    monkeypatch.undo()
    monkeypatch.setattr(module, "PACKAGE", copy)
    before = revisions(DEMOS)
    edit(copy / "demos" / "expert.py", "    gain: Gain = 1.0", "    gain: Gain = 1.1")
    time.sleep(module.LOOKED_AT_S)
    assert revisions(DEMOS) != before


def test_a_renamed_variable_costs_nothing_once_it_is_recorded(copy):
    before = revisions(DEMOS)
    edit(copy / "demos" / "expert.py", "    module, name = task", "    module, called = task")
    edit(copy / "demos" / "expert.py", "import_module(module), name)", "import_module(module), called)")
    assert revisions(DEMOS) != before
    module.main(["--keep", "demos"])
    assert revisions(DEMOS) == before


def test_a_raised_revision_is_another_one(copy, capsys):
    before = revisions(DEMOS)
    module.main(["--raise", "demos"])
    assert {name for name, one in revisions(DEMOS).items() if one != before[name]} == {"constructskill.demos"}
    assert capsys.readouterr().out == "recorded\n"
    with pytest.raises(SystemExit):
        module.main(["--raise", "kitchen"])
    assert "there is no room 'kitchen'; the rooms are: contract, sim, envs" in capsys.readouterr().err


def test_a_table_that_does_not_fit_is_one_sentence(copy):
    shutil.move(copy / "sim", copy / "sims")
    with pytest.raises(MachineError, match=r"sim, of the table of revisions, is not there: install the package again"):
        revisions(DEMOS)
    table = copy / TABLE.relative_to(PACKAGE)
    table.write_text(json.dumps({"sim": {"holds": "sim"}}))
    with pytest.raises(InputError, match="is not a table of revisions: sim.holds: Input should be a valid array"):
        revisions(DEMOS)


@pytest.mark.parametrize("python", ["3.12", "3.13", "3.14"])
def test_another_python_has_the_same_hashes(python):
    """Where there is one: its syntax trees have fields that this one's lack."""
    room = read_table()["demos"]
    code = f"""
from pathlib import Path
from lerobot_constructskill.artifacts.revisions import _hash, stamp
print({{name: _hash(*stamp(Path({str(PACKAGE)!r}) / name)) for name in {sorted(room["sources"])}}})
"""
    found = [*sorted(Path.home().glob(f".pyenv/versions/{python}.*/bin/python")), f"python{python}"]
    starts = [one for one in found if shutil.which(one) and not subprocess.run([one, "-c", ""]).returncode]
    if not starts:  # of pyenv, there are also stand-ins for what a folder has not chosen
        pytest.skip(f"no Python {python} here")
    surroundings = {"PYTHONPATH": f"{REPOSITORY}:{Path(yaml.__file__).parents[1]}"}
    done = subprocess.run([starts[0], "-c", code], env=surroundings, capture_output=True, text=True)
    assert done.stdout.strip() == str(sources(room)), done.stderr


def test_our_code_is_told_beside_others():
    assert code_of(f"{DEMOS}:Expert", "pathlib") == revisions(DEMOS)
    assert code_of("lerobot_constructskill.bounds", "lerobot.policies") == {}
