"""A stranger's policy goes the whole way on a lossless data set: the plugin of examples/your_policy, installed.

It is installed into a folder of its own, which Python finds, so that the environment of the tests stays as it is.
"""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from lerobot.configs import PreTrainedConfig

from lerobot_constructskill.analysis.report.page import write_report
from lerobot_constructskill.artifacts.digests import installed
from lerobot_constructskill.dagger.plan import Plan
from lerobot_constructskill.dagger.settings import DaggerConfig
from lerobot_constructskill.lerobot_internals import load_plugins
from lerobot_constructskill.parsing import parse
from lerobot_constructskill.scripts.held_out import FitNoiseConfig, OfflineConfig, evaluate_offline, fit_noise
from lerobot_constructskill.scripts.study import StudyConfig, study
from lerobot_constructskill.scripts.submit import SubmitConfig, submit
from lerobot_constructskill.scripts.verify import VerifyConfig, verify
from lerobot_constructskill.study.plan import list_runs
from lerobot_constructskill.study.rows import read_rows

pytestmark = [pytest.mark.sim, pytest.mark.slow]

EXAMPLE = Path(__file__).parents[1] / "examples" / "your_policy"
PLUGIN, TYPE = "lerobot_policy_tinybc", "tinybc"
ENV = {"task": "brick_to_bin", "obs_type": "pixels_agent_pos", "episode_length": 4}
STUDY = {
    "name": "mine",
    "settings": {"bin": {"data": "smoke --obs_type=pixels_agent_pos --video=lossless", "env": ENV}},
    "variants": {"mine": {"policy": {"type": TYPE}, "seeds": 2}},
    "references": {"no_op": 1},
    "training": {"epochs": 1, "batch_size": 32, "holdout": 2},
    "episodes": 1,
    "eval_seed": 5000,
}
ABOUT = dict.fromkeys(("name", "submitter", "policy", "revision", "data", "training", "compute"), "a test's")
SETTINGS = {"brick_to_bin": {"task": "brick_to_bin", "episodes": 1, "episode_length": 4, "first_start": 5000}}


def forget() -> None:
    """Let this process begin again as one that has imported no plugin."""
    PreTrainedConfig._choice_registry.pop(TYPE, None)
    for name in [name for name in sys.modules if name.partition(".")[0] == PLUGIN]:
        del sys.modules[name]
    load_plugins.cache_clear()
    installed.cache_clear()


