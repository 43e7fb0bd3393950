"""What a release has on the Hub: data sets, checkpoints, and the site with the board, each with its page.

    python results/release.py --user=NAME            # writes all of it to outputs/hub, for you to look at
    python results/release.py --user=NAME --draft    # the same while results are missing; it cannot be uploaded
    python results/release.py --push                 # uploads what lies there; killed, the same command continues

`make release HUB=NAME` does the first, after the wheel, the source distribution and the site. Data sets and
checkpoints come from the store of `make results`. What it lacks is made: minutes for a set, half an hour for the
checkpoints.
"""

import json
import shutil
from argparse import RawDescriptionHelpFormatter
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TypedDict

from huggingface_hub import HfApi
from make import Maker

from lerobot_constructskill.analysis.stats.outcomes import runs_of
from lerobot_constructskill.artifacts.digests import file_sha256
from lerobot_constructskill.artifacts.folders import staged, write_text
from lerobot_constructskill.artifacts.store import Machine, Store
from lerobot_constructskill.dataset.hub import hub_errors
from lerobot_constructskill.demos.node import Demonstrations
from lerobot_constructskill.demos.settings import GenerateConfig
from lerobot_constructskill.errors import InputError, MissingError, TakenError, plural
from lerobot_constructskill.files import Json
from lerobot_constructskill.lerobot_internals import load_plugins
from lerobot_constructskill.parsing import parse, parse_named
from lerobot_constructskill.presets import find
from lerobot_constructskill.scripts.console import Parser, edge, say
from lerobot_constructskill.scripts.dataset import CardConfig, PushConfig, push_dataset, write_card
from lerobot_constructskill.scripts.push_policy import PUSHED, card_of
from lerobot_constructskill.scripts.study import StudyConfig
from lerobot_constructskill.study.plan import list_runs
from lerobot_constructskill.study.rows import ROWS, read_rows
from lerobot_constructskill.study.runs import Run
from lerobot_constructskill.training.checkpoints import checkpoint_of

ROOT = Path(__file__).parents[1]

SETS = ("direct", "fast", "precise/brick_to_bin_shifted", "suite/orders")
"""Data sets, as `constructskill-generate` calls them."""

POLICIES = {"precise/brick_to_bin_shifted": ("precise", "brick_to_bin_shifted/precise")}
"""Data set to the study and arm that learned from it, each of whose training seeds has a repository."""

SPACE = """---
title: ConstructSkill
sdk: static
app_file: index.html
license: apache-2.0
---

The documentation of ConstructSkill, and its leaderboard.
"""

FILE = "release.json"
"""Beside the repositories: whose they are, and the tag of the version."""


class _Release(TypedDict):
    user: str
    tag: str
    draft: bool


RELEASE = Json("what says whose a release is", _Release)


def called(name: str) -> str:
    """A name as it stands in a repository's."""
    return "constructskill_" + name.replace("/", "_")


def write(out: Path, user: str, store: Store, site: Path, machine: Machine, draft: bool = False) -> None:
    """Write `datasets`, `models` and `spaces`, with a folder for each repository, to a folder that appears whole.

    Args:
        out: the folder; an earlier release in it goes.
        user: whose repositories they are.
        store: where `make results` works.
        site: where `make docs` built the site.
        draft: whether results may be missing or of older code, and checkpoints other than those of the rows.

    Raises:
        MissingError: the site was not built.
        TakenError: something else is in the way.
        InputError: results are missing, or a checkpoint is not the one that the published rows are of.
    """
    if not (site / "index.html").is_file():
        raise MissingError(f"{site} has no index.html: `make docs` builds the site.")
    if out.exists() and not (out / FILE).is_file():
        raise TakenError(f"{out} exists already, and is no release: move it away.")
    if (left := _left(store)) and not draft:
        raise InputError(
            f"The results lack {plural(left, 'piece')}, or have them of older code: `make results` makes them. "
            "--draft writes a release without them, which cannot be uploaded."
        )
    release = _Release(user=user, tag=f"v{version('lerobot_env_constructskill')}", draft=draft)
    sets = {
        name: Demonstrations(parse_named(GenerateConfig, "generate", name, ["--repo_id=local/set"])) for name in SETS
    }
    runs = {data: _runs(study, arm) for data, (study, arm) in POLICIES.items()}
    sets |= {data: own[0].arm.demonstrations.node for data, own in runs.items()}
    # First the checkpoints, which another kind of processor trains otherwise.
    policies = {data: _Policies(study, runs[data], store, machine, draft) for data, (study, _) in POLICIES.items()}
    made = {name: store.get(node, machine) for name, node in sets.items()}
    if out.exists():
        shutil.rmtree(out)
    with staged(out) as folder:
        for name, data in made.items():
            root = folder / "datasets" / called(name)
            shutil.copytree(data, root)
            write_card(CardConfig(root, f"{user}/{root.name}"))
        for name, learned in policies.items():
            learned.write(folder / "models", user, {"repo_id": f"{user}/{called(name)}", "revision": release["tag"]})
        shutil.copytree(site, folder / "spaces" / "constructskill")
        write_text(folder / "spaces" / "constructskill" / "README.md", SPACE)
        write_text(folder / FILE, json.dumps(release) + "\n")


