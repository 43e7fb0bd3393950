"""One video a variant: what the first seed's policy saw in its first episode."""

from pathlib import Path

import numpy as np
from lerobot.utils.io_utils import write_video

from lerobot_constructskill.contract import FPS
from lerobot_constructskill.progress import quiet
from lerobot_constructskill.staging import replaced
from lerobot_constructskill.study.plan import Run
from lerobot_constructskill.study.simulators import Step

CAMERA = "base"


class Film:
    """Keeps the frames of a job's seed 0, episode 0."""

    def __init__(self):
        self._frames: list[np.ndarray] = []

    def add(self, number: int, episode: int, action: np.ndarray, step: Step) -> None:
        """`rollout.OnStep`."""
        if number == 0 and episode == 0:
            self._frames.append(step.seen["pixels"][CAMERA])

    def write(self, root: Path, run: Run) -> str | None:
        """Write the video if `run` is the one filmed, and return its path in the study's folder."""
        if run.seed != 0 or not self._frames:
            return None
        path = Path("videos") / f"{run.setting}-{run.variant}.mp4"
        with quiet(), replaced(root / path) as partial:
            write_video(partial, self._frames, FPS)
        return str(path)
