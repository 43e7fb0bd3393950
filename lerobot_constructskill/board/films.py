"""Films of a board's entries: their actions, executed once more and drawn, so that they need nobody's video."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lerobot_constructskill.artifacts.folders import replaced
from lerobot_constructskill.board.entries import Entry
from lerobot_constructskill.board.protocol import HORIZON
from lerobot_constructskill.board.recovered import Lost, Recovery
from lerobot_constructskill.board.replay import open_simulator, open_workers
from lerobot_constructskill.board.submission import Claim
from lerobot_constructskill.contract import FPS
from lerobot_constructskill.lerobot_internals import write_video
from lerobot_constructskill.progress import Progress, quiet

FILMS = "films"
"""Folder of the films beside the pages."""

EDGE, RED = 8, (200, 30, 30)
"""Pixels and colour of the frame around a picture of an episode that is lost."""


@dataclass(frozen=True)
class Film:
    """An episode to film.

    Args:
        folder: of the submission's films, from the board's folder.
        claim: the episode.
        recovery: where it was lost; None if it placed, or was not searched.
    """

    folder: str
    claim: Claim
    recovery: Recovery | None

    @property
    def path(self) -> str:
        """From the board's folder. Another submission or another step has another path."""
        lost = "" if self.lost_from is None else f"_lost_{self.lost_from}"
        setting, seed, start = self.claim.key
        return f"{self.folder}/{setting}_seed_{seed}_start_{start}{lost}.mp4"

    @property
    def lost_from(self) -> int | None:
        """The first step from which the expert no longer places, whatever time it has; None if unknown or none."""
        if self.recovery is None or self.recovery.last_step_extra == self.recovery.steps:
            return None
        return 0 if self.recovery.last_step_extra is None else self.recovery.last_step_extra + 1

    @property
    def shows(self) -> str:
        """What is seen, in words."""
        if self.claim.placed:
            return "placed"
        if self.recovery is None:
            return "not placed"
        return self.recovery.lost if self.lost_from is None else f"{self.recovery.lost}, lost at step {self.lost_from}"


def films_there(entry: Entry, setting: str, out: Path) -> list[Film]:
    """The films of a setting that are there."""
    return [film for film in _films(entry, setting) if (out / film.path).exists()]


def write_films(entries: Sequence[Entry], out: Path) -> None:
    """Film what is not filmed yet.

    Args:
        out: the folder of the board's pages.

    Raises:
        OSError: a worker died, or there is nothing to render with.
    """
    films = [film for entry in entries for name in entry.standings for film in _films(entry, name)]
    with open_workers() as submit:
        running = [submit(_film, film, out / film.path) for film in films if not (out / film.path).exists()]
        for future in Progress(running, "filming", unit="episode"):
            future.result()


def _films(entry: Entry, setting: str) -> Iterator[Film]:
    """Of a setting the first episode that placed and, for each cause, the first that did not."""
    if not entry.declaration.is_replayable:
        return
    folder, seen = f"{FILMS}/{entry.name}_{entry.submission.sha256[:12]}", set[tuple]()
    for claim in (one for own in entry.standings[setting].claims.values() for one in own if one.error is None):
        recovery = None if claim.placed else entry.recoveries.get(claim.key)
        outcome = claim.placed, recovery and recovery.lost
        if outcome not in seen and outcome != (False, Lost.UNSEEN):
            seen.add(outcome)
            yield Film(folder, claim, recovery)


def _film(film: Film, path: Path) -> None:
    """Film an episode's first `HORIZON` steps: a setting may have 10,000, whose frames take 8 GB."""
    env = open_simulator(film.claim.environment, "auto")
    try:
        env.reset(seed=film.claim.evaluation_seed)
        frames = [env.render()]
        for action in film.claim.executed[:HORIZON]:
            env.step(action)
            frames.append(env.render())
    finally:
        env.close()
    if film.lost_from is not None:
        frames[film.lost_from :] = map(_framed, frames[film.lost_from :])
    with replaced(path) as partial, quiet():
        write_video(partial, frames, FPS)


def _framed(picture: np.ndarray) -> np.ndarray:
    """A picture, (height, width, 3), with a red edge."""
    framed = np.full_like(picture, RED)
    framed[EDGE:-EDGE, EDGE:-EDGE] = picture[EDGE:-EDGE, EDGE:-EDGE]
    return framed
