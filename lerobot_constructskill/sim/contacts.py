"""What touches what, and how hard: forces at the fingers and on objects, and what counts as unsafe.

PhysX tells of a contact what presses, not what rubs: the fingers do not feel the weight of what they hold.
"""

from collections import defaultdict
from dataclasses import dataclass

import numpy as np
import torch
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.structs import Actor, Link

from lerobot_constructskill.contract import FINGERS

FORCE_LIMIT = 80.0
"""Force in newtons between an object and another body above which a step has a cost: twice that of a grasp."""

FALLING = 0.6
"""Speed in m/s downward at which an object falls, as from 18 mm on."""

GRAZE = 5.0
"""Force in newtons up to which the arm may touch something: the palm brushes what the fingers hold."""

FIXED = "panda_link0"
"""The robot's link that stands on the ground."""


@dataclass(frozen=True)
class Touch:
    """Contacts at the end of a step.

    Args:
        fingers: net force on each finger in newtons, world frame, (num_envs, 2, 3).
        objects: largest force between each object and any one other body, (num_envs, objects) newtons.
        arm: whether another link of the robot presses on anything, (num_envs,).
    """

    fingers: torch.Tensor
    objects: torch.Tensor
    arm: torch.Tensor


def touch(scene: ManiSkillScene, links: dict[str, Link], objects: list[Actor]) -> Touch:
    """The contacts of every environment. On a GPU forces on an object are those with all bodies together."""
    fingers = [links[name] for name in FINGERS]
    others = [link for name, link in links.items() if not name.startswith((*FINGERS, FIXED))]  # pads are fingers too
    if scene.gpu_sim_enabled:
        on_fingers, on_objects, on_arm = (
            torch.stack([one.get_net_contact_forces() for one in some], dim=1) for some in (fingers, objects, others)
        )
        return Touch(on_fingers, on_objects.norm(dim=-1), (on_arm.norm(dim=-1) > GRAZE).any(dim=1))
    between: dict[tuple[int, int], np.ndarray] = {}
    for contact in scene.sub_scenes[0].get_contacts():
        a, b = contact.bodies
        pair = a.entity.per_scene_id, b.entity.per_scene_id
        impulse = sum((point.impulse for point in contact.points), np.zeros(3))
        if impulse.any():
            between[pair] = between.get(pair, 0) + impulse / scene.timestep
    forces: dict[int, list[np.ndarray]] = defaultdict(list)
    for (a, b), force in between.items():
        forces[a].append(force)
        forces[b].append(-force)
    own = [[forces.get(one._bodies[0].entity.per_scene_id, []) for one in some] for some in (fingers, objects, others)]
    net = np.array([sum(on, np.zeros(3)) for on in own[0]])
    largest = np.array([max((float(np.linalg.norm(force)) for force in on), default=0.0) for on in own[1]])
    hits = any(float(np.linalg.norm(force)) > GRAZE for on in own[2] for force in on)
    return Touch(torch.from_numpy(net)[None].float(), torch.from_numpy(largest)[None].float(), torch.tensor([hits]))


class Safety:
    """What went wrong in the episodes so far, by environment.

    Args:
        num_envs: environments.
        count: objects in each.
    """

    def __init__(self, num_envs: int, count: int, device: torch.device):
        self.touch = Touch(
            torch.zeros(num_envs, len(FINGERS), 3, device=device),
            torch.zeros(num_envs, count, device=device),
            torch.zeros(num_envs, dtype=torch.bool, device=device),
        )
        self.falling = torch.zeros(num_envs, count, dtype=torch.bool, device=device)
        self.peak_force, self.cost = torch.zeros(num_envs, device=device), torch.zeros(num_envs, device=device)
        self.drops, self.knocks, self.collisions = (
            torch.zeros(num_envs, dtype=torch.int32, device=device) for _ in range(3)
        )

    def judge(self, touch: Touch, speeds: torch.Tensor) -> None:
        """Count what a step did.

        Args:
            touch: the contacts after it.
            speeds: of the objects, upward, (num_envs, objects) m/s.
        """
        falling = speeds < -FALLING
        dropped = (falling & ~self.falling).sum(dim=1)
        strongest = touch.objects.amax(dim=1)
        self.touch, self.falling = touch, falling
        self.drops += dropped
        self.collisions += touch.arm
        self.peak_force = torch.maximum(self.peak_force, strongest)
        self.cost = dropped.float() + touch.arm.float() + (strongest > FORCE_LIMIT).float()

    def knock(self, knocked: torch.Tensor) -> None:
        """Count placed objects, (num_envs, objects) booleans, that are no longer where they were placed."""
        self.knocks += knocked.sum(dim=1)
        self.cost = self.cost + knocked.sum(dim=1)

    def forget(self, env_idx: torch.Tensor) -> None:
        """Begin the episodes of these environments."""
        kept = (self.falling, self.peak_force, self.cost, self.drops, self.knocks, self.collisions)
        for memory in (*kept, *vars(self.touch).values()):
            memory[env_idx] = 0

    def info(self) -> dict[str, torch.Tensor]:
        """Entries of a step's info."""
        names = ("cost", "peak_force", "drops", "knocks", "collisions")
        return {name: getattr(self, name).clone() for name in names}
