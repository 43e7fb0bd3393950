"""Checks of a data set of demonstrations: each reads it as tables and yields a sentence for each thing that is wrong.

`CHECKS` names the checks. Noise is not judged by its spread alone: it is a function of the seed, so it is drawn again.
"""

import json
import operator
from collections.abc import Callable, Iterator, Mapping, Sized
from typing import Any

import numpy as np

from lerobot_constructskill.contract import (
    ACTION_SCALE,
    DEMO_SEED_START,
    FPS,
    GRIPPER_CLOSED,
    GRIPPER_OPEN,
    REWARD_LIFTED,
    REWARD_PLACED,
    SIM_STATE,
    TASK_NAME,
    TRANSLATION,
)
from lerobot_constructskill.dataset.dataset import DataSet, TaskBlock, check_provenance_fields
from lerobot_constructskill.dataset.frames import FRAME_CHECKS
from lerobot_constructskill.dataset.language import check_language
from lerobot_constructskill.demos.columns import ACTORS, EXPERT
from lerobot_constructskill.demos.expert import Phase, PrivilegedState, make_expert
from lerobot_constructskill.demos.merge import frame_statistics
from lerobot_constructskill.demos.metadata import MODALITY, file_hashes
from lerobot_constructskill.demos.noise import execute
from lerobot_constructskill.demos.settings import FRAME_PACKAGES
from lerobot_constructskill.errors import InputError, UserError, plural
from lerobot_constructskill.progress import Progress

type Check = Callable[[DataSet], Iterator[str]]

BOOKKEEPING = {"timestamp", "frame_index", "episode_index", "index", "task_index"}
REACH = 1.2
"""Farthest that the Panda's end effector gets from its base, in metres."""

RESPONSE = (0.15, 0.8)
"""Displacement of the end effector for each metre asked for; over whole demonstrations it is 0.30 to 0.36."""

HARDLY_ASKED = 0.1
"""An axis that is asked for less than this share of the strongest one moves by the arm's sag: no response to judge."""


def _found(complaints: Mapping[str, Any]) -> Iterator[str]:
    """The sentences whose conditions hold, in their order."""
    return (said for said, is_wrong in complaints.items() if is_wrong)


def check_files(data: DataSet) -> Iterator[str]:
    recorded, found = data.facts["sha256"], file_hashes(data.root)
    yield from (f"{name} is missing." for name in sorted(recorded.keys() - found.keys()))
    yield from (f"{name} was added after the generation." for name in sorted(found.keys() - recorded.keys()))
    changed = sorted(name for name in recorded.keys() & found.keys() if recorded[name] != found[name])
    yield from (f"{name} is not the file that was generated: its SHA-256 differs." for name in changed)


def check_schema(data: DataSet) -> Iterator[str]:
    try:
        check_provenance_fields(data.facts)
    except InputError as error:
        yield str(error)
    features, wanted = data.info["features"], json.loads(json.dumps(data.columns))
    yield from (f"info.json has no feature {name}." for name in sorted(wanted.keys() - features.keys()))
    for name in sorted(features.keys() - wanted.keys() - BOOKKEEPING):
        yield f"info.json has the feature {name}, which is not of the contract and which a policy may read."
    for name in wanted.keys() & features.keys():
        for part in ("dtype", "shape", "names"):
            if features[name].get(part) != wanted[name][part]:
                yield f"{name} has {part} {features[name].get(part)}, not {wanted[name][part]}."
    stored = {name for name, feature in wanted.items() if feature["dtype"] != "video"} | BOOKKEEPING
    for name in sorted(stored ^ set(data.rows.columns)):
        yield f"data/ {'has no' if name in stored else 'has an unknown'} column {name}."
    told = _instructions(data)
    yield from _found(
        {
            f"info.json says {data.info.get('fps')} frames a second, not {FPS}.": data.info.get("fps") != FPS,
            f"The instructions are {data.tasks}, not {told}.": data.tasks != told,
        }
    )


def _instructions(data: DataSet) -> list[str]:
    """The instructions of the tasks in their order, each once."""
    return list(dict.fromkeys(block.task.instruction for block in data.blocks))


