"""A plugin of pytest that writes down which function of the package is reached by which test, for mutants.py.

Python's own monitoring tells of a function once for each test and process, so the tests take as long as without. Where
`$REACH` names a file, every Python process imports this module: what the processes of a test reach is reached by it.
"""

import atexit
import json
import os
import sys

FILE, PACKAGE = os.environ.get("REACH"), "/lerobot_constructskill/"
TOOL = 4
"""One of the numbers that Python leaves free."""


def _note(*what: object, file: str = "") -> None:
    with open(FILE + file, "a") as notes:
        notes.write(json.dumps(what) + "\n")


def _seen(code, _) -> object:
    _, found, module = code.co_filename.rpartition(PACKAGE)
    if found:
        test, _, phase = os.environ.get("PYTEST_CURRENT_TEST", "").rpartition(" ")
        _note(test, phase.strip("()"), module, code.co_qualname)
    return sys.monitoring.DISABLE


if FILE and sys.monitoring.get_tool(TOOL) is None:
    sys.monitoring.use_tool_id(TOOL, "reach")
    sys.monitoring.register_callback(TOOL, sys.monitoring.events.PY_START, _seen)
    sys.monitoring.set_events(TOOL, sys.monitoring.events.PY_START)
    os.register_at_fork(after_in_child=sys.monitoring.restart_events)
    atexit.register(sys.monitoring.set_events, TOOL, 0)


def pytest_collectstart(collector) -> None:
    """What a test file calls while it is imported, for its parameters for instance, is reached by all of its tests."""
    os.environ["PYTEST_CURRENT_TEST"] = f"{collector.nodeid} (setup)"
    sys.monitoring.restart_events()


def pytest_runtest_setup(item) -> None:
    sys.monitoring.restart_events()


def pytest_runtest_logreport(report) -> None:
    if "PYTEST_XDIST_WORKER" not in os.environ:  # the process that the others report to
        _note(report.nodeid, report.when, report.outcome, report.duration, file=".times")
