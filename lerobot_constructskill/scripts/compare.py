"""`constructskill-compare`: is policy A better than policy B? Over training seeds, evaluated on the same starts."""

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from lerobot_constructskill.analysis.section import Level
from lerobot_constructskill.bounds import Among, Checked, Count, Device, Seed, Steps, Text
from lerobot_constructskill.contract import OBS_TYPES
from lerobot_constructskill.scripts.console import command, say

if TYPE_CHECKING:
    from lerobot_constructskill.comparison.sides import Side, Source

WORSE = "worse"
FAILED = 3
"""Exit status where A is worse and `--fail_if=worse` is given."""


@dataclass
class CompareConfig(Checked):
    """Compare two policies by their training seeds.

    A and B are each a variant of a study, as results/precise:brick_on_brick/precise; or folders, one for each training
    seed, with commas between or as a pattern in quotation marks, such as 'outputs/mine/train/seed_*': checkpoints or
    output folders of lerobot-train, which are evaluated where the other side was; or recordings of
    $CONSTRUCTSKILL_RECORD. Over several tasks: results/language:*/told, or a mean of the study in place of "*", beside
    another such variant, checkpoints or recordings; or two sides of checkpoints with several tasks.

    Args:
        a: the first side, the candidate.
        b: the second side, what it is compared with.
        task: the task, or several with commas, if neither side names one; of sides that have more, these alone.
        obs_type: as of lerobot-eval's --env, if neither side says it; pixels by default.
        episode_length: the same; the task's own by default.
        perturb: the same; none by default.
        perturb_seed: the same; 0 by default.
        seed: the first start, for two sides of checkpoints; 1000 by default.
        episodes: at most so many starts; for two sides of checkpoints 50 by default.
        fail_if: "worse" ends with status 3 where A is worse than B; else the status is 0 whatever the verdict.
        alpha: level of the tests.
        out: folder for comparison.json, and recordings of what was evaluated, a side of later comparisons: OUT/a/*.
        together: checkpoints that are in memory, and evaluated, at a time.
        device: for checkpoints; that in the checkpoint by default.
    """

    a: Text
    b: Text
    task: Text | None = None
    obs_type: Annotated[str, Among(tuple(OBS_TYPES))] | None = None
    episode_length: Steps | None = None
    perturb: str | None = None
    perturb_seed: Seed | None = None
    seed: Seed | None = None
    episodes: Count | None = None
    fail_if: Annotated[str, Among((WORSE,))] | None = None
    alpha: Level = 0.05
    out: Path | None = None
    together: Count = 10
    device: Device | None = None

    @property
    def env(self) -> dict[str, Any]:
        """Keyword arguments of `ConstructSkillEnv` that were given."""
        names = ("task", "obs_type", "episode_length", "perturb", "perturb_seed")
        return {name: value for name, value in asdict(self).items() if name in names and value is not None}


@command(
    "constructskill-compare 'outputs/mine/train/seed_*' results/precise:brick_to_bin_shifted/precise",
    first=("a", "b"),
)
def compare(config: CompareConfig) -> str:
    """Compare the sides and return the text to print.

    Raises:
        MissingError: there is no such side.
        InputError: a side cannot be read or evaluated, or has nothing in common with the other.
        TakenError: the output folder exists.
        SystemExit: A is worse, and `fail_if` says that this fails.
    """
    from lerobot_constructskill.artifacts.folders import staged
    from lerobot_constructskill.comparison.match import Asked
    from lerobot_constructskill.comparison.over_tasks import match_over_tasks
    from lerobot_constructskill.comparison.sides import find
    from lerobot_constructskill.comparison.tell import as_json, tell

    a, b = find(config.a), find(config.b)
    with staged(config.out) if config.out else nullcontext() as folder:

        def evaluated(source: "Source", env: Mapping[str, Any], starts: Sequence[int]) -> "Side":
            from lerobot_constructskill.comparison.evaluate import evaluate

            kept_in = folder and folder / ("a" if source is a else "b")
            return evaluate(source, env, starts, config.together, config.device, kept_in)

        asked = Asked(config.env, config.seed, config.episodes)
        matched = match_over_tasks(a, b, asked, evaluated, config.alpha)
        if folder:
            folder.mkdir(exist_ok=True)
            (folder / "comparison.json").write_text(as_json(matched), encoding="utf-8")
    told = tell(matched, config.alpha)
    if config.fail_if == matched.judgement.conclusion:
        say(told)
        raise SystemExit(FAILED)
    return told
