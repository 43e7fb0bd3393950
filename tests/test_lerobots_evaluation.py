"""What LeRobot asks of a benchmark beyond one evaluation: its ways to evaluate, to record, and to sum up."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from commands import BIN, call
from hub_server import TOKENS, serve
from lerobot.datasets import LeRobotDataset

from lerobot_constructskill.contract import SUITES, get_task
from lerobot_constructskill.lerobot_internals import EVALUATED

pytestmark = [pytest.mark.sim, pytest.mark.slow]

ROOT = Path(__file__).parents[1]
# Random weights, the same in every process: LeRobot seeds before it makes the policy.
POLICY = ("--policy.type=frozen_vit", "--policy.backbone=vit_tiny16", "--policy.backbone_pretrained=false")
ENV = ("--env.type=constructskill", "--env.episode_length=6")

# A card is validated at the real Hub whatever HF_ENDPOINT says.
EVALUATE_TWICE = """
import sys
from huggingface_hub import RepoCard
RepoCard.validate = lambda *_, **__: None
from lerobot.scripts.lerobot_eval import main
flags = sys.argv[1:]
for word in "true", "false":
    sys.argv = ["lerobot-eval", *(flag.format(word) for flag in flags)]
    main()
"""


@pytest.fixture(scope="module")
def hub():
    with serve() as hub:
        yield hub


def recordings(folder, word):
    roots = [folder / word / "recordings" / "constructskill_0" / f"env_{i}" for i in range(2)]
    return [LeRobotDataset(f"alice/async_{word}_constructskill_0_{root.name}", root=root) for root in roots]


def test_asynchronous_and_synchronous_evaluations_record_the_same_episodes(hub, tmp_path):
    """Two episodes at once, recorded into a folder and to the Hub."""
    where = {"HF_ENDPOINT": hub.url, "HF_TOKEN": next(iter(TOKENS)), "HF_HOME": str(tmp_path / "home")}
    two = ["--env.obs_type=pixels_agent_pos", "--eval.n_episodes=2", "--eval.batch_size=2"]
    to = ["--eval.recording=true", "--eval.recording_repo_id=alice/async_{0}", "--eval.recording_private=true"]
    flags = [*POLICY, *ENV, *two, *to, "--eval.use_async_envs={0}", f"--output_dir={tmp_path}/{{0}}"]
    online = {"HF_HUB_OFFLINE": "0", "HF_HUB_DISABLE_XET": "1"}
    call(sys.executable, "-c", EVALUATE_TWICE, *flags, **online, **where)
    recorded = [recordings(tmp_path, word) for word in ("true", "false")]
    for of_async, of_sync in zip(*recorded, strict=True):
        columns = [dataset.hf_dataset.with_format("numpy") for dataset in (of_async, of_sync)]
        for name in ("action", "agent_pos", "next.reward", "next.success", "timestamp"):
            first, second = (np.stack(column[name][:]) for column in columns)
            assert len(first) == 6 and np.array_equal(first, second), name
        assert np.ptp(columns[0]["action"][:], axis=0).any()
        assert of_async.meta.camera_keys == ["observation.images.base", "observation.images.wrist"]
        assert of_async[0]["task"] == get_task("brick_to_bin").instruction
        for dataset in (of_async, of_sync):
            repo = hub.repos[f"datasets/{dataset.repo_id}"]
            assert repo.private and "v3.0" in repo.tags
            assert "meta/info.json" in repo.commits[repo.tags["v3.0"]]


def test_a_suite_is_evaluated_and_summed_up_with_the_batch_size_left_to_lerobot(tmp_path):
    flags = ["--env.task=ladder", "--eval.n_episodes=1", "--eval.batch_size=0"]
    call("lerobot-eval", *POLICY, *ENV, *flags, f"--output_dir={tmp_path}")
    info = json.loads((tmp_path / "eval_info.json").read_text())
    tasks = SUITES["ladder"]
    assert [(task["task_group"], task["task_id"]) for task in info["per_task"]] == [
        ("ladder", number) for number in range(len(tasks))
    ]
    told = EVALUATED.read(tmp_path / "eval_info.json")["per_task"]
    assert [task["metrics"]["max_rewards"] for task in told] == [[0.0]] * len(tasks)
    for summary in (info["overall"], info["per_group"]["ladder"]):
        assert summary["n_episodes"] == len(tasks) and summary["pc_success"] == 0.0
    assert len({Path(video).parent.name for video in info["overall"]["video_paths"]}) == len(tasks)


@pytest.mark.nightly
def test_the_smoke_evaluation_trains_evaluates_films_and_writes_its_metrics(tmp_path):
    path = f"{BIN}:/usr/bin:/bin"
    call("/bin/bash", str(ROOT / "examples" / "smoke_evaluation.sh"), OUT=str(tmp_path), PATH=path)
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["n_episodes"] == 1 and metrics["pc_success"] == 0.0 and metrics["eval_s"] > 0
    assert metrics["task_descriptions"] == {"brick_to_bin": get_task("brick_to_bin").instruction}
    for folder in (tmp_path / "eval", tmp_path / "train" / "eval"):
        assert [video.stat().st_size > 1000 for video in folder.rglob("*.mp4")] == [True]
