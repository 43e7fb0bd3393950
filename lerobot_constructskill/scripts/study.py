"""`constructskill-study`: run a whole study, per training seed, from one file."""

from dataclasses import dataclass, field, fields, replace
from pathlib import Path

from lerobot_constructskill.analysis.section import Analysis
from lerobot_constructskill.bounds import Count
from lerobot_constructskill.errors import InputError, plural
from lerobot_constructskill.scripts.console import command
from lerobot_constructskill.study.spec import Options, Study


@dataclass(frozen=True)
class StudyConfig(Options, Study):
    """Make what is missing of a study and keep what exists; after a kill the same command continues.

    Args:
        analysis: labels, order, comparisons and their level; only the report reads them.
        root: the study's folder, `outputs/study/<name>` by default: study.yaml, rows.parquet and videos.
        store: where demonstrations, features, checkpoints and runs are made, each once for all studies.
        seeds: cut every variant and reference to this many seeds.
        status: make nothing; say of the runs that `only` asks for which exist, which failed and why, and which would
            be made and how long that takes, as far as it is known.
    """

    analysis: Analysis = field(default_factory=Analysis)
    root: Path | None = None
    store: Path = Path("outputs/store")
    seeds: Count | None = None
    status: bool = False

    def __post_init__(self):
        super().__post_init__()
        Study.__post_init__(self)
        self.analysis.check(self.variants, self.settings, self.references)
        self.analysis.check_settings({name: self.variants_in(name) for name in self.settings})

    @property
    def study(self) -> Study:
        """The study without how it is run."""
        study = Study(**{field.name: getattr(self, field.name) for field in fields(Study)})
        if self.seeds is None:
            return study
        variants = {name: replace(v, seeds=min(v.seeds, self.seeds)) for name, v in study.variants.items()}
        references = {name: min(count, self.seeds) for name, count in study.references.items()}
        return replace(study, variants=variants, references=references)


@command("constructskill-study smoke --seeds=2", presets="study")
def study(config: StudyConfig) -> str:
    """Run a study, or look at one, and return a line about it.

    Raises:
        FileExistsError: another process is running it.
        ValueError: a field of the study cannot be used, or no run succeeded.
    """
    from lerobot_constructskill.artifacts.store import LOG, Store
    from lerobot_constructskill.lerobot_internals import load_plugins
    from lerobot_constructskill.study.plan import list_runs
    from lerobot_constructskill.study.session import choose, run_study
    from lerobot_constructskill.study.status import status
    from lerobot_constructskill.study.table import Table

    load_plugins()  # a reference may be of another package
    root = (config.root or Path("outputs/study") / config.name).absolute()
    store = Store(config.store.absolute())
    if config.status:
        runs = list_runs(config.study)
        return status(Table(root, runs, store, config.replace), choose(runs, config.only), config.retry_failed)
    table = run_study(config.study, text_of(config), root, store, config)
    failed, missing = table.failed(), table.missing()
    made = len(table.runs) - len(missing)
    if len(failed) == made:
        why, log = table.made(failed[0])[0].error, store.folder(failed[0]) / LOG
        raise InputError(f"No run succeeded; the first of {made} failed with: {why} (log: {log})")
    lacking = f", {len(failed)} of them failed (why: --status=true)" if failed else ""
    left = f", {len(missing)} missing" if missing else ""
    return f"{plural(made, 'run')}{lacking}{left}: {root} (next: constructskill-report --root={root})"


def text_of(config: StudyConfig) -> str:
    """The study as it was read, with the task of every setting, also of a plan, and the labels of its references."""
    import draccus
    import yaml

    from lerobot_constructskill.rollout.references import REFERENCES
    from lerobot_constructskill.study.plan import resolve_env

    labels = {name: REFERENCES[name].label for name in config.references if name in REFERENCES}
    analysis = replace(config.analysis, labels=labels | config.analysis.labels)
    text = {**draccus.encode(config.study), "analysis": draccus.encode(analysis)}
    for setting in text["settings"].values():
        keywords = resolve_env(setting["env"])
        given = {name: value for name, value in setting["env"].items() if name in keywords and name != "task"}
        setting["env"] = {"task": keywords["task"], **given}
    return yaml.safe_dump(text, sort_keys=False, allow_unicode=True)


if __name__ == "__main__":
    study.main()
