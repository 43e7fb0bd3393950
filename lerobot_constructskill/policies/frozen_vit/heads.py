"""The part that trains: a readout and two heads, from tokens to a chunk of actions; and its loss."""

from itertools import pairwise

import torch
import torch.nn.functional as F  # noqa: N812
from lerobot.utils import OBS_STATE
from torch import Tensor, nn

from .configuration_frozen_vit import FrozenViTChunkConfig
from .readouts import READOUTS, in_each

COSTS = {"mse": Tensor.square, "l1": Tensor.abs}
"""Cost of a translation's error: the paper's squared error, or the absolute one of ACT (Zhao et al. 2023)."""


class ChunkHeads(nn.Module):
    """Two heads that share no weights (paper, section II), on one vector: linear, or with hidden layers.

    Args:
        config: says the readout, the state, the shape of a chunk of T steps and A channels, and the layers.
        feature_dim: length of the encoder's features.
        sentence_dim: length of an instruction's vector, 0 where the heads are told none.
    """

    def __init__(self, config: FrozenViTChunkConfig, feature_dim: int, sentence_dim: int = 0):
        super().__init__()
        spec = READOUTS[config.readout]
        self.chunk_shape = (config.chunk_size, len(config.action_names) - 1)
        self.action_scale = config.action_scale
        self.readout = in_each(len(config.cameras), spec, feature_dim)
        read_dim = len(config.cameras) * spec.dim(feature_dim)
        self.side_dims = (config.input_features[OBS_STATE].shape[0] if config.use_state else 0), sentence_dim
        scales = config.language_fusion == "film" and sentence_dim > 0
        self.film = _no_change(sentence_dim, read_dim) if scales else None
        input_dim = read_dim + self.side_dims[0] + (0 if self.film else sentence_dim)
        hidden = [config.head_hidden_dim] * config.head_hidden_layers if config.head_hidden_dim else []
        self.translation = _head(input_dim, hidden, self.chunk_shape[0] * self.chunk_shape[1])
        self.gripper = _head(input_dim, hidden, self.chunk_shape[0])

    def forward(self, pooled: Tensor, side: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return a chunk and the readout's vector, for pooled tokens (B, ...).

        Args:
            pooled: what the readout takes of the encoder's tokens.
            side: the state and the instruction's vector, one after the other, (B, S); None where there is neither.

        Returns:
            (B, T, A), bounded translations in metres (and rotations in radians), then the gripper's logit or number;
            and the readout's vector.
        """
        read = self.readout(pooled)
        inputs = read if side is None else self._beside(read, side)
        regressed = self.translation(inputs).unflatten(-1, self.chunk_shape)
        chunk = torch.cat([self.action_scale * regressed.tanh(), self.gripper(inputs)[..., None]], dim=-1)
        return chunk, read

    def _beside(self, read: Tensor, side: Tensor) -> Tensor:
        state, sentence = side.split(self.side_dims, dim=-1)
        if self.film is None:
            return torch.cat([read, side], dim=-1)
        scale, shift = self.film(sentence).chunk(2, dim=-1)
        return torch.cat([read * (1 + scale) + shift, state], dim=-1)


def _no_change(sentence_dim: int, read_dim: int) -> nn.Linear:
    """From an instruction to scales and shifts of what the readout found, which begin as none."""
    film = nn.Linear(sentence_dim, 2 * read_dim)
    nn.init.zeros_(film.weight)
    nn.init.zeros_(film.bias)
    return film


def _head(input_dim: int, hidden: list[int], output_dim: int) -> nn.Module:
    if not hidden:
        return nn.Linear(input_dim, output_dim)
    layers = [layer for i, o in pairwise([input_dim, *hidden]) for layer in (nn.Linear(i, o), nn.GELU())]
    return nn.Sequential(*layers, nn.Linear(hidden[-1], output_dim))


def offsets(chunk: Tensor, target: Tensor, padded: Tensor) -> Tensor:
    """Return how far translations (and rotations) are off, (B, T, A - 1), 0 where a step is padded (B, T)."""
    return (chunk[..., :-1] - target[..., :-1]).masked_fill(padded[..., None], 0.0)


def heads_loss(
    config: FrozenViTChunkConfig,
    chunk: Tensor,
    read: Tensor,
    target: Tensor,
    padded: Tensor,
    points: Tensor | None = None,
    reduction: str = "mean",
) -> tuple[Tensor, dict[str, Tensor]]:
    """Compare the output of `ChunkHeads` with actions, and the vector of its readout with the points in the image.

    Args:
        config: says the losses and their weights.
        chunk: (B, T, A), from `ChunkHeads`.
        read: (B, ...), the readout's vector, from `ChunkHeads`.
        target: (B, T, A), the gripper +1 or -1.
        padded: (B, T), true for steps beyond an episode's end.
        points: (B, 2P), the positions that a readout with points learns from; None for other readouts.
        reduction: "mean" over all valid steps (of the readout's loss over samples), or "none" for each sample (B,).

    Returns:
        The loss, and its terms before they are weighted.
    """
    regression = COSTS[config.regression_loss](offsets(chunk, target, padded)).mean(dim=-1)
    if config.gripper_head == "regression":
        gripper = (chunk[..., -1] - target[..., -1]).pow(2)
    else:
        gripper = F.binary_cross_entropy_with_logits(chunk[..., -1], (target[..., -1] + 1) / 2, reduction="none")
    gripper = gripper.masked_fill(padded, 0.0)
    n_valid = (~padded).sum(dim=1)
    terms = {"regression_loss": regression.sum() / n_valid.sum(), "gripper_loss": gripper.sum() / n_valid.sum()}
    if reduction == "none":
        loss = (config.regression_weight * regression + gripper).sum(dim=1) / n_valid.clamp(min=1)
    else:
        loss = config.regression_weight * terms["regression_loss"] + terms["gripper_loss"]
    if points is not None:
        terms["point_loss"] = READOUTS[config.readout].loss(read, points, reduction)
        loss = loss + config.point_weight * terms["point_loss"]
    return loss, terms
