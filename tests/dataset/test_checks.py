"""Each kind of corruption is planted in a data set, and the check that is there for it finds and names it."""

import json
import re
import subprocess
import sys
from pathlib import Path

import av
import numpy as np
import pandas as pd
import pytest
from commands import call
from toy import rows

from lerobot_constructskill.artifacts.digests import data_sha256
from lerobot_constructskill.contract import TASKS
from lerobot_constructskill.dataset.card import card_facts, render
from lerobot_constructskill.dataset.checks import CHECKS, complaints
from lerobot_constructskill.dataset.dataset import open_dataset
from lerobot_constructskill.demos.columns import JOINT_COLUMNS, SIDECAR
from lerobot_constructskill.demos.language import annotate
from lerobot_constructskill.errors import InputError

pytestmark = pytest.mark.slow

VIDEO = "videos/observation.images.base/chunk-000/file-000.mp4"


def metadata(name, change):
    def corrupt(root):
        facts = json.loads((root / name).read_text())
        change(facts)
        (root / name).write_text(json.dumps(facts))

    return corrupt


def column(name, change):
    """A corruption of one column, as (N, ...) array."""

    def corrupt(table):
        values = table[name]
        array = change(np.stack(values) if values.dtype == object and name != "phase" else values.to_numpy().copy())
        return table.assign(**{name: list(array) if array.ndim > 1 else array})

    return rows(corrupt)


def at(row, value):
    def change(array):
        array[row] = value
        return array

    return change


def late_video(root):
    """By more than LeRobot lets pass, and less than a hundredth of a frame."""
    for path in (root / "meta/episodes").rglob("*.parquet"):
        table = pd.read_parquet(path)
        edges = [name for name in table.columns if name.endswith(("/from_timestamp", "/to_timestamp"))]
        table[edges] += 4e-4
        table.to_parquet(path)


def misread(root):
    """Annotated, but some frames lack the last subtask of their episode."""
    metadata(SIDECAR, lambda facts: facts["generator"].update(annotate=True))(root)
    annotate(root, [TASKS["brick_to_bin"]] * 9)
    path = root / "data/chunk-000/file-000.parquet"
    table = pd.read_parquet(path)
    said = table["language_persistent"].to_list()
    said[:9] = [rows[:-1] for rows in said[:9]]
    table.assign(language_persistent=said).to_parquet(path)


AV1 = ("libsvtav1", {"crf": "18", "preset": "12"})
OPEN_GROUPS = ("libx265", {"crf": "28", "preset": "ultrafast", "x265-params": "keyint=10:log-level=none"})


def frames(change, encoder=AV1):
    """A corruption of the video: `change` takes the list of (H, W, 3) pictures and returns it."""

    def corrupt(root):
        with av.open(str(root / VIDEO)) as video:
            pictures = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
        with av.open(str(root / VIDEO), "w") as video:
            stream = video.add_stream(encoder[0], rate=20, options=encoder[1])
            stream.width, stream.height, stream.pix_fmt = 224, 224, "yuv420p"
            for picture in change(pictures):
                video.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
            video.mux(stream.encode())

    return corrupt


def black(pictures):
    return [np.zeros_like(picture) if 300 <= index < 310 else picture for index, picture in enumerate(pictures)]


def frozen(pictures):
    return [pictures[40] if 40 <= index < 90 else picture for index, picture in enumerate(pictures)]


def without_statistics(root):
    path = root / "meta/episodes/chunk-000/file-000.parquet"
    table = pd.read_parquet(path)
    name = "stats/observation.images.base/mean"
    table.assign(**{name: table[name].where(table["episode_index"] != 3)}).to_parquet(path)


def repeated_episode(table):
    again = table[table.episode_index == 0].assign(episode_index=8)
    return pd.concat([table[table.episode_index != 8], again], ignore_index=True)


def noise_of_another_seed(table):
    table["sim.seed"] = table["sim.seed"].where(table["episode_index"] != 3, 2_000_000)
    return table


def truncate(name):
    def corrupt(root):
        (root / name).write_bytes((root / name).read_bytes()[:2000])

    return corrupt


