"""Environment steps per second while ten policies are evaluated, in lockstep and by lerobot-eval one by one."""

import json

import numpy as np
from measure import LOG, OUT, Timer, report, run

import lerobot_constructskill.plugin  # noqa: F401
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
from lerobot_constructskill.rollout.agents import Observation, PolicyAgent

STOCK_RUNS, STEPS, FRAMES, WARM = 2, 250, 20, 20


def lockstep() -> tuple[float, int]:
    """Wall seconds and environment steps of one episode of every policy."""
    seconds, _ = run("python", "benchmarks/lockstep.py", str(OUT / "checkpoints"), str(STEPS))
    return seconds, int(LOG.read_text().split("steps:")[-1])


def stock(seed: int) -> tuple[float, int]:
    """The same of lerobot-eval with one policy: float32, the robot's original meshes, one environment."""
    folder = OUT / "eval" / str(seed)
    seconds, _ = run(
        "lerobot-eval",
        f"--policy.path={OUT}/checkpoints/seed_{seed}",
        "--policy.backbone_precision=float32",
        "--env.type=constructskill",
        "--env.light_robot=false",
        f"--env.episode_length={STEPS}",
        "--eval.n_episodes=1",
        "--eval.batch_size=1",
        f"--output_dir={folder}",
    )
    return seconds, frames(folder)


def frames(folder) -> int:
    """Length of the episode that lerobot-eval filmed; it does not say it anywhere else."""
    import av

    (video,) = json.loads((folder / "eval_info.json").read_text())["overall"]["video_paths"]
    with av.open(video) as container:
        return sum(1 for _ in container.decode(video=0)) - 1


def filming() -> float:
    """Seconds that lerobot-eval spends on one frame of its video, which it makes of every step."""
    env = ConstructSkillEnv(light_robot=False)
    env.reset(seed=1000)
    env.render()
    with Timer() as timer:
        for _ in range(FRAMES):
            env.step(np.array([0, 0, 0, 1], dtype=np.float32))
            env.render()
    with Timer() as unfilmed:
        for _ in range(FRAMES):
            env.step(np.array([0, 0, 0, 1], dtype=np.float32))
    env.close()
    return (timer.seconds - unfilmed.seconds) / FRAMES


def in_turn() -> float:
    """Steps per second of one policy in this process, where encoder, heads and simulator work one after another."""
    agent = PolicyAgent.from_pretrained(OUT / "checkpoints" / "seed_0", "cpu")
    env, timer = ConstructSkillEnv(), Timer()
    shown, _ = env.reset(seed=1000)
    for step in range(STEPS):
        if step == WARM:  # the encoder is compiled for its first picture
            timer = Timer()
        with timer:
            shown, *_ = env.step(agent.act(Observation(shown, env.privileged_state(), "")))
    env.close()
    return (STEPS - WARM) / timer.seconds


def main() -> None:
    frame = filming()
    runs = [stock(seed) for seed in range(STOCK_RUNS)]
    seconds, steps = lockstep()
    stock_steps, stock_seconds = sum(steps for _, steps in runs), sum(seconds for seconds, _ in runs)
    note = f"start-up counted on both sides; {STOCK_RUNS} of the ten stock runs were timed, which film every step"
    what, baseline = "environment steps/s, ten policies evaluated", "ten runs of lerobot-eval, one after another"
    report(what, steps / seconds, baseline, stock_steps / stock_seconds, 4, note)
    note = f"the same without the {1000 * frame:.0f} ms a step that its video takes"
    report(what, steps / seconds, baseline, stock_steps / (stock_seconds - frame * stock_steps), 4, note)
    note = "start-up counted for the ten policies alone"
    report(what, steps / seconds, "one policy in one process, its parts in turn", in_turn(), note=note)


if __name__ == "__main__":
    main()
