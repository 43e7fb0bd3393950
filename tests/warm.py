"""Console commands in forks of one process that has imported LeRobot: a start takes 0.1 s in place of 10 s or more.

`python warm.py <socket>` is that process. A command is a wrapper in a folder of its own (`write_wrappers`), to be
started like the true one: it hands its arguments, environment, folder and streams to the process, and ends as the fork
does. Where a variable differs that is read while modules are imported, it becomes the true command instead. Commands
that are found beside `sys.executable`, as a study finds `lerobot-train`, start warm too.
"""

import gc
import json
import os
import signal
import socket
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path

PRELOADED = (
    "lerobot.scripts.lerobot_train",
    "lerobot.scripts.lerobot_eval",
    "lerobot_constructskill.plugin",
    "lerobot_constructskill.policies.frozen_vit.modeling_frozen_vit",
    "lerobot_constructskill.sim.register",
)
"""None of them starts a thread, which a fork would lack, but pyarrow, whose own minds its memory."""

CODE = "code"
"""A command that is no console command: its first argument is code, as that of `python -c`."""

READ_BY_IMPORTS = ("HF_", "HOME", "MKL_", "OMP_", "PYTHON", "TRANSFORMERS_", "XDG_CACHE_HOME")
"""How variables start that modules read while they are imported."""

WRAPPER = """#!{python} -SE
import json, os, socket, sys
with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as warm:
    warm.connect("{address}")
    request = json.dumps(["{name}", sys.argv[1:], dict(os.environ), os.getcwd()]).encode()
    socket.send_fds(warm, [request], [0, 1, 2])
    answer = warm.recv(100).decode()
if answer == "cold":
    os.execv("{true[0]}", {true} + sys.argv[1:])
sys.exit(int(answer or 1))
"""


def write_wrappers(names: Sequence[str], folder: Path, address: Path, true: Path) -> None:
    """Write a wrapper into `folder` for each command; the true ones lie in `true`."""
    (folder / "python").write_text(f'#!/bin/sh\nexec {sys.executable} "$@"\n')
    (folder / "python").chmod(0o755)
    for name in names:
        command = [sys.executable, "-c"] if name == CODE else [str(true / name)]
        said = WRAPPER.format(python=sys.executable, address=address, name=name, true=command)
        (folder / name).write_text(said)
        (folder / name).chmod(0o755)


def serve(address: str) -> None:
    """Answer wrappers until this process is ended; in a fork, return when the streams are the wrapper's."""
    from importlib import import_module

    for module in PRELOADED:
        import_module(module)
    warnings.filterwarnings("ignore", "This process .* is multi-threaded", DeprecationWarning)
    gc.collect()
    gc.freeze()
    ours = imported_with(os.environ)
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind(address + ".new")
        listener.listen()
        os.rename(address + ".new", address)  # whoever sees it can connect
        signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # the kernel buries who answered
        while True:
            warm, _ = listener.accept()
            if os.fork() == 0:
                break
            warm.close()
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    answer(warm, ours)


def answer(warm: socket.socket, ours: dict[str, str]) -> None:
    """Have a fork run what is asked for, and say how it ended; in the fork, return."""
    request, streams, _, _ = socket.recv_fds(warm, 1_000_000, 3)
    name, arguments, environment, folder = json.loads(request)
    if imported_with(environment) != ours:
        warm.send(b"cold")
        os._exit(0)
    child = os.fork()
    if child:
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        warm.send(str(status if status >= 0 else 128 - status).encode())
        os._exit(0)
    warm.close()
    for number, stream in enumerate(streams):
        os.dup2(stream, number)
        os.close(stream)
    sys.path[1:1] = [path for path in paths(environment) if path not in sys.path]
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(folder)
    sys.argv = [name, *arguments]


def imported_with(environment: dict[str, str]) -> dict[str, str]:
    read = {name: value for name, value in environment.items() if name.startswith(READ_BY_IMPORTS)}
    return read | {"PYTHONPATH": ""}  # further folders are searched by what is imported from now on


def paths(environment: dict[str, str]) -> list[str]:
    return [path for path in environment.get("PYTHONPATH", "").split(os.pathsep) if path]


def main() -> None:
    from importlib import metadata

    address = sys.argv[1]
    serve(address)
    sys.executable = str(Path(address).with_name("python"))
    if sys.argv[0] == CODE:
        exec(compile(sys.argv.pop(1), CODE, "exec"), {"__name__": "__main__"})
        return
    (command,) = metadata.entry_points(group="console_scripts", name=sys.argv[0])
    sys.exit(command.load()())


if __name__ == "__main__":
    main()