CORRUPTIONS = {
    "a flipped byte": (lambda root: flip(root / VIDEO), "Files", "SHA-256 differs"),
    "a lost file": (lambda root: (root / VIDEO).unlink(), "Files", "file-000.mp4 is missing"),
    "a stray file": (lambda root: (root / "data/x.parquet").touch(), "Files", "x.parquet was added"),
    "a dropped column": (rows(lambda table: table.drop(columns="dart.noise")), "Schema", "no column dart.noise"),
    "a column that policies would read": (
        metadata("meta/info.json", lambda info: info["features"].update(action_2=info["features"]["action"])),
        "Schema",
        "action_2",
    ),
    "renamed channels": (
        metadata("meta/info.json", lambda info: info["features"]["action"].update(names=["x", "y", "z", "g"])),
        "Schema",
        "action has names",
    ),
    "another frame rate": (metadata("meta/info.json", lambda info: info.update(fps=30)), "Schema", "30 frames"),
    "a number that is none": (column("observation.state", at((7, 2), np.nan)), "Values", "not finite in 1 frame."),
    "actions in millimetres": (column("action", lambda action: action * ([1e3] * 3 + [1])), "Values", "other units"),
    "a gripper from 0 to 1": (column("action", lambda a: np.c_[a[:, :3], a[:, 3] > 0]), "Values", "neither \\+1"),
    "fingers in millimetres": (column("observation.state", lambda s: s * ([1] * 6 + [1e3] * 2)), "Values", "finger"),
    "positions in centimetres": (
        column("observation.state", lambda state: state * ([100] * 3 + [1] * 5)),
        "Units",
        "for a metre asked for",
    ),
    "swapped axes": (column("observation.state", lambda s: s[:, [1, 0, *range(2, 8)]]), "Units", "m in x for a metre"),
    "a flipped sign": (
        column("observation.state", lambda state: state * [1, -1, *[1] * 6]),
        "Units",
        "-0.3 m in y for a metre",
    ),
    "labels with noise": (rows(lambda t: t.assign(action=t["dart.executed_action"])), "Noise", "clean action"),
    "labels that are no advice": (
        metadata(SIDECAR, lambda facts: facts["generator"].update(labels="advice")),
        "Noise",
        "advice action",
    ),
    "noise of another size": (
        metadata(SIDECAR, lambda facts: facts["generator"]["noise"].update(sigma=0.005)),
        "Noise",
        r"noise in PREGRASP \(std \d+\.\d, ",
    ),
    "noise in GRASP": (
        metadata(SIDECAR, lambda facts: facts["generator"]["noise"]["phases"].append("GRASP")),
        "Noise",
        "noise in GRASP",
    ),
    "noise of another seed": (rows(noise_of_another_seed), "Noise", "model draws from the seed"),
    "a lost frame": (rows(lambda table: table.drop(index=50)), "Episodes", "Episode 0 has a gap"),
    "a lost episode": (rows(lambda t: t[t.episode_index != 4]), "Episodes", "rows have the episodes 0, 1, 2, 3, 5"),
    "another instruction's number": (column("task_index", at(7, 1)), "Episodes", "another instruction .* in 1 frame"),
    "no instruction": (metadata("meta/info.json", lambda i: i.update(total_tasks=0)), "Episodes", "total_tasks is 0"),
    "a wrong total": (metadata("meta/info.json", lambda i: i.update(total_frames=7)), "Episodes", "total_frames is 7"),
    "a first phase that is called the second": (
        column("phase", lambda phases: np.where(phases == "PREGRASP", "DESCEND", phases)),
        "Episodes",
        "six phases in order",
    ),
    "phases out of order": (column("phase", at(slice(0, 3), "CARRY")), "Episodes", "six phases in order"),
    "a failed demonstration": (column("next.success", lambda s: s & False), "Episodes", "Episode 0 does not end"),
    "two seeds in an episode": (column("sim.seed", at(3, 1_000_007)), "Episodes", "several seeds"),
    "a late time stamp": (column("timestamp", at(9, 0.5)), "Time stamps", "worst by 0.0500 s"),
    "a video read too late": (late_video, "Videos", "which do not follow on frame 0"),
    "a dropped video frame": (frames(lambda pictures: pictures[:-1]), "Videos", "frames, but its episodes have"),
    "a video frame too many": (
        frames(lambda pictures: [*pictures, pictures[-1]]),
        "Pictures",
        "have more frames than",
    ),
    "a truncated video": (truncate(VIDEO), "Videos", "cannot be read"),
    "open groups of pictures": (frames(list, OPEN_GROUPS), "Reading", "with --dataset.video_backend=pyav"),
    "black pictures": (frames(black), "Pictures", "observation.images.base shows nothing in 10 frames, first 300"),
    "a frozen camera": (frames(frozen), "Pictures", "while the arm moves, first"),
    "a repeated episode": (rows(repeated_episode), "Duplicates", "Episode 8 repeats episode 0"),
    "repeated frames": (
        column("observation.state", lambda state: np.r_[state[:30], [state[30]] * 5, state[35:]]),
        "Duplicates",
        "though the arm should move, first 31",
    ),
    "a seed in two episodes": (
        column("sim.seed", lambda seed: np.where(seed == 1_000_001, 1_000_000, seed)),
        "Hold-out",
        "Seeds 1000000 made several",
    ),
    "a seed of the evaluation": (column("sim.seed", lambda seed: seed - 1_000_000 + 1000), "Hold-out", "below"),
    "the starts of the leaderboard": (
        lambda root: [
            column("sim.seed", lambda seed: seed - 1_000_000 + 5000)(root),
            metadata(SIDECAR, lambda facts: facts["generator"].update(seed_start=5000))(root),
        ],
        "Hold-out",
        "below 1000000: evaluations",
    ),
    "stale statistics": (
        metadata("meta/stats.json", lambda stats: stats["action"].update(std=[1, 1, 1, 1])),
        "Statistics",
        "std .* of action",
    ),
    "no quantiles": (
        metadata("meta/stats.json", lambda stats: stats["action"].pop("q99")),
        "Statistics",
        "no q99 of action",
    ),
    "a video that was given up": (without_statistics, "Statistics", "Episodes 3 have no statistics of .*base"),
    "a hidden failure": (metadata(SIDECAR, lambda f: f.update(discarded_seeds=[])), "Provenance", "the attempts"),
    "an unnamed version": (metadata(SIDECAR, lambda f: f["versions"].pop("sapien")), "Provenance", "sapien"),
    "a covariance that was not drawn from": (
        metadata(SIDECAR, lambda facts: facts.update(noise_covariance=[[1e-6, 0, 0], [0, 1e-6, 0], [0, 0, 1e-6]])),
        "Provenance",
        "of the settings it is",
    ),
    "annotations of other phases": (misread, "Language", "not what the phases say in 9 frames"),
    "no modality": (lambda root: (root / "meta/modality.json").unlink(), "Provenance", "modality.json"),
}


