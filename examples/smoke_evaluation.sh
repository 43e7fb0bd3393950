#!/usr/bin/env bash
# What LeRobot's CI asks of a benchmark, on a CPU and without a network: a demonstration, one step of training inside
# which an evaluation runs, an evaluation with its video, and metrics.json. It says whether the pipeline works; nothing
# is learned in a step. OUT=folder TASK=task examples/smoke_evaluation.sh; a folder of an earlier run is continued.
set -euo pipefail
cd "$(dirname "$0")/.."
export PATH="$PWD/.venv/bin:$PATH" HF_HUB_OFFLINE=1
TASK="${TASK:-brick_to_bin}"
OUT="${OUT:-outputs/smoke_evaluation/$TASK}"
if [ -e "$OUT/trained" ] && [ "$(cat "$OUT/trained")" != "$TASK" ]; then
    echo "$OUT is of the task $(cat "$OUT/trained"); name another OUT for $TASK." >&2
    exit 1
fi

# Random weights of the smallest network: nothing has to be downloaded.
policy=(--policy.type=frozen_vit --policy.backbone=vit_tiny16 --policy.backbone_pretrained=false
    --policy.push_to_hub=false)
env=(--env.type=constructskill --env.task="$TASK" --env.episode_length=20)
eval=(--eval.n_episodes=1 --eval.batch_size=1 --eval.use_async_envs=false)

[ -d "$OUT/demonstrations" ] || constructskill-generate smoke --episodes=1 --task="$TASK" --repo_id=local/smoke \
    --root="$OUT/demonstrations"
[ -e "$OUT/trained" ] || { rm -rf "$OUT/train"; lerobot-train "${policy[@]}" --dataset.repo_id=local/smoke \
    --dataset.root="$OUT/demonstrations" --dataset.episodes='[0]' --batch_size=1 --num_workers=0 --steps=1 \
    --save_freq=1 "${env[@]}" "${eval[@]}" --env_eval_freq=1 --output_dir="$OUT/train" && echo "$TASK" > "$OUT/trained"; }
lerobot-eval --policy.path="$OUT/train/checkpoints/last/pretrained_model" "${env[@]}" "${eval[@]}" \
    --output_dir="$OUT/eval"

python - "$OUT" "$TASK" <<'PYTHON'
import json
import sys
from pathlib import Path

from lerobot_constructskill.contract import select_tasks

out, task = Path(sys.argv[1]), sys.argv[2]
overall = json.loads((out / "eval" / "eval_info.json").read_text())["overall"]
missing = [video for video in overall["video_paths"] if not Path(video).stat().st_size]
assert overall["video_paths"] and not missing, f"These videos are empty or missing: {missing}."
rows = [row for suite in select_tasks(task).values() for row in suite]
facts = {"env": "constructskill", "task": task, "policy": "frozen_vit, one step, random backbone"}
kept = {name: overall[name] for name in ("pc_success", "n_episodes", "avg_sum_reward", "eval_s")}
metrics = facts | kept | {"task_descriptions": {row.name: row.instruction for row in rows}}
(out / "metrics.json").write_text(json.dumps(metrics, indent=2) + "\n")
print(json.dumps(metrics, indent=2), *overall["video_paths"], sep="\n")
PYTHON
