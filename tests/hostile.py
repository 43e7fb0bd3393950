"""What a file may be that somebody edited, a full disk tore, or a stranger sent: a reader refuses it, or reads it."""

import os
from collections.abc import Callable
from pathlib import Path

TEXTS = {
    "empty": "",
    "half an object": '{"a": [1, 2',
    "junk": "{junk",
    "a list": "[]",
    "an empty object": "{}",
    "null": "null",
    "text": '"x"',
    "a number": "3",
    "depth": "[" * 100_000,
    "depth of objects": '{"a": ' * 100_000,
    "depth that closes": "[" * 900 + "]" * 900,
    "digits": '{"a": ' + "9" * 100_000 + "}",
    "half a character": r'{"a": "\ud800"}',
    "half a name": r'{"\udfff": 1}',
    "a name twice": '{"a": 1, "a": 2}',
    "nothing but nulls": "\0" * 1000,
    "many objects": "[" + "{}," * 1_000_000 + "{}]",
    "many lists": "[" + "[]," * 2_500_000 + "[]]",
    "megabytes": " " * (20 << 20),
}
BYTES = {name: text.encode() for name, text in TEXTS.items()} | {
    "another encoding": '{"a": "é"}'.encode("latin-1"),
    "a mark and nothing": b"\xef\xbb\xbf",
    "no text": bytes(range(256)),
}


def _writer(content: bytes) -> Callable[[Path], object]:
    return lambda path: path.write_bytes(content)


def _instead(make: Callable[[Path], object]) -> Callable[[Path], object]:
    def put(path: Path) -> None:
        path.unlink(missing_ok=True)
        make(path)

    return put


def truncate(path: Path) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])


NOT_FILES: dict[str, Callable[[Path], object]] = {
    "a pipe": _instead(os.mkfifo),
    "a folder": _instead(Path.mkdir),
    "a device": _instead(lambda path: path.symlink_to("/dev/zero")),
    "a link to nothing": _instead(lambda path: path.symlink_to(path.with_name("nothing"))),
    "a link to itself": _instead(lambda path: path.symlink_to(path)),
}
WAYS = {name: _writer(content) for name, content in BYTES.items()} | NOT_FILES
"""Name to what makes that of a file, which need not be there."""
