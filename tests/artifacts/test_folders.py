"""Folders that appear whole or not at all."""

import os
from pathlib import Path

import pytest

from lerobot_constructskill.artifacts.folders import MARK, staged


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
