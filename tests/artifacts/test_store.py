"""A store: every node is made once, with what it is made of, found by what made it, and whole or not there."""

import json
import multiprocessing
import os
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from errno import ENOSPC
from functools import cached_property
from pathlib import Path

import pytest

from lerobot_constructskill.artifacts import store as module
from lerobot_constructskill.artifacts.code import code_of
from lerobot_constructskill.artifacts.differences import _code_now, differences, outdated
from lerobot_constructskill.artifacts.digests import digest
from lerobot_constructskill.artifacts.failures import Failure
from lerobot_constructskill.artifacts.store import LOG, SPEC, Machine, Node, Store
from lerobot_constructskill.errors import InputError, MachineError, MissingError

CODE = {"numpy": "1"}
"""What the things are made by; a test edits it."""


class UnsendableError(Exception):
    """An exception that another process cannot read, as those of some HTTP clients."""

    def __init__(self, status: int, *, reason: str):
        super().__init__(f"{status} {reason}")


@dataclass(frozen=True, eq=False)
class Thing(Node):
    """Text of its name and of the things that it is made of."""

    name: str
    made_of: tuple["Thing", ...] = ()
    seconds: float = 0.0
    is_passing: bool = False
    is_single_threaded: bool = False

    kind = "things"
    keeps = "parts"

    def facts(self):
        return {"name": self.name, "many": [1, 2]}

    def versions(self):
        return dict(CODE)

    @cached_property
    def inputs(self):
        return {one.name: one for one in self.made_of}

    def make(self, folder: Path, inputs: Mapping[str, Path], machine: Machine) -> None:
        folder.mkdir()
        time.sleep(self.seconds)
        match self.name.split()[0]:
            case "bad":
                raise KeyError(self.name)
            case "unsendable":
                raise UnsendableError(404, reason="not found")
            case "full":
                try:
                    raise OSError(ENOSPC, "No space left on device")
                except OSError as error:
                    raise ValueError("An error occurred while generating the dataset") from error
            case "dies":
                os._exit(9)
        texts = [(root / "text").read_text() for root in inputs.values()]
        (folder / "text").write_text(f"{self.name}({', '.join(texts)})")


ONE, OTHER = Thing("one"), Thing("other")
BOTH = Thing("both", (ONE, OTHER))


@pytest.fixture
def store(tmp_path):
    return Store(tmp_path / "store")


def text(store: Store, node: Node) -> str:
    return (store.folder(node) / "text").read_text()


def test_a_digest_knows_content_and_no_order():
    assert digest({"a": 1, "b": 2}) == digest({"b": 2, "a": 1}) != digest({"a": 1, "b": 3})
    assert ONE == Thing("one", seconds=3) != OTHER and len({ONE, OTHER, Thing("one")}) == 2
    assert BOTH != Thing("both", (OTHER,)) != Thing("both")


def test_a_node_is_made_once_and_so_is_what_it_is_made_of(store):
    folder = store.get(BOTH)
    times = {path: path.stat().st_mtime_ns for path in store.root.glob("things/*/text")}
    assert text(store, BOTH) == "both(one(), other())" and len(times) == 3
    assert store.get(Thing("next", (BOTH,))) and all(path.stat().st_mtime_ns == at for path, at in times.items())
    spec = json.loads((folder / SPEC).read_text())
    lineage = spec.pop("lineage")
    assert spec == BOTH.spec and lineage == {one.digest: one.spec for one in (ONE, OTHER)}


def test_what_is_there_needs_nothing_of_what_it_was_made_of(store):
    store.get(BOTH)
    with store.claim([ONE]):
        store.discard(ONE)
    assert store.get(BOTH) and not store.has(ONE)
    assert store.get(Thing("third", (ONE,))) and store.has(ONE)