def _left(store: Store) -> int:
    """The number of pieces of the published results that `make results` would make."""
    maker = Maker(ROOT, store.root)
    return sum(bool(runs) for _, runs in maker.due(maker.every))


def _runs(study: str, arm: str) -> list[Run]:
    return [run for run in list_runs(parse(StudyConfig, [], find("study", study)).study) if run.arm.id == arm]


class _Policies:
    """The checkpoints of an arm's runs.

    Raises:
        InputError: one is not that of the published rows, and this is no draft.
    """

    def __init__(self, study: str, runs: Sequence[Run], store: Store, machine: Machine, draft: bool):
        self._study, self._arm = study, runs[0].arm
        rows = read_rows(ROOT / "results" / study / ROWS)
        self._rows = rows[(rows["setting"] == self._arm.setting) & (rows["variant"] == self._arm.name)]
        weights = self._rows.drop_duplicates("training_seed").set_index("training_seed")["weights_sha256"]
        self._checkpoints = {run: checkpoint_of(run.seed, store.get(run.checkpoints, machine)) for run in runs}
        for run, checkpoint in self._checkpoints.items():
            if not draft and file_sha256(checkpoint / "model.safetensors") != weights[run.seed]:
                raise InputError(
                    f"The weights of {study}/{run.id} here are not those of the published rows: release on the kind "
                    f"of processor that made {study}/{self._arm.setting}, after `make results`."
                )

    def write(self, folder: Path, user: str, learned: dict[str, str]) -> None:
        """Copy them; the page of each tells the published outcomes of all of them.

        Args:
            learned: the data set that they learned from, `repo_id` and `revision`.
        """
        columns = ["training_seed", "lifted", "placed", "episodes"]
        outcomes = [*runs_of(self._rows)[columns].itertuples(index=False, name=None)]
        for run, checkpoint in self._checkpoints.items():
            root = folder / f"{called(self._study)}_{run.id.replace('/', '_')}"
            shutil.copytree(checkpoint, root)
            train = {"seed": run.seed, "dataset": learned}
            card = card_of(root, f"{user}/{root.name}", outcomes, self._arm.env["task"], train, self._flags)
            write_text(
                root / "README.md", f"{card}\nDocumentation and leaderboard: the Space `{user}/constructskill`.\n"
            )

    @property
    def _flags(self) -> str:
        """What `lerobot-eval` needs to run the episodes of the published rows."""
        env, starts = self._arm.env, self._arm.starts
        return (
            f"--env.obs_type={env['obs_type']} --env.episode_length={env['episode_length']} --seed={starts[0]} "
            f"--eval.n_episodes={len(starts)} --eval.batch_size=1"
        )


def push(out: Path) -> None:
    """Upload a release; what is on the Hub already in this version stays, files of earlier versions go.

    Raises:
        MissingError: none was written.
        InputError: it is a draft, or a check found something wrong with a data set.
        OSError: the Hub refused, or the connection broke.
    """
    if not (out / FILE).is_file():
        raise MissingError(f"{out} holds no release: `make release HUB=NAME` writes one.")
    release, api = RELEASE.read(out / FILE), HfApi()
    if release["draft"]:
        raise InputError(f"{out} holds a draft: results are missing in it. `make release HUB=NAME` writes a release.")
    kinds = {"dataset": (None, {}), "model": ([*PUSHED, "README.md"], {}), "space": (None, {"space_sdk": "static"})}
    for kind, (files, options) in kinds.items():
        for root in sorted(out.glob(f"{kind}s/*")):
            repo = {"repo_id": f"{release['user']}/{root.name}", "repo_type": kind}
            with hub_errors(repo["repo_id"]):
                api.create_repo(**repo, exist_ok=True, **options)
                if release["tag"] in {tag.name for tag in api.list_repo_refs(**repo).tags}:
                    say(f"'{repo['repo_id']}' holds {release['tag']} already")
                    continue
                if kind == "dataset":
                    push_dataset(PushConfig(repo["repo_id"], root, update=True))
                else:
                    api.upload_folder(**repo, folder_path=root, allow_patterns=files, delete_patterns="*")
                api.create_tag(**repo, tag=release["tag"])  # last, so what has it is whole
            say(f"Pushed: {repo['repo_id']}")


def main() -> None:
    """Write a release, or upload it, as the command line says."""
    parser = Parser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--user", help="write it for this user or organisation on the Hub")
    what.add_argument("--push", action="store_true", help="upload it")
    parser.add_argument("--draft", action="store_true", help="write it although results are missing")
    parser.add_argument("--out", type=Path, default=ROOT / "outputs" / "hub", help="where it is written")
    parser.add_argument("--store", type=Path, default=ROOT / "outputs" / "store", help="where runs are made")
    parser.add_argument("--site", type=Path, default=ROOT / "outputs" / "site", help="where the site was built")
    parser.add_argument("--workers", type=int, default=2, help="processes that generate demonstrations")
    asked = parser.parse_args()
    if asked.push:
        push(asked.out)
        return
    load_plugins()
    write(asked.out, asked.user, Store(asked.store.absolute()), asked.site, Machine(asked.workers), asked.draft)
    then = "it cannot be uploaded" if asked.draft else "look at it, then `python results/release.py --push`"
    say(f"{asked.out} holds the {'draft' if asked.draft else 'release'}: {then}")


if __name__ == "__main__":
    with edge():
        main()