def check_values(data: DataSet) -> Iterator[str]:
    for name, feature in data.info["features"].items():
        if feature["dtype"] == "float32":
            off = ~np.isfinite(data.column(name)).reshape(len(data.rows), -1).all(axis=1)
            yield from _found({f"{name} is not finite in {plural(off.sum(), 'frame')}.": off.any()})
    experts = data.rounds == 0  # a learner's action is bounded by the environment alone
    limits = {"action": ACTION_SCALE, "dart.executed_action": np.where(experts, data.config.noise.clip, ACTION_SCALE)}
    for name, limit in limits.items():
        sizes, axes, most = np.abs(data.column(name)[:, :-1]), len(TRANSLATION), np.max(limit)
        largest, turned = sizes[:, :axes].max(axis=1), sizes[:, axes:].max(initial=0)
        odd = ~np.isin(data.column(name)[:, -1], (GRIPPER_OPEN, GRIPPER_CLOSED)) & (experts | (name == "action"))
        units = f"{name} reaches {largest.max():.4g} where {most} m a step is the most: these are other units."
        turns = f"{name} turns by {turned:.4g} where {ACTION_SCALE} rad a step is the most: these are other units."
        gripper = f"{name} has a gripper that is neither +1 nor -1 in {plural(odd.sum(), 'frame')}."
        too_far, too_much = (largest > limit + 1e-6).any(), turned > ACTION_SCALE + 1e-6
        yield from _found({units: too_far, turns: too_much, gripper: odd.any()})
    state, rewards = data.column("observation.state"), (0, REWARD_LIFTED, REWARD_PLACED)
    reach, fingers = np.linalg.norm(state[:, :3], axis=1).max(), state[:, 6:8]
    yield from _found(
        {
            f"observation.state has positions beyond the robot's reach of {REACH} m.": reach > REACH,
            "observation.state has finger positions outside 0 to 0.04 m.": not (
                (fingers > -0.001) & (fingers < 0.041)
            ).all(),
            f"next.reward is not one of {rewards} everywhere.": not np.isin(data.column("next.reward"), rewards).all(),
        }
    )


def check_units(data: DataSet) -> Iterator[str]:
    """The arm answers a command in metres and in the base frame: its displacement is a part of it, with its sign."""
    executed, position = data.column("dart.executed_action")[:, :3], data.column("observation.state")[:, :3]
    inner = (np.diff(data.column("episode_index")) == 0) & (np.abs(executed[:-1]).max(axis=1) > 0)
    inner &= data.rounds[:-1] == 0  # a learner pushes against things
    asked, moved = executed[:-1][inner], np.diff(position, axis=0)[inner]
    strength, (low, high) = np.sqrt((asked**2).mean(axis=0)), RESPONSE
    response = (asked * moved).sum(axis=0) / ((asked**2).sum(axis=0) + 1e-12)
    for axis in np.flatnonzero(strength >= HARDLY_ASKED * strength.max()):
        if not low <= response[axis] <= high:
            yield (
                f"The end effector moves {response[axis]:.3g} m in {'xyz'[axis]} for a metre asked for, not {low} to "
                f"{high} m."
            )


def check_noise(data: DataSet) -> Iterator[str]:
    config, experts = data.config, data.rounds == 0
    executed, added = data.column("dart.executed_action"), data.column("dart.noise")
    clean = executed.copy()
    clean[:, :3] -= added
    wanted = (executed if config.labels == "executed" else clean).copy()
    if config.labels == "advice":
        wanted[experts] = _advice(data, np.flatnonzero(experts))
    off = np.abs(data.column("action") - wanted)
    if off[experts].max(initial=0) > 1e-6 or off[:, :3].max() > 1e-6:
        yield f"action is not the {config.labels} action that the provenance says its labels are."
    phases, drawn = data.column("phase"), executed.copy()
    for span in (span for span in data.spans() if experts[span.start]):
        rng = np.random.default_rng(int(data.column("sim.seed")[span.start]))
        for row in range(span.start, span.stop):
            drawn[row] = execute(clean[row], phases[row], config.noise, rng)
    off = np.abs(drawn - executed).max(axis=1) > 1e-6
    for phase in Phase:
        rows = (phases == phase) & experts
        if off[rows].any():
            spread = ", ".join(f"{1000 * value:.1f}" for value in added[rows].std(axis=0))
            model = config.noise.model
            yield f"The noise in {phase} (std {spread} mm) is not what the {model} model draws from the seed."


