"""The noise of commands that have none unless it is asked for."""

from dataclasses import dataclass

from lerobot_constructskill.demos.noise import NoiseConfig, Sigma
from lerobot_constructskill.parsing import tells_of_bases


@tells_of_bases
@dataclass(frozen=True)
class NoNoise(NoiseConfig):
    """`NoiseConfig` with another default, which draccus would not take from a default value.

    Args:
        sigma: standard deviation per axis of `fixed`, in metres; none by default.
    """

    sigma: Sigma = 0.0
