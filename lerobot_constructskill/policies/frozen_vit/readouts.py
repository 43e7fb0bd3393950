"""From an encoder's tokens to the one vector that the linear heads see: one entry of `READOUTS` each."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

KEYPOINTS = 32
"""Feature maps of `spatial_softmax`, LeRobot's default for Diffusion Policy."""

QUERIES = 4
"""Learned queries of `attention`."""

POINTS = ("object", "receptacle", "hand")
"""What `heat_maps` finds, in this order."""

POINT_NAMES = [f"{point}.{axis}" for point in POINTS for axis in "xy"]
"""The numbers that say where they are: x to the right, y down."""

POINT_SCALE = 8.0
"""Of its positions: where the whole image is from -1 to 1, the millimetres that count are lost on the heads."""


def _keep(dim: int) -> nn.Module:
    """What is pooled is the vector."""
    return nn.Identity()


@dataclass(frozen=True)
class Readout:
    """What the heads see of an image.

    Args:
        pool: `(cls (B, D), patches (B, N, D)) -> (B, ...)`: what is taken of the tokens, without parameters.
        build: `D -> module` that trains with the heads and makes one vector of what `pool` took.
        dim: `D -> length` of that vector.
        reads_patches: whether `pool` looks at the patches at all.
        points: names of the numbers that say where in the image things are. It is told them in training, from -1 to 1,
            and what `build` makes are these numbers times `POINT_SCALE`.
    """

    pool: Callable[[Tensor, Tensor], Tensor]
    dim: Callable[[int], int]
    build: Callable[[int], nn.Module] = _keep
    reads_patches: bool = True
    points: Sequence[str] = ()

    @property
    def learns(self) -> bool:
        """Whether the module has parameters, so that what it returns changes in training."""
        return self.build is not _keep


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
        attention = self.patterns(patches).softmax(dim=-2)
        positions = attention.transpose(-1, -2) @ _grid(patches.shape[-2]).to(patches)
        return positions.flatten(-2)


class HeatMaps(nn.Module):
    """Where in the image some things are: the expected position under a heat map of each.

    A hidden layer draws the maps, one patch at a time; `SpatialSoftmax` has none. In training they are told where the
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
        maps = self.maps(patches).softmax(dim=-2)
        positions = maps.transpose(-1, -2) @ _grid(patches.shape[-2]).to(patches)
        return POINT_SCALE * positions.flatten(-2)


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


def _grid(n_patches: int) -> Tensor:
    """Centres (N, 2) of a square grid's patches in row-major order: x to the right and y down, from -1 to 1."""
    side = round(n_patches**0.5)
    line = (torch.arange(side) + 0.5) / side * 2 - 1
    y, x = torch.meshgrid(line, line, indexing="ij")
    return torch.stack([x, y], dim=-1).reshape(-1, 2)


READOUTS = {
    "cls": Readout(lambda cls, patches: cls, lambda dim: dim, reads_patches=False),
    "mean": Readout(lambda cls, patches: patches.mean(dim=1), lambda dim: dim),
    "cls_mean": Readout(lambda cls, patches: torch.cat([cls, patches.mean(dim=1)], dim=-1), lambda dim: 2 * dim),
    "spatial_softmax": Readout(lambda cls, patches: patches, lambda dim: 2 * KEYPOINTS, SpatialSoftmax),
    "attention": Readout(lambda cls, patches: patches, lambda dim: QUERIES * dim, AttentionPooling),
    "heat_maps": Readout(lambda cls, patches: patches, lambda dim: 2 * len(POINTS), HeatMaps, points=POINT_NAMES),
}
