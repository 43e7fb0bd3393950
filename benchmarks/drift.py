"""What bfloat16 changes against float32: the features of real frames, and the actions of trained seeds on them."""

import torch
from lerobot.datasets import LeRobotDataset
from measure import OUT, report

from lerobot_constructskill.features.encode import load_encoder
from lerobot_constructskill.policies.frozen_vit.precision import native_precision
from lerobot_constructskill.rollout.agents import PolicyAgent

FRAMES = 200


@torch.inference_mode()
def main() -> None:
    if native_precision() != "bfloat16":
        print("this CPU would emulate bfloat16, which nothing here then uses")
        return
    dataset = LeRobotDataset("local/fast", root=OUT / "demonstrations")
    rows = torch.linspace(0, len(dataset) - 1, FRAMES).long()
    images = torch.stack([dataset[int(row)]["observation.images.base"] for row in rows])
    exact = load_encoder("dinov2_vits14", precision="float32")[0](images)
    low = load_encoder("dinov2_vits14", precision="bfloat16")[0](images)
    policies = [PolicyAgent.from_pretrained(path, "cpu").policy for path in sorted((OUT / "checkpoints").iterdir())]
    chunks = [[p.predict_action_chunk({p.config.feature_key: f})[:, 0] for f in (exact, low)] for p in policies]
    moved = torch.stack([(a - b)[:, :3].norm(dim=1) for a, b in chunks]) * 1000
    length = torch.stack([a[:, :3].norm(dim=1) for a, _ in chunks]) * 1000
    flipped = torch.stack([a[:, 3] != b[:, 3] for a, b in chunks]).float().mean()
    note = f"relative norm of the difference, {FRAMES} frames of the fast set; 0 would be equal"
    report("drift of the features, bfloat16", (low - exact).norm().item(), "float32", exact.norm().item(), note=note)
    note = (
        f"mean over ten seeds; largest {moved.max():.2f} mm; gripper decided otherwise in {flipped:.2%} of the frames"
    )
    report("drift of the translations, bfloat16, mm", moved.mean().item(), "float32", length.mean().item(), note=note)


if __name__ == "__main__":
    main()
