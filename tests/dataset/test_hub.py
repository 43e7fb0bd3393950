"""Data sets to and from a Hub on loopback that speaks the protocol; the machine that uses it is another process."""

import multiprocessing
import os
import signal
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import pytest
from hub_server import TOKENS, serve
from toy import record_toy

from lerobot_constructskill.contract import SUITES
from lerobot_constructskill.dataset.dataset import open_dataset
from lerobot_constructskill.dataset.hub import locate, push
from lerobot_constructskill.demos.metadata import file_hashes
from lerobot_constructskill.errors import InputError, TakenError
from lerobot_constructskill.scripts.dataset import CardConfig, PushConfig, push_dataset, write_card

pytestmark = pytest.mark.slow

TOKEN = next(iter(TOKENS))
ENVHUB = Path(__file__).parents[2] / "examples" / "envhub" / "env.py"


@pytest.fixture(scope="module")
def hub():
    with serve() as hub:
        yield hub


@pytest.fixture(scope="module")
def machine(hub, tmp_path_factory):
    """Call a function in a process whose Hub is ours: huggingface_hub reads its environment once, when imported."""
    home = tmp_path_factory.mktemp("home")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HF_ENDPOINT", hub.url)
        patch.setenv("HF_HOME", str(home))
        patch.setenv("HF_HUB_DISABLE_XET", "1")
        patch.delenv("HF_HUB_OFFLINE", raising=False)
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            yield lambda function, *arguments, token=TOKEN, offline=False, **options: pool.submit(
                as_user, token, offline, function, *arguments, **options
            ).result()


def as_user(token, offline, function, *arguments, **options):
    from huggingface_hub import constants
    from huggingface_hub.utils import _http

    _http.time = SimpleNamespace(sleep=lambda seconds: None)  # it would wait longer and longer before it tries again
    os.environ.pop("HF_TOKEN", None)
    if token:
        os.environ["HF_TOKEN"] = token
    constants.HF_HUB_OFFLINE = offline
    return function(*arguments, **options)


def count_frames(repo_id, revision):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    return len(LeRobotDataset(repo_id, revision=revision))


def is_killed(number, after, *arguments, **options):
    """Push in a process that is killed just before or just after its request `number`; whether there was one."""
    child = os.fork()
    if child == 0:
        import httpx
        from huggingface_hub import close_session

        close_session()
        send, numbers = httpx.Client.send, count()

        def mortal(*its, **own):
            is_last = next(numbers) == number
            if is_last and not after:
                os.kill(os.getpid(), signal.SIGKILL)
            answer = send(*its, **own)
            if is_last:
                os.kill(os.getpid(), signal.SIGKILL)
            return answer

        httpx.Client.send = mortal
        push(*arguments, **options)
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL


def refusal(call, *arguments, **options):
    """The one sentence with which a call is refused; it never holds the token."""
    with pytest.raises(OSError) as error:
        call(*arguments, **options)
    assert "\n" not in str(error.value) and (options.get("token") or TOKEN) not in str(error.value)
    return str(error.value)


def test_what_is_pushed_is_pulled_by_revision_and_from_a_warm_cache(hub, machine, pristine, copy, tmp_path):
    videos = (copy / "videos").rename(tmp_path / "on a larger disk")
    (copy / "videos").symlink_to(videos)
    write_card(CardConfig(copy, "bob/before"))  # as a push under another name does
    url = machine(push_dataset, PushConfig("alice/toy", copy, private=True, tag="v1.0"))
    repo = hub.repos["datasets/alice/toy"]
    assert repo.private and set(repo.tags) == {"v3.0", "v1.0"} and repo.branches["main"] in url
    for revision, offline in (("v1.0", False), (repo.tags["v1.0"], False), (None, False), (None, True)):
        pulled = machine(locate, "alice/toy", None, revision, offline=offline)
        assert file_hashes(pulled) == file_hashes(pristine)
        assert "# alice/toy" in (pulled / "README.md").read_text() and (pulled / "pictures").is_dir()
    assert machine(count_frames, "alice/toy", "v3.0") == 1108
    assert all(TOKEN.encode() not in content for content in hub.blobs.values())


