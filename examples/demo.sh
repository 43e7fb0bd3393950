#!/usr/bin/env bash
# The reference recipe from end to end, the brick elsewhere in every episode: demonstrations, one pass of the frozen
# encoder, and for each training seed lerobot-train, lerobot-eval and the outcome, as soon as it is known. Every step is a
# command of the README. A finished step is not done again, so a run that was killed continues.
set -euo pipefail
cd "$(dirname "$0")/.."
export PATH="$PWD/.venv/bin:$PATH"
OUT="${OUT:-outputs/demo}" SEEDS="${SEEDS:-0}"

if [ -d "$OUT/features" ] && ! grep -q efficientnet_lite0_fine "$OUT/features/meta/info.json"; then
    echo "$OUT holds the demo of another recipe: remove it, or name another folder (OUT=...)" >&2
    exit 1
fi

trap 'kill $(jobs -p) 2>/dev/null || true' EXIT # what is interrupted leaves nothing running

say() { printf '\n\033[1m== %d:%02d  %s\033[0m\n' $((SECONDS / 60)) $((SECONDS % 60)) "$*"; }

# Run a command of LeRobot's: its log goes to a file, its newest progress bar to the screen.
with_bar() {
    local log=$1 width=$(($(tput cols 2>/dev/null || echo 100) - 1))
    shift
    "$@" >"$log" 2>&1 &
    while kill -0 $! 2>/dev/null; do
        sleep 1
        printf '\r%-*.*s' "$width" "$width" "$(tail -c 500 "$log" | tr '\r' '\n' | grep '%|' | tail -n 1)"
    done
    printf '\n'
    wait $! || { echo "$1 failed: $(tail -n 1 "$log") (all of it: $log)" >&2; exit 1; }
}

say "Demonstrations: 50 of the brick task by the scripted expert, with noise (the simulators start: 10 seconds)"
[ -d "$OUT/demonstrations" ] || constructskill-generate precise/brick_to_bin_shifted --episodes=50 '--cameras=[wrist]' \
    --repo_id=local/shifted --root="$OUT/demonstrations" --workers="$(nproc)"

say "Features: every frame once through the frozen encoder, inner layers of EfficientNet-Lite0"
[ -d "$OUT/features" ] || constructskill-encode --backbone=efficientnet_lite0_fine --camera=wrist --patches=true \
    --repo_id=local/shifted --root="$OUT/demonstrations" --out_repo_id=local/shifted_fine --out_root="$OUT/features"

recipe=$(constructskill-config train/frozen_vit_precise --root="$OUT/features")
for seed in $SEEDS; do
    train="$OUT/train/seed_$seed" eval="$OUT/eval/seed_$seed"
    if [ ! -e "$train/checkpoints/last" ]; then
        say "Training seed $seed: lerobot-train, 30 epochs of 44 demonstrations"
        rm -rf "$train" # lerobot-train refuses the folder of a run that was killed before its checkpoint
        with_bar "$OUT/train_$seed.log" lerobot-train --config_path="$recipe" --seed="$seed" --output_dir="$train"
    fi
    if [ ! -e "$eval/eval_info.json" ]; then
        say "Training seed $seed: lerobot-eval, 5 episodes of at most 300 steps"
        with_bar "$OUT/eval_$seed.log" lerobot-eval --policy.path="$train/checkpoints/last/pretrained_model" \
            --env.type=constructskill --env.task=brick_to_bin_shifted --env.obs_type=pixels_agent_pos \
            --env.episode_length=300 --seed=2000 --eval.n_episodes=5 --eval.batch_size=1 --output_dir="$eval"
    fi
    say "Outcomes so far"
    python examples/count_outcomes.py "$OUT"
done
echo
echo "Left out to save time: 30 of the 80 demonstrations, and more training seeds, which results are reported by (SEEDS='0 1 2' make"
echo "demo continues from here; constructskill-study precise --only=brick_to_bin_shifted makes ten, for a report)."
