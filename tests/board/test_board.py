"""The board's pages and exports, from the committed entries and from small ones of many seeds."""

import json
import shutil
import threading
import time
from dataclasses import replace
from datetime import UTC, datetime
from html.parser import HTMLParser
from pathlib import Path

import hostile
import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml
from markupsafe import escape

from lerobot_constructskill.board import films, verification
from lerobot_constructskill.board.entries import ranks, read_entries
from lerobot_constructskill.board.explained import meaning
from lerobot_constructskill.board.exports import eval_info, write_exports, write_table
from lerobot_constructskill.board.protocol import BOARD_SUITES, HORIZON, STANDARD, BoardSetting
from lerobot_constructskill.board.recovered import Lost, Recovery
from lerobot_constructskill.board.site import write_board
from lerobot_constructskill.board.submission import Claim, read_submission, write_submission
from lerobot_constructskill.contract import SUITES
from lerobot_constructskill.errors import InputError, MissingError

BOARD = Path(__file__).parents[2] / "board"


class Page(HTMLParser):
    """What a page links to and asks for."""

    def __init__(self, text):
        super().__init__()
        self.found = {"id": set(), "href": set(), "src": set()}
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        for name, value in attributes:
            if name in self.found:
                self.found[name].add(value)


@pytest.fixture(scope="module")
def committed():
    """The entries of the board that is kept here."""
    return read_entries(BOARD)[0]


@pytest.fixture(scope="module")
def many(valid, tmp_path_factory):
    """A board: a policy that places with eight of ten training seeds, one that never does, and one of two seeds."""
    root = tmp_path_factory.mktemp("many")
    said = read_submission(valid).declaration
    placed, never = (
        [one for one in read_submission(BOARD / "entries" / name).claims if one.setting == "block_to_bin"]
        for name in ("bins_keypoints", "bins_random")
    )
    for name, seeds, placing, first in (("good", 10, 8, 5006), ("bad", 10, 0, 5006), ("few", 2, 2, 5010)):
        settings = {"block_to_bin": BoardSetting("block_to_bin", episodes=2, first_start=first)}
        claims = [
            Claim(**vars(one) | {"training_seed": seed})
            for seed in range(seeds)
            for one in (placed if seed < placing else never)
            if one.evaluation_seed in settings["block_to_bin"].starts
            and (seed >= placing or one.training_seed == seed)
        ]
        if name == "bad":
            claims[0] = Claim(claims[0].evaluation_seed, setting="block_to_bin", error="<b>out of memory</b>")
        about = replace(said.about, name=f"<script>{name}</script>", observes="pixels")
        told = {"about": about, "backend": said.backend, "versions": said.versions}
        write_submission(
            root / "entries" / name, claims, suite="bins", settings=settings, training_seeds=list(range(seeds)), **told
        )
    return root


