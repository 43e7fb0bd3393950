"""Configuration of `--policy.type=frozen_vit`."""

from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar

from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature, PreTrainedConfig
from lerobot.optim import AdamWConfig
from lerobot.utils import ACTION, OBS_IMAGES, OBS_STATE

from lerobot_constructskill.bounds import Among, Cameras, Pattern, Range, Text, check
from lerobot_constructskill.errors import InputError, as_field_error
from lerobot_constructskill.lerobot_internals import CosineAnnealingWithWarmupSchedulerConfig

from .backbones import IMAGE_SIZE, check_backbone
from .feature_sets import cameras_of, feature_key, point_key
from .language import check_language
from .precision import AUTO, PRECISIONS
from .readouts import READOUTS

TRANSLATION_NAMES = ("dx", "dy", "dz")
ROTATION_NAMES = ("droll", "dpitch", "dyaw")
GRIPPER_NAME = "gripper"
GRIPPER_HEADS = ("bce", "regression")
FUSIONS = ("film", "concat")
REGRESSION_LOSSES = ("mse", "l1")

LARGEST_EXPONENT = 80
"""Largest exponent of a weight in temporal ensembling: float32 holds no more than exp(88)."""

ChunkSize = Annotated[int, Range(1, 1000, unit="steps")]
Logit = Annotated[float, Range(-100, 100)]
Weight = Annotated[float, Range(above=0, most=1e9)]


