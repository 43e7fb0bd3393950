"""Sixty edits of the package, drawn from mutmut's list by a fixed seed, each against the tests that reach it.

`python tests/mutants.py` runs `make test` once, to see which test reaches which function, and then the mutants, one a
core, each in a copy of the checkout. A mutant is caught where one of these tests fails or stands still. What all of
them let pass has survived: it is to be shown equivalent, or to be caught by a new test. A killed run goes on while no
file changes. --draw lists the mutants and stops.
"""

import argparse
import difflib
import json
import os
import random
import shutil
import subprocess
import sys
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from hashlib import sha256
from itertools import groupby
from pathlib import Path
from queue import Queue

from libcst import FunctionDef, Module
from mutmut.mutation.file_mutation import Mutation, create_mutations
from test_packaging import own_files

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "lerobot_constructskill"
KEPT = ROOT / "outputs" / "mutants"
MOST_TESTS = 400
"""Of those that reach a function, the quickest; a function that more of them reach is one that everything needs."""

FAILED, NOT_COLLECTED = 1, 2
"""Exit statuses of pytest that a mutant brings about."""


@dataclass(frozen=True)
class Mutant:
    """One edit of a module, which is named by its place below the package."""

    module: str
    number: int
    tree: Module
    mutation: Mutation

    @property
    def name(self) -> str:
        return f"{self.module}#{self.number}"

    @property
    def room(self) -> str:
        return self.module.rpartition("/")[0].split("/")[0]

    @property
    def function(self) -> str:
        return self.mutation.contained_by_top_level_function.name.value

    @cached_property
    def source(self) -> str:
        return self.tree.deep_replace(self.mutation.original_node, self.mutation.mutated_node).code

    @property
    def diff(self) -> list[str]:
        lines = difflib.unified_diff(self.tree.code.splitlines(), self.source.splitlines(), lineterm="", n=0)
        return list(lines)[2:]


def list_mutants() -> list[Mutant]:
    found = []
    for path in sorted(PACKAGE.rglob("*.py")):
        tree, mutations, *_ = create_mutations(str(path), path.read_text())
        inside = [one for one in mutations if isinstance(one.contained_by_top_level_function, FunctionDef)]
        module = path.relative_to(PACKAGE).as_posix()
        found += [Mutant(module, number, tree, one) for number, one in enumerate(inside)]
    return found


def draw(mutants: list[Mutant], count: int, seed: int) -> list[Mutant]:
    """One of each room, and the rest from all of them."""
    rng = random.Random(seed)
    rooms = groupby(sorted(mutants, key=lambda one: one.room), key=lambda one: one.room)
    drawn = [rng.choice(list(of)) for _, of in rooms]
    rest = [one for one in mutants if one not in drawn]
    return drawn + rng.sample(rest, max(0, count - len(drawn)))


def make_copy(folder: Path) -> Path:
    """A copy of the checkout whose environment is this one's, but for the package, which is the copy's own."""
    shutil.rmtree(folder, ignore_errors=True)
    for name in own_files():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, folder / name)
    python, site = Path(sys.executable), next(Path(sys.prefix).glob("lib/python*/site-packages"))
    own = folder / ".venv"
    subprocess.run([python, "-m", "venv", "--without-pip", own], check=True)
    inside = own / site.relative_to(sys.prefix)
    (inside / "copy.pth").write_text(f"{folder}\n{folder / 'tests'}\n{site}\n")
    (inside / "sitecustomize.py").write_text("import os\nif os.environ.get('REACH'):\n    import reach\n")
    for script in python.parent.iterdir():
        if script.is_file() and script.read_bytes().startswith(b"#!" + str(python.parent).encode()):
            (own / "bin" / script.name).write_text(script.read_text().replace(str(python.parent), str(own / "bin")))
            (own / "bin" / script.name).chmod(0o755)
    subprocess.run(["git", "init", "--quiet"], cwd=folder, check=True)
    return folder


def run_pytest(copy: Path, *options: str, timeout: float | None = None, **surroundings: str) -> tuple[int, str]:
    quiet = os.environ | {"OMP_NUM_THREADS": "1", "LP_NUM_THREADS": "1"} | surroundings
    quiet.pop("PYTHONDONTWRITEBYTECODE", None)
    command = [copy / ".venv" / "bin" / "python", "-m", "pytest", "-q", "-p", "no:cacheprovider", *options]
    done = subprocess.run(command, cwd=copy, env=quiet, capture_output=True, text=True, timeout=timeout)
    return done.returncode, done.stdout


