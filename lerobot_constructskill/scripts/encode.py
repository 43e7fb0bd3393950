"""`constructskill-encode`: run a frozen encoder once over a data set, so that training need not."""

import re
from dataclasses import dataclass
from pathlib import Path

from lerobot_constructskill.artifacts.folders import staged
from lerobot_constructskill.bounds import BatchSize, Cameras, Device, RepoId, Text, check
from lerobot_constructskill.scripts.console import command


@dataclass
class EncodeConfig:
    """Write a data set of features.

    Train on the result with `--policy.type=frozen_vit` and the same backbone fields; the policy checks
    that they are the same and then skips its encoder.
    """

    repo_id: RepoId  # the data set to encode
    root: Path | None = None  # its folder; default: LeRobot's cache
    revision: Text | None = None  # tag, branch or commit on the Hub
    out_repo_id: RepoId | None = None  # default: <repo_id>_<backbone>
    out_root: Path | None = None  # default: LeRobot's cache
    backbone: str = "dinov2_vits14"  # an entry of `backbones.BACKBONES`, timm/<model>, or hf/<owner>/<name>
    backbone_path: Text | None = None  # folder or file with the weights; else the [offline] packages, then the Hub
    backbone_precision: str = "auto"  # auto is the fastest that the device has natively; or float32, bfloat16
    camera: Cameras = "base"  # observation.images.<camera>; several as base+wrist
    crop: list[float] | None = None  # left, top, right, bottom in shares of the image, the same as the policy's
    patches: bool = False  # also write every patch's feature, `patch_features.npy`, (N, P, D) float16
    points: bool = False  # also write where in the image object, receptacle and hand are, for the readout heat_maps
    batch_size: BatchSize | None = None  # images at a time; default: 16, on a GPU 256
    device: Device | None = None  # default: a GPU if there is one

    def __post_init__(self):
        check(self)
        from lerobot_constructskill.policies.frozen_vit.configuration_frozen_vit import FrozenViTChunkConfig

        shared = ("backbone", "backbone_path", "backbone_precision", "camera", "crop")
        FrozenViTChunkConfig(device="cpu", **{name: getattr(self, name) for name in shared})  # refuses what it would


def encode(config: EncodeConfig) -> Path:
    """Encode a data set and return the folder of the feature set; a killed run continues with its next episode.

    Raises:
        ValueError: unknown backbone, precision or camera, damaged weights, or a data set that does not say where its
            points are.
        FileExistsError: the output folder exists.
        FileNotFoundError: the data set or the backbone's weights cannot be had.
        OSError: the output folder cannot be written, which shows before anything is encoded.
    """
    from lerobot.utils import auto_select_torch_device

    from lerobot_constructskill.dataset.hub import open_lerobot
    from lerobot_constructskill.features.encode import PARTS, load_encoder, write_feature_set
    from lerobot_constructskill.lerobot_internals import HF_LEROBOT_HOME

    out_repo_id = config.out_repo_id or f"{config.repo_id}_{re.sub(r'[^\w.-]', '_', config.backbone)}"
    out_root = config.out_root or HF_LEROBOT_HOME / out_repo_id
    with staged(out_root, keep=PARTS) as folder:
        device = config.device or auto_select_torch_device()
        encoder, info = load_encoder(
            config.backbone, config.backbone_path, config.backbone_precision, config.crop, device
        )
        dataset = open_lerobot(config.repo_id, config.root, config.revision)
        write_feature_set(
            dataset,
            config.camera,
            encoder,
            info,
            out_repo_id,
            folder,
            config.batch_size,
            config.patches,
            config.points,
        )
    return out_root


@command("constructskill-encode --repo_id=local/fast --root=outputs/fast --out_root=outputs/fast_features")
def tell_encode(config: EncodeConfig) -> str:
    return f"Feature set written to {encode(config)}"
