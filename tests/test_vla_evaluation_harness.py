"""The adapter in examples/vla_evaluation_harness under the harness's own classes, with a real environment.

In all but one test the expert answers in place of the harness's web socket. Its Dockerfile is not built here.
"""

import asyncio
import json
import os
import socket
import subprocess
import sys
import time
from pathlib import Path
from urllib.error import URLError
from urllib.request import urlopen

import numpy as np
import pytest
import yaml
from commands import call
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.policies import make_pre_post_processors
from random_features import config, tiny_weights  # noqa: F401

from lerobot_constructskill.contract import (
    ACTION_SCALE,
    ACTIONS,
    FULL_ACTION,
    GRIPPER_OPEN,
    OBS_TYPES,
    REWARD_PLACED,
    get_task,
)
from lerobot_constructskill.demos.expert import ExpertConfig, PrivilegedState, make_expert
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.sim.actions import LEAST, Clipping

pytest.importorskip("vla_eval", reason="extra `evaluators`")

from vla_eval.config import EvalConfig
from vla_eval.orchestrator import Connection, Orchestrator
from vla_eval.registry import resolve_import_string
from vla_eval.render import apply_render_mode
from vla_eval.runners.sync_runner import SyncEpisodeRunner
from vla_eval.specs import (
    GRIPPER_CLOSE_NEG,
    GRIPPER_CLOSE_POS,
    IMAGE_RGB,
    POSITION_DELTA,
    ROTATION_AA,
    STATE_JOINT,
    check_specs,
)

FOLDER = Path(__file__).parents[1] / "examples" / "vla_evaluation_harness"
ENTRIES = yaml.safe_load((FOLDER / "eval.yaml").read_text())["benchmarks"]


@pytest.fixture
def benchmark_class(monkeypatch):
    monkeypatch.syspath_prepend(FOLDER)
    return resolve_import_string(ENTRIES[0]["benchmark"])


class Teacher:
    """The connection to a model server, with the scripted expert at its other end."""

    def __init__(self, benchmark, task):
        self.benchmark, self.expert, self.progress = benchmark, make_expert(get_task(task), ExpertConfig()), None
        self.last = None

    async def start_episode(self, payload):
        self.task = payload["task"]

    async def act(self, observation):
        assert {name: image.shape for name, image in observation["images"].items()} == {
            "base": (224, 224, 3),
            "wrist": (224, 224, 3),
        }
        assert observation["state"].shape == (8,) and observation["task_description"] == self.task["instruction"]
        state = PrivilegedState(**self.benchmark._env.privileged_state())
        if self.last is None or self.progress is not None:
            action, _, self.progress = self.expert.act(state, self.progress or self.expert.start(state))
            # What a model of seven numbers sends: rotations that this task does not have stay unheard.
            self.last = {"actions": np.insert(action, 3, [ACTION_SCALE] * 3)}
            return self.last
        return self.benchmark.get_hold_action(self.last)

    async def end_episode(self, result):
        self.result = result


@pytest.mark.sim
@pytest.mark.slow
def test_the_expert_succeeds_through_the_harness(benchmark_class, monkeypatch):
    for name in ("LP_NUM_THREADS", "OMP_NUM_THREADS"):
        monkeypatch.setenv(name, "1")
    monkeypatch.setattr(benchmark_class, "_render_backend", "auto")
    assert set(apply_render_mode(benchmark_class, "cpu", "ours")) == {"LP_NUM_THREADS", "OMP_NUM_THREADS"}
    benchmark = benchmark_class(tasks="brick_to_bin", max_steps=200)
    (task,) = benchmark.get_tasks()
    teacher = Teacher(benchmark, task["name"])
    steps = benchmark.get_metadata()["max_steps"]
    result = asyncio.run(SyncEpisodeRunner().run_episode(benchmark, task, teacher, max_steps=steps))
    assert result["metrics"] == {"success": True, "lifted": True} == dict.fromkeys(benchmark.get_metric_keys(), True)
    assert result == teacher.result and 60 < result["steps"] < steps
    assert benchmark._last_result.reward == REWARD_PLACED and benchmark.render().ndim == 3
    assert benchmark._last_result.info["clipped_steps"] == 0
    with pytest.raises(InputError, match="sends 5 numbers"):
        benchmark.step({"actions": np.zeros(5)})
    benchmark.cleanup()
    assert benchmark.render() is None


@pytest.mark.sim
@pytest.mark.parametrize("action", ACTIONS)
def test_a_model_that_sends_normalised_actions_is_told_so(action, benchmark_class, monkeypatch, caplog):
    monkeypatch.setattr(Clipping, "has_warned", False)
    benchmark = benchmark_class(tasks="brick_to_bin", action=action)
    (task,) = benchmark.get_tasks()
    asyncio.run(benchmark.start_episode(task))
    steps = [benchmark.step({"actions": [0.6, -0.4, 0.9, 0, 0, 0, 1]}) for _ in range(LEAST)]
    benchmark.cleanup()
    assert steps[-1].info["clipped_steps"] == LEAST and "were clipped" in caplog.text


