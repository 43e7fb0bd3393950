"""Find a side of a comparison by what the user typed: a variant of a study, or a folder for each training seed."""

from collections.abc import Callable
from dataclasses import dataclass
from glob import glob
from pathlib import Path

from lerobot_constructskill.comparison.read import EVAL_INFO, recordings_in
from lerobot_constructskill.errors import InputError, MissingError
from lerobot_constructskill.lerobot_internals import LAST_CHECKPOINT
from lerobot_constructskill.study.rows import STUDY

STUDY_KIND, CHECKPOINT, RECORDED, EVALUATED = "study", "checkpoint", "recordings", "lerobot-eval"


@dataclass(frozen=True)
class Found:
    """Where a side lies.

    Args:
        name: what the user typed.
        kind: `STUDY_KIND`, `CHECKPOINT`, `RECORDED` or `EVALUATED`.
        folders: of a study, its folder; else one for each training seed.
        arm: setting/variant of a study.
    """

    name: str
    kind: str
    folders: tuple[Path, ...]
    arm: str = ""


def find(text: str) -> Found:
    """Find a side.

    Args:
        text: a study's folder, ":" and setting/variant; or folders separated by commas, or patterns such as
            `outputs/mine/train/seed_*`, of checkpoints, of `lerobot-train`, of `lerobot-eval` or of recordings.

    Raises:
        MissingError: nothing lies there.
        InputError: what lies there is none of these, of several kinds, or there twice.
    """
    root, colon, arm = text.rpartition(":")
    if colon and (Path(root) / STUDY).is_file():
        return Found(text, STUDY_KIND, (Path(root),), arm)
    if (Path(text) / STUDY).is_file():
        return Found(text, STUDY_KIND, (Path(text),))
    folders = [folder for part in text.split(",") for folder in _matches(part.strip())]
    recognized = [_recognize(folder) for folder in folders]
    if len(kinds := dict.fromkeys(kind for kind, _ in recognized)) > 1:
        raise InputError(f"'{text}' is of several kinds ({', '.join(kinds)}); the seeds of a side are of one.")
    paths = tuple(path for _, path in recognized)
    if len({path.resolve() for path in paths}) < len(paths):
        raise InputError(f"'{text}' names a folder twice; each training seed counts once.")
    return Found(text, *kinds, paths)


def _matches(pattern: str) -> list[Path]:
    found = sorted(Path(name) for name in glob(pattern) if Path(name).is_dir()) if pattern else []
    if not found:
        raise MissingError(f"There is no folder '{pattern}'.")
    return found


def _recognize(folder: Path) -> tuple[str, Path]:
    """The kind of a folder, and the folder that holds what is to be read."""
    for kind, inner, holds in _KINDS:
        if holds(folder / inner):
            return kind, folder / inner
    raise InputError(
        f"'{folder}' is no checkpoint (config.json), no output of lerobot-train ({LAST_CHECKPOINT}) or lerobot-eval "
        f"({EVAL_INFO}), and has no recordings (*.parquet)."
    )


def _has(file: str) -> Callable[[Path], bool]:
    return lambda folder: (folder / file).is_file()


_KINDS: tuple[tuple[str, Path, Callable[[Path], bool]], ...] = (
    (CHECKPOINT, Path(), _has("config.json")),
    (CHECKPOINT, LAST_CHECKPOINT, _has("config.json")),
    (CHECKPOINT, Path("pretrained_model"), _has("config.json")),
    (RECORDED, Path(), lambda folder: bool(recordings_in(folder)) and not _has(STUDY)(folder)),
    (EVALUATED, Path(), _has(EVAL_INFO)),
)
"""Kind, where in a folder it lies, and whether it does. Recordings say more than `lerobot-eval`'s results do."""
