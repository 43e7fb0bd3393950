"""Damaged files, each of them in each way: every command that reads a data set says in a sentence which one it is."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import hostile
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from lerobot_constructskill.artifacts.digests import files_below
from lerobot_constructskill.dataset.card import card_facts
from lerobot_constructskill.dataset.checks import CHECKS, complaints
from lerobot_constructskill.dataset.dataset import open_dataset
from lerobot_constructskill.dataset.hub import PUSHED, open_lerobot
from lerobot_constructskill.demos.columns import SIDECAR
from lerobot_constructskill.errors import InputError, MissingError, UserError
from lerobot_constructskill.files import bounded_memory
from lerobot_constructskill.scripts.dataset import CardConfig, CheckConfig, check_dataset, write_card
from lerobot_constructskill.scripts.push_policy import card_of, seed_outcomes

pytestmark = pytest.mark.slow

JSON = ("meta/info.json", "meta/stats.json", SIDECAR)
BINARY = ("meta/tasks.parquet", "data/*/*.parquet", "meta/episodes/*/*.parquet", "videos/*/*/*.mp4")


WAYS: dict[str, Callable[[Path], object]] = {
    "truncated": hostile.truncate,
    "empty": hostile.WAYS["empty"],
    "gone": Path.unlink,
    **hostile.WAYS,
}
CASES = [(pattern, way) for pattern in JSON for way in WAYS] + [(p, way) for p in BINARY for way in list(WAYS)[:3]]


@pytest.fixture(scope="module")
def damaged(pristine: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, str], Path]:
    def damage(pattern: str, way: str) -> Path:
        root = tmp_path_factory.mktemp("damaged") / "set"
        shutil.copytree(pristine, root)
        WAYS[way](next(root.glob(pattern)))
        return root

    return damage


@pytest.mark.parametrize(("pattern", "way"), CASES)
def test_a_damaged_file_is_named_by_the_check(damaged, pattern: str, way: str, monkeypatch, capsys) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    with pytest.raises(UserError) as refusal:
        check_dataset(CheckConfig(root=damaged(pattern, way)))
    said = capsys.readouterr().out + str(refusal.value)
    assert Path(pattern).name in said or pattern.split("/")[0] in said


@pytest.mark.parametrize(("pattern", "way"), [(pattern, way) for pattern, way in CASES if pattern in BINARY])
def test_lerobot_opens_no_damaged_file(damaged, pattern: str, way: str) -> None:
    with pytest.raises((UserError, OSError)):
        open_lerobot("local/toy", damaged(pattern, way))


@pytest.mark.parametrize("fps", [10, 30, 20.5, 0, -20])
def test_a_rate_that_is_not_the_videos_is_refused_by_whoever_reads_them(copy: Path, fps: float) -> None:
    info = json.loads((copy / "meta/info.json").read_text())
    (copy / "meta/info.json").write_text(json.dumps(info | {"fps": fps}))
    with pytest.raises(InputError, match="fps|frames a second"):
        open_lerobot("local/toy", copy)


def test_a_set_that_lerobot_has_edited_is_told_what_it_lacks(copy: Path) -> None:
    (copy / SIDECAR).unlink()
    with pytest.raises(MissingError, match="lerobot-edit-dataset removes it"):
        check_dataset(CheckConfig(root=copy))


@pytest.mark.parametrize(
    "change",
    [
        lambda facts: facts["generator"].update(repo_id="a/b](javascript:alert(1))"),
        lambda facts: facts["generator"].update(repo_id="../../x"),
        lambda facts: facts["versions"].update(torch="1\n# Heading"),
        lambda facts: facts.update(attempts="<script>"),
        lambda facts: facts.update(discarded_seeds=["<img>"]),
    ],
)
def test_a_hostile_set_gets_no_card(pristine: Path, change) -> None:
    data = open_dataset(pristine)
    change(data.facts)
    with pytest.raises(InputError):
        card_facts(data)


def test_a_policys_card_escapes_what_its_files_say(tmp_path: Path) -> None:
    hostile = "x`\n# Heading <script>[a](javascript:b)"
    train = {"seed": 0, "dataset": {"repo_id": hostile, "revision": hostile}}
    (tmp_path / "config.json").write_text(json.dumps({"backbone": hostile, "type": hostile}))
    (tmp_path / "encoder.json").write_text(json.dumps({"source": hostile}))
    card = card_of(tmp_path, "me/mine", [(0, 1, 1, 1)], "brick_to_bin", train)
    assert "<script>" not in card and "](" not in card and "\n# Heading" not in card


@pytest.mark.parametrize(
    "content", ["[]", "{}", "null", '{"per_task": 3}', '{"per_task": [[]]}', "", '{"per_task": [{}]}']
)
def test_an_evaluation_that_is_none_is_named(tmp_path: Path, content: str) -> None:
    (tmp_path / "seed_0").mkdir()
    (tmp_path / "seed_0" / "eval_info.json").write_text(content)
    with pytest.raises(InputError, match=r"eval_info\.json"):
        seed_outcomes(tmp_path)


def test_what_is_pushed_is_an_allow_list(copy: Path) -> None:
    from huggingface_hub.utils import filter_repo_objects

    for name in (".env", "notes.txt", ".cache/x.json", "data/key.pem", "pictures/private.png", "outputs/a.json"):
        (copy / name).parent.mkdir(parents=True, exist_ok=True)
        (copy / name).write_text("secret")
    everything = [path.relative_to(copy).as_posix() for path in copy.rglob("*") if path.is_file()]
    pushed = set(filter_repo_objects(everything, allow_patterns=PUSHED))
    assert pushed == {name for name in everything if (copy / name).read_bytes() != b"secret"}


@pytest.mark.parametrize(
    "place",
    ["{chunk_index:0999999999d}", "{nope}", "{", "{0}", "/dev/zero", "../{video_key}", "{video_key.__class__}", 3],
)
def test_a_set_says_of_no_place_outside_of_it_where_its_videos_are(place, copy: Path) -> None:
    info = json.loads((copy / "meta/info.json").read_text())
    (copy / "meta/info.json").write_text(json.dumps(info | {"video_path": place}))
    for read in (open_dataset, lambda root: open_lerobot("local/toy", root)):
        with pytest.raises(InputError, match="video_path"):
            read(copy)


def test_a_set_that_says_of_a_billion_attempts_takes_no_memory(copy: Path) -> None:
    facts = json.loads((copy / SIDECAR).read_text())
    (copy / SIDECAR).write_text(json.dumps(facts | {"attempts": 10**9}))
    open_dataset(copy)  # Arrow starts its threads, whose stacks are no file's doing
    with bounded_memory(300 << 20):
        assert any(
            "not those of the attempts" in said for said in complaints(open_dataset(copy), CHECKS["Provenance"])
        )


@pytest.mark.parametrize(
    ("file", "column", "value"),
    [
        ("data/*/*.parquet", "phase", "zzz"),
        ("data/*/*.parquet", "sim.seed", None),
        ("data/*/*.parquet", "episode_index", "a"),
        ("meta/episodes/*/*.parquet", "length", None),
        ("meta/episodes/*/*.parquet", "dataset_from_index", "a"),
    ],
)
def test_a_column_of_something_else_is_one_sentence(file, column, value, copy: Path) -> None:
    path = next(copy.glob(file))
    table = pq.read_table(path)
    place = table.schema.get_field_index(column)
    kind = table.schema.field(column).type if value is None else None
    pq.write_table(table.set_column(place, column, pa.array([value] * len(table), kind)), path)
    with pytest.raises(InputError, match=column):
        data = open_dataset(copy)
        card_facts(data)
        data.column(column)


def test_a_folder_that_holds_itself_is_walked_once(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "file").touch()
    (tmp_path / "data" / "again").symlink_to(tmp_path / "data")
    assert [path.name for path in files_below(tmp_path, "data")] == ["file"]


@pytest.mark.parametrize("way", ["a pipe", "a device", "a link to nothing", "a folder"])
def test_a_video_that_is_no_file_is_waited_for_by_nobody(way, copy: Path) -> None:
    video = next(copy.glob("videos/*/*/*.mp4"))
    hostile.WAYS[way](video)
    with pytest.raises(InputError, match=video.name):
        write_card(CardConfig(copy))