@pytest.fixture(scope="module", autouse=True)
def plugin(tmp_path_factory):
    """The plugin's source where pip installs it, and Python finds it in this process and those that it starts."""
    site = tmp_path_factory.mktemp("site")
    uv = shutil.which("uv")
    install = (
        [uv, "pip", "install", f"--python={sys.executable}"]
        if uv
        else [sys.executable, "-m", "pip", "install", "--disable-pip-version-check"]
    )
    subprocess.run([*install, f"--target={site}", "--no-deps", "--no-build-isolation", EXAMPLE], check=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(site)
        patch.setenv("PYTHONPATH", str(site))
        patch.setenv("HF_HUB_OFFLINE", "1")
        patch.setenv("CUDA_VISIBLE_DEVICES", "")
        yield site / PLUGIN
    forget()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mine")
    (folder / "mine.yaml").write_text(yaml.safe_dump(STUDY, sort_keys=False))
    return folder


def config(folder: Path, *flags: str) -> StudyConfig:
    where = [f"--root={folder / 'study'}", f"--store={folder / 'store'}", "--workers=1"]
    return parse(StudyConfig, [*where, *flags], folder / "mine.yaml")


def digests(folder: Path) -> dict[str, str]:
    """Of all runs, as the plugin is now."""
    return {run.id: run.digest for run in list_runs(config(folder).study)}


@pytest.fixture(scope="module")
def studied(folder, plugin) -> dict[str, str]:
    """The digests of the study's runs, both seeds trained by `lerobot-train` in a process of its own."""
    forget()
    study(config(folder))
    return digests(folder)


@pytest.fixture
def checkpoint(folder, studied) -> Path:
    """Of the first seed, for a process that has imported no plugin."""
    forget()
    return folder / "store" / "runs" / studied["bin/mine/seed_0"] / "checkpoint"


@pytest.fixture
def demonstrations(folder, studied) -> Path:
    (made,) = (folder / "store" / "demonstrations").iterdir()
    return made


def test_it_is_trained_evaluated_and_reported_with_its_held_out_error(folder, studied):
    rows = read_rows(folder / "study" / "rows.parquet")
    mine = rows[rows["variant"] == "mine"]
    assert len(mine) == 2 and not mine["error_kind"].notna().any(), mine["error"].tolist()
    assert mine["heldout_mse_m2"].between(1e-7, 0.1).all() and mine["heldout_mse_m2"].nunique() == 2
    assert mine["versions"].str.contains(rf'"{PLUGIN}": "0.1.0, source [0-9a-f]{{12}}"').all()
    write_report(folder / "study")
    told = [line for line in (folder / "study" / "report.md").read_text().splitlines() if line.startswith("| mine")]
    assert f"{mine['heldout_mse_m2'].mean() * 1e4:.2f}" in told[0]


def test_lerobot_evaluates_its_checkpoint(checkpoint, tmp_path, monkeypatch):
    from lerobot.scripts.lerobot_eval import main

    env = [f"--env.{name}={value}" for name, value in ENV.items()]
    one = ["--eval.n_episodes=1", "--eval.batch_size=1", "--eval.use_async_envs=false", f"--output_dir={tmp_path}"]
    flags = ["lerobot-eval", f"--policy.path={checkpoint}", "--env.type=constructskill", *env, *one]
    monkeypatch.setattr(sys, "argv", flags)
    main()
    assert json.loads((tmp_path / "eval_info.json").read_text())["overall"]["n_episodes"] == 1


def read_offline(checkpoint: Path, demonstrations: Path, out: Path) -> None:
    asked = OfflineConfig(policies=[str(checkpoint)], repo_id="local/mine", root=demonstrations, episodes=[1], out=out)
    assert TYPE in evaluate_offline(asked)


def read_to_fit_noise(checkpoint: Path, demonstrations: Path, out: Path) -> None:
    named = {"policy_path": str(checkpoint), "repo_id": "local/mine", "root": demonstrations}
    assert "Noise of" in fit_noise(FitNoiseConfig(**named, out=out / "dart.yaml", episodes=[1]))


def read_to_drive(checkpoint: Path, demonstrations: Path, out: Path) -> None:
    """As far as the plan of its rounds."""
    assert Plan.of(DaggerConfig("local/driven", {"type": TYPE})).learner.config.type == TYPE


@pytest.mark.parametrize("command", [read_offline, read_to_fit_noise, read_to_drive])
def test_a_command_that_reads_a_policy_knows_that_of_a_plugin(command, checkpoint, demonstrations, tmp_path):
    command(checkpoint, demonstrations, tmp_path)


def test_it_is_submitted_and_verified(folder, studied, tmp_path):
    about, settings = tmp_path / "about.yaml", tmp_path / "settings.yaml"
    about.write_text(yaml.safe_dump(ABOUT | {"observes": ENV["obs_type"]}))
    settings.write_text(yaml.safe_dump(SETTINGS))
    made_from = {"study": folder / "study", "variant": "mine", "store": folder / "store", "settings": settings}
    assert "2 episodes of 2 training seeds" in submit(SubmitConfig("bins", about, tmp_path / "entry", **made_from))
    assert "2 of 2 episodes replayed" in verify(VerifyConfig(tmp_path / "entry", workers=1))


def test_an_edited_line_makes_its_runs_stale_and_nothing_else(folder, studied, plugin):
    """The last test of this file: it edits the plugin."""
    before = study(config(folder, "--status=true"))
    assert "bin/mine: 2 finished, 0 failed, 0 missing" in before and before.endswith("Nothing to make.")
    source = plugin / "modeling_tinybc.py"
    source.write_text(
        source.read_text().replace("nn.Linear(32 * 36 + n_state, 256)", "nn.Linear(32 * 36 + n_state, 128)")
    )
    lines = study(config(folder, "--status=true")).splitlines()
    assert f"bin/mine: 0 finished, 0 failed, 2 missing (2 made before with another {PLUGIN})" in lines
    assert any(line.startswith("To make: 2 runs, about ") for line in lines)
    assert set(before.splitlines()[:-1]) - {*lines} == {"bin/mine: 2 finished, 0 failed, 0 missing"}
    assert [run for run, digest in digests(folder).items() if digest != studied[run]] == [
        f"bin/mine/seed_{i}" for i in (0, 1)
    ]
