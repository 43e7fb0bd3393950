"""A few convolutions over one camera's picture, and a head that sees them beside the state."""

from collections import deque

import torch
from lerobot.policies import PreTrainedPolicy
from torch import nn

from lerobot_policy_tinybc.configuration_tinybc import TinyBCConfig


class TinyBCPolicy(PreTrainedPolicy):
    config_class, name = TinyBCConfig, "tinybc"

    def __init__(self, config, **kwargs):
        super().__init__(config)
        config.validate_features()
        (n_state,), (self.n_action,) = config.robot_state_feature.shape, config.action_feature.shape
        sizes = [(3, 16, 5), (16, 32, 3), (32, 32, 3)]
        layers = [layer for size in sizes for layer in (nn.Conv2d(*size, stride=3), nn.ReLU())]
        self.eye = nn.Sequential(*layers, nn.AdaptiveAvgPool2d(6), nn.Flatten())
        n_out = config.chunk_size * self.n_action
        self.head = nn.Sequential(nn.Linear(32 * 36 + n_state, 256), nn.ReLU(), nn.Linear(256, n_out))
        self.reset()

    def get_optim_params(self):
        return self.parameters()

    def reset(self):
        self.queue = deque()

    def forward(self, batch):
        errors = (self.predict(batch) - batch["action"]).abs().mean(-1)
        return errors[~batch["action_is_pad"]].mean(), None

    def predict(self, batch):
        seen = self.eye(batch[f"observation.images.{self.config.camera}"])
        chunk = self.head(torch.cat([seen, batch["observation.state"]], dim=-1))
        return chunk.unflatten(-1, (self.config.chunk_size, self.n_action))

    @torch.no_grad()
    def predict_action_chunk(self, batch, **kwargs):
        return self.predict(batch)

    def select_action(self, batch, **kwargs):
        if not self.queue:
            self.queue.extend(self.predict_action_chunk(batch)[:, : self.config.n_action_steps].unbind(1))
        return self.queue.popleft()
