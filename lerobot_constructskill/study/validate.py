"""Held-out errors of a study's policies, on all demonstrations of their setting."""

import logging
from collections.abc import Sequence
from pathlib import Path

from lerobot_constructskill.artifacts.store import Machine, Store
from lerobot_constructskill.progress import Progress
from lerobot_constructskill.study.runs import Arm, NamedSet, Run
from lerobot_constructskill.study.timing import timed
from lerobot_constructskill.training.heldout import HeldOutError

logger = logging.getLogger(__name__)


def validate(runs: Sequence[Run], others: Sequence[Run], store: Store, machine: Machine, times: Path) -> None:
    """Measure the held-out errors that are not known yet; those that cannot be measured are logged and stay unknown.

    Args:
        runs: those whose policies are validated, where the store has them. Nothing is made for one trained elsewhere.
        others: the other runs of their study, which are not asked for.
        times: folder of the file that says what took how long.
    """
    elsewhere = [run for run in runs if _was_trained_elsewhere(run, store)]
    pairs = list_pairs([run for run in runs if run not in elsewhere], [*others, *elsewhere])
    for arm, data in Progress(pairs, "validation", unit="set", disable=not pairs):
        nodes = [heldout(run, data) for run in runs if run.arm is arm and store.has(run.checkpoints)]
        due = [node for node in nodes if not store.has(node)]
        if not due:
            continue
        with timed(times, arm.id, "validation", len(due)):
            failed = store.get_all(due, machine)
        for said in dict.fromkeys(failure.said for failure in failed.values()):
            logger.warning("%s is not validated on %s: %s", arm.id, data.name, said)
        for node, failure in failed.items():
            store.note(node, failure)


def _was_trained_elsewhere(run: Run, store: Store) -> bool:
    """Whether the store has neither a run's policy nor what it learns from."""
    policy, data = run.checkpoints, run.arm.demonstrations
    return policy is not None and data is not None and not (store.has(policy) or store.has(data.node))


def list_pairs(runs: Sequence[Run], others: Sequence[Run]) -> list[tuple[Arm, NamedSet]]:
    """Arms, each with a data set to validate it on; no data set is made that only `others` need."""
    arms = {id(run.arm): run.arm for run in runs}.values()
    own = {arm.demonstrations.node for arm in arms if arm.demonstrations}
    spared = {run.arm.demonstrations.node for run in others if run.arm.demonstrations} - own
    return [(arm, data) for arm in arms if arm.learner for data in arm.validated_on if data.node not in spared]


def heldout(run: Run, data: NamedSet) -> HeldOutError:
    """The held-out error of a run's policy on a set."""
    return HeldOutError(run.checkpoints, run.seed, data.node)