@pytest.mark.slow
def test_what_two_processes_want_is_made_by_one(store):
    context = multiprocessing.get_context("spawn")
    slow = Thing("slow", (replace(ONE, seconds=0.3),), seconds=0.3)
    processes = [context.Process(target=store.get, args=(slow,)) for _ in range(3)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    assert [process.exitcode for process in processes] == [0, 0, 0] and text(store, slow) == "slow(one())"


def test_a_node_that_is_named_twice_is_claimed_once(store):
    with store.claim([ONE, OTHER, ONE]) as missing:
        assert missing == [ONE, OTHER]


def test_a_failure_leaves_nothing_but_its_log(store):
    bad = Thing("bad", (ONE,))
    with pytest.raises(KeyError):
        store.get(bad)
    assert store.has(ONE) and not store.has(bad) and [*store.root.glob("things/*")] == [store.folder(ONE)]
    store.note(OTHER, Failure.of(KeyError("half")))
    assert "KeyError: 'half'" in store.log(OTHER).read_text()
    store.get(OTHER)
    assert "KeyError" in (store.folder(OTHER) / LOG).read_text() and not store.log(OTHER).exists()


@pytest.fixture(params=[False, True], ids=["one after another", "side by side"])
def several(request, monkeypatch):
    """Things of some names, all made of one; they are made in one of two ways."""
    monkeypatch.setattr(module, "cores", lambda: 2)
    return lambda *names: [replace(Thing(name, (ONE,)), is_single_threaded=request.param) for name in names]


@pytest.mark.slow
def test_of_several_those_that_can_be_made_are(several, store):
    good, bad, unsendable, full = several("good", "bad", "unsendable", "full")
    lost = replace(Thing("lost", (Thing("bad input"),)), is_single_threaded=good.is_single_threaded)
    failed = store.get_all([good, bad, unsendable, full, lost, good], Machine())
    assert {one: failure.said for one, failure in failed.items()} == {
        bad: "KeyError: 'bad'",
        unsendable: "UnsendableError: 404 not found",
        full: "ValueError: An error occurred while generating the dataset",
        lost: "KeyError: 'bad input'",
    }
    assert [one for one, failure in failed.items() if failure.is_of_the_machine] == [full]
    assert all(failure.said in failure.traceback and "in make" in failure.traceback for failure in failed.values())
    assert text(store, good) == "good(one())"


def test_what_several_lack_is_tried_once(several, store, monkeypatch):
    tried, get = [], Store._make
    monkeypatch.setattr(Store, "_make", lambda self, node, machine: tried.append(node) or get(self, node, machine))
    lacking = Thing("bad input")
    failed = store.get_all([replace(one, made_of=(lacking,)) for one in several("a", "b", "c")], Machine())
    assert len(failed) == 3 and tried == [lacking]


@pytest.mark.slow
def test_a_process_that_dies_is_the_machines_failure_of_what_it_made_and_of_nothing_else(store, monkeypatch):
    monkeypatch.setattr(module, "cores", lambda: 2)
    dies, slow = (Thing(name, seconds=at, is_single_threaded=True) for name, at in (("dies", 0.5), ("slow", 1)))
    failed = store.get_all([dies, slow], Machine())
    assert {one: failure.is_of_the_machine for one, failure in failed.items()} == {dies: True}
    assert text(store, slow) == "slow()", "it was made by a second process"


def test_what_is_passing_goes_with_what_it_was_for(store):
    passing = Thing("passing", (ONE,), is_passing=True)
    assert store.get(Thing("whole", (passing,))) and text(store, Thing("whole", (passing,))) == "whole(passing(one()))"
    with pytest.raises(KeyError):
        store.get(Thing("bad", (passing,)))
    assert store.has(ONE) and not store.has(passing)
    assert {path.name for path in store.root.glob("things/*")} == {ONE.digest, Thing("whole", (passing,)).digest}


def test_what_is_passing_stays_while_anything_is_made_of_it(store):
    passing = Thing("passing", (ONE,), is_passing=True)
    whole, slow = Thing("whole", (passing,)), Thing("slow", (passing,), seconds=0.5)
    store.get(whole)
    other = threading.Thread(target=store.get, args=(slow,))
    other.start()
    time.sleep(0.2)
    store.get(whole)  # which is there
    other.join()
    assert text(store, slow) == "slow(passing(one()))"


def test_a_hundred_times_made_of_each_other_is_no_deeper_than_once(store):
    top = ONE
    for number in range(200):
        top = Thing(f"{number}", (top,))
        assert top.digest
    store.get(replace(top))
    assert len(top.lineage) == 200


def test_what_is_made_of_itself_is_one_sentence(store):
    circle = Thing("circle")
    object.__setattr__(circle, "made_of", (circle,))
    with pytest.raises(InputError, match="^One of the things is made of itself.$"):
        store.get(circle)


def test_code_that_is_edited_while_it_is_at_work_makes_nothing(store, monkeypatch):
    node = Thing("edited")
    assert node.digest
    monkeypatch.setitem(CODE, "numpy", "2")
    with pytest.raises(MachineError, match="numpy is not what it was when this began"):
        store.get(node)
    assert not store.has(node) and store.get(Thing("edited"))


def test_something_else_in_its_place_is_one_sentence(store):
    folder = store.folder(ONE)
    for content in (None, "not JSON", json.dumps({"a": 7}), json.dumps(ONE.spec | {"name": "two"})):
        folder.mkdir(parents=True, exist_ok=True)
        if content:
            (folder / SPEC).write_text(content)
        with pytest.raises(ValueError, match="move it away") as refused:
            store.get(ONE)
        assert "\n" not in str(refused.value) and str(folder) in str(refused.value)


def test_what_is_discarded_is_made_anew(store):
    store.get(ONE)
    for _ in range(2):  # the second time there is nothing to discard
        with store.claim([ONE]):
            store.discard(ONE)
    assert not store.has(ONE) and store.get(ONE) and store.has(ONE)


def test_it_is_told_what_differs_from_what_was_made_before(store, monkeypatch):
    before = json.loads((store.get(BOTH) / SPEC).read_text())
    assert differences(before, BOTH) == []
    assert differences(before, Thing("both", (ONE, Thing("third")))) == ["third"]
    assert differences(before, Thing("wrong", (Thing("one", (OTHER,)), OTHER))) == ["name", "one.other"]
    monkeypatch.setitem(CODE, "numpy", "2")
    assert differences(before, Thing("both", (Thing("one"), Thing("other")))) == ["numpy"]


@pytest.mark.parametrize(("name", "module"), [("PyYAML", "yaml"), ("written_by_hand", "written_by_hand")])
def test_a_package_is_found_by_its_distribution_or_its_own_name(name, module, tmp_path, monkeypatch):
    """An editable installation may list no packages."""
    (tmp_path / "written_by_hand.py").write_text("HERE = 1\n")
    monkeypatch.syspath_prepend(tmp_path)
    code = code_of(module)[name]
    assert "source " in code and _code_now(name, code) == code


def test_a_folder_of_a_store_tells_what_it_was_made_by(store, tmp_path, monkeypatch):
    for name, version in (("numpy", "1"), ("constructskill.sim", "before"), ("not_installed", "1")):
        monkeypatch.setitem(CODE, name, version)
    folder = store.get(Thing("both", (Thing("one"),)))
    assert {*outdated(folder)} == {"numpy", "constructskill.sim", "not_installed"}
    with pytest.raises(MissingError, match="no folder of a store"):
        outdated(tmp_path)
    (folder / SPEC).write_text("{}")
    with pytest.raises(InputError, match="versions: it is missing"):
        outdated(folder)
