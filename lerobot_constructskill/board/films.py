"""Films of a board's entries: their actions, executed once more and drawn, so that they need nobody's video."""

from collections.abc import Sequence
from pathlib import Path

from lerobot_constructskill.artifacts.folders import replaced
from lerobot_constructskill.board.entries import Entry
from lerobot_constructskill.board.protocol import HORIZON
from lerobot_constructskill.board.replay import open_simulator, open_workers
from lerobot_constructskill.board.submission import Claim
from lerobot_constructskill.contract import FPS
from lerobot_constructskill.lerobot_internals import write_video
from lerobot_constructskill.progress import Progress, quiet

FILMS = "films"
"""Folder of the films beside the pages."""


def films_there(entry: Entry, setting: str, out: Path) -> dict[str, Claim]:
    """The films of a setting that are there: path from the board's folder to the episode."""
    return {path: claim for path, claim in _films(entry, setting).items() if (out / path).exists()}


def write_films(entries: Sequence[Entry], out: Path) -> None:
    """Film what is not filmed yet.

    Args:
        out: the folder of the board's pages.

    Raises:
        OSError: a worker died, or there is nothing to render with.
    """
    films = [film for entry in entries for name in entry.standings for film in _films(entry, name).items()]
    with open_workers() as submit:
        running = [submit(_film, claim, out / path) for path, claim in films if not (out / path).exists()]
        for future in Progress(running, "filming", unit="episode"):
            future.result()


def _films(entry: Entry, setting: str) -> dict[str, Claim]:
    """The first episode of a setting that placed and the first that did not; another submission's have other paths."""
    if not entry.declaration.is_replayable:
        return {}
    claims = [one for own in entry.standings[setting].claims.values() for one in own if one.error is None]
    firsts = [next((one for one in claims if one.placed == placed), None) for placed in (True, False)]
    folder = f"{FILMS}/{entry.name}_{entry.submission.sha256[:12]}"
    named = "{0.setting}_seed_{0.training_seed}_start_{0.evaluation_seed}.mp4"
    return {f"{folder}/{named.format(one)}": one for one in firsts if one is not None}


def _film(claim: Claim, path: Path) -> None:
    """Film an episode's first `HORIZON` steps: a setting may have 10,000, whose frames take 8 GB."""
    env = open_simulator(claim.environment, "auto")
    try:
        env.reset(seed=claim.evaluation_seed)
        frames = [env.render()]
        for action in claim.executed[:HORIZON]:
            env.step(action)
            frames.append(env.render())
    finally:
        env.close()
    with replaced(path) as partial, quiet():
        write_video(partial, frames, FPS)
