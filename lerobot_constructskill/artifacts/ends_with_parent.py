"""Imported first by a fork server: the kernel then ends the server together with the process that started it.

A fork server checks for the end of its process only between two requests, and its imports take up to a minute.
"""

from lerobot_constructskill.artifacts.pools import be_killed_with_parent

be_killed_with_parent()
