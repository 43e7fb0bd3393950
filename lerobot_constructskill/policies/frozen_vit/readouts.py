"""From an encoder's tokens to the one vector that the heads see: the entries of `READOUTS`."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

KEYPOINTS = 32
"""Feature maps of `spatial_softmax`, LeRobot's default for Diffusion Policy."""

QUERIES = 4
"""Learned queries of `attention`."""

POINTS = ("object", "receptacle", "hand")
"""Points in the image that `heat_maps` finds, in this order."""

POINT_NAMES = [f"{point}.{axis}" for point in POINTS for axis in "xy"]
"""Names of the points' positions: x to the right, y down."""

CACHED = 8
"""Images whose patches are taken into the processor's cache at a time, a few megabytes."""

NEGLIGIBLE = 1e-12
"""Share of a map that changes no sum: it is far below the 1e-7 of float32."""

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

    As in Finn et al. 2016 (Deep Spatial Autoencoders) and LeRobot's Diffusion Policy, on a transformer's patches. They
    may be in float16, as a feature set keeps them.

    Args:
        dim: length D of a patch feature.
        keypoints: patterns K.
    """

    def __init__(self, dim: int, keypoints: int = KEYPOINTS):
        super().__init__()
        self.patterns = nn.Linear(dim, keypoints, bias=False)  # the softmax would take a bias out

    def forward(self, patches: Tensor) -> Tensor:
        """Return (B, 2K) for patches (B, N, D) of a square grid: x then y of each keypoint, from -1 to 1."""
        return _Positions.apply(patches, self.patterns.weight)[0]


class _Positions(torch.autograd.Function):
    """`_expected_positions` of maps that are linear in the patches, with a gradient for the patterns alone.

    On a CPU its time is that of two matrix products, which are faster in a processor's cache. So the patches of a few
    images at a time go there, and are made float32 there (`benchmarks/keypoints.py`). Shares of a softmax so small
    that they change no sum are set to 0: denormal numbers are slow, in products above all.
    """

    @staticmethod
    def forward(patches: Tensor, patterns: Tensor) -> tuple[Tensor, Tensor]:
        """Return positions (B, 2K) and the softmax of each map (B, K, N), for patches (B, N, D), patterns (K, D)."""
        shares = patterns.new_empty(len(patches), len(patterns), patches.shape[1])
        for some, its_shares in zip(_in_cache(patches, patterns), shares.split(_group(patches)), strict=True):
            torch.matmul(patterns, some.transpose(1, 2), out=its_shares)
        shares = nn.functional.threshold(shares.softmax(dim=-1), NEGLIGIBLE, 0.0, inplace=True)
        line = _line(patches.shape[1]).to(shares)
        square = shares.unflatten(-1, (len(line), len(line)))
        positions = torch.stack([square.sum(dim=-2) @ line, square.sum(dim=-1) @ line], dim=-1)
        return positions.flatten(-2), shares

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: tuple[Tensor, Tensor]) -> None:
        positions, shares = output
        ctx.mark_non_differentiable(shares)
        ctx.save_for_backward(inputs[0], positions, shares)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor, _: Tensor) -> tuple[None, Tensor]:
        patches, positions, shares = ctx.saved_tensors
        gradient, positions = (one.unflatten(-1, (-1, 2)) for one in (gradient, positions))
        of_maps = gradient @ _centres(patches.shape[1]).to(gradient).T
        of_maps -= (gradient * positions).sum(dim=-1, keepdim=True)
        of_maps *= shares
        of_patterns = gradient.new_zeros(shares.shape[1], patches.shape[-1])
        for some, of_its_maps in zip(_in_cache(patches, gradient), of_maps.split(_group(patches)), strict=True):
            of_patterns += torch.bmm(of_its_maps, some).sum(dim=0)
        return None, of_patterns

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, int | None], patches: Tensor, patterns: Tensor) -> Any:
        """Over seeds, one after another: they share nothing."""
        seeds = range(info.batch_size)
        own_patches, own_patterns = (
            [tensor if dim is None else tensor.select(dim, seed) for seed in seeds]
            for tensor, dim in zip((patches, patterns), in_dims, strict=True)
        )
        made = [_Positions.apply(*own) for own in zip(own_patches, own_patterns, strict=True)]
        return tuple(torch.stack(each) for each in zip(*made, strict=True)), (0, 0)


def _group(patches: Tensor) -> int:
    """Images at a time: all of them on a GPU, which has no cache to fill."""
    return CACHED if patches.device.type == "cpu" else max(1, len(patches))


def _in_cache(patches: Tensor, like: Tensor) -> Iterator[Tensor]:
    """Yield the patches of a few images at a time, in the type of `like`; the next ones overwrite them."""
    cached = like.new_empty(min(_group(patches), len(patches)), *patches.shape[1:])
    for some in patches.split(_group(patches)):
        yield cached[: len(some)].copy_(some)


class InEach(nn.Module):
    """A readout of several cameras: a module for each, and their vectors one after the other.

    Args:
        modules: one a camera.
    """

    def __init__(self, modules: Sequence[nn.Module]):
        super().__init__()
        self.cameras = nn.ModuleList(modules)

    def forward(self, patches: Tensor) -> Tensor:
        """Return (B, C V) for the patches of C cameras, (B, C N, D)."""
        parts = zip(self.cameras, patches.chunk(len(self.cameras), dim=1), strict=True)
        return torch.cat([module(own) for module, own in parts], dim=-1)


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
        return POINT_SCALE * _expected_positions(self.maps(patches.float()))


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
        patches = patches.float()
        attention = self.queries(patches).softmax(dim=-2)
        return (attention.transpose(-1, -2) @ patches).flatten(-2)


def _expected_positions(scores: Tensor) -> Tensor:
    """Return x then y of each map's expected position under a softmax over its patches, (B, 2K), from -1 to 1.

    Args:
        scores: (B, N, K) of a square grid's N patches in row-major order, x to the right and y down.
    """
    centres = _centres(scores.shape[-2]).to(scores)
    return (scores.softmax(dim=-2).transpose(-1, -2) @ centres).flatten(-2)


def _line(patches: int) -> Tensor:
    """The centres of the patches of a side of a square grid of N patches, (sqrt(N),), from -1 to 1."""
    side = round(patches**0.5)
    return (torch.arange(side) + 0.5) / side * 2 - 1


def _centres(patches: int) -> Tensor:
    """x and y of the centre of each of N patches of a square grid, (N, 2), from -1 to 1."""
    y, x = torch.meshgrid(_line(patches), _line(patches), indexing="ij")
    return torch.stack([x, y], dim=-1).reshape(-1, 2)


READOUTS = {
    "cls": Readout(lambda cls, patches: cls, lambda dim: dim, reads_patches=False),
    "mean": Readout(lambda cls, patches: patches.mean(dim=1), lambda dim: dim),
    "cls_mean": Readout(lambda cls, patches: torch.cat([cls, patches.mean(dim=1)], dim=-1), lambda dim: 2 * dim),
    "spatial_softmax": Readout(lambda cls, patches: patches, lambda dim: 2 * KEYPOINTS, SpatialSoftmax),
    "attention": Readout(lambda cls, patches: patches, lambda dim: QUERIES * dim, AttentionPooling),
    "heat_maps": Readout(lambda cls, patches: patches, lambda dim: 2 * len(POINTS), HeatMaps, points=POINT_NAMES),
}


def beside(parts: Sequence[Tensor]) -> Tensor:
    """What is taken of each camera's tokens, (B, ...), one after the other; of one camera as it is, without a copy."""
    return parts[0] if len(parts) == 1 else torch.cat([*parts], dim=1)


def in_each(cameras: int, readout: Readout, dim: int) -> nn.Module:
    """What trains of a readout of so many cameras, for an encoder's features of length `dim`."""
    if readout.build is None:
        return nn.Identity()
    return readout.build(dim) if cameras == 1 else InEach([readout.build(dim) for _ in range(cameras)])
