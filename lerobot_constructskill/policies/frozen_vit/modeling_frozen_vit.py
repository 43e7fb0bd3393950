"""The reference policy of the paper: a frozen encoder, two linear heads, overlapping chunks."""

import json
import logging
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from huggingface_hub import hf_hub_download
from huggingface_hub.errors import HFValidationError
from lerobot.policies import PreTrainedPolicy
from lerobot.utils import ACTION, OBS_STATE
from torch import Tensor, nn

from lerobot_constructskill.errors import InputError, MissingError, first_line, one_line
from lerobot_constructskill.files import Json
from lerobot_constructskill.threads import one_thread

from .backbones import get_backbone
from .batches import read_whole_batches
from .configuration_frozen_vit import FrozenViTChunkConfig
from .encoder import RECORD, RECORD_FILE, EncoderRecord, FrozenEncoder
from .feature_sets import check_features, describe, open_patches, stated
from .heads import ChunkHeads, heads_loss
from .language import Told, sentences_of
from .precision import PRECISIONS, RUNTIMES, check_native, resolve_precision
from .readouts import READOUTS, beside
from .shared_encoder import POOLED, SharedEncoders
from .weights import load_weights, read_tensors, state_sha256

BACKBONE_PREFIX = "backbone."
SAVED = Json("a policy's configuration")

DECISIVE = ("backbone", "readout", "standardize_features", "crop", "blind", "language", "gripper_head", "action_scale")
"""Fields that change the meaning of the heads' inputs or outputs, and no shape."""

SILENT = 1e-3
"""A feature whose standard deviation is below this share of the median one counts as constant and is not scaled."""

logger = logging.getLogger(__name__)


