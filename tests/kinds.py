"""The tasks, for tests that drive each of them in a simulator.

Where several are one class and differ in a number, as the rungs of the ladder are, `make test` drives one of them and
`make nightly` the others.
"""

import pytest

from lerobot_constructskill.contract import TASKS

LAST_OF_ITS_CLASS = {task.scene: name for name, task in TASKS.items()}
"""Scene to a task; of the ladder, its tightest rung."""

KINDS = [
    name if name in LAST_OF_ITS_CLASS.values() else pytest.param(name, marks=pytest.mark.nightly) for name in TASKS
]
