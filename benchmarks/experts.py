"""How often each task's expert succeeds, as `constructskill-check-task` measures it, into benchmarks/experts.json.

Usage: python benchmarks/experts.py [TASK ...]   (tasks that are not named keep their counts)
"""

import json
import sys
from pathlib import Path

from run import machine

from lerobot_constructskill.contract import SHIPPED
from lerobot_constructskill.scripts.expert import CheckTaskConfig, measure_expert

FILE = Path(__file__).with_suffix(".json")


def main(names: list[str]) -> None:
    counts = json.loads(FILE.read_text()) if FILE.exists() else {}
    for name in names or SHIPPED:
        config = CheckTaskConfig(name)
        lengths, failures = measure_expert(config)
        longest = max(lengths, default=0)
        counts[name] = {"states": config.states, "failed": failures, "longest": longest, "machine": machine()}
        FILE.write_text(json.dumps(counts, indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
