"""The commands as a stranger uses them: record, submit, verify, and from fresh starts again."""

import json
import os
import shutil
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import yaml
from commands import call
from torchcodec.decoders import VideoDecoder

from lerobot_constructskill.artifacts.processor import make, processor
from lerobot_constructskill.board.protocol import FIRST_FRESH
from lerobot_constructskill.board.submission import EPISODES_FILE, Claim, read_submission, write_submission

VALUE = f"20000000:{'ab' * 32}"
"""Of 18 July 2025."""

pytestmark = [pytest.mark.sim, pytest.mark.slow]

SETTINGS = {"shifted": {"task": "brick_to_bin_shifted", "episodes": 5, "episode_length": 3, "first_start": 7}}
ABOUT = dict.fromkeys(("name", "submitter", "policy", "revision", "data", "training", "compute"), "a test's")

EVALUATE = """
import os, sys
import numpy as np
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
root, first = sys.argv[1], int(sys.argv[2])
env = ConstructSkillEnv("brick_to_bin_shifted", episode_length=3, render_backend="cpu")
for seed in (0, 1):
    os.environ["CONSTRUCTSKILL_RECORD"] = f"{root}/seed_{seed}"
    rng = np.random.default_rng(seed)
    for start in range(first, first + 5):
        env.reset(seed=start)
        for _ in range(3):
            env.step(rng.uniform(-0.1, 0.1, 4).astype(np.float32))
env.close()
"""


def evaluate(root: Path, first: int) -> None:
    """Two training seeds' episodes from five starts, in a process that never renders."""
    call("code", EVALUATE, str(root), str(first))