def _advice(data: DataSet, rows: np.ndarray) -> np.ndarray:
    """The actions that the expert advises in some frames, (n, channels)."""
    experts = {block.task.name: make_expert(block.task, data.config.expert) for block in data.blocks}
    asked = [experts[data.task_of(episode).name] for episode in data.column("episode_index")[rows]]
    return np.array([expert.advise(_state(data, row)).action for expert, row in zip(asked, rows, strict=True)])


def _state(data: DataSet, row: int) -> PrivilegedState:
    known = [name for name in SIM_STATE if f"sim.{name}" in data.columns]
    return PrivilegedState(**{name: np.atleast_1d(data.column(f"sim.{name}")[row]) for name in known})


def check_episodes(data: DataSet) -> Iterator[str]:
    spans, rows = data.spans(), len(data.rows)
    indices = [int(data.column("episode_index")[span.start]) for span in spans]
    if indices != list(range(len(data.episodes))):
        yield f"The rows have the episodes {_few(indices)}, the metadata {len(data.episodes)}."
    for span, (_, episode) in zip(spans, data.episodes.iterrows(), strict=False):
        yield from _check_episode(data, span, f"Episode {episode['episode_index']}", episode)
    yield from _check_tasks(data)
    counts = {"total_episodes": len(spans), "total_frames": rows, "total_tasks": len(data.tasks)}
    uncounted = "index does not count the frames of the data set one by one."
    yield from _found(
        {uncounted: not np.array_equal(data.column("index"), np.arange(rows))}
        | {
            f"info.json says {name} is {data.info.get(name)}, but there are {count}.": data.info.get(name) != count
            for name, count in counts.items()
        }
    )


def _check_tasks(data: DataSet) -> Iterator[str]:
    """Every frame has its task's instruction, and in a set of several tasks every episode its task's name."""
    instructions = _instructions(data)
    episodes, place = np.unique(data.column("episode_index"), return_inverse=True)
    wanted = np.array([instructions.index(data.task_of(episode).instruction) for episode in episodes])
    other = data.column("task_index") != wanted[place]
    said = f"task_index is of another instruction than the episode's in {plural(other.sum(), 'frame')}."
    named, is_one = data.episodes.get(TASK_NAME), len(data.blocks) == 1
    is_named = named is None if is_one else named is not None and named.tolist() == data.task_names
    unnamed = f"meta/episodes/ must have {'no ' if is_one else ''}{TASK_NAME}, the name of each episode's task."
    yield from _found({said: other.any(), unnamed: not is_named})


def _check_episode(data: DataSet, span: slice, who: str, episode) -> Iterator[str]:
    length, is_round = span.stop - span.start, data.rounds[span.start] > 0
    done, success = data.column("next.done")[span], data.column("next.success")[span]
    place, phases = (episode["dataset_from_index"], episode["dataset_to_index"]), data.column("phase")[span]
    counted = np.array_equal(data.column("frame_index")[span], np.arange(length))
    yield from _found(
        {
            f"{who} has a gap: frame_index does not count its {length} frames.": not counted,
            f"{who} has rows {span.start} to {span.stop}, its metadata have others.": place != (span.start, span.stop),
            f"{who} has frames of several seeds.": len(set(data.column("sim.seed")[span])) > 1,
            f"{who} goes on after its end, or ends before its last frame.": done[:-1].any() or not done[-1],
            f"{who} of a round goes on after its success.": is_round and success[:-1].any(),
            f"{who} does not go through the six phases in order.": not is_round
            and not _are_in_order(data, span.start, phases),
            f"{who} does not end in success.": not is_round and not success[-1],
        }
    )


def _are_in_order(data: DataSet, first: int, phases: np.ndarray) -> bool:
    """Whether a demonstration, whose first row is given, goes through the six phases.

    It begins with the second one where the hand is above the object from the start.
    """
    found, wanted = [*dict.fromkeys(phases)], [*Phase]
    if found == wanted:
        return True
    if found[0] != wanted[1] or [phase for phase in found if phase != wanted[0]] != wanted[1:]:
        return False
    state = _state(data, first)
    expert = make_expert(data.task_of(data.column("episode_index")[first]), data.config.expert)
    return expert.act(state, expert.start(state))[1] == wanted[1]


def check_timestamps(data: DataSet) -> Iterator[str]:
    off = np.abs(data.column("timestamp") - data.column("frame_index") / FPS)
    if off.max() > 1e-4:
        yield f"{(off > 1e-4).sum()} time stamps are not frame_index / {FPS}, the worst by {off.max():.4f} s."


