"""`make results`: pieces are made once, committed one by one, and go on elsewhere; so do entries of the board."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

import lerobot_constructskill.plugin  # noqa: F401
from lerobot_constructskill.board.declaration import About
from lerobot_constructskill.board.from_recordings import submit
from lerobot_constructskill.board.protocol import BOARD_SUITES, BoardSetting
from lerobot_constructskill.board.submission import read_submission
from lerobot_constructskill.envs.recording import COUNTS, RECORDINGS, Episode, deciding, write_recordings
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.study import session
from lerobot_constructskill.study.rows import ROWS, EpisodeRow, load_rows, write_rows
from lerobot_constructskill.study.runs import EPISODES
from lerobot_constructskill.study.timing import TIMINGS

ROOT = Path(__file__).parents[2]

STUDY = {
    "settings": {
        name: {"data": "smoke", "env": {"episode_length": length, "obs_type": "pixels_agent_pos"}}
        for name, length in (("one", 8), ("two", 9))
    },
    "variants": {
        "a": {"policy": {"type": "frozen_vit", "backbone": "dinov2_vits14"}, "seeds": 2},
        "act": {"policy": {"type": "act", "pretrained_backbone_weights": None}, "seeds": 1, "settings": ["one"]},
    },
    "references": {"no_op": 1},
    "episodes": 2,
}


@pytest.fixture(scope="module")
def made():
    """The module, as the script finds it."""
    sys.path.insert(0, str(ROOT / "results"))
    try:
        import make

        yield make
    finally:
        sys.path.remove(str(ROOT / "results"))


def git(root, *arguments):
    who = ["-c", "user.name=anyone", "-c", "user.email=anyone@localhost"]
    command = ["git", *who, "-C", str(root), *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


@pytest.fixture
def checkout(tmp_path, monkeypatch, made):
    """A repository with a study and a page that shows a number of it; runs are made at once, without a simulator."""
    root = tmp_path / "checkout"
    for name in ("results/tiny", "configs", "lerobot_constructskill"):
        (root / name).mkdir(parents=True)
    (root / "configs" / "tiny.yaml").write_text(yaml.safe_dump({"name": "tiny"} | STUDY))
    (root / "README.md").write_text("No number yet.\n")
    for name in ("user.name", "user.email"):
        monkeypatch.setenv(f"GIT_CONFIG_KEY_{name == 'user.email':d}", name)
        monkeypatch.setenv(f"GIT_CONFIG_VALUE_{name == 'user.email':d}", "anyone@localhost")
    monkeypatch.setenv("GIT_CONFIG_COUNT", "2")
    git(root, "init", "--quiet")
    git(root, "add", ".")
    git(root, "commit", "--quiet", "--message=what there is")
    monkeypatch.setattr(made, "PAGES", [ROOT / "README.md"])
    monkeypatch.setattr(made, "find", lambda kind, name: root / "configs" / f"{name}.yaml")
    monkeypatch.setattr(session, "make_runs", make_at_once)
    monkeypatch.setattr(session, "validate", lambda *_: None)
    return root


def make_at_once(job):
    for run in job.runs:
        with job.store.claim([run]) as missing:
            for node in missing:
                with job.store.writing(node) as folder:
                    folder.mkdir()
                    row = EpisodeRow(
                        run=run.digest,
                        training_seed=run.seed,
                        evaluation_seed=1000,
                        episode=0,
                        versions='{"processor": "a processor"}',
                    )
                    rows = [replace(row, episode=number, placed=True, lifted=True) for number in range(2)]
                    write_rows(rows, folder / EPISODES, EpisodeRow)
                    write_recordings(recorded(run.arm.env["episode_length"], run.seed), folder / RECORDINGS)
        yield run


def recorded(length, seed):
    """Two episodes in which nothing happens, of another policy for each seed."""
    facts = {"task": "brick_to_bin", "episode_length": length, "obs_type": "pixels_agent_pos"}
    facts |= {"backend": "physx_cpu, sapien_cpu rendering", "versions": json.dumps(deciding())}
    nothing = dict.fromkeys(("is_lifted", "is_in_bin", "is_success"), False) | dict.fromkeys((*COUNTS, "cost"), 0)
    episodes = [Episode(start, **facts) for start in (1000, 1001)]
    for episode in episodes:
        for _ in range(length):
            episode.add(np.full(4, 0.01 * (seed + 1), dtype=np.float32), nothing)
    return episodes


def test_what_pieces_share_is_counted_with_the_first(checkout, tmp_path, made):
    """Two seeds of `a` learn from one set, which both settings have; `no_op` and `a` have two episodes a run."""
    took = {"demonstrations": 600, "data": 200, "training": 60, "evaluation": 8}  # of a set, of two seeds
    lines = [{"arm": "one/a", "stage": stage, "runs": 2, "seconds": seconds} for stage, seconds in took.items()]
    lines.append({"arm": "one/no_op", "stage": "evaluation", "runs": 1, "seconds": 240})
    (checkout / "results/tiny" / TIMINGS).write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    maker = made.Maker(checkout, tmp_path / "store", ["tiny"])
    assert maker.status(maker.pieces()).splitlines() == [
        "tiny/one: 3 runs, about 18 min",  # 600 + 200 + 60 + 8 + 240 s
        "tiny/one/act: 1 run, time unknown",
        "tiny/two: 3 runs, about 4 min",  # 8 + 240 s
        "0 of 3 pieces made; the others: about 23 min and some of unknown time",
    ]
    store = maker.store
    node = next(run for run in maker.pieces("tiny/one")[0].runs if run.checkpoints).checkpoints.inputs["data"]
    with store.claim([node]), store.writing(node) as folder:
        folder.mkdir()
    assert maker.status(maker.pieces("tiny/one")).startswith("tiny/one: 3 runs, about 15 min"), "without the features"


def test_a_piece_is_committed_before_the_next_and_a_clone_makes_the_rest(checkout, tmp_path, made):
    maker = made.Maker(checkout, tmp_path / "store", ["tiny"])
    pieces = {piece.name: len(piece.runs) for piece in maker.pieces()}
    assert pieces == {"tiny/one": 3, "tiny/one/act": 1, "tiny/two": 3}, "another policy type is a piece of its own"
    (first,) = maker.pieces("tiny/two")
    maker.make(first)
    assert git(checkout, "log", "--format=%s").splitlines() == ["Results: tiny/two", "what there is"]
    assert not git(checkout, "status", "--porcelain", "--", "results", "README.md")
    assert maker.status(maker.pieces()).splitlines() == [
        "tiny/one: 3 runs, time unknown",
        "tiny/one/act: 1 run, time unknown",
        "1 of 3 pieces made; the others: time unknown",
    ]
    clone = tmp_path / "clone"
    git(tmp_path, "clone", "--quiet", str(checkout), str(clone))
    elsewhere = made.Maker(clone, tmp_path / "another_store", ["tiny"])
    left = [piece for piece, runs in elsewhere.due(elsewhere.pieces()) if runs]
    assert [piece.name for piece in left] == ["tiny/one", "tiny/one/act"]
    for piece in left:
        elsewhere.make(piece)
    for piece, runs in maker.due(maker.pieces()):
        if runs:
            maker.make(piece)
    assert load_rows(clone / "results/tiny" / ROWS) == load_rows(checkout / "results/tiny" / ROWS)
    one, other = ((root / "results/tiny/report.md").read_text() for root in (clone, checkout))
    assert one.partition("## Provenance")[0] == other.partition("## Provenance")[0], "all but the time that it took"
    assert elsewhere.status(elsewhere.pieces()) == "3 of 3 pieces made"


def test_the_numbers_of_a_page_are_committed_with_their_rows(checkout, tmp_path, made):
    link = '(results/tiny/report.md "placed two/a")'
    maker = made.Maker(checkout, tmp_path / "store", ["tiny"])
    (piece,) = maker.pieces("tiny/two")
    maker.make(piece)
    (checkout / "README.md").write_text(f"It places [a lot]{link}.\n")
    maker.publish(piece)
    assert git(checkout, "show", "HEAD:README.md") == f"It places [4/4]{link}.\n"
    (act,) = maker.pieces("tiny/one/act")
    told = {word: f'(results/tiny/report.md "{word} one/act")' for word in ("count", "placed")}
    (checkout / "README.md").write_text(f"[]{told['count']} []{told['placed']}\n")
    maker.publish(piece)
    assert git(checkout, "show", "HEAD:README.md") == f"[not run yet]{told['count']} [not run yet]{told['placed']}\n"
    maker.make(act)
    assert git(checkout, "show", "HEAD:README.md") == f"[2]{told['count']} [2/2]{told['placed']}\n", (
        "rows are read anew"
    )


@pytest.mark.parametrize("during", ["publish", "validate"])
def test_a_process_that_was_killed_before_its_commit_makes_it_up(during, checkout, tmp_path, made, monkeypatch):
    maker = made.Maker(checkout, tmp_path / "store", ["tiny"])
    monkeypatch.setattr(made, "ROOT", checkout)
    monkeypatch.setattr(made, "PAGES", [checkout / "README.md"])
    monkeypatch.setattr(made, "Maker", lambda *_, **options: maker)
    monkeypatch.setattr(sys, "argv", ["make.py"])
    one, act, two = maker.pieces()
    maker.make(one)
    with monkeypatch.context() as killed:
        killed.setattr(maker if during == "publish" else session, during, lambda *_: sys.exit("killed"))
        with pytest.raises(SystemExit, match="killed"):
            made.main()
    assert [maker.is_committed(piece) for piece in (one, act)] == [True, False], "it is known which piece waits"
    validated = []
    monkeypatch.setattr(session, "validate", lambda *asked: validated.append(asked))
    made.main()
    assert validated[0][0] == [*act.runs], "held-out errors that are missing are measured"
    told = [f"Results: {name}" for name in ("tiny/two", "tiny/one/act", "tiny/one")]
    assert git(checkout, "log", "-3", "--format=%s").splitlines() == told
    assert all(map(maker.is_committed, (one, act, two)))


def test_rows_that_the_store_alone_has_are_due(checkout, tmp_path, made):
    """As where a process was killed between a run and its rows."""
    clone = tmp_path / "clone"
    git(tmp_path, "clone", "--quiet", str(checkout), str(clone))
    maker, elsewhere = (made.Maker(root, tmp_path / "store", ["tiny"]) for root in (checkout, clone))
    (piece,) = maker.pieces("tiny/two")
    maker.make(piece)
    ((same, runs),) = elsewhere.due(elsewhere.pieces("tiny/two"))
    assert [run.id for run in runs] == [run.id for run in piece.runs]
    elsewhere.make(same)
    assert load_rows(clone / "results/tiny" / ROWS) == load_rows(checkout / "results/tiny" / ROWS)
    assert not next(elsewhere.due([same]))[1] and elsewhere.is_committed(same)


def test_nothing_is_made_of_sources_that_are_in_no_commit(checkout, tmp_path, made):
    maker = made.Maker(checkout, tmp_path / "store", ["tiny"])
    (checkout / "configs" / "tiny.yaml").write_text("name: other\n")
    with pytest.raises(InputError, match=r"Commit your edits first.*: configs/tiny.yaml"):
        maker.make(maker.pieces()[0])
    with pytest.raises(InputError, match="--only=huge fits no piece; the first one is tiny/one"):
        maker.pieces("huge")


def test_what_would_spoil_a_commit_is_refused_before_the_hours_that_a_piece_takes(
    checkout, tmp_path, made, monkeypatch
):
    maker = made.Maker(checkout, tmp_path / "store", ["tiny"])
    one, _, two = maker.pieces()
    monkeypatch.setattr(made, "run_study", lambda *_: pytest.fail("it works for hours"))
    readme = checkout / "README.md"
    readme.write_text("Half a sentence of somebody's\n")
    with pytest.raises(InputError, match=r"Commit your edits first: README.md"):
        maker.make(one)
    git(checkout, "restore", "README.md")
    git(checkout, "checkout", "--quiet", "--detach")
    with pytest.raises(InputError, match="No branch is checked out"):
        maker.make(one)
    git(checkout, "switch", "--quiet", "-")
    (checkout / ".git" / "MERGE_HEAD").write_text(git(checkout, "rev-parse", "HEAD"))
    with pytest.raises(InputError, match=r"Something else is going on in git: .*MERGE_HEAD"):
        maker.make(one)
    (checkout / ".git" / "MERGE_HEAD").unlink()
    with (
        monkeypatch.context() as anonymous,
        pytest.raises(InputError, match="`git var` refuses: .*no email was given"),
    ):
        anonymous.setenv("GIT_CONFIG_KEY_0", "user.useConfigOnly")
        anonymous.setenv("GIT_CONFIG_VALUE_0", "true")
        anonymous.setenv("GIT_CONFIG_GLOBAL", "/dev/null")
        anonymous.setenv("GIT_CONFIG_COUNT", "1")
        maker.make(one)


def test_rows_of_another_piece_are_not_committed_half_made(checkout, tmp_path, made, monkeypatch):
    maker = made.Maker(checkout, tmp_path / "store", ["tiny"])
    one, _, two = maker.pieces()
    with monkeypatch.context() as killed, pytest.raises(SystemExit):
        killed.setattr(maker, "_commit", lambda *_: sys.exit("killed"))
        maker.make(two)
    with pytest.raises(
        InputError, match=r"tiny/two has rows that are in no commit: make it first \(`--only=tiny/two`"
    ):
        maker.make(one)
    maker.make(two)
    maker.make(one)
    assert git(checkout, "log", "-2", "--format=%s").splitlines() == ["Results: tiny/one", "Results: tiny/two"]


def test_a_piece_takes_nothing_of_others_from_the_store(checkout, tmp_path, made):
    """Another study may have made their runs; with their own piece come their recordings."""
    clone = tmp_path / "clone"
    git(tmp_path, "clone", "--quiet", str(checkout), str(clone))
    elsewhere, maker = (made.Maker(root, tmp_path / "store", ["tiny"]) for root in (clone, checkout))
    one, _, two = maker.pieces()
    elsewhere.make(elsewhere.pieces("tiny/two")[0])
    maker.make(one)
    assert [len(runs) for _, runs in maker.due([one, two])] == [0, 3]


def test_a_folder_that_somebody_removed_is_made_anew(checkout, tmp_path, made):
    maker = made.Maker(checkout, tmp_path / "store", ["tiny"])
    one, _, two = maker.pieces()
    maker.make(one)
    assert "tiny/one/act: 1 run, time unknown; rows of one are of a processor\n" in maker.status(maker.pieces())
    shutil.rmtree(checkout / "results/tiny")
    for piece in (two, one):
        maker.make(piece)
    assert all(map(maker.is_committed, (one, two)))


def test_what_no_piece_needs_any_more_can_be_removed(checkout, tmp_path, made):
    maker = made.Maker(checkout, tmp_path / "store", ["tiny"])
    one, act, two = maker.pieces()
    kinds = sorted({node.kind for node in made._bulky(one.runs)})
    assert kinds == ["demonstrations", "features"]
    nodes = made._bulky(one.runs)
    for node in nodes:
        with maker.store.writing(node) as folder:
            folder.mkdir()
    for piece, left in ((one, nodes), (act, nodes), (two, set())):
        maker.make(piece)
        maker.discard()
        assert {node for node in nodes if maker.store.has(node)} == left, piece.name


def test_every_study_that_the_benchmark_stands_on_has_a_folder_and_no_other_has(made):
    folders = {path.parent.name for path in (ROOT / "results").glob("*/study.yaml")}
    assert folders == {*made.STUDIES} and len(made.STUDIES) <= 10


def test_an_entry_of_the_board_is_written_when_its_last_piece_is_made_wherever_the_others_were(
    checkout, tmp_path, made, monkeypatch, capsys
):
    """Its replay, which has tests of its own, is left out: these episodes were never run."""
    import entries

    settings = {
        name: BoardSetting("brick_to_bin", episodes=2, episode_length=length, first_start=1000)
        for name, length in (("one", 8), ("two", 9))
    }
    about = About("of old", "me", "frozen_vit", "an old commit", "smoke", "twice", "a computer", "pixels_agent_pos")
    old = {3: [*recorded(8, 3), *recorded(9, 3)]}
    submit(checkout / "board/entries/mine", about, next(iter(BOARD_SUITES)), settings, old, {})
    (checkout / "board/recovered").mkdir()
    (checkout / "board/recovered/mine.parquet").touch()
    git(checkout, "add", "board")
    git(checkout, "commit", "--quiet", "--message=an entry")
    replayed = []
    monkeypatch.setattr(entries, "ENTRIES", {"mine": entries.Part("tiny", "a", ("one", "two"))})
    monkeypatch.setattr(entries, "verify", lambda config: replayed.append(config.root) or "it holds")
    maker = made.Maker(checkout, tmp_path / "store", ["tiny"])
    stale = checkout / "results/tiny/recordings/runs/of_older_code" / RECORDINGS
    stale.parent.mkdir(parents=True)
    stale.touch()
    maker.make(maker.pieces("tiny/two")[0])
    there = git(checkout, "ls-files", "results/tiny/recordings").split()
    assert len(there) == 2 and not replayed and read_submission(checkout / "board/entries/mine").claims[0].key[1] == 3
    clone = tmp_path / "clone"
    git(tmp_path, "clone", "--quiet", str(checkout), str(clone))
    elsewhere = made.Maker(clone, tmp_path / "another_store", ["tiny"])
    (last,) = elsewhere.pieces("tiny/one")[:1]

    def refuse(config):
        raise InputError("seed 3 ends otherwise")

    with monkeypatch.context() as refused:
        refused.setattr(entries, "verify", refuse)
        elsewhere.make(last)
    assert "No new entry mine: seed 3 ends otherwise" in capsys.readouterr().out
    assert git(clone, "log", "-1", "--format=%s") == "Results: tiny/one\n" and not git(clone, "status", "--porcelain")
    assert len(git(clone, "ls-files", "results/tiny/recordings").split()) == 4
    assert elsewhere.is_committed(last), "a command tries a refused entry once"
    elsewhere = made.Maker(clone, tmp_path / "another_store", ["tiny"])
    assert not elsewhere.is_committed(last)
    elsewhere.make(last)  # as the next command does
    assert elsewhere.is_committed(last)
    entry = read_submission(clone / "board/entries/mine")
    assert [root.name for root in replayed] == ["mine"]
    assert git(clone, "log", "-2", "--format=%s").splitlines()[1] == "Board: mine"
    assert {claim.key for claim in entry.claims} == {
        (name, seed, start) for name in ("one", "two") for seed in (0, 1) for start in (1000, 1001)
    }
    assert entry.declaration.about.compute == "2 cores of a processor, no GPU" and entry.recipe
    assert entry.declaration.about.revision.startswith("study tiny of results/tiny, variant a, commit ")
    assert not git(clone, "ls-files", "results/tiny/recordings", "board/recovered")
    assert not git(clone, "status", "--porcelain")


def test_entries_that_share_runs_are_written_together(checkout, tmp_path, made, monkeypatch):
    """Else the one that is whole first would be written anew with every piece, until the other is."""
    import entries

    asked = []
    parts = {
        name: entries.Part("tiny", "a", settings) for name, settings in {"a": ("two",), "b": ("one", "two")}.items()
    }
    monkeypatch.setattr(entries, "ENTRIES", parts)
    for name in parts:
        (checkout / "board/entries" / name).mkdir(parents=True)
    monkeypatch.setattr(made, "write_entries", lambda due, *_: asked.append(due) or [])
    maker = made.Maker(checkout, tmp_path / "store", ["tiny"])
    maker.make(maker.pieces("tiny/two")[0])
    maker.make(maker.pieces("tiny/one")[0])
    assert asked == [[], ["a", "b"]]


@pytest.mark.slow
def test_every_entry_that_is_made_of_a_study_is_on_the_board_and_names_settings_that_the_study_has(made):
    from entries import ENTRIES

    maker = made.Maker(ROOT, ROOT / "outputs" / "store")
    runs = {study: [run for piece in maker.pieces(study) for run in piece.runs] for study in made.STUDIES}
    for name, entry in ENTRIES.items():
        told = read_submission(ROOT / "board" / "entries" / name).declaration
        places = {(one.task, one.episode_length, one.perturb) for one in told.settings.values()}
        own = [run for run in runs[entry.study] if entry.holds(run)]
        assert {run.arm.setting for run in own} == {*entry.settings}, name
        envs = [run.arm.env for run in own]
        assert {(env["task"], env["episode_length"], env["perturb"]) for env in envs} == places, name
