"""What a kind of video costs: size, fidelity, and how far an encoder's features move; a line a kind and camera.

python benchmarks/video.py [task] [backbone]
"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from lerobot.datasets import LeRobotDataset

from lerobot_constructskill.contract import CAMERAS, DEMO_SEED_START, OBS_TYPES, get_task
from lerobot_constructskill.demos.columns import demonstration_features
from lerobot_constructskill.demos.demonstrate import demonstrate
from lerobot_constructskill.demos.expert import ExpertConfig, make_expert
from lerobot_constructskill.demos.noise import NoiseConfig
from lerobot_constructskill.demos.shards import write_episode
from lerobot_constructskill.demos.video import VIDEOS
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
from lerobot_constructskill.features.encode import load_encoder

OBS_TYPE = "pixels_agent_pos"
EVERY = 8
"""Of so many frames one is compared."""


def main(name: str = "brick_on_brick", backbone: str = "efficientnet_lite0_fine") -> None:
    task, (encoder, _) = get_task(name), load_encoder(backbone)
    env = ConstructSkillEnv(name, OBS_TYPE, task.horizon)
    frames, _ = demonstrate(env, make_expert(task, ExpertConfig()), NoiseConfig(), DEMO_SEED_START)
    env.close()
    rows, features = range(0, len(frames), EVERY), demonstration_features(task, OBS_TYPES[OBS_TYPE])
    for camera in OBS_TYPES[OBS_TYPE]:
        key = CAMERAS[camera].key
        rendered = torch.stack([torch.from_numpy(frames[row][key]).permute(2, 0, 1) / 255 for row in rows])
        said = f"one pixel to the right: features {moved(encoder, rendered, rendered.roll(1, -1)):.0%}"
        for kind in VIDEOS:
            with TemporaryDirectory() as folder:
                root = Path(folder) / "set"
                write_episode("local/video", task, features, frames, root, kind)
                size = sum(path.stat().st_size for path in root.rglob(f"*{key}*/**/*.mp4")) / len(frames)
                dataset = LeRobotDataset("local/video", root=root)
                decoded = torch.stack([dataset[row][key] for row in rows])
            difference = decoded - rendered
            noise = difference.square().mean().clamp(min=1e-12)
            print(
                f"{name}, {camera}, {kind}: {size:,.0f} bytes a frame, {-10 * noise.log10():.0f} dB, "
                f"brightness {difference.mean():+.2%}, features {moved(encoder, rendered, decoded):.0%} ({said})"
            )


def moved(encoder, images: torch.Tensor, others: torch.Tensor) -> float:
    """The distance of two batches' patch features, as a share of the first's norm."""
    before, after = (encoder.encode(batch)[1] for batch in (images, others))
    return float((after - before).norm() / before.norm())


if __name__ == "__main__":
    main(*sys.argv[1:])
