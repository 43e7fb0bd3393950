"""How a stranger's folder is opened: it holds exactly what it should, and says nothing that could be read two ways."""

import os
from collections.abc import Mapping
from pathlib import Path

import yaml

from lerobot_constructskill.errors import InputError, MissingError
from lerobot_constructskill.files import MERGE, Loader, read_bytes


def read_files(root: Path, most: Mapping[str, int]) -> dict[str, bytes]:
    """The bytes of a folder's files, which are to be exactly those of `most`, each of at most so many bytes.

    Raises:
        MissingError: there is no such folder, or one of the files is not in it.
        InputError: something else is in it, a link or a device for instance, or a file is too large.
    """
    if root.is_symlink() or not root.is_dir():
        raise MissingError(f"'{root}' is not the folder of a submission.")
    found = {entry.name: entry for entry in os.scandir(root)}
    if absent := [name for name in most if name not in found]:
        raise MissingError(f"'{root}' is not a submission: {absent[0]} is missing.")
    if others := sorted(set(found) - set(most)):
        raise InputError(f"'{root}' holds {others[0]!a}; a submission is {' and '.join(most)}, and nothing else.")
    return {name: read_bytes(root / name, size, links=False) for name, size in most.items()}


class Plain(Loader):
    """`files.Loader` without tags, anchors, aliases and merged mappings."""

    def compose_node(self, parent, index):
        event = self.peek_event()
        if isinstance(event, yaml.AliasEvent) or event.anchor is not None or getattr(event, "tag", None) is not None:
            raise InputError("tags, anchors and aliases are not read")
        node = super().compose_node(parent, index)
        if node.tag == MERGE:
            raise InputError("mappings are not merged")
        return node
