"""Moves data sets to and from the Hub by huggingface_hub; each of its errors becomes one sentence without a token."""

import logging
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING

import httpx
from huggingface_hub import CommitOperationAdd, CommitOperationDelete, HfApi, errors, snapshot_download
from huggingface_hub.utils import filter_repo_objects

from lerobot_constructskill.artifacts.digests import data_sha256, files_below
from lerobot_constructskill.contract import HELD_OUT_EVERY
from lerobot_constructskill.dataset.dataset import read_info, video_complaints
from lerobot_constructskill.errors import (
    InputError,
    MachineError,
    MissingError,
    TakenError,
    UserError,
    first_line,
    plural,
)
from lerobot_constructskill.lerobot_internals import DATA_SET, INFO, TRAIN_CONFIG, TRAINED
from lerobot_constructskill.training.recipe import FACTS, SAID, held_out_of

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDataset

logger = logging.getLogger(__name__)

PUSHED = [
    "README.md",
    "pictures/contact_sheet.jpg",
    "pictures/trajectories.png",
    "meta/*.json",
    "meta/*.parquet",
    "data/*.parquet",
    "videos/*.mp4",
]
"""Files that are uploaded; `*` stands for folders as well."""

SET_FOLDERS = ("data/", "videos/", "meta/")
"""Folders whose files are deleted on the Hub where the pushed set lacks them."""

UNTOUCHED = {".gitattributes"}
"""Files that the Hub itself puts into a new repository."""

LOGIN = "`hf auth login` stores a token, HF_TOKEN gives one for a single command."


def locate(repo_id: str | None, root: Path | None = None, revision: str | None = None) -> Path:
    """The folder of a data set: `root`, else LeRobot's own copy of `repo_id`, else a revision that the Hub has.

    The revision, by default LeRobot's version tag, is downloaded into LeRobot's cache, or found there offline.

    Raises:
        ValueError: neither a name nor a folder was given, or a folder and a revision.
        FileNotFoundError: the folder is not there.
        OSError: there is no such data set or revision, the Hub cannot be reached, or it refuses the token.
    """
    if root is not None:
        if not root.is_dir():
            raise MissingError(f"There is no folder {root}.")
        if revision is not None:
            raise InputError("--revision is of a data set on the Hub, and --root a folder: give one of them.")
        return root
    if repo_id is None:
        raise InputError("Give a data set's name with --repo_id, or its folder with --root.")
    from lerobot.datasets import CODEBASE_VERSION  # ten seconds, which a mistake need not wait

    from lerobot_constructskill.lerobot_internals import HF_LEROBOT_HOME, HF_LEROBOT_HUB_CACHE

    if revision is None and (HF_LEROBOT_HOME / repo_id / "meta").is_dir():
        return HF_LEROBOT_HOME / repo_id
    revision = revision or CODEBASE_VERSION
    with hub_errors(repo_id, revision):
        folder = snapshot_download(repo_id, repo_type="dataset", revision=revision, cache_dir=HF_LEROBOT_HUB_CACHE)
    return Path(folder)


def open_lerobot(repo_id: str, root: Path | None, revision: str | None = None) -> "LeRobotDataset":
    """The data set in `root`, else in LeRobot's cache or on the Hub, as LeRobot opens it.

    Raises:
        FileNotFoundError: there is no data set in `root`.
        ValueError: a file of it cannot be read.
        OSError: the Hub does not have it, or cannot be reached.
    """
    from lerobot.datasets import LeRobotDataset

    if root is not None:
        read_info(root)
    try:
        with hub_errors(repo_id, revision):
            dataset = LeRobotDataset(repo_id, root=root, revision=revision)
    except Exception as error:  # whatever a file can do to LeRobot, datasets and Arrow; no line of ours is in there
        if root is None and isinstance(error, UserError | OSError):
            raise
        # LeRobot looks on the Hub for what it cannot read, and its last word is about that.
        said = first_line(_first(error))
        raise InputError(f"LeRobot cannot open the data set {root or repo_id} ({said}).") from error
    _check_videos(dataset)
    return dataset


def _first(error: BaseException) -> BaseException:
    """The first of the exceptions that led to one."""
    return _first(error.__context__) if error.__context__ else error


