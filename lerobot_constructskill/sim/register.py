"""Importing this registers every task of the contract table with ManiSkill (and so with Gymnasium)."""

from contextlib import suppress
from importlib import import_module

from mani_skill.utils.registration import REGISTERED_ENVS

from lerobot_constructskill.contract import SHIPPED, TASKS, Task
from lerobot_constructskill.errors import InputError, first_line


def register(task: Task) -> None:
    """Import the scene of a task, which registers it with ManiSkill.

    Raises:
        InputError: the module cannot be imported, or does not register the task's `env_id`.
    """
    module = task.scene.partition(":")[0]
    try:
        import_module(module)
    except (Exception, SystemExit) as error:  # whatever the code of another package may raise
        raise InputError(
            f"The scene of the task '{task.name}', {task.scene}, cannot be imported ({type(error).__name__}: "
            f"{first_line(error)})."
        ) from error
    made = REGISTERED_ENVS.get(task.env_id)
    if made is None or made.cls.__module__ != module:
        raise InputError(
            f"The scene of the task '{task.name}', {task.scene}, does not register {task.env_id} with ManiSkill: "
            "decorate its class with @register_env."
        )


for _task in SHIPPED.values():
    import_module(_task.scene.partition(":")[0])
for _task in TASKS.values():
    with suppress(InputError):  # raised again for whoever asks for this task; the others go on
        register(_task)