@PreTrainedConfig.register_subclass("frozen_vit")
@dataclass
class FrozenViTChunkConfig(PreTrainedConfig):
    """A frozen vision transformer with two linear heads that predict a chunk of actions.

    The paper's four ablations are `chunk_size=1`, `temporal_ensemble_coeff=null`, `gripper_head=regression`,
    and training on the data set without noise.

    Args:
        chunk_size: future steps predicted at once.
        n_action_steps: steps taken from a chunk before the next one; 1 with temporal ensembling.
        backbone: an entry of `backbones.BACKBONES`, or any model of timm as `timm/<model>` and of transformers as
            `hf/<owner>/<name>`; `@<commit>` at the end pins a version on the Hub.
        backbone_path: folder or file with the weights; None looks for an installed package that holds them, then at
            the Hub. So does a checkpoint (or a feature set) that knows their hash, if the path does not exist.
        backbone_pretrained: False draws the weights of the same architecture at random, to measure what pretraining
            gives.
        backbone_sha256: hash that the weights must have; None takes the backbone's known one, or where none is known
            the weights that are found. A checkpoint records their hash in `encoder.json` and checks it on every load.
        backbone_precision: number format that the backbone computes in: "float32", "bfloat16", or "auto", which
            becomes the feature set's, or without one the fastest that the device has natively.
        backbone_trained_precision: number format of the features that a study trains the heads on; None for
            `backbone_precision`. A feature set and a checkpoint say their own. Where a policy acts on features of
            another one, the log says so, with the drift of the features.
        save_backbone: whether checkpoints hold the backbone; without it they are small and need a source of weights.
        camera: the camera that it looks at, `observation.images.<camera>` or encoded `observation.features.<camera>`;
            or several, such as `base+wrist`: the heads see what the readout takes of each, one after the other.
        crop: left, top, right and bottom edge of the part of the image that is encoded, in shares of its width and
            height (0 to 1); None takes all of it, as the paper does. On a feature set it must be that of its encoding.
        blind: whether the encoder always sees a grey image, to measure what seeing gives.
        readout: what the heads see of the encoder's tokens, one of `readouts.READOUTS`: "cls" (the paper's pooled
            feature), the "mean" of the patches, both ("cls_mean"), where K learned patterns are
            ("spatial_softmax"), what a few learned queries find ("attention"), or where the object, the receptacle and
            the hand are ("heat_maps"). On a feature set all but "cls" need its patch features, and "heat_maps" learns
            from its points.
        standardize_features: whether each feature is standardised by the data set's mean and deviation. The linear
            heads can express the same functions either way (the paper's is False), but Adam needs far fewer
            samples. Needs a feature set, whose statistics go into the checkpoint; they are
            those that LeRobot computes, of the whole data set, episodes held out for evaluation included. Only
            for the readout "cls".
        use_state: whether the heads also see `observation.state`, normalised by the statistics of the whole data set,
            episodes held out for evaluation included.
        language: how the heads are told the instruction, the data set's `task`: by its vector of a frozen sentence
            encoder, "minilm" (all-MiniLM-L6-v2, extra `language`) or `hf/<owner>/<name>[@<commit>]`; by the "number"
            of a sentence that was trained on; or not at all (None).
        language_sha256: hash that the sentence encoder's weights must have; None takes those that are found. A
            checkpoint records it in `encoder.json`.
        language_fusion: where the instruction enters: "film" scales and shifts what the readout found (Perez et al.
            2018), "concat" stands beside it and the state.
        sentences: the instructions that it is trained on, each with its rewordings, written from the data set.
        head_hidden_dim: width of the hidden layers (GELU) in each of the two heads; None makes them linear, as the
            paper does.
        head_hidden_layers: how many hidden layers each head has, where it has any.
        fps: actions per second. A data set of another rate is refused.
        action_names: channels of `action`, written from the data set: translations in metres and rotations in
            radians, then `gripper` (+1 open, -1 closed).
        action_scale: bound of the regression head, `action_scale * tanh(.)`, in metres (and radians).
        gripper_head: "bce" for a logit, "regression" for a number regressed to +-1.
        gripper_threshold: the bce head opens above this logit (0.5, as the paper says, is p = 0.62). The
            regression head opens above 0, the middle of its two labels.
        temporal_ensemble_coeff: LeRobot's, with ACT's sign: the i-th chunk from the oldest has weight
            exp(-coeff * i). -0.1 is the paper's exp(-0.1 k), where k is the steps since a chunk was predicted: the
            newest has most weight. None takes the newest chunk's first action.
        regression_loss: cost of a translation's error: "mse", its square as in the paper, or "l1", its absolute
            value as in ACT, whose slope does not vanish in the last millimetres.
        regression_weight: weight of the translations' loss (a squared error of about 1e-4 m2, an absolute one of
            about 3e-3 m) relative to the gripper's. It matters only with a readout that learns, because both heads
            then share its parameters.
        point_weight: weight of the error of the points that the readout finds (half the image is 1) relative to the
            gripper's loss. Only a readout that finds points takes another one than 1.
        scheduler_warmup_steps: steps of linear warm-up, after which the learning rate falls to zero along a cosine.
            None keeps it constant.
    """

    study_trainer: ClassVar[str] = "lerobot_constructskill.features.trainer:FeatureTrainer"
    """The `training.trainers.Trainer` of a study: many seeds at once, on features encoded once."""

    device: Annotated[str, Pattern(r"cpu|mps|xpu|cuda(:\d{1,3})?", "one of cpu, cuda, mps, xpu")] | None = None
    n_obs_steps: Annotated[int, Range(1, 1)] = 1
    chunk_size: ChunkSize = 8
    n_action_steps: ChunkSize = 1

    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.MEAN_STD,
            "ACTION": NormalizationMode.IDENTITY,
        }
    )

    backbone: Text = "dinov2_vits14"
    backbone_path: Text | None = None
    backbone_pretrained: bool = True
    backbone_sha256: Annotated[str, Pattern("[0-9a-f]{64}", "64 hexadecimal digits")] | None = None
    backbone_precision: Annotated[str, Among((AUTO, *PRECISIONS))] = AUTO
    backbone_trained_precision: Annotated[str, Among(PRECISIONS)] | None = None
    save_backbone: bool = True
    camera: Cameras = "base"
    crop: list[Annotated[float, Range(0, 1)]] | None = None
    blind: bool = False
    readout: Annotated[str, Among(tuple(READOUTS))] = "cls"
    standardize_features: bool = False
    use_state: bool = False
    language: Text | None = None
    language_sha256: Annotated[str, Pattern("[0-9a-f]{64}", "64 hexadecimal digits")] | None = None
    language_fusion: Annotated[str, Among(FUSIONS)] = "film"
    sentences: list[list[str]] | None = None
    head_hidden_dim: Annotated[int, Range(1, 65_536)] | None = None
    head_hidden_layers: Annotated[int, Range(1, 16)] = 1

    fps: Annotated[int, Range(1, 1000, unit="Hz")] = 20
    action_names: list[str] = field(default_factory=lambda: [*TRANSLATION_NAMES, GRIPPER_NAME])
    action_scale: Annotated[float, Range(above=0, most=10, unit="m and rad")] = 0.1
    gripper_head: Annotated[str, Among(GRIPPER_HEADS)] = "bce"
    gripper_threshold: Logit = 0.5
    temporal_ensemble_coeff: Logit | None = -0.1

    regression_loss: Annotated[str, Among(REGRESSION_LOSSES)] = "mse"
    regression_weight: Weight = 1.0
    point_weight: Weight = 1.0
    optimizer_lr: Annotated[float, Range(above=0, most=10)] = 1e-3
    optimizer_weight_decay: Annotated[float, Range(0, 10)] = 1e-2
    scheduler_warmup_steps: Annotated[int, Range(0, 100_000_000, unit="steps")] | None = None

    def __post_init__(self) -> None:
        with as_field_error():
            self._check()
        super().__post_init__()
        # Entry of the encoded frames in the data set's `features`, None where it has images; no field of a checkpoint.
        self.feature_column: dict[str, Any] | None = None

    def _check(self) -> None:
        check(self)
        check_backbone(self.backbone)
        if self.language is not None:
            check_language(self.language)
        _check_action_names(self.action_names)
        identity = {"VISUAL": NormalizationMode.IDENTITY, "ACTION": NormalizationMode.IDENTITY}
        coeff = self.temporal_ensemble_coeff
        conflicts = (
            (
                self.crop is not None and not _encloses_pixels(self.crop),
                f"crop must be left, top, right and bottom in shares of the image, at least two pixels of "
                f"{IMAGE_SIZE} apart, such as [0.25, 0.25, 0.75, 0.75]; got {self.crop}.",
            ),
            (
                self.standardize_features and self.readout != "cls",
                f"standardize_features works with readout=cls only, not {self.readout}: the statistics of a feature "
                "set are those of its pooled feature.",
            ),
            (
                bool(READOUTS[self.readout].points) and len(self.cameras) > 1,
                f"readout={self.readout} finds points in the picture of one camera, not of {self.camera}.",
            ),
            (
                len({*self.cameras}) < len(self.cameras),
                f"camera names one twice: {self.camera}.",
            ),
            (
                self.point_weight != 1 and not READOUTS[self.readout].points,
                f"point_weight weighs points, and readout={self.readout} finds none: leave it at 1.",
            ),
            (
                not identity.items() <= self.normalization_mapping.items(),
                "normalization_mapping must have IDENTITY for VISUAL and ACTION: the backbone has pixel statistics of "
                "its own, and actions are in metres.",
            ),
            (
                self.n_action_steps > self.chunk_size,
                f"n_action_steps must be between 1 and chunk_size={self.chunk_size}, not {self.n_action_steps}.",
            ),
            (
                abs(coeff or 0) * self.chunk_size > LARGEST_EXPONENT,
                f"temporal_ensemble_coeff must be within {LARGEST_EXPONENT / self.chunk_size:g} of 0 with "
                f"chunk_size={self.chunk_size}, not {coeff}: weights would overflow.",
            ),
            (
                coeff is not None and self.n_action_steps != 1,
                f"n_action_steps must be 1 with temporal ensembling, got {self.n_action_steps}; set "
                "temporal_ensemble_coeff=null to take several steps of one chunk.",
            ),
        )
        for is_conflict, reason in conflicts:
            if is_conflict:
                raise InputError(reason)

    @property
    def cameras(self) -> list[str]:
        """The cameras, in the order in which the heads see them."""
        return cameras_of(self.camera)

    @property
    def image_keys(self) -> list[str]:
        return [f"{OBS_IMAGES}.{name}" for name in self.cameras]

    @property
    def feature_key(self) -> str:
        return feature_key(self.camera)

    @property
    def point_key(self) -> str:
        return point_key(self.camera)

    def set_dataset_feature_metadata(self, features: dict[str, dict]) -> None:
        """Take action names and the description of encoded frames from a data set; `make_policy` calls this.

        Raises:
            ValueError: the policy cannot serve the data set's action names, or was trained with others.
        """
        names = (features.get(ACTION) or {}).get("names")
        names = list(names) if isinstance(names, list | tuple) else names
        _check_action_names(names)
        if self.pretrained_path and names != self.action_names:
            raise InputError(f"The checkpoint acts in {self.action_names}, but the data set's actions are {names}.")
        self.action_names = names
        self.feature_column = features.get(self.feature_key)

    def validate_features(self) -> None:
        """Narrow inputs to the cameras (and state) and outputs to `action`.

        A feature set has no images, but its policy will act on images: they are declared all the same.

        Raises:
            ValueError: neither its cameras nor their features are among the inputs, the state is asked for
                and absent, or `action` has another number of channels than `action_names`.
        """
        inputs, outputs = self.input_features or {}, self.output_features or {}
        if not {*self.image_keys} <= {*inputs} and self.feature_key not in inputs:
            raise InputError(
                f"frozen_vit needs {' and '.join(self.image_keys)} or {self.feature_key}; the inputs are: "
                f"{', '.join(inputs) or 'none'} (choose another camera)."
            )
        if self.use_state and OBS_STATE not in inputs:
            raise InputError(f"use_state needs {OBS_STATE}; the inputs are: {', '.join(inputs)}.")
        shape = outputs[ACTION].shape if ACTION in outputs else (len(self.action_names),)
        if tuple(shape) != (len(self.action_names),):
            raise InputError(
                f"The policy's actions have {len(self.action_names)} numbers ({', '.join(self.action_names)}), those "
                f"of the environment or data set {shape[0]}: give both the same `action`, task or full."
            )
        picture = PolicyFeature(FeatureType.VISUAL, (3, IMAGE_SIZE, IMAGE_SIZE))
        self.input_features = {key: inputs.get(key, picture) for key in self.image_keys}
        if self.use_state:
            self.input_features[OBS_STATE] = inputs[OBS_STATE]
        self.output_features = {ACTION: PolicyFeature(FeatureType.ACTION, tuple(shape))}

    def get_optimizer_preset(self) -> AdamWConfig:
        return AdamWConfig(lr=self.optimizer_lr, weight_decay=self.optimizer_weight_decay)

    def get_scheduler_preset(self) -> CosineAnnealingWithWarmupSchedulerConfig | None:
        steps = self.scheduler_warmup_steps
        return None if steps is None else CosineAnnealingWithWarmupSchedulerConfig(steps)

    @property
    def observation_delta_indices(self) -> None:
        return None

    @property
    def action_delta_indices(self) -> list[int]:
        return list(range(self.chunk_size))

    @property
    def reward_delta_indices(self) -> None:
        return None


def _encloses_pixels(crop: list[float]) -> bool:
    least = 2 / IMAGE_SIZE  # rounding its edges may leave nothing of a single pixel
    return len(crop) == 4 and all(
        0 <= first <= last - least <= 1 - least for first, last in zip(crop[:2], crop[2:], strict=True)
    )


def _check_action_names(names: Any) -> None:
    known = (*TRANSLATION_NAMES, *ROTATION_NAMES)
    moves = names[:-1] if isinstance(names, list) and names[-1:] == [GRIPPER_NAME] else []
    if not moves or len(set(moves)) < len(moves) or not set(moves) <= set(known):
        raise InputError(
            f"action_names must be one or more of {', '.join(known)}, each once, and then '{GRIPPER_NAME}', "
            f"not {names}."
        )
