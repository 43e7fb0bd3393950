"""What ours refuses under LeRobot's commands: the reason is the last thing they print.

A field of each kind: all refuse in the same way, and what they refuse is tested where they are.
"""

import pytest
from commands import call

TRAIN = ("lerobot-train", "--dataset.repo_id=local/none", "--policy.push_to_hub=false", "--policy.type=frozen_vit")
EVAL = ("lerobot-eval", "--policy.type=frozen_vit", "--env.type=constructskill")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "flag", "said"),
    [
        (TRAIN, "--policy.chunk_size=0", "chunk_size must be a whole number from 1 to 1000 steps, not 0."),
        (TRAIN, "--policy.device=quantum", "device must be one of cpu, cuda, mps, xpu, not 'quantum'."),
        (EVAL, "--env.task=nope", "Unknown task 'nope'; the tasks are: brick_to_bin"),
    ],
)
def test_the_reason_is_the_last_line(command: tuple[str, ...], flag: str, said: str, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert said in call(*command, flag, fails=True).strip().splitlines()[-1]
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_program_of_ones_own_ends_with_its_traceback(tmp_path, monkeypatch) -> None:
    """One wants to know where."""
    monkeypatch.chdir(tmp_path)
    code = "import lerobot_constructskill.plugin as plugin; plugin.ConstructSkillEnvConfig(task='none')"
    assert "Traceback" in call("code", code, fails=True)
