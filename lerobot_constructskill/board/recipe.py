"""The recipe of an entry: the study that made its policies, as plain data, so that anyone can train them again.

It names shipped demonstrations, policies and tasks, and neither files nor code.
"""

import json
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from lerobot_constructskill.contract import PLANNED
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.files import Yaml
from lerobot_constructskill.presets import names
from lerobot_constructskill.study.rows import STUDY, merged

KEPT = ("name", "training", "demonstrations", "starts", "seeds_a_draw", "episodes", "eval_seed")
"""Fields of a study that its recipe takes as they are."""

RECIPE = Yaml("a recipe, the fields of a study", dict[str, Any])

A_PATH = re.compile(r"[/~.\\]|.*(\.\.|\\)|.*\.(ya?ml|json|safetensors|ckpt|bin|pth?|py|parquet)$")
"""Text that names a file, from its beginning on."""

ON_THE_HUB, COMMIT = re.compile(r"[\w-][\w.-]*/[\w-][\w.-]*"), re.compile("[0-9a-f]{40}")

OF_POLICY = re.compile(r"variants\.[^.]+\.policy\..*")
"""Where a field of a policy stands."""

NAMED = re.compile(rf"(hf/)?{ON_THE_HUB.pattern}(@.*)?")
"""Weights on the Hub, as a field of a policy names them; without a commit they may be others tomorrow."""


def recipe_of(root: Path, variant: str, settings: Mapping[str, str]) -> str:
    """The recipe of a study's variant.

    Args:
        root: the study's folder.
        settings: what the submission calls a setting, to what the study calls it.

    Raises:
        InputError: it names a file, so it is no plain data.
    """
    study = RECIPE.read(root / STUDY)
    if variant not in study.get("variants", {}):
        raise InputError(f"'{root / STUDY}' has no variant {variant}.")
    kept = {name: study[name] for name in KEPT if name in study}
    own = study["variants"][variant] | {"settings": None}
    values = kept | {
        "settings": {name: study["settings"][theirs] for name, theirs in settings.items()},
        "variants": {variant: own},
    }
    check_plain(values)
    return yaml.safe_dump(values, sort_keys=False, allow_unicode=True, width=119)


def read_recipe(text: str) -> dict[str, Any]:
    """The fields of a study.

    Raises:
        InputError: it is not YAML without tags, or names a file.
    """
    values = RECIPE.parse(text, "The recipe")
    check_plain(values)
    return values


def check_plain(values: Mapping[str, Any]) -> None:
    """Refuse a recipe that names anything that is not shipped with this package.

    Raises:
        InputError: the message names it.
    """
    for where, text in _texts(values):
        words = [one for word in _split(text) for one in re.split("[=,:]", word.strip("[]{}"))]
        if path := next((one for one in words if A_PATH.match(one.strip())), None):
            raise InputError(f"A recipe names no file, and {where} is {path!a:.80}.")
        name, field = (_split(text) or [""])[0], where.rpartition(".")[2]
        if field.endswith("path"):
            also = " without pretrained_revision, a commit on the Hub" * (field == "pretrained_path")
            raise InputError(f"A recipe names no file, and {where} is {text!a:.80}{also}.")
        if OF_POLICY.fullmatch(where) and NAMED.fullmatch(text) and not COMMIT.fullmatch(text.partition("@")[2]):
            raise InputError(
                f"A recipe names weights on the Hub by their commit, NAME@COMMIT: {where} is {text!a:.80}."
            )
        kind = {"data": "generate", "dagger": "dagger"}.get(field)
        if kind and not name.startswith("--") and name not in names(kind):
            raise InputError(f"A recipe names shipped configurations, and {where} is {name!a:.80}.")
        if (plan := text.partition(PLANNED)[2]) and plan not in names("plan"):
            raise InputError(f"A recipe names shipped plans, and {where} is {text!a:.80}.")


def starts_from(policy: Mapping[str, Any]) -> str:
    """The weights on the Hub that the policy of a recipe starts from, NAME@COMMIT; empty where there are none."""
    names = {text for _, text in _texts(policy) if NAMED.fullmatch(text)}
    if policy.get("pretrained_path"):
        names.add(f"{policy['pretrained_path']}@{policy['pretrained_revision']}")
    return ", ".join(sorted(names))


def _texts(value: Any, where: str = "") -> Iterator[tuple[str, str]]:
    """Every text in plain values but the weights that `_is_pinned` allows, and where it stands."""
    if isinstance(value, Mapping):
        for name, one in value.items():
            if name == "pretrained_path" and _is_pinned(value):
                continue
            yield from _texts(one, f"{where}.{name}".lstrip("."))
    elif isinstance(value, list):
        for one in value:
            yield from _texts(one, where)
    elif isinstance(value, str):
        yield where, value


def _is_pinned(policy: Mapping[str, Any]) -> bool:
    """Whether a policy starts from the weights of one commit of a repository on the Hub."""
    name, commit = str(policy["pretrained_path"]), str(policy.get("pretrained_revision"))
    is_local = A_PATH.match(name) or Path(name).exists()  # which LeRobot prefers to the Hub
    return bool(ON_THE_HUB.fullmatch(name) and COMMIT.fullmatch(commit)) and not is_local


def _split(text: str) -> list[str]:
    try:
        return shlex.split(text)
    except ValueError:
        raise InputError(f"A recipe has a text whose quotation marks do not close: {text!a:.80}.") from None


def trained_by(rows: pd.DataFrame, settings: Mapping[str, str], seeds: Sequence[int]) -> dict[str, Any]:
    """What the rows of a study's variant say of its training: fields of `Trained` without the recipe's hash."""
    weights = {name: [_weights(rows, theirs, seed) for seed in seeds] for name, theirs in settings.items()}
    return {"weights": weights, "made_with": merged(map(json.loads, rows["versions"].dropna().unique()))}


def _weights(rows: pd.DataFrame, setting: str, seed: int) -> str | None:
    own = rows[(rows["setting"] == setting) & (rows["training_seed"] == seed)]["weights_sha256"].dropna()
    return None if own.empty else str(own.iloc[0])
