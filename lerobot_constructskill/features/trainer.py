"""How a study trains frozen_vit: demonstrations through the encoder once, then the heads on what came out."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor
from contextlib import AbstractContextManager, contextmanager
from copy import deepcopy
from dataclasses import replace
from itertools import groupby, product
from pathlib import Path
from typing import Any

import torch
from lerobot.datasets import LeRobotDataset
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.utils import OBS_STATE

from lerobot_constructskill.artifacts.code import code_of
from lerobot_constructskill.artifacts.digests import finished_sha256, versions
from lerobot_constructskill.artifacts.pools import cores, open_pool
from lerobot_constructskill.artifacts.store import Artifact, Store
from lerobot_constructskill.errors import InputError, MissingWeightsError
from lerobot_constructskill.features.encode import (
    PARTS,
    batch_facts,
    join_feature_sets,
    load_encoder,
    write_feature_set,
)
from lerobot_constructskill.policies.frozen_vit.backbones import get_backbone
from lerobot_constructskill.policies.frozen_vit.configuration_frozen_vit import FrozenViTChunkConfig
from lerobot_constructskill.policies.frozen_vit.feature_sets import close_patches, describe, feature_key
from lerobot_constructskill.policies.frozen_vit.heads import ChunkHeads
from lerobot_constructskill.policies.frozen_vit.modeling_frozen_vit import FrozenViTChunkPolicy
from lerobot_constructskill.policies.frozen_vit.precision import AUTO, PRECISIONS, resolve_precision
from lerobot_constructskill.policies.frozen_vit.readouts import READOUTS
from lerobot_constructskill.policies.frozen_vit.train_seeds import (
    heldout_mse,
    save_checkpoint,
    train_seeds,
    with_heads,
)
from lerobot_constructskill.policies.frozen_vit.weights import find_sha256, load_weights
from lerobot_constructskill.policy_types import read_policy
from lerobot_constructskill.progress import Progress, quiet

STACK = 10
"""Seeds whose heads are trained as one computation: a step of all of them takes little longer than one of a seed."""


class FeatureTrainer:
    """`training.trainers.Trainer` of frozen_vit."""

    places = ("backbone_path",)
    packages = ("torchcodec", "transformers", "timm", "openvino")

    def seeds_together(self, config: FrozenViTChunkConfig) -> bool:
        return True

    def stack(self, config: FrozenViTChunkConfig) -> int:
        """Seeds whose readout learns are trained each by itself."""
        return 1 if READOUTS[config.readout].learns else STACK

    def settle(self, config: FrozenViTChunkConfig) -> FrozenViTChunkConfig:
        """Write out what `auto` means here, and which weights there are; None where there are none.

        Raises:
            InputError: its heads are to begin as those of a checkpoint, or no source has weights of the hash it names.
        """
        if config.pretrained_path:
            raise InputError("A study trains frozen_vit's heads from the start; lerobot-train takes pretrained_path.")
        precision = resolve_precision(config.backbone_precision, config.device)
        spec = get_backbone(config.backbone, config.backbone_path)
        sha256 = find_sha256(spec, config.backbone_path, config.backbone_pretrained, config.backbone_sha256)
        return replace(config, backbone_precision=precision, backbone_sha256=sha256, save_backbone=False)

    def idle(self, config: FrozenViTChunkConfig) -> tuple[str, ...]:
        written = ("backbone_trained_runtime",)
        return written if READOUTS[config.readout].points else (*written, "point_weight")

    def settled_elsewhere(self, config: FrozenViTChunkConfig) -> list[dict[str, Any]]:
        """The precisions that `auto` means on other machines, and those of the CPU where this is a GPU."""
        here = resolve_precision(config.backbone_precision, config.device)
        precisions = PRECISIONS if config.backbone_precision == AUTO else [here]
        kinds = product(dict.fromkeys([config.device, "cpu"]), precisions)
        return [{"device": d, "backbone_precision": one} for d, one in kinds if (d, one) != (config.device, here)]

    @contextmanager
    def joined(
        self, config: FrozenViTChunkConfig, whole: LeRobotDataset, parts: Sequence[LeRobotDataset], store: Store
    ) -> Iterator[None]:
        """Join the parts' features, which are encoded where they are not there, for as long as the block takes."""
        of_parts = [obtain_features(config, part, store) for part in parts]
        if len(parts) == 1:
            yield
            return
        made = features_artifact(config, whole)
        info = of_parts[0].meta.features[feature_key(config.camera)]["info"]
        joined = whole, config.camera, of_parts, info, f"local/{made.digest}"
        store.obtain(made, lambda folder: join_feature_sets(*joined, folder, **_beside(config)))
        try:
            yield
        finally:
            close_patches()
            with store.claim([made]) as missing:
                if not missing:
                    store.discard(made)

    def fit(
        self,
        config: FrozenViTChunkConfig,
        demonstrations: LeRobotDataset,
        writers: Mapping[int, Callable[..., AbstractContextManager[Path]] | None],
        epochs: int,
        batch_size: int,
        held_out: Sequence[int],
        store: Store,
    ) -> None:
        """Train every seed of `writers` and write its checkpoint where its writer says, as soon as it is trained."""
        features = obtain_features(config, demonstrations, store)
        for seeds, policies in _trained(config, features, list(writers), epochs, batch_size, held_out):
            preprocess, _ = make_pre_post_processors(policies[0].config, dataset_stats=features.meta.stats)
            asked = {seed: policy for seed, policy in zip(seeds, policies, strict=True) if writers[seed]}
            errors = heldout_mse([*asked.values()], features, held_out, preprocess)
            for (seed, policy), error in zip(asked.items(), errors, strict=True):
                made_of = {config.backbone: _backbone_line(policy)}
                with writers[seed](heldout_mse_m2=error, made_of=made_of) as folder:
                    save_checkpoint(policy, features, folder)

    def heldout_mse(
        self,
        config: FrozenViTChunkConfig,
        checkpoints: Sequence[Path],
        demonstrations: LeRobotDataset,
        held_out: Sequence[int],
        store: Store,
    ) -> list[float | None]:
        """Return each checkpoint's translation error on other demonstrations, in m2; None where they lack an input."""
        here = {name: getattr(config, name) for name in ("device", *self.places)}
        return [self._heldout_mse(checkpoint, here, demonstrations, held_out, store) for checkpoint in checkpoints]

    def _heldout_mse(
        self,
        checkpoint: Path,
        here: Mapping[str, Any],
        demonstrations: LeRobotDataset,
        held_out: Sequence[int],
        store: Store,
    ) -> float | None:
        policy = FrozenViTChunkPolicy.from_pretrained(checkpoint, config=replace(read_policy(checkpoint), **here))
        if policy.config.use_state and OBS_STATE not in demonstrations.meta.features:
            return None
        features = obtain_features(policy.config, demonstrations, store)
        on_device = {"device_processor": {"device": policy.config.device}}
        preprocess, _ = make_pre_post_processors(policy.config, str(checkpoint), preprocessor_overrides=on_device)
        return heldout_mse([policy], features, held_out, preprocess)[0]


