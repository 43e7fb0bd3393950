"""Ten epochs of ten seeds trained together on `<folder>/features`, each saved as a LeRobot checkpoint beside it.

Usage: python benchmarks/ten_seeds.py <folder> <seeds> <batch size> [<weights of vit_tiny16>]
"""

import sys
from pathlib import Path

from lerobot.datasets import LeRobotDataset

from lerobot_constructskill.contract import held_out
from lerobot_constructskill.policies.frozen_vit.configuration_frozen_vit import FrozenViTChunkConfig
from lerobot_constructskill.policies.frozen_vit.train_seeds import save_checkpoint, train_seeds
from lerobot_constructskill.rollout.offline import heldout_mse

DINOV2 = {"standardize_features": True}  # configs/train/frozen_vit_fast.yaml


def main(folder: Path, n_seeds: int, batch_size: int, weights: str | None = None) -> None:
    fields = {"backbone": "vit_tiny16", "backbone_path": weights} if weights else DINOV2
    config = FrozenViTChunkConfig(save_backbone=False, device="cpu", **fields)
    dataset = LeRobotDataset("local/features", root=folder / "features")
    episodes = held_out(dataset.num_episodes)
    policies = train_seeds(config, dataset, range(n_seeds), 10, batch_size, episodes)
    for seed, policy in enumerate(policies):
        save_checkpoint(policy, dataset, checkpoint := folder / "checkpoints" / f"seed_{seed}")
        print(f"seed {seed}: held-out translation error {heldout_mse(checkpoint, dataset, episodes):.2e} m2")


if __name__ == "__main__":
    folder, n_seeds, batch_size, *weights = sys.argv[1:]
    main(Path(folder), int(n_seeds), int(batch_size), *weights)
