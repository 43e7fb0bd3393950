"""A feature set, made from a real data set, and the policy that trains on it."""

import json
import shutil
import tracemalloc
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType
from lerobot.datasets import LeRobotDataset, delete_episodes
from lerobot.policies.factory import make_policy, make_pre_post_processors
from safetensors.torch import load_file, save_file

from lerobot_constructskill.artifacts.folders import MARK
from lerobot_constructskill.errors import InputError, MachineError, UserError
from lerobot_constructskill.features import encode as features_encode
from lerobot_constructskill.features.encode import _ahead, load_encoder
from lerobot_constructskill.features.points import POSES, find_points
from lerobot_constructskill.features.trainer import FeatureTrainer
from lerobot_constructskill.policies.frozen_vit import precision
from lerobot_constructskill.policies.frozen_vit import weights as weights_module
from lerobot_constructskill.policies.frozen_vit.backbones import BACKBONES
from lerobot_constructskill.policies.frozen_vit.configuration_frozen_vit import FrozenViTChunkConfig
from lerobot_constructskill.policies.frozen_vit.feature_sets import PATCHES_FILE, close_patches, open_patches
from lerobot_constructskill.policies.frozen_vit.weights import Wheel
from lerobot_constructskill.scripts.encode import EncodeConfig, encode

KEY = "observation.features.base"
LENGTHS = (5, 3)
STORED = pytest.mark.parametrize("source", ["video", "image"], indirect=True)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("encode")


