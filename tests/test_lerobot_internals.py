"""What we rely on in LeRobot: each test that fails says in one sentence what a new LeRobot has changed."""

import ast
import inspect
import json
from collections.abc import Iterator
from dataclasses import asdict
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.datasets import CODEBASE_VERSION
from lerobot.policies import PreTrainedPolicy, make_policy
from lerobot.utils import constants

from lerobot_constructskill import lerobot_internals
from lerobot_constructskill.lerobot_internals import LAST_CHECKPOINT, NAMES, TRAIN_CONFIG
from lerobot_constructskill.policies.frozen_vit.configuration_frozen_vit import FrozenViTChunkConfig
from lerobot_constructskill.policies.frozen_vit.encoder import EncoderRecord
from lerobot_constructskill.policies.frozen_vit.modeling_frozen_vit import FrozenViTChunkPolicy

ROOT = Path(__file__).parents[1]
OURS = [
    path for folder in ("lerobot_constructskill", "examples", "benchmarks") for path in (ROOT / folder).rglob("*.py")
]
LEROBOT = f"LeRobot {version('lerobot')}"


def lerobots_names(path: Path) -> Iterator[tuple[str, str]]:
    """Module and name of what a file imports from LeRobot."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "lerobot":
            yield from ((node.module, alias.name) for alias in node.names)


def test_lerobot_exports_what_we_import_from_it():
    used = {pair for path in OURS for pair in lerobots_names(path)}
    hidden = sorted(
        f"{module}.{name}" for module, name in used if name not in getattr(import_module(module), "__all__", ())
    )
    assert used and not hidden, f"{LEROBOT} does not export {hidden}: take them through lerobot_internals.py."


CALLS = {
    "_LazyAsyncVectorEnv": (("env_fns", "observation_space", "action_space", "metadata"), {}),
    "FreezeAfterEpisodeEnd": (("env",), {}),
    "compute_episode_stats": (("columns", "features"), {}),
    "decode_video_frames": (("path", "times", "tolerance"), {"return_uint8": True}),
    "load_episodes": (("folder",), {}),
    "load_info": (("folder",), {}),
    "load_stats": (("folder",), {}),
    "write_video": (("path", "frames", "fps"), {}),
    "CosineAnnealingWithWarmupSchedulerConfig": (("num_warmup_steps",), {}),
    "register_third_party_plugins": ((), {}),
    "ArgumentParser": (("config_class", "config_path"), {"exit_on_error": False, "epilog": None}),
}
"""How we call what can be called."""


@pytest.mark.parametrize("name", NAMES)
def test_an_internal_is_where_it_was_and_takes_what_we_give(name):
    found = getattr(lerobot_internals, name)  # says itself what is gone
    given, named = CALLS.get(name, ((), {}))
    try:
        name in CALLS and inspect.signature(found).bind(*given, **named)
    except TypeError as error:
        pytest.fail(f"{LEROBOT} takes other arguments for {NAMES[name]}.{name} than {given} and {named}: {error}.")


def test_what_lerobot_no_longer_has_is_named_in_one_sentence(monkeypatch):
    monkeypatch.setitem(NAMES, "gone", "lerobot.utils.io_utils")
    monkeypatch.setitem(NAMES, "gone_too", "lerobot.no_such_module.inside")
    for name in ("gone", "gone_too"):
        with pytest.raises(OSError, match=rf"LeRobot .* has no {NAMES[name]}\.{name}, which .*docs/lerobot\.md"):
            getattr(lerobot_internals, name)


def test_files_lie_where_lerobot_puts_them():
    last = Path(constants.CHECKPOINTS_DIR, constants.LAST_CHECKPOINT_LINK, constants.PRETRAINED_MODEL_DIR)
    assert last == LAST_CHECKPOINT, f"{LEROBOT} keeps its last checkpoint in {last}."
    train_config = import_module("lerobot.configs.train").TRAIN_CONFIG_NAME
    assert train_config == TRAIN_CONFIG, f"{LEROBOT} calls a checkpoint's training configuration {train_config}."
    assert CODEBASE_VERSION == "v3.0", f"{LEROBOT} writes data sets of format {CODEBASE_VERSION}; dataset/ reads v3.0."


def test_outcomes_are_read_from_what_an_evaluation_keeps():
    kept = import_module("lerobot.scripts.lerobot_eval").TaskMetrics.__annotations__
    assert "max_rewards" in kept, f"{LEROBOT} keeps of a task's episodes in eval_info.json only {list(kept)}."


class Meta:
    """A data set's metadata, as far as `make_policy` reads it."""

    features = {
        "observation.images.base": {
            "dtype": "video",
            "shape": (224, 224, 3),
            "names": ["height", "width", "channels"],
        },
        "action": {"dtype": "float32", "shape": (4,), "names": ["dx", "dy", "dz", "gripper"]},
    }
    stats = {"action": {"mean": np.zeros(4)}}
    root, fps = Path("nowhere"), 20


def test_a_policy_is_told_what_its_data_set_is(monkeypatch):
    told = {}

    def init(self, config, **kwargs):
        told.update(kwargs, config=config)
        raise InterruptedError

    monkeypatch.setattr(FrozenViTChunkPolicy, "__init__", init)
    monkeypatch.setattr(FrozenViTChunkConfig, "set_dataset_feature_metadata", lambda _, seen: told.update(seen=seen))
    with pytest.raises(InterruptedError):
        make_policy(FrozenViTChunkConfig(device="cpu"), ds_meta=Meta())
    asked = {"seen": Meta.features, "dataset_stats": Meta.stats}
    assert asked.items() <= told.items(), f"{LEROBOT}'s make_policy tells a policy other things of its data: {told}."
    assert (told["dataset_meta"].root, told["dataset_meta"].fps) == (Meta.root, Meta.fps), (
        f"{LEROBOT}'s make_policy hands no dataset_meta to a policy."
    )
    wanted = PolicyFeature(FeatureType.VISUAL, (3, 224, 224))
    found = told["config"].input_features
    assert found == {"observation.images.base": wanted}, f"{LEROBOT}'s make_policy makes other inputs: {found}."


def test_lerobot_loads_a_checkpoint_by_the_method_that_we_override(monkeypatch, tmp_path):
    given = {}

    def init(self, config, **kwargs):
        given.update(kwargs)
        super(PreTrainedPolicy, self).__init__()

    def load(*args):
        given.update(loads=args)
        raise InterruptedError

    monkeypatch.setattr(FrozenViTChunkPolicy, "__init__", init)
    monkeypatch.setattr(FrozenViTChunkPolicy, "_load_as_safetensor", load)
    record = EncoderRecord(sha256="0" * 64)
    (tmp_path / "encoder.json").write_text(json.dumps(asdict(record)))
    with pytest.raises(InterruptedError):
        FrozenViTChunkPolicy.from_pretrained(tmp_path, config=FrozenViTChunkConfig(device="cpu"))
    assert given["encoder_record"] == record, (
        f"{LEROBOT} keeps from_pretrained's own arguments from a policy: {given}."
    )
    model, file, device, strict = given["loads"]
    assert (Path(file).name, device, strict) == ("model.safetensors", "cpu", False), f"{LEROBOT} loads from {file}."


def test_lerobot_finds_the_queue_of_actions_under_our_name():
    names = getattr(PreTrainedPolicy, "_action_queue_attrs", ("_action_queue",))  # since 0.6.2
    assert "_action_queue" in names, f"{LEROBOT} empties queues named {names}, and ours is _action_queue."