@pytest.mark.slow
def test_every_committed_entry_was_replayed_and_is_on_its_page(committed, tmp_path):
    texts = {path.stem: path.read_text() for path in write_board(BOARD, tmp_path, "alice/bench")}
    pages = {name: Page(text) for name, text in texts.items()}
    for name, suite in BOARD_SUITES.items():
        shown = [one for entry in committed if entry.declaration.suite == name for one in entry.standings]
        assert texts[name].count('class="interval"') == len(shown)
        assert all(str(escape(meaning(one))) in texts[name] for one in suite.settings.values())
        assert len(pages[name].found["src"]) >= len({one.task for one in suite.settings.values()})
    others = json.loads((tmp_path / "exports" / "leaderboard.json").read_text())
    assert committed and pages.keys() == {"index", *BOARD_SUITES}
    for entry in committed:
        assert entry.level == "replayed"
        assert entry.name in pages[entry.declaration.suite].found["id"]
        path = tmp_path / "exports" / entry.name / ".eval_results/constructskill.yaml"
        official = entry.declaration.settings_class == "standard" and not entry.is_reference
        tasks = [f"{entry.declaration.suite}_{one}" for one in entry.standings] if official else []
        results = yaml.safe_load(path.read_text()) if path.exists() else []
        assert [one["dataset"]["task_id"] for one in results] == tasks
        assert all(list(one) == ["dataset", "value", "notes"] for one in results), "in the order of the Hub's page"
        assert official == any(one["model"] == entry.name for one in others["results"])
    for page in pages.values():
        links = {link for link in page.found["href"] if not link.startswith(("#", "data:"))}
        assert all(source.startswith("data:image/jpeg;base64,") for source in page.found["src"])
        assert all((tmp_path / link).is_file() for link in links)
        assert {link[1:] for link in page.found["href"] if link.startswith("#")} <= page.found["id"]
    table = pq.read_table(tmp_path / "board.parquet")
    assert table.num_rows == sum(len(entry.submission.claims) for entry in committed)
    for few in ([], [entry for entry in committed if entry.is_reference][:1]):
        write_table(few, tmp_path / "few.parquet")
        assert pq.read_schema(tmp_path / "few.parquet").equals(table.schema), "whatever entries there are"


@pytest.mark.nightly
@pytest.mark.parametrize("width", [390, 1280])
def test_only_tables_scroll_sideways_and_all_pages_lead_back(width, tmp_path, browser):
    page = browser.new_page(viewport={"width": width, "height": 844})
    for path in write_board(BOARD, tmp_path, documentation="../docs/leaderboard.html"):
        page.goto(path.as_uri())
        assert page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth") == 0
        assert page.locator('a[href="../docs/leaderboard.html"]').is_visible()
        assert page.evaluate("[...document.images].every(image => image.naturalWidth > 0)")
    page.close()


def test_ranks_are_of_seeds_and_ties_are_ties(many):
    claimed, _ = read_entries(many)
    assert ranks(claimed, "block_to_bin") == {}, "an unchecked entry would push others down"
    entries = [replace(entry, level="replayed") for entry in claimed]
    assert ranks(entries, "block_to_bin") == {"good": (1, False), "bad": (2, False)}
    good = next(entry for entry in entries if entry.name == "good")
    standing = good.standings["block_to_bin"]
    assert standing.placed.value == 0.8 and 0 < standing.placed.low < 0.8 < standing.placed.high < 1
    bad, few = (next(entry for entry in entries if entry.name == name) for name in ("bad", "few"))
    assert bad.standings["block_to_bin"].errors == 1 and bad.standings["block_to_bin"].placed.value == 0
    assert few.missing_seeds == 8 and not few.is_ranked
    unseen = replace(good.submission, declaration=replace(good.declaration, backend="physx_cuda, gpu rendering"))
    assert not replace(good, submission=unseen).is_ranked, "nobody can replay it"
    twin = replace(good, name="twin")
    assert ranks([good, twin], "block_to_bin") == {"good": (1, True), "twin": (1, True)}
    setting = replace(good.declaration.settings["block_to_bin"], episodes=1)
    easier = replace(good.declaration, settings={"block_to_bin": setting})
    other = replace(good, name="other", submission=replace(good.submission, declaration=easier))
    assert ranks([bad, other], "block_to_bin") == {"bad": (1, False), "other": (1, False)}, "from other starts"
    about = replace(bad.declaration.about, demonstrations="own")
    drawn = replace(bad.submission, declaration=replace(bad.declaration, about=about))
    own = replace(bad, name="own", submission=drawn)
    assert ranks([good, bad, own], "block_to_bin") == {"good": (1, False), "bad": (2, False), "own": (1, False)}


