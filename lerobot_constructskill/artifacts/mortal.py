"""Preloaded first by a fork server: it dies with the process that it serves, also while it still imports the rest.

A fork server looks for its end only between two requests, and what ours imports takes from seconds to a minute.
"""

from lerobot_constructskill.artifacts.pools import be_killed_with_parent

be_killed_with_parent()