def test_a_strangers_three_commands_and_a_rerun(tmp_path):
    (tmp_path / "about.yaml").write_text(yaml.safe_dump(ABOUT | {"observes": "pixels"}))
    (tmp_path / "settings.yaml").write_text(yaml.safe_dump(SETTINGS))
    evaluate(tmp_path / "recorded", 7)
    flags = ["--suite=bins", f"--about={tmp_path / 'about.yaml'}", f"--settings={tmp_path / 'settings.yaml'}"]
    entry, again = tmp_path / "entry", tmp_path / "again"
    said = call("constructskill-submit", *flags, f"--recorded={tmp_path / 'recorded'}", f"--root={entry}")
    assert "custom, 10 episodes of 2 training seeds" in said

    recorded = {"CONSTRUCTSKILL_RECORD": str(tmp_path / "recorded" / "seed_0")}  # as it may still be exported
    before = {path: path.read_bytes() for path in tmp_path.rglob("recorded/*/*")}
    said = call("constructskill-verify", f"--root={entry}", **recorded)
    assert "10 of 10 episodes replayed (30 steps)" in said
    assert {path: path.read_bytes() for path in tmp_path.rglob("recorded/*/*")} == before
    said = call("constructskill-verify", f"--root={entry}", f"--value={VALUE}", "--workers=1")
    first = int(said.partition("fresh starts are ")[2].split()[0])
    assert first >= FIRST_FRESH and f"--seed={first}" in said and f"first_start: {first}" in said
    evaluate(tmp_path / "fresh", first)
    (tmp_path / "settings.yaml").write_text(yaml.safe_dump({"shifted": SETTINGS["shifted"] | {"first_start": first}}))
    call("constructskill-submit", *flags, f"--recorded={tmp_path / 'fresh'}", f"--root={again}")
    rerun = [f"--value={VALUE}", f"--rerun={again}", f"--record={tmp_path / 'verified'}", "--workers=1"]
    said = call("constructskill-verify", f"--root={entry}", *rerun, fails=True)
    assert "record a replay first, with --record alone" in said
    call("constructskill-verify", f"--root={entry}", *rerun[2:])
    path = tmp_path / "verified" / "entry.json"
    said = call("constructskill-verify", f"--root={entry}", *rerun, fails=True)
    assert "a re-run needs a value of a later day" in said
    path.write_text(json.dumps(json.loads(path.read_text()) | {"date": "2025-07-17"}))
    said = call("constructskill-verify", f"--root={entry}", *rerun)
    assert "10 of 10 episodes replayed (30 steps)" in said and "shifted 0% submitted, 0% run anew" in said
    verdict = json.loads(path.read_text())
    assert verdict["rerun"] == {"value": VALUE, "settings": {"shifted": [0.0, 0.0]}}
    assert verdict["level"] == "re-run" and verdict["machines"] == [processor()]
    assert "processor" not in verdict["versions"], "another make would find something else than the first"
    for sha256, machines in ((verdict["submission"], ["another", processor()]), ("", [processor()])):
        path.write_text(json.dumps(verdict | {"submission": sha256, "machines": ["another"]}))
        call("constructskill-verify", f"--root={entry}", *(rerun if sha256 else rerun[2:]))
        assert json.loads(path.read_text())["machines"] == machines, "those that found the same of the same"
    said = call(
        "constructskill-verify", f"--root={entry}", *rerun[1:2], f"--value={VALUE.replace('2', '1', 1)}", fails=True
    )
    assert "calls for the starts from" in said and "the re-run has others" in said

    shutil.copytree(entry, tmp_path / "board" / "entries" / "mine")
    (tmp_path / "board" / "verified").mkdir()
    (tmp_path / "board" / "verified" / "mine.json").write_text(json.dumps(verdict))
    for made in (True, False):
        call("constructskill-board", f"--root={tmp_path / 'board'}", f"--out={tmp_path / 'site'}", "--films=true")
        (film,) = tmp_path.glob("site/films/*/*.mp4")  # none of its episodes placed
        page = (tmp_path / "site" / "bins.html").read_text()
        assert "round 20000000 of drand" in page and "shifted 0% submitted, 0% again" in page
        assert len(VideoDecoder(film)) == 4, "three steps, and what was there before"
        assert str(film.relative_to(tmp_path / "site")) in page
        assert (film.stat().st_mtime != 0) == made, "what is there is not made again"
        os.utime(film, (0, 0))

    content = np.frombuffer((entry / EPISODES_FILE).read_bytes(), np.uint8).copy()
    content[len(content) // 2] ^= 1
    (entry / EPISODES_FILE).write_bytes(content.tobytes())
    assert "its hash differs." in call("constructskill-verify", f"--root={entry}", fails=True)


def test_a_difference_on_another_make_of_processor_is_told_as_such(tmp_path):
    (tmp_path / "about.yaml").write_text(yaml.safe_dump(ABOUT | {"observes": "pixels"}))
    (tmp_path / "settings.yaml").write_text(yaml.safe_dump(SETTINGS))
    evaluate(tmp_path / "recorded", 7)
    files = [f"--{name}={tmp_path / name}.yaml" for name in ("about", "settings")]
    where = [f"--recorded={tmp_path / 'recorded'}", f"--root={tmp_path / 'true'}"]
    call("constructskill-submit", "--suite=bins", *files, *where)
    true = read_submission(tmp_path / "true")
    declared = {one.name: getattr(true.declaration, one.name) for one in fields(true.declaration)}
    del declared["episodes_sha256"], declared["version"]
    assert declared["versions"]["processor"] == make()
    claims = [Claim(**vars(true.claims[0]) | {"lifted": True, "lift_step": 2, "stage": "lifted"}), *true.claims[1:]]
    edited = {"constructskill.sim": "source 12ab34cd56ef, edited: sim/strict.py"}  # another criterion of success
    for name, is_told in ((make(), False), ("AnotherMake", True)):
        versions = declared["versions"] | {"processor": name} | edited
        write_submission(tmp_path / name, claims, **declared | {"versions": versions})
        told = call("constructskill-verify", f"--root={tmp_path / name}", "--workers=1", fails=True)
        assert "1 of 10 replayed episodes are not as claimed" in told and "lifted is False, not True" in told
        assert "constructskill.sim 'source 12ab34cd56ef, edited: sim/strict.py' there" in told
        assert ("processor 'AnotherMake' there" in told) == ("verify it on the make" in told) == is_told
