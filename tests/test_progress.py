"""Bars that live while they wait, and say little in a log."""

import sys
import time
from io import StringIO

import pytest

from lerobot_constructskill import progress


class Terminal(StringIO):
    def isatty(self) -> bool:
        return True


def bar_on(stream: StringIO, monkeypatch: pytest.MonkeyPatch, **options) -> progress.Progress:
    monkeypatch.setattr(sys, "stderr", stream)
    return progress.Progress(file=stream, **options)


def test_on_a_terminal_the_clock_moves_while_no_piece_of_work_ends(monkeypatch):
    monkeypatch.setattr(progress, "TICK_S", 0.01)
    with bar_on(stream := Terminal(), monkeypatch, total=2):
        begun, deadline = stream.getvalue(), time.monotonic() + 10
        while stream.getvalue().count("\r") < begun.count("\r") + 3:
            assert time.monotonic() < deadline, "it stands still"
            time.sleep(0.01)
    ended = stream.getvalue()
    time.sleep(0.1)
    assert stream.getvalue() == ended, "and stops with the bar"


def test_a_log_gets_few_lines_of_much_work(monkeypatch):
    with bar_on(stream := StringIO(), monkeypatch, total=1000) as bar:
        for _ in range(1000):
            bar.update()
    assert stream.getvalue().count("\r") <= 2 and "1000/1000" in stream.getvalue()


def test_after_a_burst_a_single_piece_shows_too(monkeypatch):
    """tqdm's own rule would wait for as many pieces as came at once before."""
    monkeypatch.setattr(progress, "LOG_INTERVAL_S", 0)
    with bar_on(stream := StringIO(), monkeypatch, total=2000) as bar:
        bar.update(1000)
        bar.update()
        assert "1001/2000" in stream.getvalue()
