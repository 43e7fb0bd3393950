"""Videos of rollouts: one agent's first episode, seen by the base camera."""

from pathlib import Path

import numpy as np

from lerobot_constructskill.contract import FPS
from lerobot_constructskill.lerobot_internals import write_video
from lerobot_constructskill.progress import quiet
from lerobot_constructskill.rollout.simulators import Step

CAMERA = "base"


class FirstEpisode:
    """Keeps the frames of one agent's first episode.

    Args:
        number: which agent is filmed; None for no agent.
    """

    def __init__(self, number: int | None):
        self._number = number
        self._frames: list[np.ndarray] = []

    def add(self, number: int, episode: int, action: np.ndarray, step: Step) -> None:
        """Keep a frame of the first episode; called as `lockstep.OnStep`."""
        if number == self._number and episode == 0:
            self._frames.append(step.seen["pixels"][CAMERA])

    def write(self, number: int, path: Path) -> None:
        """Write the video of an agent, if it is the one that was filmed."""
        if number == self._number and self._frames:
            with quiet():
                write_video(path, self._frames, FPS)