def _check_videos(dataset: "LeRobotDataset") -> None:
    """Refuse incomplete videos, and videos of another rate than the data set's, before an hour of work."""
    rows: dict[Path, int] = {}
    for episode in dataset.meta.episodes:
        for camera in dataset.meta.video_keys:
            path = dataset.root / dataset.meta.get_video_file_path(episode["episode_index"], camera)
            rows[path] = rows.get(path, 0) + episode["length"]
    for path, wanted in rows.items():
        for complaint in video_complaints(path, path.relative_to(dataset.root), wanted, dataset.fps):
            raise InputError(complaint)


def choose_held_out(
    dataset: "LeRobotDataset", episodes: list[int] | None, checkpoints: Iterable[Path | str]
) -> list[int]:
    """The named episodes, or by default those that the contract holds out, if no checkpoint was trained on them.

    A warning names each checkpoint whose training episodes are unknown.

    Raises:
        InputError: there are no such episodes, or a checkpoint was trained on one that is held out by default.
    """
    chosen = held_out_of(dataset) if episodes is None else episodes
    if not chosen:
        raise InputError("Of fewer than eight demonstrations none is held out: name some by --episodes.")
    if not set(chosen) <= set(range(dataset.num_episodes)):
        raise InputError(f"Held-out episodes must be among 0 to {dataset.num_episodes - 1}, not {chosen}.")
    for checkpoint in checkpoints if episodes is None else ():
        if (learnt := trained_on(Path(checkpoint), dataset)) is None:
            logger.warning("Whether '%s' was trained on the held-out episodes %s cannot be told.", checkpoint, chosen)
        elif seen := sorted(learnt & set(chosen)):
            raise InputError(
                f"'{checkpoint}' was trained on {plural(len(seen), 'episode')} of those that are held out by default, "
                f"episode {seen[0]} for one: name others by --episodes, or the same to see their error all the same."
            )
    return chosen


def trained_on(checkpoint: Path, dataset: "LeRobotDataset") -> set[int] | None:
    """The episodes of a data set on which, or on whose features, a checkpoint in a folder was trained.

    LeRobot holds out the last episodes of each task, a share `eval_split` that is rounded up. A study and DAgger
    record how much they hold out, but not of which folder.

    Returns:
        None if it is unknown: the checkpoint is on the Hub, or its training set was moved or made again.
    """
    from lerobot_constructskill.lerobot_internals import HF_LEROBOT_HOME

    if not (checkpoint / TRAIN_CONFIG).is_file():
        facts = checkpoint / FACTS
        is_known = facts.is_file() and SAID.read(facts)["training"]["holdout"] == HELD_OUT_EVERY
        return set() if is_known else None
    told = TRAINED.read(checkpoint / TRAIN_CONFIG).get("dataset", {})
    folder = Path(told["root"]) if told.get("root") else HF_LEROBOT_HOME / told.get("repo_id", "")
    features = DATA_SET.read(folder / INFO)["features"] if (folder / INFO).is_file() else {}
    # A feature set says of its columns which data set they were encoded from.
    sources = [info for one in features.values() if "source_repo_id" in (info := one.get("info") or {})]
    is_it = (
        dataset.repo_id in (told.get("repo_id"), *(source["source_repo_id"] for source in sources))
        or folder.resolve() == dataset.root.resolve()
        # Last, for it reads every file: a copy may have another name.
        or any(source["source_sha256"] == data_sha256(dataset.root) for source in sources)
    )
    if not is_it:
        return set() if (folder / INFO).is_file() else None
    known, given = range(dataset.num_episodes), told.get("episodes")
    given = [*known] if given is None else given
    if not {*given} <= {*known}:
        return None
    tasks: dict[str, list[int]] = {}
    for episode in given:
        tasks.setdefault(next(iter(dataset.meta.episodes[episode]["tasks"]), ""), []).append(episode)
    share = told.get("eval_split") or 0
    return {episode for own in tasks.values() for episode in own[: len(own) - ceil(len(own) * share)]}


@contextmanager
def hub_errors(repo_id: str, revision: str | None = None) -> Iterator[None]:
    """Turn what huggingface_hub raises into an `OSError` of one sentence, which never quotes a request."""
    try:
        yield
    except (OSError, RuntimeError, errors.HFValidationError, httpx.HTTPError) as error:
        # An upload's own error is the cause of a bare RuntimeError.
        reason = _reason(error.__cause__ if type(error) is RuntimeError else error, repo_id, revision)
        if reason is None:
            raise
        raise MachineError(reason) from None


