"""The part that trains: a readout and two linear heads, from tokens to a chunk of actions; and their loss."""

from itertools import pairwise
from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from .readouts import POINT_SCALE

REGRESSION_LOSSES = {"mse": Tensor.square, "l1": Tensor.abs}
"""What a translation's error costs: the paper's squared error, or the absolute one of ACT (Zhao et al. 2023)."""


class ChunkHeads(nn.Module):
    """Two heads that share no weights (paper, section II), on one vector: linear, or with hidden layers.

    Args:
        readout: makes that vector of what was pooled of the tokens; it may have parameters of its own.
        input_dim: length of the vector, with the state where the heads see it.
        chunk_size: steps T predicted at once.
        n_regressed: translations (and rotations) R of an action; the gripper makes A = R + 1.
        action_scale: bound of the regression, in metres (and radians).
        hidden_dim: width of the hidden layers, None for none.
        hidden_layers: how many of them.
    """

    def __init__(
        self,
        readout: nn.Module,
        input_dim: int,
        chunk_size: int,
        n_regressed: int,
        action_scale: float,
        hidden_dim: int | None = None,
        hidden_layers: int = 1,
    ):
        super().__init__()
        self.chunk_shape = (chunk_size, n_regressed)
        self.action_scale = action_scale
        self.readout = readout
        hidden = [hidden_dim] * hidden_layers if hidden_dim else []
        self.translation = _head(input_dim, hidden, chunk_size * n_regressed)
        self.gripper = _head(input_dim, hidden, chunk_size)

    def forward(self, pooled: Tensor, state: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return a chunk and what the readout made, for pooled tokens (B, ...).

        Returns:
            (B, T, A), bounded translations, then the gripper's logit or number; and the readout's vector.
        """
        read = self.readout(pooled)
        inputs = read if state is None else torch.cat([read, state], dim=-1)
        regressed = self.translation(inputs).unflatten(-1, self.chunk_shape)
        chunk = torch.cat([self.action_scale * regressed.tanh(), self.gripper(inputs)[..., None]], dim=-1)
        return chunk, read


def _head(input_dim: int, hidden: list[int], output_dim: int) -> nn.Module:
    if not hidden:
        return nn.Linear(input_dim, output_dim)
    layers = [layer for i, o in pairwise([input_dim, *hidden]) for layer in (nn.Linear(i, o), nn.GELU())]
    return nn.Sequential(*layers, nn.Linear(hidden[-1], output_dim))


class ChunkErrors(NamedTuple):
    """What a batch of chunks is off by; zero where a step is padded.

    Args:
        offset: (B, T, R), in metres (and radians).
        regression: (B, T), what the loss takes of translations (and rotations).
        gripper: (B, T), binary cross-entropy or squared error.
        n_valid: (B,) steps that are not padded.
        points: (B,), how far along x and y the readout's points are from theirs, where half the image is 1; 0 for a
            readout that finds none.
    """

    offset: Tensor
    regression: Tensor
    gripper: Tensor
    n_valid: Tensor
    points: Tensor

    def regression_loss(self) -> Tensor:
        return self.regression.sum() / self.n_valid.sum()

    def gripper_loss(self) -> Tensor:
        return self.gripper.sum() / self.n_valid.sum()

    def loss(self, regression_weight: float, point_weight: float) -> Tensor:
        """The mean over all valid steps, and of points over all samples."""
        chunks = regression_weight * self.regression_loss() + self.gripper_loss()
        return chunks + point_weight * self.points.mean()

    def loss_per_sample(self, regression_weight: float, point_weight: float) -> Tensor:
        """The mean over each sample's valid steps, and that of its points, (B,)."""
        errors = regression_weight * self.regression + self.gripper
        return errors.sum(dim=1) / self.n_valid.clamp(min=1) + point_weight * self.points


def chunk_errors(
    raw: Tensor,
    read: Tensor,
    target: Tensor,
    padded: Tensor,
    points: Tensor | None = None,
    *,
    gripper_head: str,
    regression_loss: str = "mse",
) -> ChunkErrors:
    """Compare what the heads returned with actions.

    Args:
        raw: (B, T, A), from `ChunkHeads`.
        read: (B, ...), what its readout made.
        target: (B, T, A), the gripper +1 or -1.
        padded: (B, T), true for steps beyond an episode's end.
        points: (B, 2P), x and y of the readout's points, from -1 to 1; None where it finds none or none is told.
        gripper_head: "bce" or "regression".
        regression_loss: one of `REGRESSION_LOSSES`.
    """
    offset = (raw[..., :-1] - target[..., :-1]).masked_fill(padded[..., None], 0.0)
    regression = REGRESSION_LOSSES[regression_loss](offset).mean(dim=-1)
    if gripper_head == "regression":
        gripper = (raw[..., -1] - target[..., -1]).pow(2)
    else:
        gripper = F.binary_cross_entropy_with_logits(raw[..., -1], (target[..., -1] + 1) / 2, reduction="none")
    n_valid = (~padded).sum(dim=1)
    astray = torch.zeros_like(read[..., 0]) if points is None else (read / POINT_SCALE - points).abs().mean(dim=-1)
    return ChunkErrors(offset, regression, gripper.masked_fill(padded, 0.0), n_valid, astray)
