"""What a data set of demonstrations owes: each check takes it as tables and yields a sentence for each thing wrong.

`CHECKS` names them. Noise is not judged by its spread alone: it is a function of the seed, so it is drawn again.
"""

import operator
from collections.abc import Callable, Iterator

import numpy as np

from lerobot_constructskill.bounds import check_fields
from lerobot_constructskill.contract import (
    ACTION_SCALE,
    DEMO_SEED_START,
    FPS,
    GRIPPER_CLOSED,
    GRIPPER_OPEN,
    REWARD_LIFTED,
    REWARD_PLACED,
    SIM_STATE,
    get_task,
)
from lerobot_constructskill.dataset.card import Provenance
from lerobot_constructskill.dataset.dataset import DataSet
from lerobot_constructskill.dataset.frames import FRAME_CHECKS
from lerobot_constructskill.dataset.reading import check_reading
from lerobot_constructskill.dataset.rounds import check_rounds
from lerobot_constructskill.demos.columns import SIDECAR
from lerobot_constructskill.demos.expert import Phase, PrivilegedState, make_expert
from lerobot_constructskill.demos.hashes import file_hashes
from lerobot_constructskill.demos.merge import frame_statistics
from lerobot_constructskill.demos.modality import MODALITY
from lerobot_constructskill.demos.noise import execute
from lerobot_constructskill.demos.settings import FRAME_PACKAGES
from lerobot_constructskill.errors import InputError, UserError, plural

type Check = Callable[[DataSet], Iterator[str]]

BOOKKEEPING = {"timestamp", "frame_index", "episode_index", "index", "task_index"}
REACH = 1.2
"""Farthest that the Panda's end effector gets from its base, in metres."""

RESPONSE = (0.15, 0.8)
"""Displacement of the end effector for each metre asked for; over whole demonstrations it is 0.30 to 0.36."""

HARDLY_ASKED = 0.1
"""An axis that is asked for less than this share of the strongest one moves by the arm's sag: no response to judge."""


def check_files(data: DataSet) -> Iterator[str]:
    recorded, found = data.facts["sha256"], file_hashes(data.root)
    for name in sorted(recorded.keys() - found.keys()):
        yield f"{name} is missing."
    for name in sorted(found.keys() - recorded.keys()):
        yield f"{name} was added after the generation."
    for name in sorted(name for name in recorded.keys() & found.keys() if recorded[name] != found[name]):
        yield f"{name} is not the file that was generated: its SHA-256 differs."


def check_schema(data: DataSet) -> Iterator[str]:
    try:
        check_fields(Provenance, data.facts, f"{SIDECAR}: ")
    except InputError as error:
        yield str(error)
    task, features, wanted = get_task(data.config.task), data.info["features"], data.columns
    for name in sorted(wanted.keys() - features.keys()):
        yield f"info.json has no feature {name}."
    for name in sorted(features.keys() - wanted.keys() - BOOKKEEPING):
        yield f"info.json has the feature {name}, which is not of the contract and which a policy may read."
    for name in wanted.keys() & features.keys():
        for part in ("dtype", "shape", "names"):
            if _plain(features[name][part]) != _plain(wanted[name][part]):
                yield f"{name} has {part} {features[name][part]}, not {wanted[name][part]}."
    stored = {name for name, feature in wanted.items() if feature["dtype"] != "video"} | BOOKKEEPING
    for name in sorted(stored ^ set(data.rows.columns)):
        yield f"data/ {'has no' if name in stored else 'has an unknown'} column {name}."
    if data.info["fps"] != FPS:
        yield f"info.json says {data.info['fps']} frames a second, not {FPS}."
    if data.tasks != [task.instruction]:
        yield f"The instruction is {data.tasks}, not '{task.instruction}'."


def check_values(data: DataSet) -> Iterator[str]:
    for name, feature in data.info["features"].items():
        if feature["dtype"] == "float32":
            finite = np.isfinite(data.column(name)).reshape(len(data.rows), -1).all(axis=1)
            if not finite.all():
                yield f"{name} is not finite in {plural((~finite).sum(), 'frame')}."
    experts = data.rounds == 0  # a learner's action is bounded by the environment alone
    limits = {"action": ACTION_SCALE, "dart.executed_action": np.where(experts, data.config.noise.clip, ACTION_SCALE)}
    for name, limit in limits.items():
        largest = np.abs(data.column(name)[:, :-1]).max(axis=1)
        if (largest > limit + 1e-6).any():
            most = np.max(limit)
            yield f"{name} reaches {largest.max():.4g} where {most} m a step is the most: these are other units."
        odd = ~np.isin(data.column(name)[:, -1], (GRIPPER_OPEN, GRIPPER_CLOSED)) & (experts | (name == "action"))
        if odd.any():
            yield f"{name} has a gripper that is neither +1 nor -1 in {plural(odd.sum(), 'frame')}."
    state = data.column("observation.state")
    if np.linalg.norm(state[:, :3], axis=1).max() > REACH:
        yield f"observation.state has positions beyond the robot's reach of {REACH} m."
    if not ((state[:, 6:] > -0.001) & (state[:, 6:] < 0.041)).all():
        yield "observation.state has finger positions outside 0 to 0.04 m."
    if not np.isin(data.column("next.reward"), (0, REWARD_LIFTED, REWARD_PLACED)).all():
        yield f"next.reward is not one of 0, {REWARD_LIFTED} and {REWARD_PLACED} everywhere."


