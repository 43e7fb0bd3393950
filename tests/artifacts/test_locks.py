"""One process at a time, also where the holder removes what is locked."""

import shutil
import threading
import time

from lerobot_constructskill.artifacts.locks import locked


def test_a_lock_is_that_of_the_file_which_is_there(tmp_path):
    """Whoever waits for it gets another where the holder removes the folder, as that of a finished data set."""
    path = tmp_path / "folder" / "lock"
    entered, leave, held = threading.Event(), threading.Event(), []

    def hold():
        with locked(path):
            entered.set()
            leave.wait()
            shutil.rmtree(path.parent)

    def wait():
        with locked(path):
            held.append(path.exists())

    threads = [threading.Thread(target=hold), threading.Thread(target=wait)]
    threads[0].start()
    entered.wait()
    threads[1].start()
    time.sleep(0.1)  # it has the old file open
    leave.set()
    for thread in threads:
        thread.join()
    assert held == [True]
