"""What the configuration refuses, and what it takes from a data set."""

import math

import pytest
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies import make_policy

from lerobot_constructskill.errors import UserError
from lerobot_constructskill.policies.frozen_vit.configuration_frozen_vit import FrozenViTChunkConfig

CAMERA = {"observation.images.base": PolicyFeature(FeatureType.VISUAL, (3, 480, 640))}
FEATURES = {"observation.features.base": PolicyFeature(FeatureType.STATE, (384,))}
OTHER = {"observation.images.top": PolicyFeature(FeatureType.VISUAL, (3, 224, 224))}
STATE = {"observation.state": PolicyFeature(FeatureType.STATE, (8,))}


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"backbone": "resnet18"}, "dinov2_vits14, clip_vitb16, vit_tiny16, vit_tiny16_augreg"),
        ({"backbone_precision": "float16"}, "auto, float32, bfloat16"),
        ({"gripper_head": "mse"}, "bce, regression"),
        ({"chunk_size": 0}, "from 1 to .*, not 0"),
        ({"n_action_steps": 9, "temporal_ensemble_coeff": None}, "between 1 and chunk_size=8, not 9"),
        ({"n_action_steps": 2}, "must be 1 with temporal ensembling, got 2"),
        ({"n_obs_steps": 2}, "must be 1, not 2"),
        ({"action_scale": 0.0}, "above 0 m and rad .* not 0.0"),
        ({"crop": [0.5, 0.0, 0.2, 1.0]}, r"left, top, right and bottom .* got \[0.5, 0.0, 0.2, 1.0\]"),
        ({"crop": [0.1, 0.9]}, r"got \[0.1, 0.9\]"),
        ({"crop": [0.5, 0.5, 0.501, 0.501]}, "at least two pixels of 224 apart"),
        ({"head_hidden_dim": 0}, "from 1 to .*, not 0"),
        ({"head_hidden_layers": 0}, "from 1 to 16, not 0"),
        ({"regression_loss": "huber"}, "mse, l1"),
        ({"readout": "max"}, "cls, mean, cls_mean, spatial_softmax, attention, heat_maps"),
        ({"readout": "mean", "standardize_features": True}, "readout=cls only, not mean"),
        ({"regression_weight": 0}, "above 0 .* not 0"),
        ({"readout": "spatial_softmax", "point_weight": 2.0}, "readout=spatial_softmax finds none"),
        ({"backbone_sha256": "0" * 12}, "64 hexadecimal digits"),
        ({"scheduler_warmup_steps": -1}, "from 0 to .* not -1"),
        ({"regression_weight": math.nan}, "regression_weight must be a finite number above 0 .* not nan"),
        ({"temporal_ensemble_coeff": math.nan}, "not nan"),
        ({"gripper_threshold": math.nan}, "not nan"),
        ({"action_scale": math.inf}, "not inf"),
        ({"chunk_size": 1000}, "temporal_ensemble_coeff must be within 0.08 of 0 with chunk_size=1000"),
        ({"action_names": ["dx", "dy", "dz"]}, "gripper"),
        ({"normalization_mapping": dict.fromkeys(("VISUAL", "STATE", "ACTION"), "MEAN_STD")}, "IDENTITY for VISUAL"),
        ({"action_names": ["gripper"]}, "one or more of"),
        ({"action_names": ["dx", "dx", "gripper"]}, "each once"),
        ({"action_names": ["joint_0", "gripper"]}, "joint_0"),
    ],
)
def test_nonsense_is_refused_with_the_valid_choices(fields: dict, said: str):
    with pytest.raises(UserError, match=said) as refusal:
        FrozenViTChunkConfig(device="cpu", **fields)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("names", [["dx", "dy", "dz", "gripper"], ["dx", "dy", "dz", "dyaw", "gripper"]])
def test_action_names_come_from_the_data_set(names: list[str]):
    config = FrozenViTChunkConfig(device="cpu")
    config.set_dataset_feature_metadata({"action": {"dtype": "float32", "shape": (len(names),), "names": names}})
    assert config.action_names == names


@pytest.mark.parametrize("names", [None, {"motors": ["dx", "gripper"]}, ["gripper", "dx"], ["q0", "q1"]])
def test_other_action_names_are_refused(names: object):
    with pytest.raises(ValueError, match="one or more of dx, dy, dz"):
        FrozenViTChunkConfig(device="cpu").set_dataset_feature_metadata({"action": {"names": names}})


def test_a_checkpoint_refuses_a_data_set_with_other_actions():
    config = FrozenViTChunkConfig(device="cpu", pretrained_path="somewhere")
    with pytest.raises(ValueError, match="The checkpoint acts in"):
        config.set_dataset_feature_metadata({"action": {"names": ["dx", "dy", "gripper"]}})


@pytest.mark.parametrize(("inputs", "shape"), [(CAMERA, (3, 480, 640)), (FEATURES, (3, 224, 224))])
def test_inputs_are_narrowed_to_the_one_camera(inputs: dict, shape: tuple):
    config = FrozenViTChunkConfig(device="cpu", input_features={**inputs, **OTHER, **STATE})
    for _ in range(2):
        config.validate_features()
        assert config.input_features == {"observation.images.base": PolicyFeature(FeatureType.VISUAL, shape)}


def test_the_state_is_an_input_on_request():
    config = FrozenViTChunkConfig(device="cpu", use_state=True, input_features=CAMERA | STATE)
    config.validate_features()
    assert set(config.input_features) == set(CAMERA | STATE)


@pytest.mark.parametrize(
    ("fields", "inputs", "said"),
    [
        ({}, OTHER | STATE, "the inputs are: observation.images.top, observation.state"),
        ({"camera": "wrist"}, CAMERA, "observation.images.wrist"),
        ({"use_state": True}, CAMERA, "use_state needs observation.state"),
        ({"output_features": {"action": PolicyFeature(FeatureType.ACTION, (7,))}}, CAMERA, "4 numbers .* set 7: give"),
    ],
)
def test_missing_inputs_are_named(fields: dict, inputs: dict, said: str):
    with pytest.raises(ValueError, match=said):
        FrozenViTChunkConfig(device="cpu", input_features=inputs, **fields).validate_features()


@pytest.mark.parametrize("dtype", ["video", "image"])
def test_a_data_set_of_another_rate_is_refused(dtype, tmp_path):
    image = {"dtype": dtype, "shape": (224, 224, 3), "names": ["height", "width", "channels"]}
    action = {"dtype": "float32", "shape": (2,), "names": ["dx", "gripper"]}
    features = {"observation.images.base": image, "action": action}
    meta = LeRobotDatasetMetadata.create("local/slow", 30, features, root=tmp_path / "slow")
    tiny = {"device": "cpu", "backbone": "vit_tiny16", "backbone_pretrained": False}
    with pytest.raises(UserError, match="data set has 30 frames a second and the policy acts at 20 Hz"):
        make_policy(FrozenViTChunkConfig(**tiny), ds_meta=meta)
    assert make_policy(FrozenViTChunkConfig(**tiny, fps=30), ds_meta=meta).config.fps == 30


def test_an_unknown_device_is_refused():
    with pytest.raises(UserError, match="device must be one of cpu, cuda, mps, xpu, not 'quantum'"):
        FrozenViTChunkConfig(device="quantum")
