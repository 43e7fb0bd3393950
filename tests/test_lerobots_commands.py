"""What ours refuses under LeRobot's commands: the reason is the last thing they print."""

import pytest
from commands import call

TRAIN = ("lerobot-train", "--dataset.repo_id=local/none", "--policy.push_to_hub=false", "--policy.type=frozen_vit")
EVAL = ("lerobot-eval", "--policy.type=frozen_vit", "--env.type=constructskill")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "flag", "said"),
    [
        (TRAIN, "--policy.chunk_size=0", "chunk_size must be a whole number from 1 to 1000 steps, not 0."),
        (TRAIN, "--policy.gripper_head=softmax", "gripper_head must be one of bce, regression, not 'softmax'."),
        (TRAIN, "--policy.regression_weight=nan", "regression_weight must be a finite number above 0"),
        (TRAIN, "--policy.device=quantum", "device must be one of cpu, cuda, mps, xpu, not 'quantum'."),
        (EVAL, "--env.task=nope", "Unknown task 'nope'; the tasks are: brick_to_bin"),
        (EVAL, "--env.episode_length=-5", "episode_length must be a whole number from 1 to 100000 steps, not -5."),
        (EVAL, "--env.perturb=rain=1", "Unknown perturbation 'rain'"),
    ],
)
def test_the_reason_is_the_last_line(command: tuple[str, ...], flag: str, said: str, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert said in call(*command, flag, fails=True).strip().splitlines()[-1]
    assert not list(tmp_path.iterdir())
