"""`constructskill-study`: a whole study, per training seed, from one file."""

from dataclasses import dataclass, fields, replace
from pathlib import Path

from lerobot_constructskill.errors import InputError
from lerobot_constructskill.scripts.console import run
from lerobot_constructskill.study.plan import StudyPlan


@dataclass(frozen=True)
class StudyConfig(StudyPlan):
    """Run what is missing of a study, and keep what is finished; a killed study goes on with the same command.

    Args:
        root: the study's folder, `outputs/study/<name>` by default: plan.yaml, rows.parquet, checkpoints and videos.
        data_root: where demonstrations and features are kept, for all studies.
        seeds: cut every variant and reference to this many seeds. The cut plan is a plan of its own.
        workers: processes that generate demonstrations; jobs at a time on Ray.
        together: policies evaluated in lockstep.
        executor: "processes" (this machine) or "ray" (folders on a file system that all its machines share).
        retry_failed: run again what failed before.
    """

    root: Path | None = None
    data_root: Path = Path("outputs/data")
    seeds: int | None = None
    workers: int = 2
    together: int = 10
    executor: str = "processes"
    retry_failed: bool = False

    @property
    def plan(self) -> StudyPlan:
        """The study without how it is run."""
        plan = StudyPlan(**{field.name: getattr(self, field.name) for field in fields(StudyPlan)})
        if self.seeds is None:
            return plan
        variants = {name: replace(v, seeds=min(v.seeds, self.seeds)) for name, v in plan.variants.items()}
        references = {name: min(count, self.seeds) for name, count in plan.references.items()}
        return replace(plan, variants=variants, references=references)


def study(config: StudyConfig) -> str:
    """Run a study and return a sentence about its rows.

    Raises:
        FileExistsError: another process is running it.
        FileNotFoundError: a data set's configuration does not exist.
        ValueError: the folder holds another plan's results, or not one run succeeded.
    """
    import lerobot_constructskill.plugin  # noqa: F401
    from lerobot_constructskill.study.checkpoints import settle_precision
    from lerobot_constructskill.study.prepare import Store
    from lerobot_constructskill.study.run import Options, run_study

    root = config.root or Path("outputs/study") / config.name
    options = Options(config.together, config.executor, config.workers, config.retry_failed)
    plan, store = settle_precision(config.plan), Store(config.data_root.absolute(), config.workers)
    rows = run_study(plan, root.absolute(), store, options)
    runs = rows.groupby(["setting", "variant", "training_seed"])["error"].first()
    if runs.notna().all():
        why = f"their tracebacks are in {root / 'logs'}; the first: {runs.iloc[0]}"
        raise InputError(f"All {len(runs)} runs failed; {why}")
    failed = f", {runs.notna().sum()} of them failed (why: {root / 'logs'})" if runs.notna().any() else ""
    return f"{len(runs)} runs{failed}: {root} (next: constructskill-report --root={root})"


def main() -> None:
    run(StudyConfig, study)


if __name__ == "__main__":
    main()
