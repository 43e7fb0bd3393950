"""Demonstrations as a node of a store."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lerobot_constructskill.artifacts.store import Machine, Node
from lerobot_constructskill.demos.recorder import SHARDS, check_disk, write
from lerobot_constructskill.demos.settings import GenerateConfig, frame_facts, frame_versions, generator_facts
from lerobot_constructskill.envs.gym_env import resolve_rendering


@dataclass(frozen=True, eq=False)
class Demonstrations(Node):
    """A data set of scripted demonstrations.

    Args:
        config: what it is generated from. Its names, its root, its executor and its workers are no part of the node.
    """

    config: GenerateConfig

    kind = "demonstrations"
    keeps = SHARDS

    @property
    def starts(self) -> range:
        """Seeds of the initial states."""
        return self.config.starts

    def facts(self) -> dict[str, Any]:
        facts = generator_facts(self.config)
        del facts["repo_id"], facts["max_failures"]
        light_robot, backend = resolve_rendering(self.config.light_robot)
        return facts | frame_facts(self.config) | {"light_robot": light_robot, "render_backend": backend}

    def versions(self) -> dict[str, str]:
        return frame_versions(self.config)

    def make(self, folder: Path, inputs: Mapping[str, Path], machine: Machine) -> None:
        """Generate the demonstrations. Raises as `recorder.record` does."""
        config = replace(self.config, repo_id=self.repo_id, workers=machine.workers)
        check_disk(config, folder)
        write(config, folder)
