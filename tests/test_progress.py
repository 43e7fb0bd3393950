"""Bars show every piece of work, and say little in a log."""

import sys
from io import StringIO

import pytest

from lerobot_constructskill import progress


def bar_on(stream: StringIO, monkeypatch: pytest.MonkeyPatch, **options) -> progress.Progress:
    monkeypatch.setattr(sys, "stderr", stream)
    return progress.Progress(file=stream, **options)


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
