"""Rewordings of the tasks' sentences: enough of them, none twice, and none of the unseen ones trained with."""

import pytest

from lerobot_constructskill.contract import PLAN_TASK, SHIPPED

EVERY = {task.instruction: task for task in (PLAN_TASK, *SHIPPED.values())}


@pytest.mark.parametrize("instruction", EVERY)
def test_every_sentence_has_rewordings_to_train_with_and_three_levels_of_others(instruction):
    trained, *unseen = EVERY[instruction].rewordings
    assert len(trained) >= 2 and len(unseen) == 3 and all(unseen)


def test_no_sentence_means_two_things_and_none_is_both_trained_and_unseen():
    said = [sentence for task in EVERY.values() for some in task.rewordings for sentence in some]
    assert len({*said, *EVERY}) == len(said) + len(EVERY)