def test_only_what_was_replayed_is_for_the_boards_of_others(committed, many, tmp_path):
    entries = [replace(entry, level=level) for entry in committed for level in ("claimed", "replayed")]
    standard = {
        entry.name for entry in entries if entry.declaration.settings_class == "standard" and not entry.is_reference
    }
    write_exports(entries[1::2], tmp_path, "today", "alice/bench")
    assert {path.parts[-3] for path in tmp_path.glob("exports/*/.eval_results/*")} == standard != set()
    write_exports(entries[::2], tmp_path, "today", "alice/bench")
    assert not list(tmp_path.glob("exports/*/.eval_results/*"))
    assert not json.loads((tmp_path / "exports" / "leaderboard.json").read_text())["results"]


def test_of_an_entry_that_was_withdrawn_no_export_stays_and_what_is_somebody_elses_does(many, tmp_path):
    board = shutil.copytree(many, tmp_path / "board")
    write_board(board, tmp_path / "site", "alice/bench")
    notes = tmp_path / "site" / "exports" / "mine" / "notes.txt"
    notes.parent.mkdir()
    notes.touch()
    shutil.rmtree(board / "entries" / "good")
    write_board(board, tmp_path / "site", "alice/bench")
    assert {path.name for path in (tmp_path / "site" / "exports").glob("*/")} == {"bad", "few", "mine"}
    assert notes.is_file()


def test_an_entry_that_is_being_written_is_not_read(many, tmp_path):
    board = shutil.copytree(many, tmp_path / "board")
    (board / "entries" / "new.partial").mkdir()
    assert [entry.name for entry in read_entries(board)[0]] == [entry.name for entry in read_entries(many)[0]]