def check_units(data: DataSet) -> Iterator[str]:
    """The arm answers a command in metres and in the base frame: its displacement is a part of it, with its sign."""
    executed, position = data.column("dart.executed_action")[:, :3], data.column("observation.state")[:, :3]
    inner = (np.diff(data.column("episode_index")) == 0) & (np.abs(executed[:-1]).max(axis=1) > 0)
    inner &= data.rounds[:-1] == 0  # a learner pushes against things
    asked, moved = executed[:-1][inner], np.diff(position, axis=0)[inner]
    strength = np.sqrt((asked**2).mean(axis=0))
    for axis, name in enumerate("xyz"):
        if strength[axis] < HARDLY_ASKED * strength.max():
            continue
        response = asked[:, axis] @ moved[:, axis] / (asked[:, axis] @ asked[:, axis] + 1e-12)
        if not RESPONSE[0] <= response <= RESPONSE[1]:
            low, high = RESPONSE
            yield f"The end effector moves {response:.3g} m in {name} for a metre asked for, not {low} to {high} m."


def check_noise(data: DataSet) -> Iterator[str]:
    config = data.config
    executed, added = data.column("dart.executed_action"), data.column("dart.noise")
    clean = executed.copy()
    clean[:, :3] -= added
    experts = data.rounds == 0
    wanted = (executed if config.labels == "executed" else clean).copy()
    if config.labels == "advice":
        for row, advised in _advice(data, np.flatnonzero(experts)):
            wanted[row] = advised
    off = np.abs(data.column("action") - wanted)
    if off[experts].max(initial=0) > 1e-6 or off[:, :3].max() > 1e-6:
        yield f"action is not the {config.labels} action that the provenance says its labels are."
    phases, seeds = data.column("phase"), data.column("sim.seed")
    drawn = executed.copy()
    for span in (span for span in data.spans() if experts[span.start]):
        rng = np.random.default_rng(int(seeds[span.start]))
        for row in range(span.start, span.stop):
            drawn[row] = execute(clean[row], phases[row], config.noise, rng)
    for phase in Phase:
        rows = (phases == phase) & experts
        off = np.abs(drawn - executed)[rows].max(initial=0)
        if off > 1e-6:
            spread = ", ".join(f"{1000 * value:.1f}" for value in added[rows].std(axis=0))
            model = config.noise.model
            yield f"The noise in {phase} (std {spread} mm) is not what the {model} model draws from the seed."


