"""`constructskill-submit`: make a submission for the board from recorded episodes."""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from lerobot_constructskill.board.protocol import BOARD_SUITES, BoardSetting
from lerobot_constructskill.bounds import Among, Text, check
from lerobot_constructskill.errors import InputError, plural
from lerobot_constructskill.scripts.console import command

Suite = Annotated[str, Among(tuple(BOARD_SUITES))]


@dataclass
class SubmitConfig:
    """Make a submission's folder: submission.yaml and episodes.parquet, as docs/leaderboard.md says.

    It is made of a study's runs, or of what environments recorded while `CONSTRUCTSKILL_RECORD` named
    `recorded/seed_<training seed>`.
    """

    suite: Suite  # its settings and starts are evaluated
    about: Path  # YAML: whose it is and how it was trained; docs/leaderboard.md has its fields
    root: Path  # the folder to write
    recorded: Path | None = None  # folder of recordings, with a folder seed_0, seed_1, ... for each training seed
    study: Path | None = None  # or a study's folder
    variant: Text | None = None  # and the study's variant
    study_settings: list[Text] | None = None  # those of the study's settings that are meant, if several evaluate alike
    store: Path = Path("outputs/store")  # where the study's runs are
    settings: Path | None = None  # YAML of settings other than the suite's: the submission is then a custom one
    failures: dict[str, str] = field(default_factory=dict)  # training seed to why its missing episodes failed

    def __post_init__(self):
        check(self)
        if (self.recorded is None) == (self.study is None) or (self.study is None) != (self.variant is None):
            raise InputError("Give what the submission is made from: --recorded, or --study with --variant.")
        if self.study_settings and self.study is None:
            raise InputError("study_settings are of --study.")
        if bad := [seed for seed in self.failures if not re.fullmatch("0|[1-9][0-9]{0,8}", seed)]:
            raise InputError(f"failures must map training seeds to reasons, not '{bad[0][:100]}'.")


@command("constructskill-submit --suite=bins --about=about.yaml --recorded=recorded --root=outputs/submission")
def submit(config: SubmitConfig) -> str:
    """Write a submission and say what is in it.

    Raises:
        TakenError: the folder exists.
        MissingError: something that was named is not there.
        InputError: an episode is missing, or a file is not what it should be.
    """
    from lerobot_constructskill.board import from_recordings
    from lerobot_constructskill.board.declaration import ABOUT, SETTINGS
    from lerobot_constructskill.board.submission import EPISODES_FILE

    about = ABOUT.read(config.about)
    settings = BOARD_SUITES[config.suite].settings if config.settings is None else SETTINGS.read(config.settings)
    failures = {int(seed): why for seed, why in config.failures.items()}
    if config.study is None:
        recorded = from_recordings.recorded_in(config.recorded)
    else:
        recorded, said = from_recordings.recorded_by_study(
            config.study, config.store, config.variant, settings, config.study_settings
        )
        failures = said | failures
        about = from_recordings.with_draws(about, config.study)
    recipe, told = _recipe(config, settings)
    made = from_recordings.submit(config.root, about, config.suite, settings, recorded, failures, recipe)
    size = (config.root / EPISODES_FILE).stat().st_size
    return (
        f"{config.root}: {made.declaration.settings_class}, {plural(len(made.claims), 'episode')} of "
        f"{plural(len(made.declaration.training_seeds), 'training seed')}, "
        f"{size / 1e6:.2f} MB; {told}; now constructskill-verify."
    )


def _recipe(config: SubmitConfig, settings: dict[str, BoardSetting]) -> tuple[tuple[str, dict] | None, str]:
    """The recipe of a submission with what it made, or None, and what is said of that."""
    from lerobot_constructskill.board.from_recordings import trained_by_study

    if config.study is None or config.variant is None:
        return None, "no recipe, as recordings have none"
    try:
        made = trained_by_study(config.study, config.variant, settings, config.study_settings)
    except InputError as error:
        return None, f"no recipe, so nobody can train it again ({str(error).rstrip('.')})"
    return made, "with its recipe"
