"""`constructskill-generate`: make scripted demonstrations as a LeRobotDataset."""

from lerobot_constructskill.demos.recorder import GenerateConfig, record
from lerobot_constructskill.errors import plural, remedy_of
from lerobot_constructskill.scripts.console import command, say


@command("constructskill-generate fast --repo_id=local/fast --root=outputs/fast --workers=2", presets="generate")
def generate(config: GenerateConfig) -> str:
    from lerobot_constructskill.scripts.dataset import CardConfig, write_card

    root, attempts = record(config)
    lengths = [attempt.frames for attempt in attempts if attempt.success]
    try:
        say(write_card(CardConfig(root)))
    except ModuleNotFoundError as error:  # the demonstrations are whole; constructskill-card writes it later
        say(f"No card: {remedy_of(error) or error}")
    return (
        f"{plural(len(lengths), 'demonstration')}, {plural(sum(lengths), 'frame')}, "
        f"{plural(len(attempts) - len(lengths), 'attempt')} discarded: {root}"
    )


if __name__ == "__main__":
    generate.main()
