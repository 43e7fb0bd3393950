"""submission.yaml: what the author of a submission says of the policy, and where it was evaluated."""

from dataclasses import dataclass, replace
from typing import Annotated

from lerobot_constructskill.board.protocol import BOARD_SUITES, PHYSICS, BoardSetting, class_of
from lerobot_constructskill.bounds import UNSEEN, Among, Checked, NotEmpty, Pattern, Seed, check
from lerobot_constructskill.contract import DEMO_SEED_START, DEMO_SEED_STOP, FULL_ACTION, OBS_TYPES, TASKS
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.files import Yaml

VERSION = 1

UNSEEING = ", none rendering"
"""End of a backend that shows no pictures."""

BACKEND = Pattern(
    r"[a-z_]+(:\d+)?, (none|(sapien_)?(cpu|gpu|cuda)(:\d+)?) rendering",
    "what simulated and what rendered, such as 'physx_cpu, sapien_cpu rendering'",
)

MOST_EPISODES, MOST_SETTINGS, MOST_BYTES = 50_000, 32, 1 << 30
"""Episodes and settings of a submission, and bytes of its actions unpacked."""

LINE = Pattern(rf"(?=.*\S)[^{UNSEEN}]{{1,300}}", "one line of text, of at most 300 characters")
NAME = Pattern("[a-z0-9][a-z0-9_]{0,39}", "a name of a-z, 0-9 and '_'")
Line = Annotated[str, LINE]
Link = Annotated[str, Pattern(r"https://[A-Za-z0-9./_~%#?=&:+-]{1,300}", "an address that begins with https://")]
Hash = Annotated[str, Pattern("[0-9a-f]{64}", "a SHA-256 in hexadecimal digits")]

OBSERVES = (*OBS_TYPES, "privileged", "nothing")
"""What a policy sees: an `obs_type`, the simulator's own state (an expert), or nothing at all."""

DRAWS = {"shared": "one draw of demonstrations", "own": "draws of demonstrations of their own"}
"""What training seeds learnt from, as the board says it. An interval over seeds of one draw covers no other draw."""


POLICIES = {"one": "one policy for all settings", "several": "several policies for its settings"}
"""What a training seed of an entry is, as the board says it."""


@dataclass(frozen=True)
class About(Checked):
    """Description of a submission's policy.

    Args:
        name: what the board calls it.
        submitter: person or group responsible for the submission.
        policy: its type, and its size where that matters.
        revision: commit or hash by which its checkpoints are found.
        data: training data, by name and revision; "none" if there are none.
        training: how it was trained, and how its training seeds were chosen.
        compute: hardware of the training, and its duration.
        observes: one of `OBSERVES`.
        demonstrations: whether all training seeds learnt from one draw of demonstrations, or each from its own; one of
            `DRAWS`, and None where it is not said.
        policies: whether a training seed is one policy for all settings; one of `POLICIES`, None where it is not said.
        url: where its checkpoints are.
        notes: anything else that a reader must know.

    Raises:
        InputError: a field is no line of text.
    """

    name: Line
    submitter: Line
    policy: Line
    revision: Line
    data: Line
    training: Line
    compute: Line
    observes: Annotated[str, Among(OBSERVES)]
    demonstrations: Annotated[str, Among(tuple(DRAWS))] | None = None
    policies: Annotated[str, Among(tuple(POLICIES))] | None = None
    url: Link | None = None
    notes: Line | None = None

    @property
    def is_policy(self) -> bool:
        """Whether it sees what a policy sees; what does not is a reference, a floor or a ceiling."""
        return self.observes in OBS_TYPES

    @property
    def draws(self) -> str:
        """What the training seeds learnt from, in words."""
        return DRAWS.get(self.demonstrations or "", "draws of demonstrations not said") if self.is_policy else ""


@dataclass(frozen=True)
class Trained(Checked):
    """What a recipe made, with which training again is compared.

    Args:
        recipe_sha256: hash of the recipe.
        weights: setting to the SHA-256 of each training seed's weights, in the order of `training_seeds`; None for one
            that failed.
        made_with: packages, rooms of our code and processors, each with its version.
    """

    recipe_sha256: Hash
    weights: dict[str, list[Hash | None]]
    made_with: dict[Line, Line]

    @property
    def policies(self) -> str | None:
        """As in `About`, by the seeds that have weights in all settings; None with one setting or no such seed."""
        whole = [seed for seed in zip(*self.weights.values(), strict=True) if all(seed)]
        if len(self.weights) == 1 or not whole:
            return None
        return "one" if all(len(set(seed)) == 1 for seed in whole) else "several"


