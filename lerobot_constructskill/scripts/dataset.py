"""Commands about a data set: `constructskill-check`, `-card`, `-push` and `-replay`."""

import json
import re
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lerobot_constructskill.artifacts.folders import write_text
from lerobot_constructskill.bounds import Checked, Episodes, RepoId, Text, Word
from lerobot_constructskill.dataset.card import card_facts, render
from lerobot_constructskill.dataset.checks import CHECKS, examine
from lerobot_constructskill.dataset.dataset import DataSet, open_dataset
from lerobot_constructskill.dataset.hub import locate, push
from lerobot_constructskill.errors import InputError, plural
from lerobot_constructskill.files import read_text
from lerobot_constructskill.progress import Progress
from lerobot_constructskill.scripts.console import command, say


@dataclass
class CheckConfig(Checked):
    """Check a data set of demonstrations; exit status 1 if something is wrong."""

    repo_id: RepoId | None = None  # its name; downloaded from the Hub unless root is given
    root: Path | None = None  # its folder
    revision: Text | None = None  # tag, branch or commit on the Hub

    def read(self) -> DataSet:
        """The data set, downloaded where it is not here. Raises as `locate` and `open_dataset` do."""
        return open_dataset(locate(self.repo_id, self.root, self.revision))


@command("constructskill-check --root=outputs/fast")
def check_dataset(config: CheckConfig) -> str:
    """Print a line for each check and return the verdict.

    Raises:
        MissingError: there is no such data set.
        InputError: something is wrong with it, or neither a name nor a folder was given.
    """
    data, wrong = config.read(), 0
    for name, found in examine(data):
        wrong += bool(found)
        with Progress.external_write_mode():
            say(f"{'FAIL' if found else 'OK':<4}  {name:<12}  {' '.join(found)}".rstrip())
    if wrong:
        raise InputError(f"{wrong} of {len(CHECKS)} checks found something wrong with {data.root}.")
    size = f"{plural(len(data.episodes), 'demonstration')}, {plural(len(data.rows), 'frame')}"
    return f"{size}: {len(CHECKS)} checks, nothing wrong."


@dataclass
class CardConfig(Checked):
    """Write README.md, pictures/contact_sheet.jpg and pictures/trajectories.png for a data set."""

    root: Path  # the data set's folder
    repo_id: RepoId | None = None  # its name on the Hub; default: the one it was generated under
    out: Path | None = None  # folder to write; default: root
    facts: Path | None = None  # also write the card's facts as JSON here


@command("constructskill-card --root=outputs/fast")
def write_card(config: CardConfig) -> str:
    """Write the card and return a line that says where.

    Raises:
        MissingError: there is no data set in `root`.
        InputError: a file cannot be read.
    """
    from lerobot_constructskill.dataset.plots import contact_sheet, trajectories

    data, out = open_dataset(config.root), config.out or config.root
    facts = card_facts(data) | ({"repo_id": config.repo_id} if config.repo_id else {})
    contact_sheet(data, out / "pictures" / "contact_sheet.jpg")
    trajectories(data, out / "pictures" / "trajectories.png")
    write_text(out / "README.md", render(facts))
    if config.facts:
        write_text(config.facts, json.dumps(facts, indent=2) + "\n")
    return f"Card and pictures written to {out}"


@dataclass
class PushConfig(Checked):
    """Check a data set, write its card, upload it to the Hub as one commit and tag it.

    A card that somebody changed, or another version wrote, stays as it is; others get this name.

    After an interruption the same command continues.
    """

    repo_id: RepoId  # its name on the Hub, user/name
    root: Path  # its folder
    private: bool = False  # whether only its owner sees it
    tag: Word | None = None  # a version tag of yours, beside LeRobot's tag
    update: bool = False  # replace a data set that is there already


@command("constructskill-push --repo_id=user/name --root=outputs/fast --tag=v1")
def push_dataset(config: PushConfig) -> str:
    """Push and return the commit's address.

    Raises:
        MissingError: there is no data set in `root`.
        TakenError: the name is taken and `update` is not set.
        InputError: a check found something wrong.
        OSError: the Hub refused, or the connection broke.
    """
    data = open_dataset(config.root)
    wrong = [f"{name}: {complaint}" for name, found in examine(data) for complaint in found]
    if wrong:
        raise InputError(
            f"{config.root} is not pushed, because the checks found {plural(len(wrong), 'fault')}; {wrong[0]}"
        )
    card = config.root / "README.md"
    text = read_text(card) if card.is_file() else ""
    named = re.search(r"^# (\S+/\S+)$", text, re.MULTILINE)
    is_anothers = named and named[1] != config.repo_id
    if not text or (is_anothers and text == render(card_facts(data) | {"repo_id": named[1]})):
        say(write_card(CardConfig(config.root, config.repo_id)))
    return f"Pushed: {push(config.root, config.repo_id, config.private, config.tag, config.update)}"


@dataclass
class ReplayConfig(CheckConfig):
    """Execute the recorded actions of a data set again in the simulator; exit status 1 if an outcome differs."""

    episodes: Episodes | None = None  # which to replay; default: all


@command("constructskill-replay --root=outputs/fast --episodes='[0, 1]'")
def replay_dataset(config: ReplayConfig) -> str:
    """Replay and return the verdict.

    Raises:
        MissingError: there is no such data set.
        InputError: there is no such episode, or an outcome differs.
        OSError: this machine has no simulator that starts.
    """
    data = config.read()
    everything = range(len(data.episodes))
    episodes = list(everything) if config.episodes is None else config.episodes
    if not episodes or not set(episodes) <= set(everything):
        raise InputError(f"episodes must be among 0 to {len(everything) - 1}, not {episodes}.")
    replays = {episode: replay_episode(data, episode) for episode in Progress(episodes, "replay", unit="demo")}
    different = [str(episode) for episode, (is_same, _) in replays.items() if not is_same]
    if different:
        raise InputError(f"{len(different)} of {len(replays)} did not end as recorded: {', '.join(different)}.")
    deviation = max(deviation for _, deviation in replays.values())
    ended = f"{plural(len(replays), 'demonstration')} ended as recorded"
    return f"{ended}; the largest deviation from a recorded state is {deviation:.2g}."


def replay_episode(data: DataSet, episode: int) -> tuple[bool, float]:
    """Start from the episode's seed and execute what was executed.

    Returns:
        Whether reward and success are as recorded at every step. The largest difference between a recorded number and
        the one found, over `observation.state` and, where it was recorded, `sim.joint_positions`, in m and rad.
    """
    from lerobot_constructskill.envs.gym_env import ConstructSkillEnv

    span, config = data.spans()[episode], data.config
    states = ["observation.state", *(["sim.joint_positions"] if data.has_joints else [])]
    recorded = np.concatenate([data.column(name)[span] for name in states], axis=1)
    outcomes = np.stack([data.column("next.reward")[span], data.column("next.success")[span]], axis=1)
    task, steps = data.task_of(episode).name, len(outcomes) + 1
    env = ConstructSkillEnv(
        task, config.obs_type, steps, config.light_robot, render_backend="none", action=config.action
    )
    with closing(env):
        env.reset(seed=int(data.column("sim.seed")[span.start]))
        found, reached = [], []
        for action in data.column("dart.executed_action")[span]:
            found.append(np.concatenate([env.agent_state(), env.privileged_state()["joint_positions"]]))
            reached.append(env.step(action)[1:3])
    deviation = np.abs(np.array(found)[:, : recorded.shape[1]] - recorded).max()
    return bool((np.array(reached, dtype=float) == outcomes).all()), float(deviation)