def flip(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize("name", CHECKS)
def test_nothing_is_wrong_with_a_data_set_as_it_was_generated(name, pristine):
    assert complaints(open_dataset(pristine), CHECKS[name]) == []


def test_a_hand_may_be_above_the_object_from_the_start(copy):
    """Then there is nothing to do in the first phase."""
    config = open_dataset(copy).config.expert

    def above(table):
        is_first = (table["episode_index"] == 0) & (table["phase"] == "PREGRASP")
        x, y, z = table["sim.object_pose"][0][:3]
        height = z + table["sim.object_size"][0][2] / 2 - config.finger_depth + config.pregrasp_clearance
        table.at[0, "sim.tcp_pose"] = np.array([x, y, height, 0, 1, 0, 0], dtype=np.float32)
        return table.assign(phase=table["phase"].mask(is_first, "DESCEND"))

    rows(above)(copy)
    assert complaints(open_dataset(copy), CHECKS["Episodes"]) == []


@pytest.mark.parametrize("name", CORRUPTIONS)
def test_a_planted_corruption_is_found_and_named(name, copy):
    corrupt, check, words = CORRUPTIONS[name]
    corrupt(copy)
    found = complaints(open_dataset(copy), CHECKS[check])
    assert found and all("\n" not in line and line.endswith(".") for line in found)
    with pytest.raises(ValueError, match=words):
        raise ValueError(" ".join(found))


def test_an_axis_that_is_hardly_asked_for_has_no_response_to_judge(copy):
    """A mirrored x is found, but not where the arm was told next to nothing in x, and moved by its own sag."""
    column("observation.state", lambda state: state * [-1, *[1] * 7])(copy)
    assert any("in x for a metre" in found for found in complaints(open_dataset(copy), CHECKS["Units"]))
    column("dart.executed_action", lambda action: action * [1e-3, *[1] * 3])(copy)
    assert complaints(open_dataset(copy), CHECKS["Units"]) == []


def test_every_check_has_its_corruption():
    assert {check for _, check, _ in CORRUPTIONS.values()} == set(CHECKS)


@pytest.mark.parametrize(
    "name", ["meta/info.json", "meta/stats.json", SIDECAR, "meta/tasks.parquet", "data/chunk-000/file-000.parquet"]
)
def test_a_file_that_cannot_be_read_is_named(name, copy):
    (copy / name).write_bytes(b"{")
    with pytest.raises(ValueError, match=f"{name}' (cannot be read|is not )"):
        open_dataset(copy)


@pytest.mark.parametrize(
    "corrupt, words",
    [
        (column("dart.noise", lambda noise: noise[:, :2]), "shape \\(2,\\), not \\(3,\\)"),
        (rows(lambda table: table.drop(columns="phase")), "no column phase"),
        (metadata("meta/info.json", lambda info: info["features"].pop("dart.noise")), "has no 'dart.noise'"),
    ],
)
def test_what_is_missing_is_named_by_every_check_that_needs_it(corrupt, words, copy):
    corrupt(copy)
    found = complaints(open_dataset(copy), CHECKS["Noise"])
    assert found and re.search(words, found[0])


@pytest.mark.parametrize(
    "corrupt, words",
    [
        (rows(lambda table: table.iloc[:0]), "no frames"),
        (metadata(SIDECAR, lambda facts: facts.pop("generator")), f"{SIDECAR}' is not .*: generator: it is missing"),
        (
            metadata("meta/info.json", lambda info: info.pop("features")),
            "meta/info.json' is not .*: features: it is missing",
        ),
    ],
)
def test_a_set_that_holds_nothing_is_not_opened(corrupt, words, copy):
    corrupt(copy)
    with pytest.raises(InputError, match=words):
        open_dataset(copy)


def test_a_set_from_before_joints_were_recorded_is_right_as_well_and_its_card_has_what_it_has(copy):
    def forget(info):
        for name, feature in list(info["features"].items()):
            if name in JOINT_COLUMNS:
                del info["features"][name]
            elif name.startswith(("phase", "sim.", "next.")):
                feature["names"] = None

    metadata("meta/info.json", forget)(copy)
    rows(lambda table: table.drop(columns=list(JOINT_COLUMNS)))(copy)
    data = open_dataset(copy)
    assert all(complaints(data, CHECKS[name]) == [] for name in CHECKS if name != "Files")
    card = render(card_facts(data))
    assert "`sim.fingers` | float32 | 2 |" in card and "sim.joint" not in card
    metadata(SIDECAR, lambda facts: facts["generator"].update(labels="advice"))(copy)
    (complaint,) = complaints(open_dataset(copy), CHECKS["Noise"])
    assert "advice action" in complaint


def test_all_of_a_set_is_as_open_as_its_folder(pristine):
    access = pristine.stat().st_mode
    assert access & 0o444 == 0o444, "the umask of these tests hides folders from others"
    assert not [path for path in pristine.rglob("*") if path.is_file() and path.stat().st_mode & 0o444 != 0o444]


@pytest.mark.parametrize("name", ["videos/observation.images.base", "videos", "data"])
def test_a_folder_that_is_a_link_to_another_disk_is_part_of_the_set(name, pristine, copy, tmp_path):
    elsewhere = (copy / name).rename(tmp_path / "elsewhere")
    (copy / name).symlink_to(elsewhere)
    data = open_dataset(copy)
    assert [complaints(data, CHECKS[check]) for check in ("Files", "Videos", "Statistics")] == [[], [], []]
    assert data_sha256(copy) == data_sha256(pristine)
    next(path for path in elsewhere.rglob("*") if path.is_file()).unlink()
    assert data_sha256(copy) != data_sha256(pristine)


@pytest.mark.parametrize("error", [KeyError, IndexError, ValueError])
def test_an_error_of_a_check_is_no_fault_of_the_data(error, pristine):
    def broken(data):
        raise error("in the check itself")
        yield

    with pytest.raises(error, match="in the check itself"):
        complaints(open_dataset(pristine), broken)


def test_the_command_prints_a_line_for_each_check_and_tells_by_its_status(pristine, copy):
    counted = f"9 demonstrations, 1108 frames: {len(CHECKS)} checks, nothing wrong."
    assert counted in call("constructskill-check", f"--root={pristine}")
    flip(copy / VIDEO)
    said = call("constructskill-check", f"--root={copy}", fails=True)
    assert f"FAIL  Files         {VIDEO} is not" in said
    assert "found something wrong" in said and "Traceback" not in said


@pytest.mark.parametrize("flags, words", [([], "--repo_id"), (["--root=/nowhere"], "no folder /nowhere")])
def test_what_is_not_there_is_told_in_one_sentence(flags, words):
    command = [Path(sys.executable).parent / "constructskill-check", *flags]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 1 and words in done.stderr and len(done.stderr.strip().splitlines()) == 1
