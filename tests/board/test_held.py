"""Determinism, held: committed actions have the outcomes, the states and the pictures that they had when recorded.

So have the videos of a demonstration. An update of SAPIEN, ManiSkill, NumPy, torch, Mesa or FFmpeg that changes a bit
is seen here; docs/leaderboard.md says what to do then. All is held for each make of processor, which decides the last
bits of physics. States are compared to a micrometre, on processors of which it is known to the last bit, pictures and
videos by their hash.
`python tests/board/test_held.py` records anew, for the make that it runs on.
"""

import hashlib
import json
import sys
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from lerobot_constructskill.artifacts.processor import make, processor
from lerobot_constructskill.artifacts.revisions import revisions
from lerobot_constructskill.board.submission import read_submission
from lerobot_constructskill.contract import OBS_TYPES
from lerobot_constructskill.demos.recorder import GenerateConfig, record
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
from lerobot_constructskill.envs.recording import Episode

pytestmark = pytest.mark.sim

RECORDED = Path(__file__).with_name("held.json")
ENTRY = Path(__file__).parents[2] / "board" / "entries" / "bins_expert"
TASKS, START = ("brick_to_bin_shifted", "block_to_bin"), 5000
FRAMES = (1, 40, 80)
"""Steps after which the pictures are compared: the robot alone, at the object, carrying it."""
MICROMETRE = 1e-6
EXACT = ("family 6, model 106", "family 6, model 167", "family 6, model 207", "family 25, model 1")
"""Processors that came to the recorded states of their make to the last bit; no other model was compared."""


def held(what: str) -> dict:
    """The states or pictures that were recorded on this make of processor."""
    recorded = json.loads(RECORDED.read_text())[what]
    if make() not in recorded:
        pytest.skip(f"no {what} were recorded on {make()}; those held are of {', '.join(recorded)}")
    return recorded[make()]


@cache
def execute(task: str) -> tuple[dict, dict, bool]:
    """States and pictures of one of the expert's episodes, and whether it ends as the entry claims."""
    submission = read_submission(ENTRY)
    (claim,) = (one for one in submission.claims if (one.setting, one.evaluation_seed) == (task, START))
    env = ConstructSkillEnv(task, "pixels_agent_pos", claim.episode_length, render_backend="cpu")
    env.reset(seed=START)
    episode, frames = Episode(START), {}
    for step, action in enumerate(claim.executed, 1):
        seen, *_, info = env.step(action)
        episode.add(action, info)
        if step in FRAMES:
            pictures = [seen["pixels"][name].tobytes() for name in OBS_TYPES["pixels_agent_pos"]]
            frames[str(step)] = hashlib.sha256(b"".join(pictures)).hexdigest()
    states = {name: env.privileged_state()[name].tolist() for name in ("object_pose", "tcp_pose", "fingers")}
    env.close()
    return states, frames, episode.outcome == claim.outcome


def videos(root: Path) -> dict[str, str]:
    """Hashes of the videos of one demonstration with both cameras, made in a folder.

    Not of its rows: that CPUs with and without AVX-512 come to the same last bits has not been confirmed.
    """
    record(GenerateConfig("local/held", str(root), task=TASKS[0], episodes=1, obs_type="pixels_agent_pos"))
    made = sorted(root.glob("videos/**/*.mp4"))
    return {str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest() for path in made}


@pytest.mark.parametrize("task", TASKS)
def test_no_outcome_and_no_state_has_changed(task):
    found, _, is_as_claimed = execute(task)
    assert is_as_claimed, "physics changed: the same actions have another outcome"
    tolerance = 0 if any(f"({model})" in processor() for model in EXACT) else MICROMETRE
    for name, state in held("states")[task].items():
        np.testing.assert_allclose(found[name], state, rtol=0, atol=tolerance, err_msg=name)


@pytest.mark.parametrize("task", TASKS)
def test_no_picture_has_changed(task):
    recorded = held("pictures")
    assert execute(task)[1] == recorded[task], "pictures changed: Mesa, SAPIEN or the scene's looks"


def test_the_videos_of_a_demonstration_have_not_changed(tmp_path):
    assert videos(tmp_path / "set") == held("pictures")["videos"]


def record_anew() -> None:
    """Hold what this machine comes to, for its make of processor."""
    recorded, executed = json.loads(RECORDED.read_text()), {task: execute(task) for task in TASKS}
    with TemporaryDirectory() as scratch:
        filmed = {"videos": videos(Path(scratch, "set"))}
    pictures = {task: frames for task, (_, frames, _) in executed.items()} | filmed
    ours = revisions("lerobot_constructskill.envs")
    if recorded["pictures"].get(make(), pictures) != pictures and recorded["revisions"] == ours:
        sys.exit("Pictures changed: raise the revision of sim or envs, by which stores tell them apart.")
    recorded["states"][make()] = {task: states for task, (states, _, _) in executed.items()}
    recorded["pictures"][make()], recorded["revisions"] = pictures, ours
    RECORDED.write_text(json.dumps(recorded, indent=1) + "\n")


if __name__ == "__main__":
    record_anew()