@pytest.mark.sim
@pytest.mark.slow
def test_an_episode_is_its_seed(benchmark_class):
    benchmark = benchmark_class(tasks="brick_to_bin_shifted", seed=7)
    (task,) = benchmark.get_tasks()

    def first_image(episode):
        asyncio.run(benchmark.start_episode(task | {"episode_idx": episode}))
        return asyncio.run(benchmark.get_observation())["images"]["base"]

    images = [first_image(episode) for episode in (0, 1, 0)]
    benchmark.cleanup()
    assert (images[0] == images[2]).all() and (images[0] != images[1]).any()


@pytest.mark.sim
@pytest.mark.parametrize("perturb", ["language=3", "wrong_task=1"])
def test_the_model_is_told_the_sentence_of_the_perturbation(perturb, benchmark_class):
    benchmark = benchmark_class(tasks="brick_to_grey", perturb=perturb, perturb_seed=1)
    (task,) = benchmark.get_tasks()
    asyncio.run(benchmark.start_episode(task))
    told = asyncio.run(benchmark.get_observation())["task_description"]
    assert told == benchmark._env.task_description != get_task("brick_to_grey").instruction
    benchmark.cleanup()


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda entry: entry["subname"])
def test_every_entry_of_the_yaml_makes_a_benchmark(entry, benchmark_class):
    read = EvalConfig.from_dict(entry)
    benchmark = resolve_import_string(read.benchmark)(**read.params)
    assert type(benchmark) is benchmark_class
    assert all(task["instruction"] == get_task(task["name"]).instruction for task in benchmark.get_tasks())
    assert benchmark.get_metadata()["max_steps"] == max(
        get_task(task["name"]).horizon for task in benchmark.get_tasks()
    )
    specs = benchmark.get_action_spec(), benchmark.get_observation_spec()
    assert check_specs(specs[0], specs[0], specs[1], specs[1]) == []


def test_a_task_that_turns_says_so(benchmark_class):
    spec = benchmark_class(tasks="brick_to_bin_turned").get_action_spec()
    assert spec["rotation"].format == "delta_dyaw_radians" and sum(part.dims for part in spec.values()) == 5


def test_a_model_with_another_contract_is_told_field_by_field_before_the_first_episode(benchmark_class):
    benchmark = benchmark_class(tasks="brick_to_bin_turned")
    own, seen = benchmark.get_action_spec(), benchmark.get_observation_spec()
    theirs = {"position": POSITION_DELTA, "rotation": ROTATION_AA, "gripper": GRIPPER_CLOSE_POS}
    told = check_specs(theirs, own, {"wrist": IMAGE_RGB, "state": STATE_JOINT}, seen)
    assert sorted(line.split(":")[0] for line in told) == [
        "action [gripper]",
        "action [position]",
        "action [rotation]",
        "observation [state]",
    ]
    assert check_specs(own | {"gripper": GRIPPER_CLOSE_NEG}, own, seen, seen) == []


def test_holding_keeps_the_gripper_and_moves_nothing(benchmark_class):
    benchmark = benchmark_class(tasks="brick_to_bin")
    assert benchmark.get_hold_action(None)["actions"].tolist() == [0, 0, 0, GRIPPER_OPEN]
    assert benchmark.get_hold_action({"actions": np.array([0.1, 0, 0, -1])})["actions"].tolist() == [0, 0, 0, -1]


TAKEN = {
    4: {"tasks": "brick_to_bin"},
    5: {"tasks": "brick_to_bin_turned"},
    7: {"tasks": "bins,brick_to_bin_turned", "action": "full"},
}
"""Length of an action to what asks for it."""


@pytest.mark.parametrize("sent", TAKEN)
@pytest.mark.parametrize("asked", TAKEN)
def test_tasks_take_their_own_numbers_or_seven(asked, sent, benchmark_class, monkeypatch, tmp_path, caplog):
    """The harness's own start of a run, with no episode in it."""
    told = {name: spec.to_dict() for name, spec in benchmark_class(**TAKEN[sent]).get_action_spec().items()}

    async def connect(self, **_):
        self.server_info = {"action_spec": told, "observation_params": {"action_length": sent}}

    monkeypatch.setattr(Connection, "connect", connect)
    entry = {"benchmark": ENTRIES[0]["benchmark"], "params": TAKEN[asked], "episodes_per_task": 0}
    run = Orchestrator({"benchmarks": [entry], "output_dir": str(tmp_path)}, no_save=True).run()
    if sent not in (asked, 7):
        own = "" if asked == 7 else rf"{asked} \(.* or "
        with pytest.raises(InputError, match=rf"sends {sent} numbers a step, .* take {own}7 \(.*`action: full`"):
            asyncio.run(run)
        return
    with caplog.at_level("INFO"):
        asyncio.run(run)
    assert "Spec validation passed" in caplog.text and "cannot be forwarded" not in caplog.text
    benchmark = benchmark_class(**TAKEN[asked])
    names = get_task(benchmark.get_tasks()[-1]["name"], TAKEN[asked].get("action", "task")).action_names
    assert sum(part.dims for part in benchmark.get_action_spec().values()) == len(names) == asked
    last = {"actions": np.arange(sent)}
    assert benchmark.get_hold_action(last)["actions"].tolist() == [0] * (asked - 1) + [sent - 1]
    places = [FULL_ACTION.index(name) for name in names] if sent == 7 else range(sent)
    assert benchmark._command(last["actions"]).tolist() == [*places]