def _trained(
    config: FrozenViTChunkConfig, features: LeRobotDataset, seeds: Sequence[int], *recipe: Any
) -> Iterator[tuple[Sequence[int], list[FrozenViTChunkPolicy]]]:
    """Yield seeds with their policies, as many at once as are finished at once.

    Seeds are stacked, but where the readout learns: each step then reads tens of megabytes a seed, and stacking only
    costs memory. Such seeds are trained side by side, a process for each core, or one after another on a GPU.
    """
    if not READOUTS[config.readout].learns:
        for _, stacked in groupby(sorted(seeds), key=lambda seed: seed // STACK):
            stack = list(stacked)
            yield stack, train_seeds(config, features, stack, *recipe)
    elif min(len(seeds), cores()) == 1 or config.device != "cpu":
        for seed in seeds:
            yield [seed], train_seeds(config, features, [seed], *recipe)
    else:
        yield from _trained_side_by_side(config, features, seeds, recipe)


def _trained_side_by_side(
    config: FrozenViTChunkConfig, features: LeRobotDataset, seeds: Sequence[int], recipe: tuple
) -> Iterator[tuple[Sequence[int], list[FrozenViTChunkPolicy]]]:
    """One that fails does not keep the others."""
    template, failed = make_policy(deepcopy(config), ds_meta=features.meta), None
    with (
        open_pool("processes", min(len(seeds), cores())) as submit,
        Progress(total=len(seeds), desc="training", unit="seed") as bar,
    ):
        running = [submit(_train_heads, config, features.repo_id, features.root, seed, recipe) for seed in seeds]
        for seed, future in zip(seeds, running, strict=True):
            try:
                heads = future.result()
            except BrokenExecutor:
                raise
            except Exception as error:
                failed = error
                continue
            bar.update()
            yield [seed], [with_heads(template, heads)]
    if failed is not None:
        raise failed


def _train_heads(config: FrozenViTChunkConfig, repo_id: str, root: Path, seed: int, recipe: tuple) -> ChunkHeads:
    """In a process of its own, in which denormal numbers are zero, as in that of its study."""
    torch.set_flush_denormal(True)
    with quiet():
        (policy,) = train_seeds(config, LeRobotDataset(repo_id, root=root), [seed], *recipe)
    return policy.heads


def obtain_features(config: FrozenViTChunkConfig, demonstrations: LeRobotDataset, store: Store) -> LeRobotDataset:
    """Return the features of demonstrations under a policy's encoder, from a store, where they are made if need be.

    Patch features, 0.2 MB a frame, are there where the policy's readout looks at them, and points where it finds some.

    Raises:
        FileNotFoundError: no source has the encoder's weights.
    """
    made = features_artifact(config, demonstrations)
    repo_id = f"local/{made.digest}"

    def make(folder: Path) -> None:
        eyes = config.crop, config.device, config.backbone_pretrained, config.blind, config.backbone_sha256
        encoder, info = load_encoder(config.backbone, config.backbone_path, _precision(config), *eyes)
        write_feature_set(demonstrations, config.camera, encoder, info, repo_id, folder, **_beside(config))

    return LeRobotDataset(repo_id, root=store.obtain(made, make, keep=PARTS))


def features_artifact(config: FrozenViTChunkConfig, demonstrations: LeRobotDataset) -> Artifact:
    """What `obtain_features` returns. Raises as it does."""
    spec, readout = get_backbone(config.backbone, config.backbone_path), READOUTS[config.readout]
    if config.backbone_sha256 is None:
        load_weights(spec, config.backbone_path)  # says what was tried
        raise MissingWeightsError(f"The weights of {config.backbone} arrived while the study ran: start it again.")
    made_by = describe(spec, config.backbone_sha256, _precision(config), config.crop, config.blind)
    made_by |= batch_facts(config.device)
    source = {"demonstrations_sha256": finished_sha256(demonstrations.root), "camera": config.camera}
    made_in = versions("lerobot", "torch", *FeatureTrainer.packages) | code_of(__name__)
    beside = {"patches": readout.reads_patches} | ({"points": [*readout.points]} if readout.points else {})
    return Artifact("features", {**source, **beside, "encoder": made_by, "versions": made_in})


def _beside(config: FrozenViTChunkConfig) -> dict[str, bool]:
    """What a feature set has beside the pooled features, for the policy's readout to learn from."""
    readout = READOUTS[config.readout]
    return {"patches": readout.reads_patches, "points": bool(readout.points)}


def _precision(config: FrozenViTChunkConfig) -> str:
    """What the policy saw in while it was trained, or is to be trained in."""
    return config.backbone_trained_precision or config.backbone_precision


def _backbone_line(policy: FrozenViTChunkPolicy) -> str:
    """What the backbone is, whose weights are none of the checkpoint's."""
    precision, record = policy.config.backbone_precision, policy.encoder_record
    crossed = f", trained in {record.precision}" if record.precision != precision else ""
    return f"{record.source}, SHA-256 {record.sha256[:12]}, {precision}{crossed}"
