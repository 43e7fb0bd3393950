"""Draws what a perturbation changes in a scene, once, from the axis and the perturbation's seed."""

import zlib
from dataclasses import dataclass

import numpy as np

from lerobot_constructskill.contract import BRICK
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.perturbations import Perturbation


def check_fits(size: tuple[float, ...], clearance: float) -> None:
    """Raise InputError where a brick of a drawn size, in metres, is too large for a bin of the ladder."""
    if any(edge > usual + clearance for edge, usual in zip(size[:2], BRICK[:2], strict=True)):
        x, y = (f"{1000 * edge:.1f}" for edge in size[:2])
        raise InputError(
            f"This draw of size makes a brick of {x} x {y} mm, which is too large for the bin, "
            f"{1000 * clearance:g} mm larger than the usual brick: name another perturb_seed."
        )


@dataclass(frozen=True)
class Draws:
    """The draws of one scene. Every method returns its argument unchanged where its axis is not perturbed."""

    perturbation: Perturbation

    def _rng(self, axis: str) -> np.random.Generator:
        return np.random.default_rng([self.perturbation.seed, zlib.crc32(axis.encode())])

    def eye(self, eye: tuple[float, float, float]) -> np.ndarray:
        """A camera's place, (3,) metres, moved in a random direction."""
        direction = self._rng("camera").standard_normal(3)
        return np.array(eye) + self.perturbation.amount("camera") * direction / np.linalg.norm(direction)

    def light(self, direction: list[float], colour: list[float]) -> tuple[list[float], list[float]]:
        """Direction and colour of a light, the former turned and the latter brighter or darker."""
        rng, amount = self._rng("light"), self.perturbation.amount("light")
        turned = np.array(direction) + amount * rng.uniform(-1, 1, 3) * [1, 1, 0]
        return turned.tolist(), (np.array(colour) * (1 + amount * rng.choice([-1, 1]))).tolist()

    def surface(self, name: str, colour: tuple[int, int, int], pattern: int) -> tuple[tuple[int, ...], int]:
        """Colour and pattern seed of the surface called `name`."""
        amount = self.perturbation.amount("texture")
        if not amount:
            return colour, pattern
        rng = self._rng(f"texture {name}")
        tinted = np.clip(np.array(colour) * (1 + amount * rng.choice([-1, 1], 3)), 0, 255)
        return tuple(int(channel) for channel in tinted), int(rng.integers(1000))

    def brick(self, size: tuple[float, float, float]) -> tuple[float, ...]:
        """Size of a brick in metres, within EN 771-1's tolerance of the mean: k * sqrt(dimension in mm), in mm."""
        factor, rng = self.perturbation.amount("size"), self._rng("size")
        return tuple(
            side + factor * np.sqrt(side * 1000) / 1000 * rng.uniform(-1, 1) if factor else side for side in size
        )

    @property
    def latency(self) -> int:
        """Steps by which an action is executed late; 0 where this axis is not perturbed."""
        return int(self.perturbation.amount("latency"))

    def offcuts(self, taken: np.ndarray, clearance: float) -> list[tuple[np.ndarray, np.ndarray]]:
        """Size and place, each (3,) metres, of boxes on the ground at least `clearance` from every row of `taken`."""
        rng, boxes = self._rng("distractors"), []
        while len(boxes) < self.perturbation.amount("distractors"):
            size = rng.uniform(0.02, 0.06, 3)
            place = np.array([*rng.uniform([-0.35, -0.55], [0.30, 0.55]), size[2] / 2])
            if (np.linalg.norm(taken[:, :2] - place[:2], axis=1) > clearance).all():
                boxes.append((size, place))
        return boxes
