"""Rewordings of the tasks' sentences: enough of them, none twice, and none of the unseen ones trained with."""

from dataclasses import replace

import pytest

from lerobot_constructskill.contract import PLAN_TASK, SHIPPED
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.perturbations import Perturbation

EVERY = {task.instruction: task for task in (PLAN_TASK, *SHIPPED.values())}


@pytest.mark.parametrize("instruction", EVERY)
def test_every_sentence_has_rewordings_to_train_with_and_three_levels_of_others(instruction):
    trained, *unseen = EVERY[instruction].rewordings
    assert len(trained) >= 2 and len(unseen) == 3 and all(unseen)


@pytest.mark.parametrize("name", SHIPPED)
def test_the_axis_says_an_unseen_rewording_or_as_control_what_another_task_is_asked(name):
    task = SHIPPED[name]
    said = [Perturbation(axis).told(task) for axis in ("", "language=1", "language=2", "language=3", "wrong_task=1")]
    assert said[0] == task and all(
        one.instruction in own for one, own in zip(said[1:4], task.rewordings[1:], strict=True)
    )
    assert said[4].instruction in {*EVERY} - {task.instruction}
    assert {replace(one, instruction=task.instruction) for one in said} == {task}


def test_a_task_without_rewordings_has_the_control_alone():
    bare = replace(SHIPPED["brick_to_bin"], rewordings=())
    Perturbation("wrong_task=1").check(bare)
    with pytest.raises(InputError, match="has no rewordings of level 2"):
        Perturbation("language=2").check(bare)


def test_no_sentence_means_two_things_and_none_is_both_trained_and_unseen():
    said = [sentence for task in EVERY.values() for some in task.rewordings for sentence in some]
    assert len({*said, *EVERY}) == len(said) + len(EVERY)
