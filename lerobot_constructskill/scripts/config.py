"""`constructskill-config`: list our configurations, print the path of one, or write one of training for a data set."""

import os
from dataclasses import dataclass
from math import ceil
from pathlib import Path

from lerobot_constructskill.bounds import Checked, Count, RepoId, Text
from lerobot_constructskill.errors import InputError, MissingError, TakenError, plural
from lerobot_constructskill.files import read_bytes
from lerobot_constructskill.presets import KINDS, description, find, names
from lerobot_constructskill.scripts.console import command

TRAIN = "train/"


@dataclass
class ConfigConfig(Checked):
    """List the shipped configurations, or print the path of one.

    One of train/ is first written for a data set, into a file that `lerobot-train` reads.
    """

    name: Text | None = None  # KIND/NAME, KIND is dagger, generate, plan, policy, study or train; default: list all
    root: Path | None = None  # for train/: the data set's folder
    repo_id: RepoId | None = None  # for train/: its name; without root, of one in LeRobot's cache or on the Hub
    epochs: Count | None = None  # for train/: how often each frame is trained on; default: as the configuration says
    out: Path | None = None  # for train/: the file to write; default: beside the data set's folder, or in outputs/


def show(name: str | None = None) -> str:
    """The path of a configuration such as `study/paper`; without a name, a line for each of them.

    Raises:
        MissingError: there is no such configuration.
    """
    shipped = {f"{kind}/{one}": find(kind, one) for kind in KINDS for one in names(kind)}
    if name is None:
        width = max(map(len, shipped))
        return "\n".join(f"{one:<{width}}  {description(path)}" for one, path in shipped.items())
    if name not in shipped:
        raise MissingError(f"There is no configuration '{name}'; the configurations are: {', '.join(shipped)}.")
    return str(shipped[name])


def write(config: ConfigConfig) -> Path:
    """Write the plain YAML that `lerobot-train` reads, for one data set, and return its path.

    Raises:
        MissingError: there is no such configuration or data set.
        InputError: no data set is named, it holds features and the policy reads images, or LeRobot cannot hold out
            every eighth demonstration of it.
        TakenError: the file is there and is not one that was written like this.
        OSError: the Hub does not have the data set, or the file cannot be written.
    """
    import yaml

    from lerobot_constructskill.artifacts.folders import write_text
    from lerobot_constructskill.dataset.dataset import read_info
    from lerobot_constructskill.dataset.hub import locate
    from lerobot_constructskill.dataset.split import split_of
    from lerobot_constructskill.parsing import read_fields
    from lerobot_constructskill.policies.frozen_vit.feature_sets import FEATURE_PREFIX

    template = read_fields(Path(show(config.name)))
    if config.root is None and config.repo_id is None:
        raise InputError(
            f"{config.name} is written for a data set: add --root=FOLDER, or --repo_id=NAME of one in LeRobot's cache "
            "or on the Hub."
        )
    folder = Path(os.path.abspath(config.root or Path("outputs") / config.repo_id.partition("/")[2]))
    source = {"repo_id": config.repo_id or f"local/{folder.name}"} | ({"root": str(folder)} if config.root else {})
    file = config.out or folder.with_name(f"{folder.name}_{config.name.removeprefix(TRAIN)}.yaml")
    located = locate(config.repo_id, config.root)
    is_encoded = any(name.startswith(FEATURE_PREFIX) for name in read_info(located)["features"])
    if is_encoded and template["policy"].get("type") != "frozen_vit":
        raise InputError(
            f"{config.root or config.repo_id} holds features, which frozen_vit alone can read: give the "
            "demonstrations that they were encoded from."
        )
    split, epochs = split_of(located), config.epochs or template["epochs"]
    held_out = f"{split.n_held_out} of them" if split.n_held_out else "too few for every eighth to be"
    text = (
        f"# {config.name} for {config.root or config.repo_id}: {plural(len(split.episodes), 'demonstration')}, "
        f"{held_out} held out; {plural(epochs, 'epoch')}.\n"
        "# constructskill-config wrote it for this data set alone: for another set let it write another file.\n"
    )
    if file.exists() and not read_bytes(file).startswith(f"# {TRAIN}".encode()):
        raise TakenError(f"{file} exists and was not written by constructskill-config: name another with --out.")
    steps = epochs * ceil(split.frames / template["batch_size"])  # the last batch of an epoch may be smaller
    # Only as many checkpoints as have equally many whole epochs between them, so that the last is of the last step.
    often = steps // max(n for n in range(1, template["checkpoints"] + 1) if epochs % n == 0)
    fields = {
        "dataset": {**source, "episodes": split.episodes, "eval_split": split.eval_split},
        **{name: value for name, value in template.items() if name not in ("epochs", "checkpoints")},
        **{"steps": steps, "save_freq": often, "eval_steps": often if split.n_held_out else 0},
    }
    write_text(file, text + yaml.safe_dump(fields, sort_keys=False, default_flow_style=None, width=119))
    return file


@command("lerobot-train --config_path=$(constructskill-config train/act --root=outputs/fast_wrist)", first=("name",))
def show_or_write(config: ConfigConfig) -> str:
    """What `show` returns, or the path that `write` returns. Raises as they do."""
    if config.name is not None and config.name.startswith(TRAIN):
        return str(write(config))
    if config != ConfigConfig(config.name):
        raise InputError(f"Flags are for configurations of {TRAIN}, which are written for a data set.")
    return show(config.name)
