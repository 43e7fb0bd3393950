"""What each level of each axis of perturbation changes in each task and what it leaves alone, into benchmarks/AXES.md.

Usage: python benchmarks/axes.py [--task TASK ...]   (the page covers these; all tasks of this package by default)

The expert acts in the task as it is until it has the object in the jaws; then the same actions again with one thing
perturbed. States and pictures are compared to the last bit, and with what the axis is said to change. Where states
differ, or something is added, the expert then acts by itself, without noise, from the board's first starts. It fails
where an axis does not keep to what is said.
"""

import argparse
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from run import machine

from lerobot_constructskill.artifacts.pools import cores, open_pool
from lerobot_constructskill.board.protocol import FIRST_START, steps_of
from lerobot_constructskill.contract import OBS_TYPES, SHIPPED, get_task
from lerobot_constructskill.demos.demonstrate import demonstrate
from lerobot_constructskill.demos.expert import ExpertConfig, make_expert
from lerobot_constructskill.demos.noise import NoiseConfig
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv, perturbed_task
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.perturbations import AXES, BODIES, Perturbation
from lerobot_constructskill.progress import Progress

PAGE = Path(__file__).with_name("AXES.md")
STARTS = range(FIRST_START, FIRST_START + 3)
CAMERAS = OBS_TYPES["pixels_agent_pos"]
GRASPED = 100
"""Steps within which every expert has the object in the jaws; the slowest needs 90 (`brick_to_grey`)."""

ROBOT = ("tcp_pose", "fingers", "joint_positions", "joint_velocities", "finger_forces")


def body_of(name: str) -> str:
    """The body that a name of a state is about."""
    return "robot" if name in ROBOT else "receptacle" if "bin" in name else "object"


def levels(task: str) -> list[tuple[str, int]]:
    """Axes and levels that a task has."""
    every = [(axis, level) for axis, of in AXES.items() for level in range(1, len(of.levels) + 1)]
    return [one for one in every if not is_refused(Perturbation("{}={}".format(*one)).check, get_task(task))]


def seed_of(task: str, axis: str, level: int) -> int:
    """The first seed whose draw a task accepts: a brick may be too large for its bin."""
    return next(seed for seed in range(10) if not is_refused(perturbed_task, task, f"{axis}={level}", seed))


def is_refused(check: Callable[..., Any], *arguments: Any) -> bool:
    try:
        check(*arguments)
    except InputError:
        return True
    return False


@dataclass(frozen=True)
class Seen:
    """An episode: states, one a step and the first before them, pictures likewise, and the instruction."""

    states: list[dict[str, np.ndarray]]
    pictures: list[dict[str, np.ndarray]]
    instruction: str


def replay(actions: Sequence[np.ndarray], task: str, perturb: str = "", seed: int = 0) -> Seen:
    """The episode of the first of `STARTS` under these actions."""
    env = ConstructSkillEnv(task, "pixels_agent_pos", len(actions) + 1, perturb=perturb, perturb_seed=seed)
    seen, _ = env.reset(seed=STARTS[0])
    states, pictures = [state(env)], [seen["pixels"]]
    for action in actions:
        pictures.append(env.step(action)[0]["pixels"])
        states.append(state(env))
    env.close()
    return Seen(states, pictures, env.task_description)


def state(env: ConstructSkillEnv) -> dict[str, np.ndarray]:
    """What experts are told, and pose and velocity of everything else that can move."""
    scene: Any = env.started()
    bodies = scene.get_state_dict()["actors"]
    return env.privileged_state() | {name: body.cpu().numpy() for name, body in bodies.items()}