@pytest.fixture(scope="module")
def source(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> LeRobotDataset:
    """Two short episodes: a video unless a test asks for images."""
    dtype = getattr(request, "param", "video")
    image = {"dtype": dtype, "shape": (64, 96, 3), "names": ["height", "width", "channels"]}
    dataset = LeRobotDataset.create(
        "local/source",
        fps=20,
        root=tmp_path_factory.mktemp(dtype) / "source",
        features={
            "observation.images.base": image,
            "observation.images.wrist": image,
            "observation.state": {"dtype": "float32", "shape": (8,), "names": [f"s{i}" for i in range(8)]},
            "action": {"dtype": "float32", "shape": (4,), "names": ["dx", "dy", "dz", "gripper"]},
            "phase": {"dtype": "string", "shape": (1,), "names": None},
            "sim.seed": {"dtype": "int64", "shape": (1,), "names": None},
            **{name: {"dtype": "float32", "shape": (7,), "names": None} for name in POSES.values()},
        },
    )
    rng = np.random.default_rng(0)
    for episode, length in enumerate(LENGTHS):
        for step in range(length):
            frame = np.full((64, 96, 3), 20 * step + 100 * episode, dtype=np.uint8)
            dataset.add_frame(
                {
                    "observation.images.base": frame,
                    "observation.images.wrist": 255 - frame,
                    "observation.state": rng.normal(size=8).astype(np.float32),
                    "action": np.array([*rng.uniform(-0.05, 0.05, 3), 1.0], dtype=np.float32),
                    "phase": "LIFT",
                    "sim.seed": np.array([1_000_000 + episode]),
                    **{name: rng.normal(size=7).astype(np.float32) for name in POSES.values()},
                    "task": f"task {episode}",
                }
            )
        dataset.save_episode()
    dataset.finalize()
    return LeRobotDataset("local/source", root=dataset.root)


@pytest.fixture(scope="module")
def weights(folder: Path) -> Path:
    """Random weights of the real tiny architecture."""
    torch.manual_seed(0)
    save_file(BACKBONES["vit_tiny16"].build().state_dict(), folder / "tiny.safetensors")
    return folder / "tiny.safetensors"


def settings(source: LeRobotDataset, weights: Path, out: Path, **fields: object) -> EncodeConfig:
    fields = {
        "backbone": "vit_tiny16",
        "backbone_path": str(weights),
        "batch_size": 2,
        "device": "cpu",
    } | fields
    return EncodeConfig("local/source", root=source.root, out_repo_id="local/out", out_root=out, **fields)


@pytest.fixture(scope="module")
def encoded(source: LeRobotDataset, weights: Path) -> LeRobotDataset:
    out = source.root.with_name(source.root.name + "_features")
    stale = out.with_name(out.name + ".partial")  # as a killed run leaves it
    (stale / "dataset").mkdir(parents=True)
    (stale / MARK).touch()
    encode(settings(source, weights, out))
    assert not stale.exists()
    return LeRobotDataset("local/out", root=out)


def policy_config(weights: Path, **fields: object) -> FrozenViTChunkConfig:
    fields = {"backbone": "vit_tiny16", "backbone_path": str(weights)} | fields
    return FrozenViTChunkConfig(device="cpu", **fields)


def test_a_device_on_which_the_batch_shows_has_its_own_and_says_so(source, weights, tmp_path, monkeypatch):
    """As a GPU does; on a CPU a set says nothing of it."""
    sizes, encode_batch = set(), features_encode._encode
    monkeypatch.setattr(features_encode, "_encode", lambda *given: sizes.add(len(given[1])) or encode_batch(*given))
    monkeypatch.setattr(features_encode, "BATCHES", {"cpu": 3})
    encode(settings(source, weights, tmp_path / "out", batch_size=None))
    info = LeRobotDataset("local/out", root=tmp_path / "out").meta.features[KEY]["info"]
    assert max(sizes) == 3 and info.items() >= features_encode.batch_facts("cpu").items() == {("batch_size", "3")}


@STORED
def test_what_policies_read_is_as_before_and_nothing_else_is_there(source, encoded):
    assert {name for name in encoded.meta.features if "." in name} == {"observation.state", KEY}
    assert not encoded.meta.camera_keys and not list(encoded.root.rglob("*.mp4"))
    assert encoded.meta.total_episodes == len(LENGTHS) and len(encoded) == sum(LENGTHS)
    assert list(encoded.meta.tasks.index) == list(source.meta.tasks.index)
    assert not any(name.startswith("videos/") for name in encoded.meta.episodes.column_names)
    for before, after in zip(source, encoded, strict=True):
        for name in set(before) & set(after):
            assert (
                torch.equal(before[name], after[name])
                if torch.is_tensor(before[name])
                else before[name] == after[name]
            )
    assert encoded.meta.stats[KEY]["mean"].shape == (192,)
    assert "batch_size" not in encoded.meta.features[KEY]["info"]


@STORED
def test_features_are_the_policys_own_at_every_frame(source, encoded, weights):
    policy = make_policy(policy_config(weights), ds_meta=source.meta)
    for before, after in zip(source, encoded, strict=True):
        feature = policy.backbone(before["observation.images.base"][None])[0]
        torch.testing.assert_close(after[KEY], feature, atol=1e-4, rtol=0)


@pytest.mark.slow
def test_patch_features_on_request(source, weights, tmp_path):
    encode(settings(source, weights, tmp_path / "out", patches=True))
    patches = np.load(tmp_path / "out" / PATCHES_FILE, mmap_mode="r")
    encoder, _ = load_encoder("vit_tiny16", str(weights))
    _, expected = encoder.encode(torch.stack([frame["observation.images.base"] for frame in source]))
    assert patches.shape == (sum(LENGTHS), 196, 192) and patches.dtype == np.float16
    np.testing.assert_allclose(patches, expected, atol=1e-2)
    assert len(LeRobotDataset("local/out", root=tmp_path / "out")) == sum(LENGTHS)


def interrupted(*_):
    raise KeyboardInterrupt


@pytest.mark.slow
def test_a_disk_without_room_for_the_patches_shows_before_they_are_encoded(
    source, weights, tmp_path, monkeypatch, capfd
):
    asked = settings(source, weights, tmp_path / "out", camera="base+wrist", patches=True)
    size = sum(LENGTHS) * 196 * 192 * 2  # bytes of a camera, which are there by episode and joined
    disk = SimpleNamespace(free=4 * size - 1)
    monkeypatch.setattr(features_encode.shutil, "disk_usage", lambda _: disk)
    with pytest.raises(MachineError, match=r"has 2 MB free, and the patch features of 8 frames take 2 MB more"):
        encode(asked)
    assert not [*tmp_path.rglob("*.npy")]
    disk.free += 1
    with monkeypatch.context() as killed, pytest.raises(KeyboardInterrupt):
        killed.setattr(features_encode, "_write_copy", interrupted)
        encode(asked)
    disk.free = 2 * size - 100  # a file of an episode has a header
    encode(asked)
    assert f"Encoding wrist, {size / 1e6:,.0f} MB" in capfd.readouterr().err


@pytest.mark.slow
def test_several_cameras_stand_one_after_the_other_and_a_policy_trains_on_them(source, weights, tmp_path):
    sets, patches = {}, {}
    for camera in ("base", "wrist", "base+wrist"):
        out = encode(settings(source, weights, tmp_path / camera, camera=camera, patches=True))
        sets[camera] = LeRobotDataset("local/features", root=out)
        patches[camera] = open_patches(out).clone()
    names = {camera: f"observation.features.{camera}" for camera in sets}
    pooled = {
        camera: torch.tensor(np.stack(one.hf_dataset.with_format("numpy")[names[camera]]))
        for camera, one in sets.items()
    }
    assert torch.equal(pooled["base+wrist"], torch.cat([pooled["base"], pooled["wrist"]], dim=1))
    assert torch.equal(patches["base+wrist"], torch.cat([patches["base"], patches["wrist"]], dim=1))
    config = policy_config(weights, camera="base+wrist", readout="spatial_softmax")
    policy = make_policy(config, ds_meta=sets["base+wrist"].meta)
    frame = {name: value[None] for name, value in sets["base+wrist"][0].items() if torch.is_tensor(value)}
    seen = {
        f"observation.images.{camera}": source[0][f"observation.images.{camera}"][None] for camera in ("base", "wrist")
    }
    torch.testing.assert_close(policy.head_inputs(frame)[0].float(), policy.head_inputs(seen)[0], atol=1e-2, rtol=1e-2)
    close_patches()


@pytest.mark.slow
def test_points_on_request(source, weights, tmp_path):
    crop = [0.25, 0.5, 0.75, 1.0]
    encode(settings(source, weights, tmp_path / "out", points=True, crop=crop))
    dataset = LeRobotDataset("local/out", root=tmp_path / "out")
    columns = {name: np.stack([frame[name] for frame in source]) for name in POSES.values()}
    written = torch.stack([frame["observation.points.base"] for frame in dataset])
    np.testing.assert_array_equal(written, find_points(columns, "base", crop))


def test_the_description_travels_with_the_data_set(source, encoded, weights):
    info = json.loads((encoded.root / "meta" / "info.json").read_text())["features"][KEY]["info"]
    assert info == encoded.meta.features[KEY]["info"]
    assert info["backbone"] == "vit_tiny16" and info["precision"] == precision.native_precision("cpu")
    assert info["weights_source"] == f"local {weights.name}" and info["source_repo_id"] == "local/source"


def test_the_policy_trains_on_features_and_declares_the_camera(encoded, weights):
    policy = make_policy(policy_config(weights, use_state=True), ds_meta=encoded.meta)
    assert policy.config.image_features["observation.images.base"].type is FeatureType.VISUAL
    chunks = {"action": [i / 20 for i in range(8)]}
    dataset = LeRobotDataset("local/out", root=encoded.root, delta_timestamps=chunks)
    preprocess, _ = make_pre_post_processors(policy.config, dataset_stats=encoded.meta.stats)
    batch = preprocess(torch.utils.data.default_collate([dataset[i] for i in range(4)]))
    loss, _ = policy.train().forward(batch)
    loss.backward()
    assert batch[KEY].shape == (4, 192) and batch["action_is_pad"].any() and torch.isfinite(loss)


@pytest.mark.slow
def test_a_crop_is_all_that_is_encoded_and_the_policys_must_be_the_same(source, weights, tmp_path):
    crop = [0.25, 0.5, 0.75, 1.0]
    encode(settings(source, weights, tmp_path / "out", crop=crop))
    dataset = LeRobotDataset("local/out", root=tmp_path / "out")
    policy = make_policy(policy_config(weights, crop=crop), ds_meta=dataset.meta)
    images = torch.stack([source[i]["observation.images.base"] for i in range(3)])
    seen = policy.predict_action_chunk({"observation.images.base": images})
    features = torch.stack([dataset[i][KEY] for i in range(3)])
    torch.testing.assert_close(policy.predict_action_chunk({KEY: features}), seen, atol=1e-4, rtol=1e-2)
    outside = images.clone()
    outside[..., : images.shape[-2] // 2, :] = 0
    torch.testing.assert_close(policy.predict_action_chunk({"observation.images.base": outside}), seen)
    with pytest.raises(ValueError, match="crop"):
        make_policy(policy_config(weights), ds_meta=dataset.meta)


@pytest.mark.slow
def test_a_readout_of_patches_trains_on_a_set_that_has_them(source, encoded, weights, tmp_path):
    policy_fields = policy_config(weights, readout="mean")
    with pytest.raises(FileNotFoundError, match="--patches=true"):
        make_policy(policy_fields, ds_meta=encoded.meta)
    encode(settings(source, weights, tmp_path / "out", patches=True))
    chunks = {"action": [i / 20 for i in range(8)]}
    dataset = LeRobotDataset("local/out", root=tmp_path / "out", delta_timestamps=chunks)
    policy = make_policy(policy_fields, ds_meta=dataset.meta)
    preprocess, _ = make_pre_post_processors(policy.config, dataset_stats=dataset.meta.stats)
    rows = [5, 0, 3]
    batch = preprocess(torch.utils.data.default_collate([dataset[i] for i in rows]))
    images = torch.stack([source[i]["observation.images.base"] for i in rows])
    seen = policy.predict_action_chunk({"observation.images.base": images})
    torch.testing.assert_close(policy.predict_action_chunk(batch), seen, atol=1e-4, rtol=1e-2)


@pytest.mark.slow
def test_patches_of_other_frames_are_refused(source, weights, tmp_path):
    """Those of the whole set beside an edited one, of an edited one beside the whole, and of as many other frames."""
    encode(settings(source, weights, tmp_path / "whole", patches=True))
    whole = LeRobotDataset("local/out", root=tmp_path / "whole")
    edited = delete_episodes(whole, [0], tmp_path / "edited", "local/edited")
    patches = np.load(whole.root / PATCHES_FILE)
    assert open_patches(whole.root).shape == patches.shape
    for name, rows in {"too many": patches, "as many": patches[LENGTHS[0] :]}.items():
        root = shutil.copytree(edited.root, tmp_path / name)
        np.save(root / PATCHES_FILE, rows)
        with pytest.raises(InputError, match=f"is not of this feature set's {LENGTHS[1]} frames"):
            make_policy(policy_config(weights, readout="mean"), ds_meta=LeRobotDataset("local/out", root=root).meta)
    np.save(tmp_path / "whole" / PATCHES_FILE, patches[::-1])
    close_patches()
    with pytest.raises(InputError, match="encode the data set again with constructskill-encode --patches=true"):
        open_patches(whole.root)


def test_statistics_of_features_far_from_zero_are_those_of_the_frames(source, weights, tmp_path, monkeypatch):
    """In float32 a feature near 1000 that moves by hundredths has no spread."""
    rng = np.random.default_rng(0)
    pooled = (1000 + 0.01 * rng.normal(size=(sum(LENGTHS), 192))).astype(np.float32)
    batches = iter(np.split(pooled, [2, 4, 5, 7]))
    monkeypatch.setattr(features_encode, "_encode", lambda *_: (next(batches), None))
    encode(settings(source, weights, tmp_path / "out"))
    found = LeRobotDataset("local/out", root=tmp_path / "out").meta.stats[KEY]["std"]
    np.testing.assert_allclose(found, pooled.astype(np.float64).std(axis=0), rtol=1e-4)


def test_features_of_another_encoder_are_refused(encoded, weights):
    with pytest.raises(ValueError, match="backbone vit_tiny16 .the policy: vit_tiny16_augreg"):
        make_policy(policy_config(weights, backbone="vit_tiny16_augreg"), ds_meta=encoded.meta)


def test_features_of_a_precision_that_is_missing_here_are_refused_unless_another_is_asked_for(
    source, weights, tmp_path, monkeypatch
):
    monkeypatch.setattr(precision, "_cpu_multiplies_bfloat16", lambda: True)
    encode(settings(source, weights, tmp_path / "out"))
    meta = LeRobotDataset("local/out", root=tmp_path / "out").meta
    assert make_policy(policy_config(weights), ds_meta=meta).backbone.precision == "bfloat16"
    monkeypatch.setattr(precision, "_cpu_multiplies_bfloat16", lambda: False)
    with pytest.raises(ValueError, match="only emulate bfloat16"):
        make_policy(policy_config(weights), ds_meta=meta)
    crossing = make_policy(policy_config(weights, backbone_precision="float32"), ds_meta=meta)
    assert (crossing.backbone.precision, crossing.encoder_record.precision) == ("float32", "bfloat16")


def test_features_of_other_weights_are_refused(encoded, tmp_path):
    torch.manual_seed(1)
    save_file(BACKBONES["vit_tiny16"].build().state_dict(), tmp_path / "other.safetensors")
    with pytest.raises(ValueError, match="weights asked for have sha256 .* but local other.safetensors has"):
        make_policy(policy_config(tmp_path / "other.safetensors"), ds_meta=encoded.meta)


def test_training_takes_the_weights_that_encoded(encoded, weights, tmp_path, monkeypatch):
    """Both sources are faked by local files: a Hub with other weights, and a wheel with those that encoded."""
    state = load_file(weights)
    wheel = Wheel("a-package", ("torch",), "file", lambda file: state)
    spec = replace(BACKBONES["vit_tiny16"], wheel=wheel)
    monkeypatch.setitem(BACKBONES, "vit_tiny16", spec)
    torch.manual_seed(1)
    save_file(spec.build().state_dict(), tmp_path / "other.safetensors")
    monkeypatch.setattr(weights_module, "hub_file", lambda *_: tmp_path / "other.safetensors")
    monkeypatch.setattr(weights_module, "version", lambda distribution: "0")
    policy = make_policy(FrozenViTChunkConfig(backbone="vit_tiny16", device="cpu"), ds_meta=encoded.meta)
    assert policy.encoder_record.source == "a-package 0 wheel"
    assert policy.encoder_record.sha256 == encoded.meta.features[KEY]["info"]["weights_sha256"]
    monkeypatch.setitem(BACKBONES, "vit_tiny16", replace(spec, wheel=None))
    with pytest.raises(ValueError, match="weights asked for have sha256 .* but hub"):
        make_policy(FrozenViTChunkConfig(backbone="vit_tiny16", device="cpu"), ds_meta=encoded.meta)


def test_features_of_pretrained_weights_are_not_those_of_random_ones(encoded, weights, monkeypatch):
    """They are drawn otherwise here than those that stand in for pretrained ones."""
    other = load_file(weights)
    other[min(other)] += 1
    monkeypatch.setattr(weights_module, "_random_state", lambda backbone: other)
    asked = FrozenViTChunkConfig(
        backbone="vit_tiny16", backbone_path=str(weights), backbone_pretrained=False, device="cpu"
    )
    with pytest.raises(ValueError, match="weights asked for have sha256 .* but random, seed 0 has"):
        make_policy(asked, ds_meta=encoded.meta)


@pytest.mark.slow
@pytest.mark.parametrize("patches", [False, True])
def test_an_interrupted_run_continues_with_its_next_episode(patches, source, weights, encoded, tmp_path, monkeypatch):
    encoder = features_encode._encode
    seen = []

    def interrupted(of, images, with_patches):
        seen.append(len(images))
        if sum(seen) > LENGTHS[0] + 2:
            raise KeyboardInterrupt
        return encoder(of, images, with_patches)

    monkeypatch.setattr(features_encode, "_encode", interrupted)
    config = settings(source, weights, tmp_path / "out", patches=patches)
    with pytest.raises(KeyboardInterrupt):
        encode(config)
    assert not (tmp_path / "out").exists()
    seen.clear()
    monkeypatch.setattr(features_encode, "_encode", lambda *args: (seen.append(len(args[1])), encoder(*args))[1])
    encode(config)
    assert sum(seen) == LENGTHS[1] and not (tmp_path / "out.partial").exists()
    for before, after in zip(encoded, LeRobotDataset("local/out", root=tmp_path / "out"), strict=True):
        assert torch.equal(before[KEY], after[KEY])
    assert (tmp_path / "out" / PATCHES_FILE).exists() == patches


@pytest.mark.parametrize("fields", [{"backbone": "resnet18"}, {"camera": "top"}, {"batch_size": 0}])
def test_nonsense_leaves_nothing_behind(fields, source, weights, tmp_path):
    with pytest.raises(UserError, match="backbones are|cameras are|batch_size must be"):
        encode(settings(source, weights, tmp_path / "out", **fields))
    assert not list(tmp_path.iterdir())


def test_existing_folders_are_left_alone(source, weights, tmp_path):
    (tmp_path / "out").mkdir()
    with pytest.raises(FileExistsError, match="exists already"):
        encode(settings(source, weights, tmp_path / "out"))
    shutil.rmtree(tmp_path / "out")
    (tmp_path / "out.partial" / "mine").mkdir(parents=True)
    with pytest.raises(FileExistsError, match="in the way"):
        encode(settings(source, weights, tmp_path / "out"))


def test_an_unwritable_folder_shows_before_anything_is_encoded(source, weights, tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setattr(features_encode, "load_encoder", lambda *args: pytest.fail("the encoder was loaded"))
    with pytest.raises(NotADirectoryError):
        encode(settings(source, weights, tmp_path / "file" / "out"))


def test_a_backbone_without_weights_is_told_that_the_features_are_anothers(encoded, monkeypatch):
    monkeypatch.setattr(weights_module, "hub_file", lambda *_: None)
    with pytest.raises(ValueError, match=r"backbone vit_tiny16 \(the policy: clip_vitb16\)"):
        make_policy(FrozenViTChunkConfig(backbone="clip_vitb16", device="cpu"), ds_meta=encoded.meta)


def test_a_study_takes_the_weights_whose_hash_it_names_or_none(weights):
    settle = FeatureTrainer().settle
    found = settle(policy_config(weights))[0].backbone_sha256
    assert settle(policy_config(weights, backbone_sha256=found))[0].backbone_sha256 == found
    with pytest.raises(InputError, match="weights asked for have sha256 000000000000, but local tiny.safetensors has"):
        settle(policy_config(weights, backbone_sha256="0" * 64))


def test_a_file_that_is_joined_alone_is_not_loaded(tmp_path):
    """Parts of a merged set have gigabytes each."""
    for name in "ab":
        np.save(tmp_path / f"{name}.npy", np.full((64, 400, 400), ord(name), np.float16))
    tracemalloc.start()
    features_encode._join_files([[tmp_path / "a.npy"], [tmp_path / "b.npy"]], 128, tmp_path / "joined.npy")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    joined = np.load(tmp_path / "joined.npy", mmap_mode="r")
    assert peak < 4 << 20 and (joined[63, 0, 0], joined[64, 0, 0], len(joined)) == (ord("a"), ord("b"), 128)


def test_frames_are_decoded_ahead_in_order_until_one_cannot_be():
    def items():
        yield from range(3)
        raise OSError("a torn file")

    seen = []
    with pytest.raises(OSError, match="a torn file"):
        for item in _ahead(items()):
            seen.append(item)
    assert seen == [0, 1, 2] and next(_ahead(iter([7, 8]))) == 7 and list(_ahead(iter([]))) == []
