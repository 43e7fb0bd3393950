"""Overlapping chunks to one action."""

from collections.abc import Sequence

import torch
from torch import Tensor


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