@dataclass(frozen=True)
class Difference:
    """What differs between two episodes.

    Args:
        at_start, later: bodies whose states differ, of `BODIES`, in the first state, and in any.
        pixels_at_start, pixels_later: share of the pixels that differ, by camera, in the first picture, and in all.
        said: the other instruction; empty where they are equal.
    """

    at_start: set[str]
    later: set[str]
    pixels_at_start: dict[str, float]
    pixels_later: dict[str, float]
    said: str

    @classmethod
    def between(cls, one: Seen, other: Seen) -> "Difference":
        bodies = [
            {body_of(name) for name in a if not np.array_equal(a[name], b[name])}
            for a, b in zip(one.states, other.states, strict=True)
        ]
        pixels = [
            {name: float((a[name] != b[name]).any(axis=-1).mean()) for name in a}
            for a, b in zip(one.pictures, other.pictures, strict=True)
        ]
        all_pixels = {name: float(np.mean([each[name] for each in pixels])) for name in pixels[0]}
        said = other.instruction if other.instruction != one.instruction else ""
        return cls(bodies[0], set().union(*bodies), pixels[0], all_pixels, said)

    def found(self) -> set[str]:
        """What differs, in the words of `perturbations.CHANGEABLE`, if pictures are those of the first state."""
        shown = {name for name, share in self.pixels_at_start.items() if share}
        acts = {"execution"} if self.later and not self.at_start else set()
        return self.at_start | shown | acts | ({"instruction"} if self.said else set())


def complaints(axis: str, seen: Difference) -> Iterator[str]:
    """What `axis` changes though it should not, and whether it does nothing that it should."""
    said = {*AXES[axis].changes}
    follows = {*CAMERAS} if said & {*BODIES} else set()
    for what in sorted(seen.found() - said - follows):
        yield f"{axis} changes {what}"
    if not said & {"execution", *BODIES}:
        for camera in sorted({name for name, share in seen.pixels_later.items() if share} - said):
            yield f"{axis} changes {camera} in the course of the episode"
    if not seen.found() & said:
        yield f"{axis} changes none of {', '.join(AXES[axis].changes)}"


def grasping(task: str, steps: int = GRASPED) -> list[np.ndarray]:
    """The expert's actions without noise until it has the object in the jaws, at most so many."""
    env = ConstructSkillEnv(task, episode_length=steps, render_backend="none")
    frames, _ = demonstrate(env, make_expert(get_task(task), ExpertConfig()), NoiseConfig(sigma=0.0), STARTS[0])
    env.close()
    return [frame["action"] for frame in frames if frame["phase"] in ("PREGRASP", "DESCEND", "GRASP")]


def expert_places(task: str, perturb: str = "", seed: int = 0) -> int:
    """In how many of `STARTS` the expert places without noise."""
    env = ConstructSkillEnv(
        task, episode_length=steps_of(task), render_backend="none", perturb=perturb, perturb_seed=seed
    )
    expert = make_expert(get_task(task), ExpertConfig())
    placed = sum(demonstrate(env, expert, NoiseConfig(sigma=0.0), start)[1] for start in STARTS)
    env.close()
    return placed


@dataclass(frozen=True)
class Level:
    """What a level of an axis does to a task.

    Args:
        seed: of the draw.
        placed: in how many of `STARTS` the expert places.
    """

    task: str
    axis: str
    level: int
    seed: int
    seen: Difference
    placed: int

    @property
    def cells(self) -> str:
        return cells(self.axis, self.level, self.seen)


@dataclass(frozen=True)
class Certificate:
    """What all levels do to a task.

    Args:
        actions: how many were executed again.
        instruction, placed: of the task as it is.
    """

    task: str
    actions: int
    instruction: str
    placed: int
    levels: list[Level]

    @classmethod
    def of(cls, task: str) -> "Certificate":
        actions = grasping(task)
        usual, placed, found = replay(actions, task), expert_places(task), []
        for axis, level in levels(task):
            seed = seed_of(task, axis, level)
            perturbed = task, f"{axis}={level}", seed
            seen = Difference.between(usual, replay(actions, *perturbed))
            acts_otherwise = seen.later or axis == "distractors"
            found.append(Level(task, axis, level, seed, seen, expert_places(*perturbed) if acts_otherwise else placed))
        return cls(task, len(actions), usual.instruction, placed, found)


def cells(axis: str, level: int, seen: Difference) -> str:
    """The beginning of a row of the first table, which a test measures again."""
    states = [", ".join(body for body in BODIES if body in each) or "equal" for each in (seen.at_start, seen.later)]
    instruction = "another" if seen.said else "equal"
    return f"| {' | '.join([f'`{axis}`', str(level), ', '.join(AXES[axis].changes), instruction, *states])} |"