def test_a_set_of_several_tasks_is_pulled_as_it_was_pushed(hub, machine, tmp_path):
    record_toy(tmp_path / "set", 1, task="brick_to_bin,block_to_bin", action="full", annotate=True)
    machine(push, tmp_path / "set", "alice/both")
    pulled = machine(locate, "alice/both")
    assert file_hashes(pulled) == file_hashes(tmp_path / "set")
    assert open_dataset(pulled).task_names == ["brick_to_bin", "block_to_bin"]


def test_a_push_that_was_cut_continues_with_what_arrived(hub, machine, pristine):
    hub.blobs.clear()
    hub.uploads.clear()
    hub.uploads_left = 1
    said = refusal(machine, push, pristine, "alice/cut")
    hub.uploads_left = None
    assert "same command continues" in said
    assert not hub.repos["datasets/alice/cut"].tags and len(hub.uploads) == 1
    assert "no revision 'v3.0'" in refusal(machine, locate, "alice/cut")
    machine(push, pristine, "alice/cut")
    assert len(hub.uploads) == len(set(hub.uploads)) > 2
    assert file_hashes(machine(locate, "alice/cut")) == file_hashes(pristine)


@pytest.mark.parametrize("update", [pytest.param(False, marks=pytest.mark.nightly), True])
@pytest.mark.parametrize("after", [pytest.param(False, marks=pytest.mark.nightly), True])
def test_a_push_killed_at_any_request_is_finished_by_the_same_command(update, after, hub, machine, tmp_path):
    def folder(name, content):
        for path in ("README.md", "meta/info.json", f"data/{content}.parquet"):
            (tmp_path / name / path).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name / path).write_text(content)
        return tmp_path / name

    old, new = folder("old", "before"), folder("new", "behind")
    wanted = {path.relative_to(new).as_posix(): b"behind" for path in new.rglob("*") if path.is_file()}
    for number in count():
        name = f"alice/killed_{after}_{update}_{number}"
        hub.blobs.clear()
        if update:
            machine(push, old, name, tag="v1.0")
        was_killed = machine(is_killed, number, after, new, name, tag="v1.0", update=update)
        with suppress(TakenError):  # the last request was answered
            machine(push, new, name, tag="v1.0", update=update)
        repo = hub.repos[f"datasets/{name}"]
        assert set(repo.tags) == {"v3.0", "v1.0"} and set(repo.tags.values()) == {repo.branches["main"]}
        held = {path: hub.blobs[blob] for path, (blob, _) in repo.commits[repo.branches["main"]].items()}
        assert held == wanted
        if not was_killed:
            break
    assert number >= 8


def test_a_whole_data_set_is_replaced_only_where_that_is_asked_for(hub, machine, pristine, copy):
    machine(push, pristine, "alice/twice")
    first = hub.repos["datasets/alice/twice"].tags["v3.0"]
    assert "--update" in refusal(machine, push, pristine, "alice/twice")
    (copy / "README.md").write_text("# A card\n")
    (copy / "meta" / "modality.json").unlink()
    machine(push, copy, "alice/twice", update=True)
    repo = hub.repos["datasets/alice/twice"]
    files = repo.commits[repo.tags["v3.0"]]
    assert repo.tags["v3.0"] != first and "README.md" in files and "meta/modality.json" not in files


def test_another_data_set_without_lerobots_tag_is_replaced_only_where_that_is_asked_for(hub, machine, pristine, copy):
    machine(push, pristine, "alice/old")
    repo = hub.repos["datasets/alice/old"]
    repo.tags = {"v2.1": repo.tags["v3.0"]}
    info = copy / "meta" / "info.json"
    info.write_text(info.read_text() + " ")
    assert "--update" in refusal(machine, push, copy, "alice/old")
    assert repo.tags.keys() == {"v2.1"} and repo.branches["main"] == repo.tags["v2.1"]
    machine(push, copy, "alice/old", update=True)
    assert repo.tags.keys() == {"v2.1", "v3.0"}