class Reach:
    """Which tests reach which function, and how long each takes."""

    def __init__(self, folder: Path):
        reach, times = folder / "reach.jsonl", folder / "reach.jsonl.times"
        if not (folder / "whole").exists():
            reach.unlink(missing_ok=True)
            times.unlink(missing_ok=True)
            copy = make_copy(folder / "unfinished")
            options = ["-p", "reach", "-m", "not nightly", "-n", "auto", "--maxprocesses=4", "--dist=loadfile"]
            status, said = run_pytest(copy, *options, "--no-loadscope-reorder", REACH=str(reach))
            print(said[-1000:], flush=True)
            assert status == 0, "mutants say something only where all tests pass without one"
            copy.rename(folder / "whole")
        self.seconds, not_passed, tests_of = defaultdict(float), set(), defaultdict(set)
        for line in times.read_text().splitlines():
            test, _, outcome, seconds = json.loads(line)
            self.seconds[test] += seconds
            if outcome != "passed":
                not_passed.add(test)
        passed = self.seconds.keys() - not_passed
        for test in passed:
            tests_of[test.partition("::")[0]].add(test)
        self._found = defaultdict(set)
        for line in reach.read_text().splitlines():
            test, phase, module, qualified = json.loads(line)
            reached = tests_of[test.partition("::")[0]] if phase == "setup" else {test} & passed
            for name in {part for part in qualified.split(".") if not part.startswith("<")}:
                self._found[module, name] |= reached

    def tests(self, mutant: Mutant) -> list[str]:
        """Those that reach its function, the quickest first."""
        found = self._found.get((mutant.module, mutant.function), ())
        return sorted(found, key=self.seconds.__getitem__)[:MOST_TESTS]


def try_mutant(mutant: Mutant, tests: list[str], timeout: float, copy: Path) -> dict:
    """Run the tests on the mutant until one fails, and say which; the copy is as before in the end."""
    path = copy / "lerobot_constructskill" / mutant.module
    path.write_text(mutant.source)
    by = None
    try:
        status, said = run_pytest(copy, "-x", *tests, timeout=timeout) if tests else (0, "")
        if status in (FAILED, NOT_COLLECTED):
            by = next(line for line in said.splitlines() if line.startswith(("FAILED", "ERROR"))).partition(" - ")[0]
        elif status:
            raise RuntimeError(f"{mutant.name}: pytest ended with {status}: {said[-1000:]}")
    except subprocess.TimeoutExpired:
        by = f"stood still for {timeout:.0f} s"
    finally:
        path.write_text(mutant.tree.code)
    return {"mutant": mutant.name, "function": mutant.function, "tests": len(tests), "caught_by": by}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--draw", action="store_true", help="list what is drawn and stop")
    asked = parser.parse_args()
    everything = list_mutants()
    drawn = draw(everything, asked.count, asked.seed)
    print(f"{len(drawn)} of {len(everything)} mutants, seed {asked.seed}", flush=True)
    if asked.draw:
        for mutant in drawn:
            print(mutant.name, mutant.function, *mutant.diff, sep="\n    ")
        return
    content = sha256(b"".join((ROOT / name).read_bytes() for name in own_files())).hexdigest()[:12]
    folder = KEPT / content
    folder.mkdir(parents=True, exist_ok=True)
    reach, outcomes = Reach(folder), folder / f"outcomes_{asked.seed}.jsonl"
    before = [json.loads(line) for line in outcomes.read_text().splitlines()] if outcomes.exists() else []
    done = {one["mutant"] for one in before}
    copies: Queue[Path] = Queue()
    cores = len(os.sched_getaffinity(0))
    for number in range(cores):
        copies.put(make_copy(folder / f"copy_{number}"))

    def run(mutant: Mutant) -> None:
        copy, tests = copies.get(), reach.tests(mutant)
        try:
            found = try_mutant(mutant, tests, 60 + 4 * sum(map(reach.seconds.__getitem__, tests)), copy)
        finally:
            copies.put(copy)
        with outcomes.open("a") as file:
            file.write(json.dumps(found) + "\n")
        told = f"caught    {found['caught_by']}" if found["caught_by"] else f"SURVIVED  {len(tests)} tests"
        print(f"{mutant.name:<45} {told}", flush=True)

    with ThreadPoolExecutor(cores) as pool:
        list(pool.map(run, [one for one in drawn if one.name not in done]))
    told = [json.loads(line) for line in outcomes.read_text().splitlines()]
    print(f"{sum(one['caught_by'] is not None for one in told)} of {len(told)} caught")


if __name__ == "__main__":
    main()
