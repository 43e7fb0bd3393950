"""From an encoder's tokens to the one vector that the heads see: the entries of `READOUTS`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

KEYPOINTS = 32
"""Feature maps of `spatial_softmax`, LeRobot's default for Diffusion Policy."""

QUERIES = 4
"""Learned queries of `attention`."""

POINTS = ("object", "receptacle", "hand")
"""Points in the image that `heat_maps` finds, in this order."""

POINT_NAMES = [f"{point}.{axis}" for point in POINTS for axis in "xy"]
"""Names of the points' positions: x to the right, y down."""

POINT_SCALE = 8.0
"""Factor on the positions that `heat_maps` returns: from -1 to 1 the millimetres that count are lost on the heads."""


@dataclass(frozen=True)
class Readout:
    """What the heads see of an image.

    Args:
        pool: `(cls (B, D), patches (B, N, D)) -> (B, ...)`: what is taken of the tokens, without parameters.
        dim: `D -> length` of the vector.
        build: `D -> module` that trains with the heads and makes the vector of what `pool` took. None: that is the
            vector.
        reads_patches: whether `pool` looks at the patches at all.
        points: names of the positions in the image that the vector holds, times `POINT_SCALE`. In training it learns
            them from the data set's.
    """

    pool: Callable[[Tensor, Tensor], Tensor]
    dim: Callable[[int], int]
    build: Callable[[int], nn.Module] | None = None
    reads_patches: bool = True
    points: Sequence[str] = ()

    @property
    def learns(self) -> bool:
        """Whether the module has parameters, so that what it returns changes in training."""
        return self.build is not None

    def loss(self, read: Tensor, points: Tensor, reduction: str = "mean") -> Tensor:
        """Return how far, along x and y, the points are from where they were found. Half the image is 1.

        Args:
            read: (B, 2P), the vector.
            points: (B, 2P), the data set's positions, from -1 to 1.
            reduction: "mean" over samples, or "none" for each sample (B,).
        """
        distances = (read / POINT_SCALE - points).abs().mean(dim=-1)
        return distances if reduction == "none" else distances.mean()


class SpatialSoftmax(nn.Module):
    """Where in the image each of K learned patterns is: the expected position under a softmax over the patches.

    As in Finn et al. 2016 (Deep Spatial Autoencoders) and LeRobot's Diffusion Policy, on a transformer's patches.

    Args:
        dim: length D of a patch feature.
        keypoints: patterns K.
    """

    def __init__(self, dim: int, keypoints: int = KEYPOINTS):
        super().__init__()
        self.patterns = nn.Linear(dim, keypoints, bias=False)  # the softmax would take a bias out

    def forward(self, patches: Tensor) -> Tensor:
        """Return (B, 2K) for patches (B, N, D) of a square grid: x then y of each keypoint, from -1 to 1."""
        return _expected_positions(self.patterns(patches))


class HeatMaps(nn.Module):
    """Where in the image some things are: the expected position under a heat map of each.

    A hidden layer draws the maps, one patch at a time; `SpatialSoftmax` has none. In training the maps learn where the
    things are, as the first layers of Levine et al. 2016 (End-to-End Training of Deep Visuomotor Policies) and the
    auxiliary losses of Zhang et al. 2018 (Deep Imitation Learning for Complex Manipulation Tasks).

    Args:
        dim: length D of a patch feature.
        hidden_dim: width of the hidden layer.
    """

    def __init__(self, dim: int, hidden_dim: int = 32):
        super().__init__()
        hidden = nn.Linear(dim, hidden_dim), nn.GELU()
        self.maps = nn.Sequential(*hidden, nn.Linear(hidden_dim, len(POINTS), bias=False))

    def forward(self, patches: Tensor) -> Tensor:
        """Return (B, 2P) for patches (B, N, D) of a square grid: x then y of each point, times `POINT_SCALE`."""
        return POINT_SCALE * _expected_positions(self.maps(patches))


class AttentionPooling(nn.Module):
    """What a few learned queries find in the image: each a weighted mean of the patches (attentive probing).

    Args:
        dim: length D of a patch feature.
        queries: how many, Q.
    """

    def __init__(self, dim: int, queries: int = QUERIES):
        super().__init__()
        self.queries = nn.Linear(dim, queries, bias=False)

    def forward(self, patches: Tensor) -> Tensor:
        """Return (B, Q D) for patches (B, N, D)."""
        attention = self.queries(patches).softmax(dim=-2)
        return (attention.transpose(-1, -2) @ patches).flatten(-2)


def _expected_positions(scores: Tensor) -> Tensor:
    """Return x then y of each map's expected position under a softmax over its patches, (B, 2K), from -1 to 1.

    Args:
        scores: (B, N, K) of a square grid's N patches in row-major order, x to the right and y down.
    """
    side = round(scores.shape[-2] ** 0.5)
    line = (torch.arange(side) + 0.5) / side * 2 - 1
    y, x = torch.meshgrid(line, line, indexing="ij")
    centres = torch.stack([x, y], dim=-1).reshape(-1, 2).to(scores)
    return (scores.softmax(dim=-2).transpose(-1, -2) @ centres).flatten(-2)


READOUTS = {
    "cls": Readout(lambda cls, patches: cls, lambda dim: dim, reads_patches=False),
    "mean": Readout(lambda cls, patches: patches.mean(dim=1), lambda dim: dim),
    "cls_mean": Readout(lambda cls, patches: torch.cat([cls, patches.mean(dim=1)], dim=-1), lambda dim: 2 * dim),
    "spatial_softmax": Readout(lambda cls, patches: patches, lambda dim: 2 * KEYPOINTS, SpatialSoftmax),
    "attention": Readout(lambda cls, patches: patches, lambda dim: QUERIES * dim, AttentionPooling),
    "heat_maps": Readout(lambda cls, patches: patches, lambda dim: 2 * len(POINTS), HeatMaps, points=POINT_NAMES),
}
