"""`constructskill-generate`: make scripted demonstrations as a LeRobotDataset."""

from lerobot_constructskill.demos.recorder import GenerateConfig, record
from lerobot_constructskill.errors import plural, remedy_of
from lerobot_constructskill.scripts.console import run, say


def generate(config: GenerateConfig) -> str:
    from lerobot_constructskill.scripts.dataset import CardConfig, write_card

    summary = record(config)
    try:
        say(write_card(CardConfig(summary.root)))
    except ModuleNotFoundError as error:  # the demonstrations are whole; constructskill-card writes it later
        say(f"No card: {remedy_of(error) or error}")
    return (
        f"{plural(summary.episodes, 'demonstration')}, {plural(summary.frames, 'frame')}, "
        f"{plural(len(summary.discarded_seeds), 'attempt')} discarded: {summary.root}"
    )


def main() -> None:
    run(GenerateConfig, generate, presets="generate")


if __name__ == "__main__":
    main()
