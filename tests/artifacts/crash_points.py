"""Kill a process just before every change that it makes to a folder, and see that the next one ends as if nothing was.

Usage: python crash_points.py SCENARIO FOLDER [MOST]

The scenario is run undisturbed once; then, for each change (a file opened to be written, a folder made, things renamed
or removed), in a fresh folder: once until it is killed there, and once to its end. Prints how many points there were.
With MOST, so many points at equal distances are tried.
"""

import hashlib
import os
import shutil
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

CHANGES = {"os.mkdir": 0, "os.rename": 0, "os.remove": 0, "os.rmdir": 0, "os.symlink": 1, "os.truncate": 0, "open": 0}
"""Audit events (Python raises them just before it acts) and which of their arguments is the path."""

LOCKS = (".lock", "locks", ".constructskill")
"""What stays behind by intention, and is empty."""


def scenario_folder(root: Path) -> None:
    """A folder that is made of finished parts."""
    from lerobot_constructskill.artifacts.folders import staged
    from lerobot_constructskill.errors import TakenError

    with suppress(TakenError), staged(root / "set", keep="parts") as folder:
        parts = folder.with_name("parts")
        parts.mkdir(exist_ok=True)
        for number in range(3):
            if not (parts / str(number)).exists():
                (parts / f"{number}.new").write_text(f"part {number}")
                (parts / f"{number}.new").rename(parts / str(number))
        folder.mkdir()
        (folder / "whole").write_text("".join((parts / str(number)).read_text() for number in range(3)))


def scenario_file(root: Path) -> None:
    from lerobot_constructskill.artifacts.folders import replaced

    for text in ("first", "second"):
        with replaced(root / "deep" / "table.txt") as partial:
            partial.write_text(text)


def scenario_store(root: Path) -> None:
    """A node and two that it is made of, of which one passes and one is made anew; and one that failed before."""
    from dataclasses import dataclass
    from functools import cached_property

    from lerobot_constructskill.artifacts.store import Node, Store

    @dataclass(frozen=True, eq=False)
    class Thing(Node):
        name: str
        made_of: tuple[Node, ...] = ()
        is_passing: bool = False
        kind = "things"

        def facts(self):
            return {"name": self.name}

        def versions(self):
            return {}

        @cached_property
        def inputs(self):
            return {one.name: one for one in self.made_of}

        def make(self, folder, inputs, machine):
            folder.mkdir()
            (folder / "content").write_text(self.name)
            for name, path in inputs.items():
                (folder / name).write_text((path / "content").read_text())

    store, said, first = Store(root / "store"), Thing("said"), Thing("first")
    if not store.has(said):
        store.log(said).parent.mkdir(parents=True, exist_ok=True)
        store.log(said).write_text("what was said\n")
    for node in (Thing("second", (first, Thing("passing", (), True))), said):
        store.get(node)
        with store.claim([node]):
            pass  # which tidies up after a process that was killed when it was whole
    if not (root / "again").exists():
        with store.claim([first]) as missing:
            if not missing:
                store.discard(first)
        (root / "again").touch()
    store.get(first)


def scenario_study(root: Path) -> None:
    """The runs and the table of a study whose runs fail, each as a row, for want of a simulator."""
    import lerobot_constructskill.plugin  # noqa: F401
    from lerobot_constructskill.artifacts.store import Store
    from lerobot_constructskill.study import runs
    from lerobot_constructskill.study.session import run_study
    from lerobot_constructskill.study.spec import Options, Setting, Study, Variant

    def no_agents(job, run):
        raise ValueError("no simulator here")

    runs._agent = no_agents
    runs._lost = lambda job, stage, nodes: {}
    Store.note = lambda *_: None  # a log says when
    policy = {"type": "act", "pretrained_backbone_weights": None}
    setting = Setting("smoke", {"obs_type": "pixels_agent_pos"})
    study = Study("x", {"s": setting}, {"a": Variant(policy, seeds=3)}, {"no_op": 1, "random": 2})
    run_study(study, "", root / "study", Store(root / "store"), Options(together=2))
    (root / "study" / "provenance.json").unlink(missing_ok=True)  # it says how long it took
    (root / "study" / "timings.jsonl").unlink(missing_ok=True)


def scenario_generate(root: Path) -> None:
    """Two demonstrations of three frames, written and merged by LeRobot; random numbers stand in for the simulator."""
    import numpy as np

    from lerobot_constructskill.contract import get_task
    from lerobot_constructskill.demos import shards
    from lerobot_constructskill.demos.columns import demonstration_features
    from lerobot_constructskill.demos.recorder import record
    from lerobot_constructskill.demos.settings import GenerateConfig
    from lerobot_constructskill.errors import TakenError

    def demonstrate(env, expert, noise, seed, labels, stop_at_success):
        rng = np.random.default_rng(seed)
        features = demonstration_features(get_task("brick_to_bin"), ["base"])
        return [{name: invent(feature, rng) for name, feature in features.items()} for _ in range(3)], True

    def invent(feature, rng):
        if feature["dtype"] == "video":
            return rng.integers(0, 255, (224, 224, 3), dtype=np.uint8)
        if feature["dtype"] == "string":
            return "GRASP"
        return rng.integers(0, 2, feature["shape"]).astype(feature["dtype"])

    shards.demonstrate = demonstrate
    shards._environment = lambda *_: type("Env", (), {"light_robot": True, "backend": "none"})()
    with suppress(TakenError):
        record(GenerateConfig("local/set", str(root / "set"), episodes=2))


