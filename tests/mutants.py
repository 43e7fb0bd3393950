"""Sixty edits of the package, drawn from mutmut's list by a fixed seed, each against the tests that reach it.

`python tests/mutants.py` runs `make test` once, to see which test reaches which function, and then the mutants, one a
core, each in a copy of the checkout; a killed run goes on. A mutant is caught where one of these tests fails; what all
of them let pass is a survivor, to be shown equivalent or to be caught by a new test. --draw lists them and stops.
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
from itertools import groupby
from pathlib import Path
from queue import Queue

from libcst import FunctionDef, Module
from mutmut.mutation.file_mutation import Mutation, create_mutations

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "lerobot_constructskill"
KEPT = ROOT / "outputs" / "mutants"
REACH = KEPT / "reach.jsonl"
LONGEST_S = 900
MOST_TESTS = 400
"""Of those that reach a function, the quickest; a function that more of them reach is one that everything needs."""


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
    return drawn + rng.sample(rest, count - len(drawn))


def make_copy(folder: Path) -> Path:
    """A copy of the checkout whose environment is this one's, but for the package, which is the copy's own."""
    shutil.rmtree(folder, ignore_errors=True)
    listing = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    for name in filter(None, subprocess.check_output(listing, cwd=ROOT, text=True).split("\0")):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)
    python, site = Path(sys.executable), next(Path(sys.prefix).glob("lib/python*/site-packages"))
    own = folder / ".venv"
    subprocess.run([python, "-m", "venv", "--without-pip", own], check=True)
    inside = own / site.relative_to(sys.prefix)
    (inside / "copy.pth").write_text(f"{folder}\n{folder / 'tests'}\n{site}\n")
    (inside / "sitecustomize.py").write_text(
        "import os\nif os.environ.get('REACH'):\n    import reach  # noqa: F401\n"
    )
    for script in python.parent.iterdir():
        if script.is_file() and script.read_bytes().startswith(b"#!" + str(python.parent).encode()):
            (own / "bin" / script.name).write_text(script.read_text().replace(str(python.parent), str(own / "bin")))
            (own / "bin" / script.name).chmod(0o755)
    subprocess.run(["git", "init", "--quiet"], cwd=folder, check=True)
    return folder


def run_pytest(
    copy: Path, *options: str, timeout: float | None = None, **surroundings: str
) -> subprocess.CompletedProcess[str]:
    quiet = os.environ | {"OMP_NUM_THREADS": "1", "LP_NUM_THREADS": "1"} | surroundings
    quiet.pop("PYTHONDONTWRITEBYTECODE", None)
    command = [copy / ".venv" / "bin" / "python", "-m", "pytest", "-q", "-p", "no:cacheprovider", *options]
    return subprocess.run(command, cwd=copy, env=quiet, capture_output=True, text=True, timeout=timeout)


def reaching() -> dict[tuple[str, str], list[str]]:
    """(module, name of a function) to the tests that reach it, the quickest first."""
    if not REACH.exists():
        copy = make_copy(KEPT / "whole")
        options = ["-p", "reach", "-m", "not nightly", "-n", "auto", "--maxprocesses=4", "--dist=loadfile"]
        done = run_pytest(copy, *options, "--no-loadscope-reorder", REACH=str(REACH.with_suffix(".new")))
        print(done.stdout[-3000:], flush=True)
        REACH.with_suffix(".new").rename(REACH)
    times, not_passed = defaultdict(float), set()
    for line in (KEPT / "reach.new.times").read_text().splitlines():
        test, _, outcome, seconds = json.loads(line)
        times[test] += seconds
        if outcome != "passed":
            not_passed.add(test)
    passed, tests_of, found = times.keys() - not_passed, defaultdict(set), defaultdict(set)
    for test in passed:
        tests_of[test.partition("::")[0]].add(test)
    for line in REACH.read_text().splitlines():
        test, phase, module, qualified = json.loads(line)
        names = {part for part in qualified.split(".") if not part.startswith("<")}
        same = tests_of[test.partition("::")[0]] if phase == "setup" else {test} & passed  # a fixture is of its file
        for name in names:
            found[module, name] |= same
    return {key: sorted(tests, key=times.__getitem__) for key, tests in found.items()}


def try_mutant(mutant: Mutant, tests: list[str], copy: Path) -> dict:
    """Run the tests on the mutant until one fails, and say which; the copy is as before in the end."""
    path = copy / "lerobot_constructskill" / mutant.module
    path.write_text(mutant.source)
    by = f"survived {len(tests)} tests"
    try:
        done = run_pytest(copy, "-x", *tests, timeout=LONGEST_S) if tests else None
        if done and done.returncode:
            ended = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
            by = (ended or [f"pytest ended with {done.returncode}"])[0].partition(" - ")[0]
    except subprocess.TimeoutExpired:
        by = f"stood still for {LONGEST_S} s"
    finally:
        path.write_text(mutant.tree.code)
    return {"mutant": mutant.name, "function": mutant.function, "caught": not by.startswith("survived"), "by": by}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--draw", action="store_true", help="list what is drawn and stop")
    asked = parser.parse_args()
    everything = list_mutants()
    drawn = draw(everything, asked.count, asked.seed)
    print(f"{len(drawn)} of {len(everything)} mutants, seed {asked.seed}", flush=True)
    for mutant in drawn if asked.draw else ():
        print(mutant.name, mutant.function, *mutant.diff, sep="\n    ")
    if asked.draw:
        return
    KEPT.mkdir(parents=True, exist_ok=True)
    outcomes, tests = KEPT / f"outcomes_{asked.seed}.jsonl", reaching()
    before = [json.loads(line) for line in outcomes.read_text().splitlines()] if outcomes.exists() else []
    done = {one["mutant"] for one in before}
    cores = len(os.sched_getaffinity(0))
    copies: Queue[Path] = Queue()
    for number in range(cores):
        copies.put(make_copy(KEPT / f"copy_{number}"))

    def run(mutant: Mutant) -> None:
        copy = copies.get()
        try:
            found = try_mutant(mutant, tests.get((mutant.module, mutant.function), [])[:MOST_TESTS], copy)
        finally:
            copies.put(copy)
        with outcomes.open("a") as file:
            file.write(json.dumps(found) + "\n")
        print(f"{'caught' if found['caught'] else 'SURVIVED':<8}  {mutant.name}  {found['by']}", flush=True)

    with ThreadPoolExecutor(cores) as pool:
        list(pool.map(run, [one for one in drawn if one.name not in done]))
    told = [json.loads(line) for line in outcomes.read_text().splitlines()]
    print(f"{sum(one['caught'] for one in told)} of {len(told)} caught")


if __name__ == "__main__":
    main()