def check_duplicates(data: DataSet) -> Iterator[str]:
    """Noisy demonstrations never repeat one another; frames never stand still while a moving arm is told to move.

    A learner does repeat itself in a task whose initial state is always the same. Two tasks that differ only in the
    size of the bin can have the same actions from one seed, in other pictures.
    """
    executed, bins, seen = data.column("dart.executed_action"), data.column("sim.bin_interior"), {}
    for episode, span in enumerate(data.spans() if data.config.noise.root.any() else ()):
        first = seen.setdefault((executed[span].tobytes(), bins[span.start].tobytes()), episode)
        if first != episode and data.rounds[span.start] == 0:
            yield f"Episode {episode} repeats episode {first}."
    still = (np.diff(data.column("observation.state"), axis=0) == 0).all(axis=1)
    still &= (np.diff(data.column("episode_index")) == 0) & (np.abs(executed[:-1, :3]).max(axis=1) > 0.005)
    if still.any():
        first = still.argmax() + 1
        yield f"The state stays the same in {plural(still.sum(), 'frame')} though the arm should move, first {first}."


def check_hold_out(data: DataSet) -> Iterator[str]:
    """Holding out whole episodes separates seeds: none makes two episodes of a task, and none is an evaluation's."""
    found = data.column("sim.seed")[[span.start for span in data.spans()]]
    counted = [np.unique(found[_there(block, found)], return_counts=True) for block in data.blocks]
    twice = np.unique(np.concatenate([seeds[counts > 1] for seeds, counts in counted]))
    low = np.unique(found[found < DEMO_SEED_START])
    yield from _found(
        {
            f"Seeds {_few(twice)} made several episodes, so holding one out does not hold it out.": len(twice),
            f"Seeds {_few(low)} are below {DEMO_SEED_START}: evaluations use those.": len(low),
        }
    )


def check_statistics(data: DataSet) -> Iterator[str]:
    for name, wanted in frame_statistics(data.root).items():
        told = of_name if isinstance(of_name := data.stats.get(name), dict) else {}
        yield from (f"stats.json has no {statistic} of {name}." for statistic in wanted if told.get(statistic) is None)
        for statistic, value in wanted.items():
            if told.get(statistic) is not None and not _is_close(told[statistic], value):
                yield f"stats.json has {statistic} {told[statistic]} of {name}; of the frames it is {value.tolist()}."
    for camera in data.cameras:
        if not {"mean", "std", "q01", "q99"} <= data.stats.get(camera, {}).keys():
            yield f"stats.json lacks the mean, std or quantiles of {camera}."
        several = data.episodes[data.episodes["length"] > 1]  # LeRobot has none of a single frame
        without = several["episode_index"][several.get(f"stats/{camera}/mean", several["length"]).isna()]
        if len(without):
            yield f"Episodes {_few(without)} have no statistics of {camera}: LeRobot gave up their video."


def check_provenance(data: DataSet) -> Iterator[str]:
    drawn, told = data.config.noise.root @ data.config.noise.root, data.facts["noise_covariance"]
    missing = ", ".join(sorted(set(FRAME_PACKAGES) - data.facts["versions"].keys()))
    yield from check_rounds(data)
    for block in data.blocks:
        yield from _check_attempts(data, block)
    yield from _found(
        {
            f"noise_covariance is {told}; of the settings it is {drawn.tolist()}.": not _is_close(told, drawn),
            f"The versions of {missing} are not recorded.": missing,
            "Whether the light robot was drawn is not recorded.": data.config.light_robot is None,
            f"{MODALITY} is missing.": not (data.root / MODALITY).is_file(),
        }
    )


def _check_attempts(data: DataSet, block: TaskBlock) -> Iterator[str]:
    spans = data.spans()
    starts = [spans[episode].start for episode in _there(block, spans)]
    seeds = data.column("sim.seed")[starts][data.rounds[starts] == 0].tolist()
    attempts = range(data.config.seed_start, data.config.seed_start + block.attempts)
    of = f" of {block.task.name}" if len(data.blocks) > 1 else ""
    yield from _found(
        {
            f"The seeds of the episodes{of} and the discarded ones are not those of the attempts, one by one.": (
                not _counts(sorted([*seeds, *block.discarded_seeds]), attempts)
            ),
            f"The episodes{of} are not in the order of their seeds.": seeds != sorted(seeds),
        }
    )


