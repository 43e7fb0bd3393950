"""Folders that appear whole or not at all."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from lerobot_constructskill.artifacts import disk
from lerobot_constructskill.artifacts.folders import MARK, replaced, staged
from lerobot_constructskill.errors import MachineError


def test_a_folder_appears_when_it_is_complete(tmp_path):
    root = tmp_path / "deep" / "set"
    with staged(root) as folder:
        folder.mkdir()
        (folder / "rows").write_text("1")
        assert not root.exists()
    assert (root / "rows").read_text() == "1" and [path.name for path in root.parent.iterdir()] == ["set"]


def test_whoever_may_read_a_folder_may_read_its_files(tmp_path):
    before = os.umask(0o027)
    try:
        with staged(tmp_path / "set") as folder:
            folder.mkdir()
            (folder / "videos").mkdir(mode=0o700)
            (folder / "videos" / "video.mp4").touch(mode=0o600)  # as `tempfile` makes files
            (folder / "run.sh").touch(mode=0o700)
            (tmp_path / "elsewhere").touch(mode=0o600)
            (folder / "link").symlink_to(tmp_path / "elsewhere")
    finally:
        os.umask(before)
    modes = {path.relative_to(tmp_path).as_posix(): path.stat().st_mode & 0o777 for path in tmp_path.rglob("*")}
    assert modes == {
        "set": 0o750,
        "set/videos": 0o750,
        "set/videos/video.mp4": 0o640,
        "set/run.sh": 0o740,
        "set/link": 0o600,
        "elsewhere": 0o600,
    }


def test_a_failure_leaves_nothing(tmp_path):
    with pytest.raises(KeyboardInterrupt), staged(tmp_path / "set") as folder:
        folder.mkdir()
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_what_a_killed_process_left_is_replaced(tmp_path):
    left = tmp_path / "set.partial" / "dataset"
    left.mkdir(parents=True)
    (left / "half").touch()
    (left.parent / MARK).touch()
    with staged(tmp_path / "set") as folder:
        assert not folder.exists()
        folder.mkdir()
    assert list((tmp_path / "set").iterdir()) == []


def test_other_peoples_folders_are_refused_and_left_alone(tmp_path):
    for name in ("set", "other.partial"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "mine").touch()
    for name in ("set", "other"):
        with pytest.raises(FileExistsError), staged(tmp_path / name):
            pass
    assert all((tmp_path / name / "mine").exists() for name in ("set", "other.partial"))


def test_the_folder_that_one_is_in_exists(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FileExistsError, match=f"{tmp_path} exists already"), staged(Path(".")):
        pass


def test_two_processes_do_not_share_a_folder(tmp_path):
    with staged(tmp_path / "set") as folder:
        with pytest.raises(FileExistsError, match="Another process"), staged(tmp_path / "set"):
            pass
        folder.mkdir()
    assert (tmp_path / "set").exists()


def test_finished_parts_outlive_a_failure_until_the_folder_is_whole(tmp_path):
    for attempt in range(2):
        with pytest.raises(KeyboardInterrupt), staged(tmp_path / "set", keep="parts") as folder:
            parts = folder.with_name("parts")
            assert len(list(parts.glob("*"))) == attempt
            folder.mkdir()
            parts.mkdir(exist_ok=True)
            (parts / str(attempt)).touch()
            raise KeyboardInterrupt
    with staged(tmp_path / "set", keep="parts") as folder:
        assert len(list(folder.with_name("parts").iterdir())) == 2 and not folder.exists()
        folder.mkdir()
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


def test_a_failure_without_finished_parts_leaves_nothing(tmp_path):
    with pytest.raises(KeyboardInterrupt), staged(tmp_path / "set", keep="parts"):
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


WRITER = """
import sys
from pathlib import Path
from lerobot_constructskill.artifacts.folders import replaced
with replaced(Path(sys.argv[1])) as partial:
    partial.write_text("theirs")
    print("writing", flush=True)
    sys.stdin.readline()
"""


def test_a_file_that_another_process_is_writing_is_left_alone(tmp_path):
    path = tmp_path / "rows.txt"
    theirs = subprocess.Popen(
        [sys.executable, "-c", WRITER, path], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert theirs.stdout.readline() == "writing\n"
    with replaced(path) as partial:
        partial.write_text("ours")
    assert path.read_text() == "ours"
    theirs.communicate("go on\n")
    assert theirs.returncode == 0 and path.read_text() == "theirs" and list(tmp_path.iterdir()) == [path]


def test_a_file_that_a_killed_process_was_writing_is_removed_by_the_next(tmp_path):
    path = tmp_path / "rows.txt"
    killed = subprocess.Popen(
        [sys.executable, "-c", WRITER, path], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    killed.stdout.readline()
    killed.kill()
    killed.communicate()
    assert len(list(tmp_path.iterdir())) == 1 and not path.exists()
    with replaced(path) as partial:
        partial.write_text("ours")
    assert list(tmp_path.iterdir()) == [path]


def test_the_root_of_all_folders_exists():
    with pytest.raises(FileExistsError, match="The output folder / exists already"), staged(Path("/")):
        pass


@pytest.mark.parametrize("writing", [replaced, staged])
def test_a_full_disk_is_one_sentence_with_its_path_whoever_writes(writing, tmp_path):
    with pytest.raises(MachineError, match=f"^The disk of {tmp_path} is full"), writing(tmp_path / "new"):
        Path("/dev/full").write_text("x")
    with pytest.raises(MachineError, match=f"^The disk of {tmp_path} is full"), writing(tmp_path / "new"):
        raise OSError("Not enough free space to write 21626880 bytes")  # as NumPy says it
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("writing", [replaced, staged])
def test_the_room_is_measured_before_what_took_it_is_removed(writing, tmp_path, monkeypatch):
    """Stands in for a disk that what was written has filled."""
    free = lambda path: type("Usage", (), {"free": 0 if list(tmp_path.rglob("*new*")) else 10**9})  # noqa: E731
    monkeypatch.setattr(disk.shutil, "disk_usage", free)
    with pytest.raises(MachineError, match="is full"), writing(tmp_path / "new") as path:
        path.touch()
        raise OSError("7150080 requested and 1572800 written")  # as np.save says it


def test_a_full_disk_of_temporary_files_is_named(tmp_path, monkeypatch):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    free = lambda path: type("Usage", (), {"free": 0 if path == tmp_path else 10**9})  # noqa: E731
    monkeypatch.setattr(disk.shutil, "disk_usage", free)
    with pytest.raises(MachineError, match=f"^The disk of {tmp_path} is full"), disk.room_for(Path("/elsewhere")):
        raise RuntimeError("av: 28")
