"""A store: everything is made once, found by what made it, and whole or not there."""

import json
import multiprocessing
import time

import pytest

from lerobot_constructskill.artifacts.digests import digest
from lerobot_constructskill.artifacts.store import LOG, SPEC, Artifact, Store

ONE, OTHER = Artifact("things", {"a": 1, "b": [1, 2]}), Artifact("things", {"a": 2, "b": [1, 2]})


@pytest.fixture
def store(tmp_path):
    return Store(tmp_path / "store")


def make(store, artifact, seconds=0.0):
    """Make an artefact if it is missing, and say whether it was."""
    with store.claim([artifact]) as missing:
        for one in missing:
            with store.writing(one) as folder:
                folder.mkdir()
                time.sleep(seconds)
                (folder / "content").write_text("made")
        return bool(missing)


def test_a_digest_knows_content_and_no_order():
    assert digest({"a": 1, "b": 2}) == digest({"b": 2, "a": 1}) != digest({"a": 1, "b": 3})
    assert ONE.digest != OTHER.digest


def test_a_thing_is_made_once(store):
    assert make(store, ONE) and not make(store, ONE) and make(store, OTHER)
    assert json.loads((store.folder(ONE) / SPEC).read_text()) == ONE.spec
    assert store.has(ONE) and (store.folder(ONE) / "content").read_text() == "made"


def test_what_two_processes_want_is_made_by_one(store):
    context = multiprocessing.get_context("spawn")
    processes = [context.Process(target=make, args=(store, ONE, 0.3)) for _ in range(3)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    assert [process.exitcode for process in processes] == [0, 0, 0] and store.has(ONE)


def test_a_thing_that_is_named_twice_is_claimed_once(store):
    with store.claim([ONE, OTHER, ONE]) as missing:
        assert missing == [ONE, OTHER]


def test_a_failure_leaves_nothing_but_its_log(store):
    with pytest.raises(KeyError), store.claim([ONE]), store.writing(ONE) as folder:
        folder.mkdir()
        raise KeyError("half")
    assert not store.has(ONE) and not list((store.root / "things").iterdir())
    store.note(ONE, KeyError("half"))
    assert "KeyError: 'half'" in store.log(ONE).read_text()
    make(store, ONE)
    assert "KeyError" in (store.folder(ONE) / LOG).read_text() and not store.log(ONE).exists()


def test_something_else_in_its_place_is_one_sentence(store):
    folder = store.folder(ONE)
    for content in (None, "not JSON", json.dumps({"a": 7})):
        folder.mkdir(parents=True, exist_ok=True)
        if content:
            (folder / SPEC).write_text(content)
        with pytest.raises(ValueError, match="move it away") as refused:
            store.has(ONE)
        assert "\n" not in str(refused.value) and str(folder) in str(refused.value)


def test_what_is_discarded_is_made_anew(store):
    make(store, ONE)
    with store.claim([ONE]):
        store.discard(ONE)
    assert not store.has(ONE) and make(store, ONE)