def _there(block: TaskBlock, found: Sized) -> list[int]:
    """The indices of a task's episodes that are among those found."""
    return [episode for episode in block.episodes if episode < len(found)]


def check_rounds(data: DataSet) -> Iterator[str]:
    """Compare rounds, actors and seeds of DAgger's frames with the provenance; demonstrations alone have none."""
    if "dagger" not in data.facts:
        return
    actors, listed = data.column("dagger.actor"), data.facts["dagger"]["rounds"]
    by_expert = actors == EXPERT
    unknown = set(data.rounds) - {0} - {entry["round"] for entry in listed}
    off = np.abs(data.column("dart.executed_action") - data.column("action"))[by_expert & (data.rounds > 0)]
    yield from _found(
        {
            f"dagger.actor is not one of {', '.join(ACTORS)} everywhere.": not np.isin(actors, ACTORS).all(),
            "Somebody other than the expert acts in a demonstration.": not by_expert[data.rounds == 0].all(),
            "The rounds of the frames are not those of the provenance, one after another.": (
                unknown or (np.diff(data.rounds) < 0).any()
            ),
            "Frames of a round in which the expert acted do not execute its action.": off.max(initial=0) > 1e-6,
        }
    )
    episodes, place = np.unique(data.column("episode_index"), return_inverse=True)
    of_task = np.array([data.task_of(episode).name for episode in episodes])[place]
    for entry in listed:
        number, first, rows = entry["round"], entry["seed_start"], data.rounds == entry["round"]
        rows = rows & (of_task == entry.get("task", of_task))  # of several tasks, a round is listed for each
        which = f"round {number}" + (f" of {entry['task']}" if "task" in entry else "")
        counts, told = (int(rows.sum()), int(by_expert[rows].sum())), (entry["frames"], entry["by_expert"])
        seeds = sorted([*np.unique(data.column("sim.seed")[rows]).tolist(), *entry["discarded_seeds"]])
        yield from _found(
            {
                f"{which.capitalize()} has {counts[0]} frames, {counts[1]} by the expert; its provenance says "
                f"{told[0]} and {told[1]}.": counts != told,
                f"The seeds of {which} and its discarded ones do not count up from {first}.": (
                    not _counts(seeds, range(first, first + entry["episodes"]))
                ),
            }
        )


def _counts(seeds: list[int], wanted: range) -> bool:
    """Whether seeds are those of a range, which a file may say is longer than any memory."""
    return len(seeds) == len(wanted) and all(map(operator.eq, seeds, wanted))


def _is_close(found, value: np.ndarray) -> bool:
    try:
        numbers = np.asarray(found, dtype=float)
    except (TypeError, ValueError):
        return False
    return numbers.shape == value.shape and np.allclose(numbers, value, rtol=1e-4, atol=1e-6)


def _few(values) -> str:
    values = [int(value) for value in values]
    return ", ".join(map(str, values[:5])) + (", ..." if len(values) > 5 else "")


CHECKS: dict[str, Check] = {
    "Files": check_files,
    "Schema": check_schema,
    "Values": check_values,
    "Units": check_units,
    "Noise": check_noise,
    "Episodes": check_episodes,
    "Time stamps": check_timestamps,
    "Language": check_language,
    **FRAME_CHECKS,
    "Duplicates": check_duplicates,
    "Hold-out": check_hold_out,
    "Statistics": check_statistics,
    "Provenance": check_provenance,
}


def examine(data: DataSet) -> Iterator[tuple[str, list[str]]]:
    """Yield the name of each check and what it finds wrong, with a bar."""
    for name, check in Progress(CHECKS.items(), "check", unit="check", leave=False):
        yield name, complaints(data, check)


def complaints(data: DataSet, check: Check) -> list[str]:
    """What `check` finds wrong, the first few things; also where it cannot look because something is not there.

    A check may rely on the schema. Where that is right, what a check itself raises is an error of the check.
    """
    try:
        found = list(check(data))
    except UserError as error:
        return [f"Cannot be checked: {error}"]
    except Exception:
        if check is check_schema or not complaints(data, check_schema):
            raise
        return ["Cannot be checked while the schema is wrong."]
    return found[:3] + [f"And {len(found) - 3} more like these."] * (len(found) > 3)
