"""Training: stock lerobot-train on features against video, and ten seeds together against ten stock runs."""

import re
import shutil

from measure import LOG, OUT, report, run

from lerobot_constructskill.scripts.config import ConfigConfig, write

RECIPE_SAMPLES = 150 * 7252
"""What one seed of the recipe sees: 150 epochs of the 70 demonstrations of the fast set that are not held out."""

BATCH, STEPS = 64, 1140
VIDEO_STEPS = 12
SEEDS = 10
STOCK_RUNS = 2

VIDEO = [
    "--policy.type=frozen_vit",
    "--dataset.repo_id=local/fast",
    f"--dataset.root={OUT}/demonstrations",
    "--policy.backbone_precision=float32",
]
COMMON = ["--policy.push_to_hub=false", "--policy.save_backbone=false", "--env_eval_freq=0", "--log_freq=1"]


def train(number: int, steps: int, *flags: str) -> tuple[float, float]:
    """Run lerobot-train; return its wall seconds, and samples/s once it runs (the first steps left out)."""
    folder = OUT / "train" / str(number)
    shutil.rmtree(folder, ignore_errors=True)  # LeRobot does not train where it has trained
    seconds, _ = run(
        "lerobot-train",
        *flags,
        *COMMON,
        f"--batch_size={BATCH}",
        f"--steps={steps}",
        f"--save_freq={steps}",
        f"--output_dir={folder}",
    )
    log = LOG.read_text()
    durations = [float(u) + float(d) for u, d in re.findall(r"updt_s:(\S+) data_s:(\S+)", log)][2:]
    return seconds, BATCH * len(durations) / sum(durations)


def main() -> None:
    video_seconds, video_rate = train(0, VIDEO_STEPS, *VIDEO, "--num_workers=0")
    features = f"--config_path={write(ConfigConfig('train/frozen_vit_fast', OUT / 'features'))}"
    stock = [train(seed, STEPS, features, f"--seed={seed}") for seed in range(1, 1 + STOCK_RUNS)]
    feature_rate = sum(rate for _, rate in stock) / STOCK_RUNS
    what = "training samples/s under stock lerobot-train"
    report(what, feature_rate, "the same policy on video, float32", video_rate, 50, "once they run, start-up left out")
    starts = video_seconds - BATCH * VIDEO_STEPS / video_rate, stock[0][0] - BATCH * STEPS / stock[0][1]
    rates = video_rate, feature_rate
    whole = [RECIPE_SAMPLES / (start + RECIPE_SAMPLES / rate) for start, rate in zip(starts, rates, strict=True)]
    note = f"start-up of {starts[1]:.0f} and {starts[0]:.0f} s counted, over one seed of the recipe, extrapolated"
    report(what, whole[1], "the same policy on video, float32", whole[0], 50, note)

    together = run("python", "benchmarks/ten_seeds.py", str(OUT), str(SEEDS), str(BATCH))
    one = sum(seconds for seconds, _ in stock) / STOCK_RUNS
    note = f"{STOCK_RUNS} stock runs of ten epochs were timed ({one:.0f} s each) and multiplied"
    report(
        "ten seeds trained, s",
        together.seconds,
        "ten runs of lerobot-train on features",
        SEEDS * one,
        20,
        note,
        less_is_better=True,
    )


if __name__ == "__main__":
    main()
