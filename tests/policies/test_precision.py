"""What `auto` becomes, what is refused and how a checkpoint crosses over, on both kinds of CPU on either."""

import json
import os
import re
import subprocess
import sys
from dataclasses import replace

import pytest
import torch

from lerobot_constructskill.errors import MachineError
from lerobot_constructskill.features.encode import load_encoder
from lerobot_constructskill.policies.frozen_vit import openvino
from lerobot_constructskill.policies.frozen_vit import precision as precision_module
from lerobot_constructskill.policies.frozen_vit.backbones import BACKBONES
from lerobot_constructskill.policies.frozen_vit.configuration_frozen_vit import FrozenViTChunkConfig
from lerobot_constructskill.policies.frozen_vit.encoder import FrozenEncoder
from lerobot_constructskill.policies.frozen_vit.modeling_frozen_vit import FrozenViTChunkPolicy
from lerobot_constructskill.policies.frozen_vit.precision import (
    ISA_CAP,
    WITHOUT_BFLOAT16,
    computing_in,
    native_precision,
)


@pytest.fixture
def machine(monkeypatch):
    """Make this CPU one that multiplies in bfloat16 natively, or one that does not, as far as our choices go."""

    def be(native: str) -> None:
        monkeypatch.setattr(precision_module, "_cpu_multiplies_bfloat16", lambda: native == "bfloat16")

    return be


def test_a_capped_cpu_has_no_bfloat16(monkeypatch):
    for cap in WITHOUT_BFLOAT16:
        monkeypatch.setenv(ISA_CAP, cap.lower())
        assert native_precision("cpu") == "float32"


@pytest.mark.parametrize("native", ["float32", "bfloat16"])
def test_auto_is_the_native_precision_and_recorded(native, machine, make_policy, tmp_path):
    machine(native)
    make_policy().save_pretrained(tmp_path)
    config, record = (json.loads((tmp_path / name).read_text()) for name in ("config.json", "encoder.json"))
    assert config["backbone_precision"] == record["precision"] == native


def test_bfloat16_by_name_is_refused_where_it_would_be_emulated(machine, make_policy, weights):
    machine("float32")
    for call in (
        lambda: make_policy(backbone_precision="bfloat16"),
        lambda: load_encoder("vit_tiny16", str(weights("vit_tiny16")), "bfloat16"),
    ):
        with pytest.raises(ValueError, match="60 times slower .* use backbone_precision=float32") as refusal:
            call()
        assert "\n" not in str(refusal.value)
        assert isinstance(refusal.value, MachineError), "a study stops there; it is no result of a run"


def test_a_checkpoint_keeps_its_precision_where_another_would_be_faster(machine, make_policy, tmp_path):
    machine("float32")
    make_policy().save_pretrained(tmp_path)
    machine("bfloat16")
    assert FrozenViTChunkPolicy.from_pretrained(tmp_path).config.backbone_precision == "float32"


@pytest.mark.slow
def test_a_checkpoint_crosses_over_on_purpose_alone(machine, make_policy, images, tmp_path, caplog):
    machine("bfloat16")
    make_policy().save_pretrained(tmp_path / "made")
    machine("float32")
    batch = {"observation.images.base": images}
    stranded = FrozenViTChunkPolicy.from_pretrained(tmp_path / "made")  # so that it can be pushed from here
    with pytest.raises(ValueError, match="backbone_precision=float32, with which what was made in bfloat16 runs"):
        stranded.select_action(batch)
    config = FrozenViTChunkConfig.from_pretrained(tmp_path / "made", cli_overrides=["--backbone_precision=float32"])
    crossed = FrozenViTChunkPolicy.from_pretrained(tmp_path / "made", config=config)
    for _ in range(2):
        crossed.select_action(batch)
    said = r"trained on features of \w+ in bfloat16, acts on features of \w+ in float32"
    assert len(re.findall(said, caplog.text)) == 1
    crossed.save_pretrained(tmp_path / "crossed")
    config, record = (
        json.loads((tmp_path / "crossed" / name).read_text()) for name in ("config.json", "encoder.json")
    )
    assert (config["backbone_precision"], record["precision"]) == ("float32", "bfloat16")