@dataclass(frozen=True)
class Declaration:
    """The content of submission.yaml.

    Args:
        about: the policy.
        suite: a name in `protocol.BOARD_SUITES`.
        settings: name to setting; those of the suite, or others.
        training_seeds: of the runs that are in it.
        backend: what simulated and rendered.
        versions: packages that decide what an action does, and the make of the processor, each with its version.
        episodes_sha256: hash of episodes.parquet.
        trained: what its recipe made; None without a recipe.
        version: of this format.

    Raises:
        InputError: a field has a value that it cannot have.
    """

    about: About
    suite: Annotated[str, Among(tuple(BOARD_SUITES))]
    settings: dict[str, BoardSetting]
    training_seeds: Annotated[list[Seed], NotEmpty()]
    backend: Annotated[str, BACKEND]
    versions: dict[Line, Line]
    episodes_sha256: Hash
    trained: Trained | None = None
    version: Annotated[int, Among((VERSION,))] = VERSION

    def __post_init__(self):
        check(self)
        if not 1 <= len(self.settings) <= MOST_SETTINGS:
            raise InputError(f"settings must be 1 to {MOST_SETTINGS}, not {len(self.settings)}.")
        for name, setting in self.settings.items():
            self._check_setting(name, setting)
        if len(set(self.training_seeds)) < len(self.training_seeds):
            raise InputError("training_seeds must differ.")
        weights = self.trained.weights if self.trained else dict.fromkeys(self.settings, self.training_seeds)
        if {name: len(own) for name, own in weights.items()} != dict.fromkeys(self.settings, len(self.training_seeds)):
            raise InputError("trained.weights must name the weights of each training seed in each setting.")
        known = self.trained and self.trained.policies
        if known and self.about.policies not in (None, known):
            raise InputError(f"about.policies is {self.about.policies}, but by its weights an entry of {known}.")
        if self.about.is_policy and self.backend.endswith(UNSEEING):
            raise InputError(
                f"about.observes is {self.about.observes}, but the backend '{self.backend}' shows no pictures: "
                "evaluate the policy with a renderer."
            )
        if self.episodes > MOST_EPISODES or self.most_bytes > MOST_BYTES:
            raise InputError(
                f"A submission has at most {MOST_EPISODES:,} episodes, and {MOST_BYTES:,} bytes of actions."
            )

    def _check_setting(self, name: str, setting: BoardSetting) -> None:
        if not NAME.allows(name):
            raise InputError(f"A setting's name must be {NAME.meaning}, not {name[:100]!a}.")
        called = {task: (task, setting.perturbation) for task in TASKS}
        called |= {one: (of.task, of.perturbation) for one, of in BOARD_SUITES[self.suite].settings.items()}
        own = setting.task, setting.perturbation
        if own != (meant := called.get(name, own)):
            raise InputError(f"The setting {name} must be of the task {''.join(meant)}, or have another name than it.")
        if setting.starts.start < DEMO_SEED_STOP and setting.starts.stop > DEMO_SEED_START:
            raise InputError(
                f"The setting {name} has starts of demonstrations, which policies are trained on: evaluate it from "
                f"starts below {DEMO_SEED_START:,}."
            )
        control = replace(setting, perturb="", perturb_seed=0).compared
        if control not in [one.compared for one in self.settings.values()]:
            raise InputError(
                f"The setting {name} must have its control beside it: a setting of the same task, length and starts "
                "without a perturbation."
            )

    @property
    def policies(self) -> str:
        """Whether a training seed is one policy, in words; empty for one setting or what is no policy."""
        if len(self.settings) == 1 or not self.about.is_policy:
            return ""
        known = (self.trained and self.trained.policies) or self.about.policies
        return POLICIES.get(known or "", "one policy or several, not said")

    @property
    def settings_class(self) -> str:
        return class_of(self.suite, self.settings, self.training_seeds)

    @property
    def is_replayable(self) -> bool:
        """Whether it was made with the physics that a replay has."""
        return self.backend.split(",")[0] == PHYSICS

    @property
    def episodes(self) -> int:
        return len(self.training_seeds) * sum(setting.episodes for setting in self.settings.values())

    @property
    def most_bytes(self) -> int:
        """Bytes of all actions, unpacked, if every episode ran to its end."""
        return len(self.training_seeds) * sum(
            4 * len(FULL_ACTION) * setting.episodes * setting.episode_length for setting in self.settings.values()
        )

    @property
    def keys(self) -> set[tuple[str, int, int]]:
        """Setting, training seed and evaluation seed of every episode that is to be there."""
        return {
            (name, seed, start)
            for name, setting in self.settings.items()
            for seed in self.training_seeds
            for start in setting.starts
        }


ABOUT = Yaml("what is said of a policy", About)
SETTINGS = Yaml("a list of settings", dict[str, BoardSetting])
DECLARED = Yaml("the declaration of a submission", Declaration)
