"""What each level of each axis of perturbation changes and what it leaves alone, into benchmarks/AXES.md.

Usage: python benchmarks/axes.py

One episode of the task as it is, in which the expert places the brick; then the same actions again with one thing
perturbed. States and pictures are compared to the last bit, and with what the axis is said to change. The expert then
acts by itself, without noise, from the board's first starts. It fails where an axis does not keep to what is said.
"""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from run import machine

from lerobot_constructskill.board.protocol import FIRST_START, HORIZON, PERTURBED_TASK
from lerobot_constructskill.contract import OBS_TYPES, get_task
from lerobot_constructskill.demos.demonstrate import demonstrate
from lerobot_constructskill.demos.expert import ExpertConfig, make_expert
from lerobot_constructskill.demos.noise import NoiseConfig
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
from lerobot_constructskill.perturbations import AXES, BODIES
from lerobot_constructskill.progress import Progress

PAGE = Path(__file__).with_name("AXES.md")
STARTS = range(FIRST_START, FIRST_START + 20)
CAMERAS = OBS_TYPES["pixels_agent_pos"]


def body_of(name: str) -> str:
    """The body that a name of the privileged state is about."""
    if name.startswith("bin_"):
        return "receptacle"
    return "object" if name.startswith(("object_", "is_", "placement")) else "robot"


@dataclass(frozen=True)
class Seen:
    """An episode: privileged states, one a step and the first before them, pictures likewise, and the instruction."""

    states: list[dict[str, np.ndarray]]
    pictures: list[dict[str, np.ndarray]]
    instruction: str


def replay(actions: Sequence[np.ndarray], perturb: str = "", task: str = PERTURBED_TASK) -> Seen:
    """The episode of the first of `STARTS` under these actions."""
    env = ConstructSkillEnv(task, "pixels_agent_pos", perturb=perturb, episode_length=len(actions) + 1)
    seen, _ = env.reset(seed=STARTS[0])
    states, pictures = [env.privileged_state()], [seen["pixels"]]
    for action in actions:
        pictures.append(env.step(action)[0]["pixels"])
        states.append(env.privileged_state())
    env.close()
    return Seen(states, pictures, env.task_description)


@dataclass(frozen=True)
class Difference:
    """What differs between two episodes.

    Args:
        at_start, later: bodies whose states differ, of `BODIES`, in the first state, and in any.
        pixels_at_start, pixels_later: share of the pixels that differ, by camera, in the first picture, and in all.
        instruction: whether the instructions differ.
    """

    at_start: set[str]
    later: set[str]
    pixels_at_start: dict[str, float]
    pixels_later: dict[str, float]
    instruction: bool

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
        return cls(bodies[0], set().union(*bodies), pixels[0], all_pixels, one.instruction != other.instruction)

    def found(self) -> set[str]:
        """What differs, in the words of `perturbations.CHANGEABLE`, if pictures are those of the first state."""
        shown = {name for name, share in self.pixels_at_start.items() if share}
        acts = {"execution"} if self.later and not self.at_start else set()
        return self.at_start | shown | acts | ({"instruction"} if self.instruction else set())


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


def expert_places(perturb: str, task: str = PERTURBED_TASK) -> tuple[int, list[np.ndarray]]:
    """How many of `STARTS` the expert places without noise, and its actions in the first episode."""
    env = ConstructSkillEnv(task, perturb=perturb, episode_length=HORIZON, render_backend="none")
    expert = make_expert(get_task(task), ExpertConfig())
    episodes = [demonstrate(env, expert, NoiseConfig(sigma=0.0), seed) for seed in STARTS]
    env.close()
    return sum(success for _, success in episodes), [frame["dart.executed_action"] for frame in episodes[0][0]]


def row(axis: str, level: int, seen: Difference, placed: int) -> str:
    shares = (
        " / ".join(f"{100 * shares[camera]:.3g}" for camera in CAMERAS)
        for shares in (seen.pixels_at_start, seen.pixels_later)
    )
    states = (
        ", ".join(body for body in BODIES if body in bodies) or "equal" for bodies in (seen.at_start, seen.later)
    )
    instruction = "another" if seen.instruction else "equal"
    cells = f"`{axis}`", level, ", ".join(AXES[axis].changes), *states, *shares, instruction, placed
    return f"| {' | '.join(map(str, cells))} |"


def main() -> None:
    usual, actions = expert_places("")
    nominal = replay(actions)
    levels = [(axis, level) for axis, of in AXES.items() for level in range(1, len(of.levels) + 1)]
    rows, wrong = [], []
    for axis, level in Progress(levels, desc="axes", unit="level"):
        seen = Difference.between(nominal, replay(actions, f"{axis}={level}"))
        wrong += complaints(axis, seen)
        rows.append(row(axis, level, seen, expert_places(f"{axis}={level}")[0]))
    head = (
        f"# What each axis changes\n\nMade by `python benchmarks/axes.py` in `{PERTURBED_TASK}`: {len(actions)} "
        "actions, with which the expert places in the task as it is, executed again with one thing perturbed. The "
        "privileged states are compared to the last bit, at the start and in all steps. Pixels are those that "
        "differ, of the base and of the wrist camera; where bodies move otherwise, pictures differ too. In the last "
        f"column the expert acts by itself, without noise: episodes placed of {len(STARTS)}, and {usual} of the task "
        f"as it is.\n\n{machine()}\n\n"
        "| axis | level | is said to change | state at the start | state later | pixels at the start, % | "
        "pixels, all steps, % | instruction | expert |\n|---|---:|---|---|---|---:|---:|---|---:|\n"
    )
    PAGE.write_text(head + "\n".join(rows) + "\n", encoding="utf-8")
    if wrong:
        sys.exit(f"Not as said: {'; '.join(wrong)}.")


if __name__ == "__main__":
    main()