def _advice(data: DataSet, rows: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """What the expert advises in some frames."""
    expert = make_expert(get_task(data.config.task), data.config.expert)
    known = {name: data.column(f"sim.{name}") for name in SIM_STATE if f"sim.{name}" in data.columns}
    for row in rows:
        state = PrivilegedState(**{name: np.atleast_1d(values[row]) for name, values in known.items()})
        yield row, expert.advise(state).action


def check_episodes(data: DataSet) -> Iterator[str]:
    spans, rows = data.spans(), len(data.rows)
    indices = [int(data.column("episode_index")[span.start]) for span in spans]
    if indices != list(range(len(data.episodes))):
        yield f"The rows have the episodes {_few(indices)}, the metadata {len(data.episodes)}."
    for span, (_, episode) in zip(spans, data.episodes.iterrows(), strict=False):
        yield from _check_episode(data, span, f"Episode {episode['episode_index']}", episode)
    if not np.array_equal(data.column("index"), np.arange(rows)):
        yield "index does not count the frames of the data set one by one."
    if (other := data.column("task_index") != 0).any():
        yield f"task_index is of another instruction than the only one in {plural(other.sum(), 'frame')}."
    for name, count in (("total_episodes", len(spans)), ("total_frames", rows), ("total_tasks", len(data.tasks))):
        if data.info.get(name) != count:
            yield f"info.json says {name} is {data.info.get(name)}, but there are {count}."


def _check_episode(data: DataSet, span: slice, who: str, episode) -> Iterator[str]:
    length = span.stop - span.start
    if not np.array_equal(data.column("frame_index")[span], np.arange(length)):
        yield f"{who} has a gap: frame_index does not count its {length} frames."
    if (episode["dataset_from_index"], episode["dataset_to_index"]) != (span.start, span.stop):
        yield f"{who} has rows {span.start} to {span.stop}, its metadata have others."
    if len(set(data.column("sim.seed")[span])) > 1:
        yield f"{who} has frames of several seeds."
    done, success = data.column("next.done")[span], data.column("next.success")[span]
    if data.rounds[span.start] > 0:
        if done[:-1].any() or success[:-1].any() or not done[-1]:
            yield f"{who} of a round goes on after its end, or ends before its last frame."
        return
    if list(dict.fromkeys(data.column("phase")[span])) != list(Phase):
        yield f"{who} does not go through the six phases in order."
    if done[:-1].any() or not (done[-1] and success[-1]):
        yield f"{who} does not end in success, or ends before its last frame."


def check_timestamps(data: DataSet) -> Iterator[str]:
    off = np.abs(data.column("timestamp") - data.column("frame_index") / FPS)
    if off.max() > 1e-4:
        yield f"{(off > 1e-4).sum()} time stamps are not frame_index / {FPS}, the worst by {off.max():.4f} s."


def check_duplicates(data: DataSet) -> Iterator[str]:
    """Noisy demonstrations never repeat one another; frames never stand still while a moving arm is told to move.

    A learner does repeat itself in a task whose initial state is always the same.
    """
    if data.config.noise.root.any():
        seen: dict[bytes, int] = {}
        for episode, span in enumerate(data.spans()):
            first = seen.setdefault(data.column("dart.executed_action")[span].tobytes(), episode)
            if first != episode and data.rounds[span.start] == 0:
                yield f"Episode {episode} repeats episode {first}."
    state, asked = data.column("observation.state"), np.abs(data.column("dart.executed_action")[:, :3]).max(axis=1)
    still = (np.diff(state, axis=0) == 0).all(axis=1) & (np.diff(data.column("episode_index")) == 0)
    frozen = still & (asked[:-1] > 0.005)
    if frozen.any():
        first = frozen.argmax() + 1
        yield f"The state stays the same in {plural(frozen.sum(), 'frame')} though the arm should move, first {first}."


def check_hold_out(data: DataSet) -> Iterator[str]:
    """Holding out whole episodes separates seeds: no seed makes two episodes, and none is an evaluation's."""
    seeds = data.column("sim.seed")[[span.start for span in data.spans()]]
    values, counts = np.unique(seeds, return_counts=True)
    if (counts > 1).any():
        yield f"Seeds {_few(values[counts > 1])} made several episodes, so holding one out does not hold it out."
    if values.min() < DEMO_SEED_START:
        yield f"Seeds {_few(values[values < DEMO_SEED_START])} are below {DEMO_SEED_START}: evaluations use those."


def check_statistics(data: DataSet) -> Iterator[str]:
    for name, wanted in frame_statistics(data.root).items():
        for statistic, value in wanted.items():
            found = of_name.get(statistic) if isinstance(of_name := data.stats.get(name), dict) else None
            if found is None:
                yield f"stats.json has no {statistic} of {name}."
            elif not _is_close(found, value):
                yield f"stats.json has {statistic} {found} of {name}; of the frames it is {value.tolist()}."
    for camera in data.cameras:
        if not {"mean", "std", "q01", "q99"} <= data.stats.get(camera, {}).keys():
            yield f"stats.json lacks the mean, std or quantiles of {camera}."
        if (of_episodes := f"stats/{camera}/mean") in data.episodes:
            several = data.episodes[data.episodes["length"] > 1]  # LeRobot has none of a single frame
            without = several["episode_index"][several[of_episodes].isna()]
            if len(without):
                yield f"Episodes {_few(without)} have no statistics of {camera}: LeRobot gave up their video."


def check_provenance(data: DataSet) -> Iterator[str]:
    discarded = data.facts["discarded_seeds"]
    starts = [span.start for span in data.spans()]
    seeds = data.column("sim.seed")[[start for start in starts if data.rounds[start] == 0]].tolist()
    wanted = range(data.config.seed_start, data.config.seed_start + data.facts["attempts"])
    yield from check_rounds(data)
    found = sorted([*seeds, *discarded])
    if len(found) != len(wanted) or any(map(operator.ne, found, wanted)):
        yield "The seeds of the episodes and the discarded ones are not those of the attempts, one by one."
    if seeds != sorted(seeds):
        yield "The episodes are not in the order of their seeds."
    covariance = data.config.noise.root @ data.config.noise.root
    if not _is_close(data.facts["noise_covariance"], covariance):
        yield f"noise_covariance is {data.facts['noise_covariance']}; of the settings it is {covariance.tolist()}."
    missing = set(FRAME_PACKAGES) - data.facts["versions"].keys()
    if missing:
        yield f"The versions of {', '.join(sorted(missing))} are not recorded."
    if data.facts["generator"]["light_robot"] is None:
        yield "Whether the light robot was drawn is not recorded."
    if not (data.root / MODALITY).is_file():
        yield f"{MODALITY} is missing."


def _is_close(found, value: np.ndarray) -> bool:
    try:
        numbers = np.asarray(found, dtype=float)
    except (TypeError, ValueError):
        return False
    return numbers.shape == value.shape and np.allclose(numbers, value, rtol=1e-4, atol=1e-6)


def _plain(value):
    return list(value) if isinstance(value, tuple) else value


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
    **FRAME_CHECKS,
    "Reading": check_reading,
    "Duplicates": check_duplicates,
    "Hold-out": check_hold_out,
    "Statistics": check_statistics,
    "Provenance": check_provenance,
}


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
