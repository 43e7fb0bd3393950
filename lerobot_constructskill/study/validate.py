"""Held-out errors of a study's policies, on all demonstrations of their setting."""

import json
import logging
from collections.abc import Sequence
from dataclasses import replace

from lerobot_constructskill.artifacts.store import Store
from lerobot_constructskill.contract import held_out
from lerobot_constructskill.demos.obtain import obtain_demonstrations
from lerobot_constructskill.files import Json
from lerobot_constructskill.progress import Progress
from lerobot_constructskill.rollout.heldout import heldout_mse
from lerobot_constructskill.study.runs import Arm, Demonstrations, Run
from lerobot_constructskill.training.checkpoints import read_facts
from lerobot_constructskill.training.trainers import trainer_of

FILE = "heldout.json"

ERROR = Json("a held-out error", dict[str, float])

logger = logging.getLogger(__name__)


def validate(runs: Sequence[Run], others: Sequence[Run], store: Store, workers: int = 1) -> None:
    """Measure whatever has not been measured; what cannot be is logged and stays unknown.

    Args:
        runs: those whose policies are validated.
        others: the other runs of their study, which are not asked for.
    """
    pairs = list_pairs(runs, others)
    for arm, data in Progress(pairs, "validation", unit="set", disable=not pairs):
        own = [run for run in runs if run.arm is arm and store.has(run.checkpoint)]
        missing = [run for run in own if not _is_known(run, data, store)]
        try:
            if missing:
                _measure(arm, missing, data, store, workers)
        except Exception as error:
            logger.warning("%s/%s is not validated on %s: %s", arm.setting, arm.name, data.name, error)
            store.note(missing[0].heldout(data), error)


def list_pairs(runs: Sequence[Run], others: Sequence[Run]) -> list[tuple[Arm, Demonstrations]]:
    """What is validated, and on which set of its setting: none that would be made for `others` alone.

    A trainer with a measure of its own has told the error on what the policy was trained beside.
    """
    arms = {id(run.arm): run.arm for run in runs}.values()
    own = [arm.demonstrations for arm in arms]
    spared = [run.arm.demonstrations for run in others if run.arm.demonstrations not in own]
    return [
        (arm, data)
        for arm in arms
        if arm.policy
        for data in arm.validated_on
        if data not in spared and not (data == arm.trained_on and trainer_of(arm.policy).heldout_mse)
    ]


def read_error(run: Run, data: Demonstrations, store: Store) -> float | None:
    """What was measured, in m2, when the policy was trained or since."""
    told = read_facts(store.folder(run.checkpoint)).get("heldout_mse_m2") if data == run.arm.trained_on else None
    if told is not None:
        return told
    made = run.heldout(data)
    return ERROR.read(store.folder(made) / FILE)["mse_m2"] if store.has(made) else None


def _is_known(run: Run, data: Demonstrations, store: Store) -> bool:
    return store.has(run.heldout(data)) or read_error(run, data, store) is not None


def _measure(arm: Arm, runs: Sequence[Run], data: Demonstrations, store: Store, workers: int) -> None:
    dataset = obtain_demonstrations(replace(data.config, workers=workers), store)
    episodes = held_out(dataset.num_episodes, arm.training.holdout)
    with store.claim([run.heldout(data) for run in runs]) as missing:
        runs = [run for run in runs if run.heldout(data) in missing]
        checkpoints = [store.folder(run.checkpoint) for run in runs]
        if own := trainer_of(arm.policy).heldout_mse:
            errors = own(arm.policy, checkpoints, dataset, episodes, store)
        else:
            errors = (heldout_mse(checkpoint, arm.policy.device, dataset, episodes) for checkpoint in checkpoints)
        for run, error in zip(runs, errors, strict=True):
            with store.writing(run.heldout(data)) as folder:
                folder.mkdir()
                (folder / FILE).write_text(json.dumps({"mse_m2": error}) + "\n", encoding="utf-8")
