"""What a TinyBC policy is made of. Each field is a flag of LeRobot's commands, such as `--policy.chunk_size=4`."""

from dataclasses import dataclass, field

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamConfig

MODES = {"VISUAL": "IDENTITY", "STATE": "MEAN_STD", "ACTION": "MEAN_STD"}


@PreTrainedConfig.register_subclass("tinybc")
@dataclass
class TinyBCConfig(PreTrainedConfig):
    camera: str = "wrist"
    chunk_size: int = 8  # actions that are predicted at once
    n_action_steps: int = 4  # and how many of them are executed
    optimizer_lr: float = 1e-3
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {name: NormalizationMode[mode] for name, mode in MODES.items()}
    )

    observation_delta_indices = reward_delta_indices = None  # one observation, no reward

    @property
    def action_delta_indices(self):
        return list(range(self.chunk_size))

    def get_optimizer_preset(self):
        return AdamConfig(lr=self.optimizer_lr)

    def get_scheduler_preset(self):
        return None

    def validate_features(self):
        if f"observation.images.{self.camera}" not in self.image_features or self.robot_state_feature is None:
            raise ValueError(f"tinybc reads camera '{self.camera}' and the state; not {[*self.input_features]}.")