class FrozenViTChunkPolicy(PreTrainedPolicy):
    """Predicts a chunk of translations and gripper states from the picture of a camera, or of several.

    Args:
        config: the configuration; the precision that `auto` stands for is written into it.
        dataset_stats: the data set's statistics as LeRobot keeps them; a feature set's serve `standardize_features`.
        dataset_meta: the data set's `LeRobotDatasetMetadata`; a feature set's patch features lie in its folder.
        encoder_record: what a checkpoint says of its encoder. With it the backbone stays without weights, which
            `from_pretrained` fills in.

    Raises:
        FileNotFoundError: the backbone's weights cannot be had, or the readout's patch features are not there.
        ValueError: the data set's features are another encoder's, its rate is another than the policy's, it does not
            say where the points are that the readout learns to find, or the inputs do not fit the configuration.
    """

    config_class = FrozenViTChunkConfig
    name = "frozen_vit"
    in_lockstep = SharedEncoders
    """Encodes for many policies at once in a rollout, as `rollout.agents.Lockstep` says."""

    def __init__(
        self,
        config: FrozenViTChunkConfig,
        *,
        dataset_stats: dict[str, dict[str, Any]] | None = None,
        dataset_meta: Any = None,
        encoder_record: EncoderRecord | None = None,
        **kwargs: Any,
    ):
        super().__init__(config)
        config.validate_features()
        self.config = config
        self.readout = READOUTS[config.readout]
        if dataset_meta is not None:
            self._check_data_set(dataset_meta)
        self.encoder_record = self._begin_record(encoder_record)
        spec = get_backbone(config.backbone, config.backbone_path)
        self.backbone = FrozenEncoder(spec, config.backbone_precision, config.crop, config.blind)
        self._check_features(dataset_meta.root if dataset_meta is not None else None)
        if encoder_record is None:
            check_native(config.backbone_precision, config.device)
            self._load_backbone()
        self.told = self._begin_told(dataset_meta)
        self.heads = self.fresh_heads()

        self.register_buffer("feature_mean", torch.zeros(self.feature_dim))
        self.register_buffer("feature_std", torch.ones(self.feature_dim))
        if encoder_record is None and config.standardize_features:
            self._take_statistics(dataset_stats or {})

        self.register_state_dict_post_hook(_drop_backbone)
        self.register_load_state_dict_post_hook(_excuse_backbone)
        self._has_seen = False
        self.reset()

    @property
    def feature_dim(self) -> int:
        """Length of the pooled features of all cameras."""
        return len(self.config.cameras) * self.backbone.spec.feature_dim

    def fresh_heads(self) -> ChunkHeads:
        """Return heads with newly drawn weights."""
        return ChunkHeads(self.config, self.backbone.spec.feature_dim, self.told.dim if self.told else 0)

    def get_optim_params(self) -> list[nn.Parameter]:
        return [parameter for parameter in self.parameters() if parameter.requires_grad]

    def reset(self) -> None:
        """Forget the chunks of the last episode."""
        self._action_queue: deque[Tensor] = deque(maxlen=self.config.chunk_size)

    def forward(self, batch: dict[str, Tensor], reduction: str = "mean") -> tuple[Tensor, dict[str, float]]:
        """Return the loss on a batch of chunks, and its terms as floats.

        Args:
            batch: images (B, 3, H, W) or features (B, D), `action` (B, T, A), and `action_is_pad` (B, T) where some
                steps lie beyond an episode's end; for a readout that finds points also their positions, (B, 2P).
            reduction: "mean" over all valid steps (of points over samples), or "none" for one loss per sample (B,).
        """
        points = batch[self.config.point_key] if self.readout.points else None
        chunk, read = self.heads(*self.head_inputs(batch))
        nothing = torch.zeros_like(batch[ACTION][..., 0], dtype=torch.bool)
        padded = batch.get(f"{ACTION}_is_pad", nothing)
        loss, terms = heads_loss(self.config, chunk, read, batch[ACTION], padded, points, reduction)
        return loss, {name: term.mean().item() for name, term in terms.items()}

    def train(self, mode: bool = True) -> "FrozenViTChunkPolicy":
        """Switch the heads' mode, and record what computes the features that they learn from."""
        if mode and self.config.feature_column is None:  # the heads learn from this encoder's own features
            own = self.backbone
            self.encoder_record = replace(self.encoder_record, precision=own.precision, runtime=own.runtime)
        return super().train(mode)

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Return the newest chunk (B, T, A): metres (radians), and the gripper as +1 open or -1 closed."""
        return self._to_action(self._raw_chunk(batch))

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Return the action of this step (B, A), from a fresh chunk and those that still cover the step."""
        coeff = self.config.temporal_ensemble_coeff
        if coeff is not None:
            self._action_queue.append(self._raw_chunk(batch))
            return self._to_action(ensemble(self._action_queue, coeff))
        if not self._action_queue:
            chunk = self._raw_chunk(batch)
            self._action_queue.extend(chunk[:, : self.config.n_action_steps].unbind(dim=1))
        return self._to_action(self._action_queue.popleft())

    @classmethod
    def from_pretrained(cls, pretrained_name_or_path: str | Path, **kwargs: Any) -> "FrozenViTChunkPolicy":
        """Load a checkpoint; one that holds its backbone needs no other source of weights.

        What an `hf/...` backbone is, and which pixels it takes, is still read from `backbone_path` or the Hub.

        Raises:
            FileNotFoundError: the checkpoint has no weights, or no `encoder.json`.
            ValueError: a file of it is damaged, or the configuration is not the one that it was trained with.
        """
        record = _read_record(pretrained_name_or_path, kwargs)
        return super().from_pretrained(pretrained_name_or_path, encoder_record=record, **kwargs)

    def _save_pretrained(self, save_directory: Path, **kwargs: Any) -> None:
        super()._save_pretrained(save_directory, **kwargs)
        text = json.dumps(asdict(self.encoder_record), indent=4) + "\n"
        (Path(save_directory) / RECORD_FILE).write_text(text, encoding="utf-8")

    @classmethod
    def _load_as_safetensor(
        cls, model: "FrozenViTChunkPolicy", model_file: str, map_location: str, strict: bool
    ) -> "FrozenViTChunkPolicy":
        state = read_tensors(Path(model_file))
        if not any(name.startswith(BACKBONE_PREFIX) for name in state):
            model._load_backbone()
        try:
            model.load_state_dict(state, strict=True)
        except RuntimeError as error:
            raise InputError(
                f"The checkpoint '{model_file}' does not fit its configuration ({one_line(error)[:300]}): use the "
                "config.json it was saved with, or train again."
            ) from None
        model._check_inputs(Path(model_file).with_name("config.json"))
        found, recorded = state_sha256(model.backbone.model.state_dict()), model.encoder_record.sha256
        if found != recorded:
            raise InputError(
                f"The backbone in '{model_file}' has sha256 {found[:12]}, but {RECORD_FILE} records "
                f"{str(recorded)[:12]}: one of the two files was changed; copy or download the checkpoint again."
            )
        return model

    def _begin_record(self, recorded: EncoderRecord | None) -> EncoderRecord:
        """Return the record as far as it is known without weights, and set the precision in the configuration.

        The facts come from the data set's features, else from the checkpoint, else from the configuration.
        """
        config, column = self.config, self.config.feature_column
        asked = config.backbone_sha256 or stated(column, "weights_sha256")
        known = recorded or EncoderRecord(sha256=asked, precision=config.backbone_trained_precision)
        trained = stated(column, "precision", PRECISIONS) or known.precision
        config.backbone_precision = resolve_precision(config.backbone_precision, config.device, trained)
        runtime = stated(column, "runtime", RUNTIMES) or known.runtime
        return replace(known, precision=trained or config.backbone_precision, runtime=runtime)

    def _check_features(self, root: Path | None) -> None:
        """Refuse features of another encoder, or without the patch features that are read; they lie in `root`."""
        self.patches_root = root
        record, encoder, column = self.encoder_record, self.backbone, self.config.feature_column
        if column is not None:
            made_by = describe(encoder.spec, record.sha256, record.precision, encoder.crop, encoder.blind)
            check_features(column, made_by, self.feature_dim)
            if self.readout.reads_patches:
                open_patches(root)
            read_whole_batches()

    def _begin_told(self, meta: Any) -> Told | None:
        """What tells the heads their instruction; a checkpoint's record says how long its vector is."""
        config, record = self.config, self.encoder_record
        if config.language is None:
            return None
        if config.sentences is None:
            if meta is None:
                raise InputError(f"language={config.language} needs a data set, whose tasks it is told.")
            config.sentences = sentences_of(meta)
        told = Told(
            config.language, config.sentences, record.sentence_dim, record.sentence_sha256 or config.language_sha256
        )
        if not told.dim:
            logger.warning(
                f"Every task of the data set is asked in one sentence, so language={config.language} tells the policy "
                "nothing."
            )
        self.encoder_record = replace(record, sentence_sha256=told.sha256, sentence_dim=told.encoder_dim)
        return told

    def _check_data_set(self, meta: Any) -> None:
        """Refuse a data set of another rate, or without the points that the readout learns to find."""
        if meta.fps != self.config.fps:
            raise InputError(
                f"The data set has {meta.fps} frames a second and the policy acts at {self.config.fps} Hz: train on a "
                "set of that rate, or set fps if what it is for runs at another."
            )
        found = meta.features.get(self.config.point_key, {}).get("names")
        if self.readout.points and found != [*self.readout.points]:
            raise InputError(
                f"readout={self.config.readout} learns from {self.config.point_key} "
                f"({', '.join(self.readout.points)}): train on a feature set that constructskill-encode makes with "
                "--patches=true --points=true."
            )

    def _log_crossing(self) -> None:
        """Log that features are computed otherwise than those that the heads learned from."""
        record, encoder = self.encoder_record, self.backbone
        left_cpu = record.runtime == "openvino" and encoder.device.type != "cpu"
        if encoder.precision != record.precision or left_cpu:
            logger.warning(
                "frozen_vit, trained on features of %s in %s, acts on features of %s in %s: they differ a little.",
                *(record.runtime, record.precision, encoder.runtime, encoder.precision),
            )

    def _load_backbone(self) -> None:
        config, record = self.config, self.encoder_record
        state, source = load_weights(
            self.backbone.spec, config.backbone_path, record.sha256, config.backbone_pretrained
        )
        self.backbone.model.load_state_dict(state)
        self.encoder_record = replace(record, source=source, sha256=record.sha256 or state_sha256(state))

    def _take_statistics(self, dataset_stats: dict[str, dict[str, Any]]) -> None:
        stats = dataset_stats.get(self.config.feature_key)
        if stats is None:
            raise InputError(
                f"standardize_features needs the statistics of {self.config.feature_key}: train on a feature set, "
                "which constructskill-encode makes of the data set."
            )
        self.feature_mean.copy_(torch.as_tensor(stats["mean"]))
        std = torch.as_tensor(stats["std"], dtype=torch.float32)
        # A channel that is the same in every frame says nothing, and divided by its spread would say anything later.
        self.feature_std.copy_(torch.where(std > SILENT * std.median().clamp(min=1e-3), std, 1))

    def _check_inputs(self, path: Path) -> None:
        """Refuse a configuration under which the heads' input or output means something else than in training."""
        saved = SAVED.read(path) if path.is_file() else {}
        trained = {name: saved[name] for name in DECISIVE if name in saved}
        trained["backbone_sha256"] = self.config.backbone_sha256 and self.encoder_record.sha256
        for name, value in trained.items():
            asked = getattr(self.config, name)
            asked = list(asked) if isinstance(asked, tuple) else asked
            if asked != value:
                raise InputError(f"The checkpoint was trained with {name}={value}, so it cannot have {name}={asked}.")

    def read_features(self, meta: Any) -> None:
        """Read a data set's features from now on, if it has those of the policy's camera in place of its images.

        Args:
            meta: the data set's `LeRobotDatasetMetadata`.

        Raises:
            ValueError: another encoder made them.
            FileNotFoundError: it lacks the patch features that the readout takes.
        """
        self.config.set_dataset_feature_metadata(meta.features)
        self._check_features(meta.root)

    def pool(self, images: Tensor) -> Tensor:
        """Return what the readout takes of the encoder's tokens for one camera's images (B, 3, H, W) in [0, 1].

        Raises:
            ValueError: a checkpoint's precision, which this device would have to emulate.
        """
        if not self._has_seen:
            check_native(self.config.backbone_precision, self.config.device)
            self._log_crossing()
            self._has_seen = True
        return self.readout.pool(*self.backbone.encode(images))

    def head_inputs(self, batch: dict[str, Tensor]) -> tuple[Tensor, ...]:
        """Return the arguments of the heads: the pooled tokens, and any state and instruction in one vector."""
        pooled, beside = self.pooled(batch), []
        if self.config.use_state:
            if OBS_STATE not in batch:
                raise InputError(f"frozen_vit was trained with {OBS_STATE}, which obs_type=pixels_agent_pos shows.")
            beside.append(batch[OBS_STATE])
        if self.told:
            if "task" not in batch:
                raise InputError("frozen_vit was trained with instructions, and the batch has no task.")
            sentences = batch["task"]
            if self.training and "index" in batch:
                sentences = self.told.reworded(sentences, batch["index"].tolist())
            beside.append(self.told(sentences))
        return (pooled, torch.cat(beside, dim=-1)) if beside else (pooled,)

    def _raw_chunk(self, batch: dict[str, Tensor]) -> Tensor:
        inputs = self.head_inputs(batch)
        with one_thread():
            return self.heads(*inputs)[0]

    def pooled(self, batch: dict[str, Tensor]) -> Tensor:
        """Return what the readout takes of the tokens of all cameras, (B, ...), standardised if so configured."""
        pooled = self._pooled(batch)
        return (pooled - self.feature_mean) / self.feature_std if self.config.standardize_features else pooled

    def _pooled(self, batch: dict[str, Tensor]) -> Tensor:
        if POOLED in batch:
            return batch[POOLED]
        if self.config.feature_key in batch:
            cls = batch[self.config.feature_key].float()
            if not self.readout.reads_patches:
                return cls
            rows = batch["index"].cpu()
            patches = open_patches(self.patches_root).index_select(0, rows).to(cls.device)  # (B, C N, D) float16
            patches = patches if self.readout.learns else patches.to(cls)
            cameras = len(self.config.cameras)
            each = zip(cls.chunk(cameras, dim=1), patches.chunk(cameras, dim=1), strict=True)
            return beside([self.readout.pool(*own) for own in each])
        keys = self.config.image_keys
        if all(key in batch for key in keys):
            return beside([self.pool(batch[key]) for key in keys])
        raise InputError(
            f"frozen_vit needs {' and '.join(keys)} or {self.config.feature_key}; the batch holds: "
            f"{', '.join(batch)}. obs_type=pixels_agent_pos shows the wrist camera and the state as well."
        )

    def _to_action(self, raw: Tensor) -> Tensor:
        boundary = 0.0 if self.config.gripper_head == "regression" else self.config.gripper_threshold
        gripper = torch.where(raw[..., -1:] > boundary, 1.0, -1.0)
        return torch.cat([raw[..., :-1], gripper], dim=-1)


