"""Puts on the Hub what a release has there: data sets, checkpoints, and the site with the board, each with its page.

    python results/release.py --user=NAME           # writes all of it to outputs/hub, for you to look at
    python results/release.py --user=NAME --push    # uploads it; interrupted, the same command continues

`make release` does the first, after the wheel, the source distribution and the site. A data set is generated where it
is not there yet; checkpoints are those of `make results` in the store.
"""

import shutil
from argparse import RawDescriptionHelpFormatter
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

from huggingface_hub import HfApi

from lerobot_constructskill.analysis.stats.outcomes import runs_of
from lerobot_constructskill.artifacts.folders import write_text
from lerobot_constructskill.artifacts.store import Store
from lerobot_constructskill.dataset.hub import hub_errors
from lerobot_constructskill.demos.settings import GenerateConfig
from lerobot_constructskill.errors import MissingError
from lerobot_constructskill.lerobot_internals import load_plugins
from lerobot_constructskill.parsing import parse, parse_named
from lerobot_constructskill.presets import find
from lerobot_constructskill.scripts.console import Parser, edge, say
from lerobot_constructskill.scripts.dataset import CardConfig, PushConfig, push_dataset, write_card
from lerobot_constructskill.scripts.generate import generate
from lerobot_constructskill.scripts.push_policy import OBJECT, render_card
from lerobot_constructskill.scripts.study import StudyConfig
from lerobot_constructskill.study.plan import list_runs
from lerobot_constructskill.study.rows import ROWS, read_rows
from lerobot_constructskill.training.checkpoints import checkpoint_of

ROOT = Path(__file__).parents[1]

SETS = ("paper", "fast", "precise/brick_to_bin_shifted", "suite/orders")
"""Data sets, as `constructskill-generate` calls them."""

POLICIES = {("precise", "brick_to_bin_shifted/precise"): "precise/brick_to_bin_shifted"}
"""Study and arm whose checkpoints are uploaded, a repository a training seed, to the set that they learned from."""

SPACE = """---
title: ConstructSkill
sdk: static
app_file: index.html
license: apache-2.0
---

The documentation of ConstructSkill, and its leaderboard: every entry's recorded actions were executed again.
"""


def called(name: str) -> str:
    """A name as it stands in a repository's."""
    return "constructskill_" + name.replace("/", "_")


class Release:
    """What goes to the Hub, in a folder: `datasets`, `models` and `spaces`, with a folder for each repository.

    Args:
        user: whose repositories they are.
        out: the folder.
        store: where `make results` made checkpoints.
        site: where `make docs` built it.
    """

    def __init__(self, user: str, out: Path, store: Store, site: Path):
        self.user, self.out, self.store, self.site = user, out, store, site
        self.tag = f"v{version('lerobot_env_constructskill')}"

    def write(self) -> None:
        """Write data sets that are not there yet, and all else anew.

        Raises:
            MissingError: the site was not built.
        """
        if not (self.site / "index.html").is_file():
            raise MissingError(f"{self.site} has no index.html: `make docs` builds the site.")
        for name in SETS:
            root = self.out / "datasets" / called(name)
            if not root.exists():
                flags = [f"--repo_id={self._repo(root)}", f"--root={root}"]
                say(generate(parse_named(GenerateConfig, "generate", name, flags)))
            say(write_card(CardConfig(root, self._repo(root))))
        for (study, arm), data in POLICIES.items():
            for line in self._checkpoints(study, arm, data):
                say(line)
        self._copy(self.site, self.out / "spaces" / "constructskill", SPACE)

    def push(self) -> None:
        """Upload everything that is in the folder.

        Raises:
            InputError: a check found something wrong with a data set.
            OSError: the Hub refused, or the connection broke.
        """
        for root in sorted(self.out.glob("datasets/*")):
            say(push_dataset(PushConfig(self._repo(root), root, tag=self.tag, update=True)))
        api = HfApi()
        for kind, options in (("model", {}), ("space", {"space_sdk": "static"})):
            for root in sorted(self.out.glob(f"{kind}s/*")):
                with hub_errors(self._repo(root)):
                    api.create_repo(self._repo(root), repo_type=kind, exist_ok=True, **options)
                    api.upload_folder(repo_id=self._repo(root), repo_type=kind, folder_path=root, delete_patterns="*")
                say(f"Pushed: {self._repo(root)}")

    def _repo(self, folder: Path) -> str:
        return f"{self.user}/{folder.name}"

    def _checkpoints(self, study: str, arm: str, data: str) -> Iterator[str]:
        """Copy the checkpoints that the store has of an arm; each card tells of all seeds. Yield which are lacking."""
        rows = read_rows(ROOT / "results" / study / ROWS)
        own = runs_of(rows[rows["setting"] + "/" + rows["variant"] == arm])
        outcomes = [*own[["training_seed", "lifted", "placed", "episodes"]].itertuples(index=False, name=None)]
        runs = [run for run in list_runs(parse(StudyConfig, [], find("study", study)).study) if run.arm.id == arm]
        made = [run for run in runs if self.store.has(run.checkpoints)]
        for run in made:
            source = checkpoint_of(run.seed, self.store.folder(run.checkpoints))
            target = self.out / "models" / f"{called(study)}_{arm.replace('/', '_')}_seed_{run.seed}"
            policy, record = OBJECT.read(source / "config.json"), source / "encoder.json"
            learned = {"repo_id": f"{self.user}/{called(data)}", "revision": self.tag}
            train = {"seed": run.seed, "dataset": learned}
            encoder = OBJECT.read(record) if record.is_file() else {}
            card = render_card(self._repo(target), outcomes, run.arm.env["task"], train, policy, encoder)
            self._copy(source, target, card)
        if len(made) < len(runs):
            setting = arm.split("/")[0]
            yield (
                f"{len(runs) - len(made)} of {len(runs)} checkpoints of {study}/{arm} are not in {self.store.root}: "
                f"`python results/make.py --only={study}/{setting}` makes them."
            )

    @staticmethod
    def _copy(source: Path, target: Path, page: str) -> None:
        shutil.rmtree(target, ignore_errors=True)
        shutil.copytree(source, target)
        write_text(target / "README.md", page)
        say(f"{source} copied to {target}")


def main() -> None:
    """Write the release, and upload it if the command line says so."""
    parser = Parser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--user", required=True, help="user or organisation on the Hub")
    parser.add_argument("--push", action="store_true", help="upload it")
    parser.add_argument("--out", type=Path, default=ROOT / "outputs" / "hub", help="where it is written")
    parser.add_argument("--store", type=Path, default=ROOT / "outputs" / "store", help="where runs were made")
    parser.add_argument("--site", type=Path, default=ROOT / "outputs" / "site", help="where the site was built")
    asked = parser.parse_args()
    load_plugins()
    release = Release(asked.user, asked.out, Store(asked.store.absolute()), asked.site)
    release.write()
    if asked.push:
        release.push()


if __name__ == "__main__":
    with edge():
        main()