def test_of_two_verdicts_at_once_none_is_lost(tmp_path, monkeypatch):
    """Both read before either writes, but for the lock."""
    read = verification.read_verification

    def slowly(*of):
        verdict = read(*of)
        time.sleep(0.2)
        return verdict

    monkeypatch.setattr(verification, "read_verification", slowly)
    monkeypatch.setattr(verification, "processor", lambda: threading.current_thread().name)
    path = tmp_path / "verified" / "entry.json"
    record, facts = verification.record_verification, (path, "0" * 64, "replayed")
    threads = [threading.Thread(target=record, args=facts, name=name) for name in ("one", "two")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(json.loads(path.read_text())["machines"]) == ["one", "two"]
    assert [file.name for file in path.parent.iterdir()] == ["entry.json"]


def test_what_a_stranger_writes_is_text(many, tmp_path):
    write_board(many, tmp_path)
    text = (tmp_path / "bins.html").read_text()
    assert "<script" not in text and "&lt;script&gt;good" in text and "1 error" in text and "8 missing" in text


def test_a_verdict_is_of_one_submission_alone(many, tmp_path):
    root = tmp_path / "board"
    shutil.copytree(many, root)
    entry = read_entries(root)[0][0]
    (root / "verified").mkdir()
    path = root / "verified" / f"{entry.name}.json"
    verdict = {
        "submission": entry.submission.sha256,
        "level": "replayed",
        "versions": {"sapien": "3"},
        "date": "2026-11-28",
    }
    for said, level in ((verdict, "replayed"), (verdict | {"submission": "0" * 64}, "claimed")):
        path.write_text(json.dumps(said))
        found = read_entries(root)[0][0]
        assert found.level == level
        assert found.other_versions == (["sapien 3.0.3, verified with 3"] if level == "replayed" else [])
    rates = {"settings": {"block_to_bin": [0.8, 0.7]}}
    for exact, told in ((True, "the same to the last bit"), (False, "compared by seeds")):
        path.write_text(json.dumps(verdict | {"level": "retrained", "retrained": rates | {"exact": exact}}))
        write_board(root, tmp_path / "site")
        text = (tmp_path / "site" / "bins.html").read_text()
        assert f"{told}: block_to_bin 80% submitted, 70% again" in text and "other versions" in text
        assert "starts from the weights" not in text
    chosen = {"exact": True, "starts_from": f"ada/chosen@{'0a' * 20}"}
    path.write_text(json.dumps(verdict | {"level": "retrained", "retrained": rates | chosen}))
    write_board(root, tmp_path / "site")
    assert "It starts from the weights ada/chosen@0a0a" in (tmp_path / "site" / "bins.html").read_text()
    value = {"value": f"1:{'ab' * 32}", "settings": {"block_to_bin": [0.8, 0.8]}}
    for wrong, why in (
        ({}, "does not show its rates"),
        ({"rerun": value | {"settings": {}}}, "does not show its rates"),
        ({"level": "retrained", "retrained": {"exact": True, "settings": {}}}, "does not show its rates"),
        ({"rerun": rates | {"value": "abc"}}, "must be a round of drand"),
        ({"rerun": {"settings": {}}}, "rerun.value: it is missing"),
        ({"rerun": value}, "needs a value of a later day"),
    ):
        path.write_text(json.dumps(verdict | {"level": "re-run"} | wrong))
        assert why in read_entries(root)[1][0]
    path.write_text('{"level": "best"}')
    assert "is not a verdict of constructskill-verify: submission: it is missing" in read_entries(root)[1][0]
    path.unlink()
    declaration = root / "entries" / entry.name / "submission.yaml"
    declaration.write_text(declaration.read_text().replace("version: 1", "version: 7"))
    (root / "entries" / "No Name").mkdir()
    _, (no_name, version) = read_entries(root)
    assert "Entry 'No Name': the folder of an entry must be called by a name" in no_name
    assert version.startswith(f"Entry '{entry.name}': ") and "version" in version
    with pytest.raises(MissingError, match="is not a board"):
        read_entries(tmp_path / "nothing")


@pytest.mark.parametrize("file", ["entries/bad/submission.yaml", "entries/bad/episodes.parquet", "verified/bad.json"])
def test_a_file_of_one_entry_stops_no_other(file, many, tmp_path):
    root = shutil.copytree(many, tmp_path / "board")
    (root / "verified").mkdir()
    for way, damage in hostile.WAYS.items():
        damage(root / file)
        entries, refused = read_entries(root)
        assert len(refused) == 1 and refused[0].startswith("Entry 'bad': ") and "\n" not in refused[0], way
        assert {entry.name for entry in entries} >= {"good", "few"}
        shutil.rmtree(root / file) if way == "a folder" else (root / file).unlink()
    (root / file).write_text("[")
    with pytest.raises(InputError, match="^The board in .* is without what cannot be read. Entry 'bad': "):
        write_board(root, tmp_path / "site")
    assert "good" in Page((tmp_path / "site" / "bins.html").read_text()).found["id"]


def test_a_verdict_keeps_what_else_is_known(tmp_path, monkeypatch):
    path, versions = tmp_path / "entry.json", {"sapien": "3"}
    replayed = {"submission": "0" * 64, "level": "replayed", "versions": versions}
    since = {"date": datetime.now(UTC).date().isoformat()}
    rerun = replayed | {"level": "re-run", "rerun": {"value": "1:ab", "settings": {"one": [0.5, 0.4]}}}
    trained = {"level": "retrained", "retrained": {"exact": True, "settings": {"one": [0.5, 0.5]}}}

    def recorded(machine, facts):
        monkeypatch.setattr(verification, "processor", lambda: machine)
        monkeypatch.setattr(verification, "deciding", lambda: facts["versions"] | {"processor": "a make"})
        shown = {name: facts[name] for name in ("rerun", "retrained") if name in facts}
        verification.record_verification(path, facts["submission"], facts["level"], **shown)
        return json.loads(path.read_text())

    assert recorded("A", replayed) == since | replayed | {"machines": ["A"]}
    since = {"date": "2026-11-23"}
    path.write_text(json.dumps(json.loads(path.read_text()) | since))
    assert recorded("B", rerun) == since | rerun | {"machines": ["A", "B"]}
    assert recorded("C", replayed) == since | rerun | {"machines": ["A", "B", "C"]}, "a replay does not undo a re-run"
    newer = {"versions": {"sapien": "4"}}
    assert recorded("D", replayed | newer) == since | rerun | newer | {"machines": ["D"]}
    assert recorded("D", replayed | newer | trained) == since | rerun | newer | trained | {"machines": ["D"]}
    assert recorded("D", rerun | newer)["level"] == "retrained", "a re-run does not undo a training"
    other = replayed | {"submission": "1" * 64}
    assert recorded("E", other) == other | {"date": datetime.now(UTC).date().isoformat(), "machines": ["E"]}


def test_a_film_of_a_long_episode_ends_where_the_protocols_do(tmp_path, monkeypatch):
    class Still:
        """Stands in for a simulator: an episode that never ends."""

        def reset(self, seed): ...
        def close(self): ...

        def render(self):
            return np.zeros((64, 64, 3), np.uint8)

        def step(self, action):
            return None, 0.0, False, False, {}

    filmed = []
    monkeypatch.setattr(films, "open_simulator", lambda *_: Still())
    monkeypatch.setattr(films, "write_video", lambda path, frames, fps: filmed.append(frames) or path.touch())
    steps = 2 * HORIZON
    claim = Claim(0, task="brick_to_bin", steps=steps, actions=[np.zeros(4 * steps, np.float32)])
    for last, red in ((None, HORIZON + 1), (9, HORIZON - 9), (steps, 0)):
        recovery = Recovery("bin", 0, 0, steps, Lost.DROPPED, False, last_step_extra=last)
        films._film(films.Film("", claim, recovery), tmp_path / "film.mp4")
        assert len(filmed[-1]) == HORIZON + 1 and (tmp_path / "film.mp4").exists()
        assert [one.any() for one in filmed[-1]] == [False] * (HORIZON + 1 - red) + [True] * red


def test_each_cause_of_failure_is_filmed_once(committed):
    for entry in committed:
        for setting, one in entry.standings.items():
            shown = [*films._films(entry, setting)]
            causes = {film.shows.partition(", lost")[0] for film in shown}
            assert len(causes) == len(shown) == len({film.path for film in shown})
            assert {film.claim.placed for film in shown} == {
                claim.placed for own in one.claims.values() for claim in own
            }


def test_rewards_are_those_of_the_environment(committed):
    expert = next(entry for entry in committed if entry.name == "bins_expert")
    info = eval_info(expert, 0)
    assert info["overall"]["n_episodes"] == 101 and info["overall"]["pc_success"] == 100
    (fixed,) = expert.standings["brick_to_bin"].claims[0]
    metrics = info["per_task"][0]["metrics"]
    assert metrics["max_rewards"] == [1.0] and metrics["successes"] == [True]
    assert metrics["sum_rewards"] == [0.5 * (fixed.steps - fixed.lift_step) + 1.0]


def test_an_export_names_tasks_as_lerobot_eval_does(committed):
    """LeRobot's comparison pairs them by these; `test_lerobots_evaluation.py` says what lerobot-eval writes."""
    seen = set()
    for entry in committed:
        info = eval_info(entry, entry.declaration.training_seeds[0])
        places = [(task["task_group"], task["task_id"]) for task in info["per_task"]]
        seen.add(suite := entry.declaration.suite)
        if entry.declaration.settings_class == STANDARD and suite in SUITES:
            assert places == [(suite, number) for number in range(len(SUITES[suite]))], entry.name
        assert len({*places}) == len(places) and {group for group, _ in places} == {*info["per_group"]}
        assert sum(group["n_episodes"] for group in info["per_group"].values()) == info["overall"]["n_episodes"]
    assert {"bins", "ladder", "joints", "orders", "perturbed"} <= seen


def test_an_episode_that_failed_with_an_error_has_no_reward(many):
    bad = next(entry for entry in read_entries(many)[0] if entry.name == "bad")
    (task,) = eval_info(bad, 0)["per_task"]
    assert task["metrics"]["max_rewards"][0] == task["metrics"]["sum_rewards"][0] == 0
