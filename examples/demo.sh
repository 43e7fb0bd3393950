#!/usr/bin/env bash
# The brick task from end to end, the brick elsewhere in every episode: demonstrations, one pass of the frozen encoder,
# lerobot-train and lerobot-eval per training seed, and the outcomes. Every step is a command of the README. A finished
# step is not done again, so a run that was killed continues.
set -euo pipefail
cd "$(dirname "$0")/.."
export PATH="$PWD/.venv/bin:$PATH"
export OUT="${OUT:-outputs/shifted}" SEEDS="${SEEDS:-0 1}"

CORES=$(nproc) # asked for before OMP_NUM_THREADS is set, which it would answer with

say() { printf '\n\033[1m== %s\033[0m\n' "$*"; }

say "1/4 80 demonstrations of the brick task by the scripted expert, with noise"
[ -d "$OUT/demonstrations" ] || constructskill-generate --config_path=configs/generate/fast_shifted_wrist.yaml \
    --repo_id=local/shifted --root="$OUT/demonstrations" --workers="$CORES"

say "2/4 every frame once through the frozen DINOv2 encoder"
[ -d "$OUT/features" ] || constructskill-encode --camera=wrist --patches=true \
    --repo_id=local/shifted --root="$OUT/demonstrations" --out_repo_id=local/shifted_dinov2 --out_root="$OUT/features"

one_seed() {
    local train="$OUT/train/seed_$1" eval="$OUT/eval/seed_$1" config=configs/train/frozen_vit_keypoints.yaml
    if [ ! -e "$train/checkpoints/last" ]; then
        rm -rf "$train" # lerobot-train refuses the folder of a run that was killed before its checkpoint
        lerobot-train --config_path="$config" --dataset.root="$OUT/features" --num_workers=0 \
            --seed="$1" --output_dir="$train" >"$OUT/train_$1.log" 2>&1 ||
            { echo "seed $1: lerobot-train failed, see $OUT/train_$1.log"; exit 255; }
    fi
    echo "seed $1: trained"
    [ -e "$eval/eval_info.json" ] || lerobot-eval --policy.path="$train/checkpoints/last/pretrained_model" \
        --env.type=constructskill --env.task=brick_to_bin_shifted --env.obs_type=pixels_agent_pos \
        --env.episode_length=250 --eval.n_episodes=5 --eval.batch_size=1 \
        --output_dir="$eval" >"$OUT/eval_$1.log" 2>&1 ||
        { echo "seed $1: lerobot-eval failed, see $OUT/eval_$1.log"; exit 255; }
    echo "seed $1: evaluated"
}
export -f one_seed

say "3/4 and 4/4 lerobot-train and lerobot-eval, training seeds $SEEDS (logs in $OUT, some minutes a seed)"
# One seed a core and one thread a process: threads of two processes that share two cores stall each other.
export OMP_NUM_THREADS=1
tr ' ' '\n' <<<"$SEEDS" | xargs -P "$CORES" -I{} bash -c 'one_seed {}'

say "Outcomes per training seed"
python examples/count_outcomes.py "$OUT"
