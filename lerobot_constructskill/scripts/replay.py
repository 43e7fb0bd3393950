"""`constructskill-replay`: execute every recorded action again, and say which demonstrations end as recorded."""

from dataclasses import dataclass
from pathlib import Path

from lerobot_constructskill.bounds import Checked, Episodes, RepoId, Text
from lerobot_constructskill.errors import InputError, plural
from lerobot_constructskill.scripts.console import run, say


@dataclass
class ReplayConfig(Checked):
    """Replay a data set in the simulator; exit status 1 if an outcome differs."""

    repo_id: RepoId | None = None  # its name; downloaded from the Hub unless root is given
    root: Path | None = None  # its folder
    revision: Text | None = None  # tag, branch or commit on the Hub
    episodes: Episodes | None = None  # which to replay; default: all


def replay_all(config: ReplayConfig) -> str:
    """Print the noise of each phase, replay, and return the verdict.

    Raises:
        FileNotFoundError: there is no such data set.
        ValueError: no such episode, or outcomes that differ.
        OSError: this machine cannot render.
    """
    from lerobot_constructskill.dataset.dataset import open_dataset
    from lerobot_constructskill.dataset.hub import locate
    from lerobot_constructskill.dataset.replay import replay
    from lerobot_constructskill.demos.expert import Phase
    from lerobot_constructskill.progress import Progress

    data = open_dataset(locate(config.repo_id, config.root, config.revision))
    everything = range(len(data.episodes))
    episodes = list(everything) if config.episodes is None else config.episodes
    if not episodes or not set(episodes) <= set(everything):
        raise InputError(f"episodes must be among 0 to {len(everything) - 1}, not {episodes}.")
    added, phases = 1000 * data.column("dart.noise"), data.column("phase")
    for phase in Phase:
        noise = added[phases == phase]
        say(f"{phase:<9} {len(noise):6} frames, added mean {noise.mean(0).round(2)} std {noise.std(0).round(2)} mm")
    replays = {episode: replay(data, episode) for episode in Progress(episodes, "replay", unit="demo")}
    different = [str(episode) for episode, one in replays.items() if not one.same_outcome]
    if different:
        raise InputError(f"{len(different)} of {len(replays)} did not end as recorded: {', '.join(different)}.")
    deviation = max(one.deviation for one in replays.values())
    ended = f"{plural(len(replays), 'demonstration')} ended as recorded"
    return f"{ended}; the largest deviation from a recorded state is {deviation:.2g}."


def main() -> None:
    run(ReplayConfig, replay_all)
