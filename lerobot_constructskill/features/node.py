"""The features of demonstrations as a node of a store."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from lerobot.datasets import LeRobotDataset

from lerobot_constructskill.artifacts.code import code_of
from lerobot_constructskill.artifacts.digests import versions
from lerobot_constructskill.artifacts.store import Machine, Node
from lerobot_constructskill.errors import MissingWeightsError
from lerobot_constructskill.features.encode import (
    PARTS,
    batch_facts,
    join_feature_sets,
    load_encoder,
    write_feature_set,
)
from lerobot_constructskill.policies.frozen_vit.backbones import get_backbone
from lerobot_constructskill.policies.frozen_vit.configuration_frozen_vit import FrozenViTChunkConfig
from lerobot_constructskill.policies.frozen_vit.feature_sets import describe, feature_key
from lerobot_constructskill.policies.frozen_vit.readouts import READOUTS
from lerobot_constructskill.policies.frozen_vit.weights import load_weights

PACKAGES = ("torchcodec", "transformers", "timm", "openvino")
"""Packages whose versions may show in features, beside LeRobot and torch."""


@dataclass(frozen=True, eq=False)
class Features(Node):
    """The features of demonstrations under a policy's encoder.

    Patch features, 0.2 MB a frame, are there where the policy's readout looks at them, and points where it finds some.
    """

    config: FrozenViTChunkConfig
    demonstrations: Node

    kind = "features"
    keeps = PARTS

    def facts(self) -> dict[str, Any]:
        config, readout = self.config, READOUTS[self.config.readout]
        spec = get_backbone(config.backbone, config.backbone_path)
        made_by = describe(spec, config.backbone_sha256, self.precision, config.crop, config.blind)
        return {
            "camera": config.camera,
            "patches": readout.reads_patches,
            "points": [*readout.points],
            "encoder": made_by | batch_facts(config.device),
        }

    def versions(self) -> dict[str, str]:
        return versions("lerobot", "torch", *PACKAGES) | code_of(__name__)

    @cached_property
    def inputs(self) -> dict[str, Node]:
        return {"demonstrations": self.demonstrations}

    def make(self, folder: Path, inputs: Mapping[str, Path], machine: Machine) -> None:
        """Encode the demonstrations.

        Raises:
            MissingWeightsError: no source has the encoder's weights.
        """
        config = self.config
        if config.backbone_sha256 is None:
            spec = get_backbone(config.backbone, config.backbone_path)
            load_weights(spec, config.backbone_path)  # says what was tried
            raise MissingWeightsError(f"The weights of {config.backbone} arrived while the study ran: start it again.")
        eyes = config.crop, config.device, config.backbone_pretrained, config.blind, config.backbone_sha256
        encoder, info = load_encoder(config.backbone, config.backbone_path, self.precision, *eyes)
        (dataset,) = _opened(self.inputs, inputs)
        write_feature_set(dataset, config.camera, encoder, info, self.repo_id, folder, **self.beside)

    @property
    def precision(self) -> str:
        """The precision that heads are trained in; a policy may act in another one."""
        return self.config.backbone_trained_precision or self.config.backbone_precision

    @property
    def beside(self) -> dict[str, bool]:
        """Whether the readout needs patch features and points."""
        readout = READOUTS[self.config.readout]
        return {"patches": readout.reads_patches, "points": bool(readout.points)}


@dataclass(frozen=True, eq=False)
class JoinedFeatures(Features):
    """The features of a merged data set, from those of its parts; a copy, which goes when heads are trained on it."""

    of_parts: tuple[Features, ...] = ()

    keeps = None
    is_passing = True

    @cached_property
    def inputs(self) -> dict[str, Node]:
        parts = {f"part_{number}": part for number, part in enumerate(self.of_parts)}
        return {"demonstrations": self.demonstrations, **parts}

    def make(self, folder: Path, inputs: Mapping[str, Path], machine: Machine) -> None:
        whole, *parts = _opened(self.inputs, inputs)
        info, camera = parts[0].meta.features[feature_key(self.config.camera)]["info"], self.config.camera
        join_feature_sets(whole, camera, parts, info, self.repo_id, folder, **self.beside)


def _opened(nodes: Mapping[str, Node], folders: Mapping[str, Path]) -> Iterator[LeRobotDataset]:
    """The data sets of some nodes, in their order."""
    return (LeRobotDataset(node.repo_id, root=folders[name]) for name, node in nodes.items())