def sentences(task: str, actions: int, instruction: str, said: Iterable[str]) -> str:
    """The beginning of a row of the second table, which a test measures again."""
    return f"| {' | '.join([f'`{task}`', str(actions), instruction, *said])} |"


def rows(certificates: Sequence[Certificate]) -> Iterator[str]:
    """A row for each level, or several where its cells differ from task to task."""
    every = [one for each in certificates for one in each.levels]
    in_order = sorted(every, key=lambda one: ([*AXES].index(one.axis), one.level))
    for own in dict.fromkeys(one.cells for one in in_order):
        alike = [one for one in every if one.cells == own]
        names = [f"`{one.task}`" + f" (seed {one.seed})" * (one.seed > 0) for one in alike]
        is_all = len(alike) == len(certificates) and not any(one.seed for one in alike)
        failing = [f"`{one.task}` {one.placed}" for one in alike if one.placed < len(STARTS)]
        placed = f"{sum(one.placed for one in alike)} of {len(STARTS) * len(alike)}"
        yield " | ".join(
            [
                f"{own} {span(one.seen.pixels_at_start for one in alike)}",
                span(one.seen.pixels_later for one in alike),
                f"{placed}: {', '.join(failing)}" if failing else placed,
                f"{'all' if is_all else ', '.join(names)} |",
            ]
        )


def span(shares: Iterable[dict[str, float]]) -> str:
    """Shares of pixels in per cent from the least to the most, by camera."""
    each = list(shares)
    ends = ([f"{100 * end(one[camera] for one in each):.3g}" for end in (min, max)] for camera in CAMERAS)
    return " / ".join(" to ".join(dict.fromkeys(low_high)) for low_high in ends)


def page(certificates: Sequence[Certificate]) -> str:
    says = [one for one in certificates[0].levels if "instruction" in AXES[one.axis].changes]
    heads = [f"`{one.axis}={one.level}`" for one in says]
    told = []
    for one in certificates:
        said = (level.seen.said for level in one.levels if level.seen.said)
        told.append(f"{sentences(one.task, one.actions, one.instruction, said)} {one.placed} |")
    return (
        "# What each axis changes\n\nMade by `python benchmarks/axes.py` for "
        f"{len(certificates)} of the {len(SHIPPED)} tasks: {', '.join(f'`{one.task}`' for one in certificates)}. "
        "In each, the actions with which the expert grasps in the task as it is are executed again with one thing "
        "perturbed. States are compared to the last bit, at the start and in all steps: `equal`, or the bodies that "
        "differ. Pixels are those that differ, of the base and of the wrist camera, from the least to the most of the "
        "tasks; where bodies move otherwise, pictures differ too. The expert acts by itself, without noise, from "
        f"{len(STARTS)} starts a task: episodes placed, and where it failed, how many of {len(STARTS)}. It sees "
        "states alone, and is not run again where these are equal and nothing is added. Where a task refuses the "
        "brick that seed 0 draws, the first seed is taken whose brick fits.\n\n"
        f"{machine()}\n\n"
        "| axis | level | is said to change | instruction | state at the start | state later | "
        "pixels at the start, % | pixels, all steps, % | expert | tasks |\n"
        f"|---|---:|---|---|---|---|---:|---:|---|---|\n{'\n'.join(rows(certificates))}\n\n"
        f"How many actions are executed again, what is said, and what the expert places of {len(STARTS)} in the task "
        "as it is:\n\n"
        f"| task | actions | as it is | {' | '.join(heads)} | expert |\n|---|---:|---|{'---|' * len(heads)}---:|\n"
        f"{'\n'.join(told)}\n"
    )


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--task", nargs="+", default=[*SHIPPED])
    tasks = parser.parse_args().task
    with open_pool("processes", cores()) as submit:
        begun = [submit(Certificate.of, task) for task in tasks]
        certificates = [one.result() for one in Progress(begun, desc="axes", unit="task")]
    PAGE.write_text(page(certificates), encoding="utf-8")
    every = [one for each in certificates for one in each.levels]
    if wrong := [f"{one.task}: {what}" for one in every for what in complaints(one.axis, one.seen)]:
        sys.exit(f"Not as said: {'; '.join(wrong)}.")


if __name__ == "__main__":
    main()