def scenario_card(root: Path) -> None:
    """The card of such a data set, with its pictures."""
    from lerobot_constructskill.scripts.dataset import CardConfig, write_card

    source = root.parent / "card_source"
    if not source.exists():
        source.mkdir(parents=True)
        scenario_generate(source)
    write_card(CardConfig(source / "set", out=root))


def scenario_encode(root: Path) -> None:
    """The features of a small data set of images, by an encoder of a few numbers."""
    import numpy as np
    import torch
    from lerobot.datasets import LeRobotDataset

    from lerobot_constructskill.artifacts.folders import staged
    from lerobot_constructskill.errors import TakenError
    from lerobot_constructskill.features.encode import PARTS, write_feature_set

    class Encoder:
        spec = type("Spec", (), {"n_patches": 2, "feature_dim": 3})
        device = torch.device("cpu")

        def encode(self, images):
            pooled = images.mean((2, 3))
            return pooled, pooled[:, None].expand(-1, 2, -1)

    source = root.parent / "source"
    if not source.exists():
        image = {"dtype": "image", "shape": (8, 8, 3), "names": ["height", "width", "channels"]}
        action = {"dtype": "float32", "shape": (4,), "names": ["dx", "dy", "dz", "gripper"]}
        features = {"observation.images.base": image, "action": action}
        dataset = LeRobotDataset.create("local/source", 20, features, source, use_videos=False)
        rng = np.random.default_rng(0)
        for _ in range(2):
            for _ in range(3):
                picture = rng.integers(0, 255, (8, 8, 3), dtype=np.uint8)
                dataset.add_frame({"observation.images.base": picture, "action": np.ones(4, "float32"), "task": "t"})
            dataset.save_episode()
        dataset.finalize()
    dataset = LeRobotDataset("local/source", root=source)
    with suppress(TakenError), staged(root / "set", keep=PARTS) as folder:
        write_feature_set(dataset, "base", Encoder(), {}, "local/set", folder, patches=True)


def run(scenario: Callable[[Path], None], root: Path, kill_at: int | None = None) -> tuple[bool, int]:
    """Run a scenario in a child; say whether it came to its end, and how many changes it made."""
    root.mkdir(parents=True, exist_ok=True)
    ours, theirs = os.pipe()
    child = os.fork()
    if child == 0:
        made = 0

        def watch(event: str, arguments: tuple) -> None:
            nonlocal made
            if event not in CHANGES or not is_change(event, arguments, root):
                return
            if made == kill_at:
                os.kill(os.getpid(), signal.SIGKILL)
            made += 1

        sys.addaudithook(watch)
        scenario(root)
        os.write(theirs, str(made).encode())
        os._exit(0)
    os.close(theirs)
    _, status = os.waitpid(child, 0)
    made = os.read(ours, 100)
    os.close(ours)
    assert status in (0, signal.SIGKILL), f"the scenario failed with status {status}"
    return status == 0, int(made or 0)


def is_change(event: str, arguments: tuple, root: Path) -> bool:
    path = arguments[CHANGES[event]]
    if event == "open" and not (arguments[2] or 0) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
        return False
    return isinstance(path, str | os.PathLike) and str(path).startswith(str(root))


def tree(root: Path) -> dict[str, str]:
    """Everything that lies in a folder, locks apart."""
    paths = (path for path in sorted(root.rglob("*")) if not set(LOCKS) & set(path.relative_to(root).parts))
    return {path.relative_to(root).as_posix(): content(path) for path in paths}


def content(path: Path) -> str:
    if path.is_symlink():
        return f"-> {os.readlink(path)}"
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "folder"


def main(name: str, folder: Path, most: int | None) -> None:
    scenario = globals()[f"scenario_{name}"]
    scenario(folder / "warm")  # whatever is imported is imported before the first fork
    undisturbed = folder / "undisturbed"
    finished, changes = run(scenario, undisturbed)
    assert finished and changes
    expected, root = tree(undisturbed), folder / "killed"
    points = range(changes) if most is None else sorted({i * changes // most for i in range(most)})
    for point in points:
        shutil.rmtree(root, ignore_errors=True)
        finished, _ = run(scenario, root, kill_at=point)
        assert not finished, f"point {point} was not reached"
        assert run(scenario, root)[0]
        found = tree(root)
        different = {name for name in expected | found if expected.get(name) != found.get(name)}
        assert not different, f"killed before change {point}, these differ: {sorted(different)}"
    print(len(points))


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]) if len(sys.argv) > 3 else None)