def test_what_is_public_is_not_called_private(hub, machine, pristine):
    machine(push, pristine, "alice/public")
    with pytest.raises(InputError, match="'alice/public' is on the Hub already and public"):
        machine(push, pristine, "alice/public", private=True, update=True)


def test_a_card_that_somebody_changed_is_pushed_as_it_is(hub, machine, copy):
    write_card(CardConfig(copy))
    with (copy / "README.md").open("a") as file:
        file.write("What our robot does with it.\n")
    changed = (copy / "README.md").read_bytes()
    machine(push_dataset, PushConfig("alice/changed", copy))
    assert (machine(locate, "alice/changed") / "README.md").read_bytes() == changed


def test_a_damaged_data_set_does_not_leave_the_machine(hub, copy):
    (copy / "meta" / "modality.json").unlink()
    with pytest.raises(ValueError, match=r"modality\.json is missing"):
        push_dataset(PushConfig("alice/damaged", copy))
    assert "datasets/alice/damaged" not in hub.repos


@pytest.mark.parametrize(
    "name, options, words",
    [
        ("alice/new", {"token": None}, "no valid token"),
        ("alice/new", {"token": "hf_" + "w" * 34}, "no valid token"),
        ("bob/new", {}, "may not write to 'bob/new'"),
        ("alice/new", {"offline": True}, "cannot be reached"),
    ],
)
def test_a_refused_push_is_one_sentence_and_makes_nothing(name, options, words, hub, machine, pristine):
    assert words in refusal(machine, push, pristine, name, **options)
    assert f"datasets/{name}" not in hub.repos


def test_what_somebody_else_keeps_under_a_name_is_not_written_over(hub, machine, pristine, tmp_path):
    (tmp_path / "README.md").write_text("Another set, in a format of its own.")
    machine(upload, tmp_path, "alice/tables")
    assert "--update" in refusal(machine, push, pristine, "alice/tables")
    repo = hub.repos["datasets/alice/tables"]
    assert list(repo.commits[repo.branches["main"]]) == ["README.md"]


def upload(folder, repo_id):
    from huggingface_hub import HfApi

    HfApi().create_repo(repo_id, repo_type="dataset")
    HfApi().upload_folder(repo_id=repo_id, repo_type="dataset", folder_path=folder)


def test_a_pull_that_cannot_be_is_one_sentence(hub, machine, pristine):
    machine(push, pristine, "alice/private", private=True)
    assert "no 'alice/nothing' that this machine may see" in refusal(machine, locate, "alice/nothing")
    assert "no 'alice/private' that this machine may see" in refusal(machine, locate, "alice/private", token=None)
    assert "no revision 'v9.9'" in refusal(machine, locate, "alice/private", None, "v9.9")
    assert "not in the cache" in refusal(machine, locate, "alice/private", None, "v3.0", offline=True)


def load_envhub(repo_id, file):
    """Put an `env.py` on the Hub, load it as LeRobot does, and start two environments of the first task."""
    from huggingface_hub import HfApi
    from lerobot.envs.factory import make_env
    from lerobot.envs.utils import close_envs

    HfApi().create_repo(repo_id)
    HfApi().upload_file(path_or_fileobj=file, path_in_repo="env.py", repo_id=repo_id)
    with pytest.raises(RuntimeError, match="Refusing to execute remote code"):
        make_env(repo_id)
    suites = make_env(repo_id, n_envs=2, trust_remote_code=True)
    observation, info = suites["bins"][0].reset(seed=[0, 1])
    shapes = {name: image.shape for name, image in observation["pixels"].items()}
    close_envs(suites)
    tasks = {suite: [env.call("task")[0] for env in envs.values()] for suite, envs in suites.items()}
    return tasks, shapes | {"state": observation["agent_pos"].shape}, list(info["is_success"])


@pytest.mark.sim
def test_lerobots_envhub_loads_every_suite_from_the_hub(machine):
    tasks, shapes, success = machine(load_envhub, "alice/constructskill", ENVHUB)
    assert {suite: tuple(names) for suite, names in tasks.items()} == SUITES
    assert shapes == {"base": (2, 224, 224, 3), "wrist": (2, 224, 224, 3), "state": (2, 8)}
    assert success == [False, False]