def ensemble(chunks: Sequence[Tensor], coeff: float) -> Tensor:
    """Average what each chunk says about the current step.

    The weights are LeRobot's (`ACTTemporalEnsembler`): exp(-coeff * i) with i = 0 for the oldest chunk, so a
    negative coefficient weighs the newest chunk most. With coeff = -0.1 the weights are, up to their sum, the
    paper's exp(-0.1 k), k being the steps since a chunk was predicted.

    Args:
        chunks: the last chunks, one per step, newest last, each (B, T, A); at most T of them, so that each
            still covers the current step.
        coeff: decay per step.

    Returns:
        (B, A)
    """
    newest = len(chunks) - 1
    current = torch.stack([chunk[:, newest - i] for i, chunk in enumerate(chunks)])
    weights = torch.exp(-coeff * torch.arange(len(chunks), device=current.device, dtype=current.dtype))
    return torch.einsum("n,nba->ba", weights / weights.sum(), current)


def _read_record(checkpoint: str | Path, options: Mapping[str, Any]) -> EncoderRecord:
    """Read the `encoder.json` of a checkpoint, a folder or a name on the Hub.

    Args:
        options: those of `from_pretrained`.
    """
    names = ("revision", "cache_dir", "force_download", "token", "local_files_only")
    asked = {name: options[name] for name in names if name in options}
    folder = Path(checkpoint)
    try:
        file = folder / RECORD_FILE if folder.is_dir() else hf_hub_download(str(checkpoint), RECORD_FILE, **asked)
        return RECORD.read(Path(file))
    except (OSError, HFValidationError) as error:
        raise MissingError(
            f"The checkpoint '{checkpoint}' has no {RECORD_FILE}, which says what its encoder is "
            f"({first_line(error).rstrip('.')}): copy or push it again with all of its files."
        ) from error


def _drop_backbone(policy: FrozenViTChunkPolicy, state: dict, prefix: str, metadata: dict) -> None:
    if not policy.config.save_backbone:
        for name in [name for name in state if name.startswith(prefix + BACKBONE_PREFIX)]:
            del state[name]


def _excuse_backbone(policy: FrozenViTChunkPolicy, incompatible: Any) -> None:
    """Let a state dict lack the backbone; the hash of the backbone is checked on its own."""
    incompatible.missing_keys[:] = [name for name in incompatible.missing_keys if BACKBONE_PREFIX not in name]