def test_an_action_is_one_of_two(benchmark_class):
    with pytest.raises(InputError, match="action must be one of task, full, not 'half'"):
        benchmark_class(action="half")


@pytest.fixture(params=["base"])
def untrained(request, config, tmp_path) -> Path:  # noqa: F811
    """A checkpoint of frozen_vit as LeRobot keeps one, its heads random, which looks through one camera."""
    from lerobot_constructskill.policies.frozen_vit.modeling_frozen_vit import FrozenViTChunkPolicy

    fields = config(save_backbone=True, camera=request.param)
    fields.input_features = {f"observation.images.{request.param}": PolicyFeature(FeatureType.VISUAL, (3, 224, 224))}
    FrozenViTChunkPolicy(fields).save_pretrained(tmp_path / "untrained")
    for processor in make_pre_post_processors(fields):
        processor.save_pretrained(tmp_path / "untrained")
    return tmp_path / "untrained"


@pytest.mark.parametrize("untrained", ["base", "wrist"], indirect=True)
def test_the_model_server_gives_a_policy_the_camera_that_it_was_trained_on(untrained, monkeypatch):
    monkeypatch.syspath_prepend(FOLDER)
    server_class = resolve_import_string("model_server:ModelServer")
    own = json.loads((untrained / "config.json").read_text())["camera"]
    cameras = dict.fromkeys(OBS_TYPES["pixels_agent_pos"])

    def sees(images, **options):
        server = server_class("frozen_vit", str(untrained), device="cpu", **options)
        return server._resolve_image_map(images)

    assert sees(cameras) == {own: f"observation.images.{own}"}
    assert sees(cameras, image_keys={"base": own}) == {"base": f"observation.images.{own}"}
    assert sees({"front": None}) == {"front": f"observation.images.{own}"}


@pytest.mark.parametrize("reach, grip, told", [(0.05, -1, []), (0.9, -1, ["position"]), (0.05, 0, ["gripper"])])
def test_the_model_server_says_what_its_checkpoint_was_trained_to_send(untrained, benchmark_class, reach, grip, told):
    fields = PreTrainedConfig.from_pretrained(untrained)
    stats = {"min": [-0.02, -reach, -0.04, grip], "max": [0.01, 0.04, reach, 1.0], "mean": [0.0] * 4, "std": [1.0] * 4}
    for processor in make_pre_post_processors(fields, dataset_stats={"action": stats}):
        processor.save_pretrained(untrained)
    server = resolve_import_string("model_server:ModelServer")("frozen_vit", str(untrained), device="cpu")
    benchmark = benchmark_class(tasks="brick_to_bin")
    asked, seen = benchmark.get_action_spec(), benchmark.get_observation_spec()
    found = check_specs(server.get_action_spec(), asked, server.get_observation_spec(), seen)
    assert [line.split("]")[0] for line in found] == [f"action [{field}" for field in told]
    assert server.get_observation_params()["action_length"] == 4


def wait_for(address: str, server: subprocess.Popen) -> None:
    for _ in range(600):
        assert server.poll() is None, "the server died"
        try:
            return urlopen(f"http://{address}/health").close()
        except URLError:
            time.sleep(0.5)
    pytest.fail("the server does not answer")


@pytest.mark.sim
@pytest.mark.slow
def test_a_checkpoint_acts_through_the_harnesss_own_server_and_web_socket(untrained, tmp_path, monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as free:
        address = f"127.0.0.1:{free.getsockname()[1]}"
    model = {"policy_type": "frozen_vit", "checkpoint": untrained, "device": "cpu", "use_select_action": "true"}
    flags = [f"--args.{name}={value}" for name, value in model.items()]
    entry = {
        "server": {"url": f"ws://{address}"},
        "output_dir": str(tmp_path),
        "benchmarks": [ENTRIES[0] | {"episodes_per_task": 1, "params": {"tasks": "brick_to_bin", "max_steps": 3}}],
    }
    (tmp_path / "one.yaml").write_text(yaml.safe_dump(entry))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(FOLDER), *filter(None, [os.environ.get("PYTHONPATH")])]))
    with subprocess.Popen([sys.executable, FOLDER / "model_server.py", f"--address={address}", *flags]) as server:
        try:
            wait_for(address, server)
            printed = call("vla-eval", "run", f"--config={tmp_path / 'one.yaml'}", "--no-docker", "--render=cpu")
        finally:
            server.terminate()
    (aggregate,) = tmp_path.glob("*_aggregate.json")
    (episode,) = json.loads(aggregate.read_text())["tasks"][0]["episodes"]
    assert episode["steps"] == 3 and episode["metrics"] == {"success": False, "lifted": False}, printed
