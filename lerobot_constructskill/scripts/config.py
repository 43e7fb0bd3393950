"""`constructskill-config`: list our configurations, print the path of one, or write one of training for a data set."""

import os
from dataclasses import dataclass
from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot_constructskill.bounds import Count, RepoId, check
from lerobot_constructskill.errors import InputError, MissingError, TakenError, plural
from lerobot_constructskill.files import read_bytes
from lerobot_constructskill.presets import KINDS, description, find, named, names
from lerobot_constructskill.scripts.console import EPILOG, Parser, edge, say

if TYPE_CHECKING:
    from lerobot_constructskill.dataset.split import Split

TRAIN = "train/"


@dataclass
class TrainingFile:
    """What a configuration of training is written for.

    Args:
        name: the configuration, without `train/`.
        root: folder of the data set.
        repo_id: name of the data set; with `root` any name, without it that of one in LeRobot's cache or on the Hub.
        passes: how often every demonstration is trained on; default: what the configuration says.
        out: the file; default: beside the data set's folder, or in `outputs/`.

    Raises:
        MissingError: there is no such configuration.
        InputError: no data set is named, or a field holds what its annotation does not allow.
    """

    name: str
    root: Path | None = None
    repo_id: RepoId | None = None
    passes: Count | None = None
    out: Path | None = None

    def __post_init__(self):
        check(self)
        named("train", self.name)
        if self.root is None and self.repo_id is None:
            raise InputError(
                f"{TRAIN}{self.name} is written for a data set: add --root=FOLDER, or --repo_id=NAME of one in "
                "LeRobot's cache or on the Hub."
            )

    @property
    def file(self) -> Path:
        if self.out is not None:
            return self.out
        beside = Path(os.path.abspath(self.root)) if self.root else Path("outputs") / self.repo_id.partition("/")[2]
        return beside.with_name(f"{beside.name}_{self.name}.yaml")


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


def write(training: TrainingFile) -> Path:
    """Write the plain YAML that `lerobot-train` reads, for one data set, and return its path.

    Raises:
        MissingError: there is no such data set.
        InputError: LeRobot cannot hold out every eighth demonstration of this set.
        TakenError: the file is there and is not one that was written like this.
        OSError: the Hub does not have the data set, or the file cannot be written.
    """
    from lerobot_constructskill import tags
    from lerobot_constructskill.artifacts.folders import write_text
    from lerobot_constructskill.dataset.split import split_of

    template = tags.read(named("train", training.name))
    source = {"repo_id": training.repo_id or f"local/{training.root.absolute().name}"}
    if training.root is not None:
        source["root"] = str(training.root.absolute())
    split = split_of(training.root or _find_set(training.repo_id))
    passes = training.passes or template["passes"]
    text = f"{_comment(training, split, passes)}\n{_dump(fill(template, source, split, passes))}"
    if training.file.exists() and not read_bytes(training.file).startswith(f"# {TRAIN}".encode()):
        raise TakenError(
            f"{training.file} exists and was not written by constructskill-config: name another with --out."
        )
    write_text(training.file, text)
    return training.file


def fill(template: dict[str, Any], source: dict[str, str], split: "Split", passes: int) -> dict[str, Any]:
    """The fields of `lerobot-train` for a data set.

    Args:
        template: a file of `configs/train`: fields of `lerobot-train`, and `passes` and `checkpoints`.
        source: `repo_id` of the data set, and its `root` if it is a folder.
        split: what is held out of it.
        passes: how often each frame is trained on; the last batch of a pass may be smaller.
    """
    fields = {name: value for name, value in template.items() if name not in ("passes", "checkpoints")}
    steps = passes * ceil(split.frames / fields["batch_size"])
    # Only as many checkpoints as have equally many whole passes between them, so that the last is of the last step.
    checkpoints = max(n for n in range(1, template["checkpoints"] + 1) if passes % n == 0)
    often = steps // checkpoints
    dataset = {**source, "episodes": split.episodes, "eval_split": split.eval_split}
    when = {"steps": steps, "save_freq": often, "eval_steps": often if split.n_held_out else 0}
    return {"dataset": dataset, **fields, **when}


def _find_set(repo_id: str) -> Path:
    from lerobot_constructskill.dataset.hub import locate

    return locate(repo_id, None)


def _comment(training: TrainingFile, split: "Split", passes: int) -> str:
    held_out = (
        f"{split.n_held_out} of them held out" if split.n_held_out else "too few for every eighth to be held out"
    )
    demonstrations = plural(len(split.episodes), "demonstration")
    return (
        f"# {TRAIN}{training.name} for {training.root or training.repo_id}: {demonstrations}, {held_out}; "
        f"{passes} {'pass' if passes == 1 else 'passes'}.\n"
        "# constructskill-config wrote it for this data set alone: for another set let it write another file."
    )


def _dump(fields: dict[str, Any]) -> str:
    """YAML with a line for each field and for each list."""
    import yaml

    class Dumper(yaml.SafeDumper):
        """SafeDumper, but lists are written in brackets."""

    def in_brackets(dumper: Dumper, values: list) -> yaml.Node:
        return dumper.represent_sequence("tag:yaml.org,2002:seq", values, flow_style=True)

    Dumper.add_representer(list, in_brackets)
    return yaml.dump(fields, Dumper=Dumper, sort_keys=False, allow_unicode=True, width=119)


def main() -> None:
    parser = Parser(
        prog="constructskill-config",
        description="List the shipped configurations, or print the path of one. Those of train/ are first written for "
        "a data set: lerobot-train --config_path=$(constructskill-config train/act --root=outputs/fast_wrist)",
        epilog=EPILOG,
        allow_abbrev=False,
    )
    parser.add_argument("name", nargs="?", help=f"{'/NAME, '.join(KINDS)}/NAME; all are listed without it")
    parser.add_argument("--root", type=Path, help="for train/: the data set's folder")
    parser.add_argument(
        "--repo_id", help="for train/: its name; without --root, of one in LeRobot's cache or on the Hub"
    )
    parser.add_argument("--passes", type=int, help="for train/: how often each frame is trained on")
    parser.add_argument(
        "--out", type=Path, help="for train/: the file to write; default: beside the data set's folder"
    )
    with edge():
        arguments = vars(parser.parse_args())
        name = arguments.pop("name")
        if name is not None and name.startswith(TRAIN):
            say(write(TrainingFile(name.removeprefix(TRAIN), **arguments)))
        elif given := [flag for flag, value in arguments.items() if value is not None]:
            raise InputError(f"--{given[0]} is for configurations of {TRAIN}, which are written for a data set.")
        else:
            say(show(name))


if __name__ == "__main__":
    main()