def test_what_is_trained_further_on_images_is_of_the_precision_it_saw(machine, make_policy):
    machine("bfloat16")
    policy = make_policy(backbone_precision="float32", backbone_trained_precision="bfloat16")
    assert policy.eval().encoder_record.precision == "bfloat16"
    assert policy.train().encoder_record.precision == "float32"
    assert policy.encoder_record.runtime == policy.backbone.runtime


@pytest.mark.slow
def test_under_the_other_kinds_instructions_float32_is_close_to_ours(weights, images, tmp_path):
    """The kernels really are capped here, which takes a process of its own."""
    code = (
        "import sys, torch; from lerobot_constructskill.features.encode import load_encoder;"
        f"encoder, info = load_encoder('vit_tiny16', {str(weights('vit_tiny16'))!r});"
        "print(info['precision'], info['runtime']); torch.save(encoder(torch.load(sys.argv[1])), sys.argv[2])"
    )
    torch.save(images, tmp_path / "images")
    files = [str(tmp_path / "images"), str(tmp_path / "features")]
    capped = os.environ | {ISA_CAP: "AVX2"}
    done = subprocess.run([sys.executable, "-c", code, *files], env=capped, capture_output=True, text=True, check=True)
    encoder, info = load_encoder("vit_tiny16", str(weights("vit_tiny16")), "float32")
    assert done.stdout.split() == ["float32", info["runtime"]]
    torch.testing.assert_close(torch.load(files[1]), encoder(images), atol=1e-4, rtol=0)


def test_features_of_a_cpu_are_told_apart_from_those_of_a_gpu(make_policy, monkeypatch, caplog):
    policy = make_policy(backbone_precision="float32")
    policy.encoder_record = replace(policy.encoder_record, runtime="openvino")
    policy._log_crossing()
    assert "acts on features" not in caplog.text
    monkeypatch.setattr(FrozenEncoder, "device", torch.device("cuda"))
    policy._log_crossing()
    assert "trained on features of openvino in float32, acts on features of torch in float32" in caplog.text


@pytest.mark.slow
def test_a_blind_encoder_sees_grey_whatever_it_is_shown(images):
    encoder = FrozenEncoder(BACKBONES["vit_tiny16"], "float32", blind=True)
    grey = [tokens[:1] for tokens in encoder.encode(torch.full_like(images, 0.5))]
    for tokens, of_grey in zip(encoder.encode(images), grey, strict=True):
        assert len(tokens) == len(images) and torch.equal(tokens, of_grey.expand_as(tokens))
    encoder.blind = False
    torch.testing.assert_close(encoder.encode(torch.full_like(images, 0.5))[0][:1], grey[0])


@pytest.fixture
def with_tf32():
    """TF32 switched on, as LeRobot's commands do."""
    torch.backends.cuda.matmul.allow_tf32 = True
    yield
    torch.backends.cuda.matmul.allow_tf32 = False


def tf32() -> tuple[bool, bool]:
    return torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32


@pytest.mark.usefixtures("with_tf32")
def test_a_gpu_encodes_without_tf32():
    with computing_in("float32", torch.device("cuda")):
        assert tf32() == (False, False)
    assert tf32() == (True, True)


@pytest.mark.slow
@pytest.mark.parametrize("precision", sorted({"float32", native_precision("cpu")}))
@pytest.mark.parametrize("runtime", ["openvino", "torch"])
def test_autocast_around_an_encoder_changes_no_feature(precision, runtime, images, monkeypatch):
    """As in `lerobot-eval --policy.use_amp=true`, where the first image meets an encoder that is not yet compiled."""
    if runtime == "openvino":
        pytest.importorskip("openvino", reason="the extra `cpu` supplies it")
    monkeypatch.setattr(openvino, "is_installed", lambda: runtime == "openvino")
    encoder = FrozenEncoder(BACKBONES["vit_tiny16"], precision)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        under_autocast = encoder.encode(images)
    assert encoder.runtime == runtime
    encoder._forget_compiled()
    for ours, alone in zip(under_autocast, encoder.encode(images), strict=True):
        assert torch.equal(ours, alone)
