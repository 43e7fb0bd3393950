"""`constructskill-generate`: scripted demonstrations into a LeRobotDataset."""

from lerobot_constructskill.demos.recorder import GenerateConfig, record
from lerobot_constructskill.scripts.console import run


def generate(config: GenerateConfig) -> str:
    summary = record(config)
    return (
        f"{summary.episodes} demonstrations, {summary.frames} frames, {len(summary.discarded_seeds)} attempts "
        f"discarded: {summary.root}"
    )


def main() -> None:
    run(GenerateConfig, generate, presets="generate")


if __name__ == "__main__":
    main()