def _reason(error: BaseException | None, repo_id: str, revision: str | None) -> str | None:
    """What an error of the Hub's client means; None for other errors."""
    of = f"revision '{revision}' of " if revision else ""
    status = error.response.status_code if isinstance(error, errors.HfHubHTTPError) else None
    reasons = (  # the first whose class and status fit
        (errors.RevisionNotFoundError, status, f"'{repo_id}' has no revision '{revision}' on the Hub."),
        (
            errors.RepositoryNotFoundError,
            status,
            f"The Hub has no '{repo_id}' that this machine may see; if it is private, {LOGIN}",
        ),
        (errors.LocalEntryNotFoundError, None, f"The Hub cannot be reached and {of}'{repo_id}' is not in the cache."),
        (errors.OfflineModeIsEnabled, None, f"The Hub cannot be reached for '{repo_id}' while HF_HUB_OFFLINE is set."),
        (errors.HfHubHTTPError, 401, f"The Hub knows no valid token of this machine for '{repo_id}'; {LOGIN}"),
        (
            errors.HfHubHTTPError,
            403,
            f"The token of this machine may not write to '{repo_id}', or not read it: ask for access or name another.",
        ),
        (errors.HfHubHTTPError, status, f"The Hub refused '{repo_id}' (HTTP status {status}); try again later."),
        (errors.HFValidationError, None, f"'{repo_id}' is neither a folder nor a name on the Hub, user/name."),
        (httpx.ConnectError, None, f"The Hub cannot be reached for '{repo_id}'."),
        (
            httpx.HTTPError,
            None,
            f"The connection to the Hub broke while '{repo_id}' was on its way; the same command continues.",
        ),
    )
    return next((said for kind, code, said in reasons if isinstance(error, kind) and status == code), None)


def check_private(repo_id: str, repo_type: str = "model") -> None:
    """Refuse a repository that is public: the Hub makes only new ones private.

    Raises:
        InputError: it is public.
    """
    if not HfApi().repo_info(repo_id, repo_type=repo_type).private:
        raise InputError(f"'{repo_id}' is on the Hub already and public: make it private there, or name another.")


def _is_cut(root: Path, **repo: str) -> bool:
    """Whether a repository without LeRobot's tag is empty or holds an interrupted push of the set in `root`."""
    api = HfApi()
    held = set(api.list_repo_files(**repo)) - UNTOUCHED
    if INFO not in held:
        return not held
    return Path(api.hf_hub_download(**repo, filename=INFO)).read_bytes() == (root / INFO).read_bytes()


def push(root: Path, repo_id: str, private: bool = False, tag: str | None = None, update: bool = False) -> str:
    """Put the folder of a data set on the Hub, in one commit, and tag it; return the commit's address.

    Interrupted, the same call continues: the Hub keeps the files that arrived. LeRobot's tag is set last, so what has
    it is whole.

    Args:
        tag: a version of the data set, beside LeRobot's own tag, without which LeRobot loads nothing.
        update: replace a data set that is whole, and move its tags.

    Raises:
        FileExistsError: the name holds a data set and `update` is not set.
        InputError: it is public, and `private` is set.
        OSError: the Hub cannot be reached, or refuses the token or the name.
    """
    from lerobot.datasets import CODEBASE_VERSION

    api, repo = HfApi(), {"repo_id": repo_id, "repo_type": "dataset"}
    with hub_errors(repo_id):
        api.create_repo(**repo, private=private, exist_ok=True)
        if private:
            check_private(**repo)
        tagged = {ref.name for ref in api.list_repo_refs(**repo).tags}
        if not update and (CODEBASE_VERSION in tagged or not _is_cut(root, **repo)):
            raise TakenError(f"'{repo_id}' holds files already; --update replaces them, or name another.")
        # `upload_folder` does not look into a folder that is a link.
        names = sorted(path.relative_to(root).as_posix() for path in files_below(root, ""))
        pushed = list(filter_repo_objects(names, allow_patterns=PUSHED))
        held = {name for name in api.list_repo_files(**repo) if name.startswith(SET_FOLDERS)}
        operations = [
            *(CommitOperationAdd(name, root / name) for name in pushed),
            *map(CommitOperationDelete, held - set(pushed)),
        ]
        commit = api.create_commit(**repo, operations=operations, commit_message="Upload a data set")
        for name in dict.fromkeys(filter(None, (tag, CODEBASE_VERSION))):
            if name in tagged:
                api.delete_tag(**repo, tag=name)
            api.create_tag(**repo, tag=name)
    return commit.commit_url
