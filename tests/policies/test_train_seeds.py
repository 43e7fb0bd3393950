"""Seeds trained together are the seeds trained alone, and end as LeRobot checkpoints."""

from functools import cache

import pytest
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.policies.factory import make_policy, make_pre_post_processors

from lerobot_constructskill.errors import InputError
from lerobot_constructskill.policies.frozen_vit.readouts import READOUTS
from lerobot_constructskill.policies.frozen_vit.train_seeds import save_checkpoint, train_seeds
from lerobot_constructskill.rollout.agents import PolicyAgent
from lerobot_constructskill.rollout.offline import heldout_mse

EPOCHS, BATCH_SIZE = 3, 16
HELD_OUT = [3, 7]
TRAINING = {"epochs": EPOCHS, "batch_size": BATCH_SIZE, "held_out": HELD_OUT}
FIELDS = [
    {},
    {"chunk_size": 1},
    {"gripper_head": "regression"},
    {"use_state": True},
    {"standardize_features": True},
    {"head_hidden_dim": 32},
    {"head_hidden_dim": 32, "head_hidden_layers": 2, "regression_loss": "l1"},
    {"regression_weight": 100.0, "scheduler_warmup_steps": 4},
    *({"readout": name, "use_state": readout.learns} for name, readout in READOUTS.items() if name != "cls"),
]


@cache
def chunked(dataset, chunk_size):
    """Items of LeRobot's own loader, read once for all variants."""
    chunks = {"action": [i / dataset.fps for i in range(chunk_size)]}
    return list(LeRobotDataset(dataset.repo_id, root=dataset.root, delta_timestamps=chunks))


def train_alone(config, dataset, seed):
    """One seed as a plain loop over LeRobot's own loader items, `policy.forward`, AdamW and gradient clipping."""
    torch.manual_seed(seed)
    policy = make_policy(config, ds_meta=dataset.meta).train()
    items = chunked(dataset, config.chunk_size)
    preprocess, _ = make_pre_post_processors(policy.config, dataset_stats=dataset.meta.stats)
    preset = policy.config.get_optimizer_preset()
    optimizer = preset.build(policy.get_optim_params())
    schedule = policy.config.get_scheduler_preset()
    rows = [i for i in range(len(items)) if int(items[i]["episode_index"]) not in HELD_OUT]
    scheduler = schedule and schedule.build(optimizer, EPOCHS * -(-len(rows) // BATCH_SIZE))
    generator = torch.Generator().manual_seed(seed)
    for _ in range(EPOCHS):
        order = torch.tensor(rows)[torch.randperm(len(rows), generator=generator)]
        for batch in order.split(BATCH_SIZE):
            loss, _ = policy(preprocess(torch.utils.data.default_collate([items[int(i)] for i in batch])))
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(policy.get_optim_params(), preset.grad_clip_norm)
            optimizer.step()
            _ = scheduler and scheduler.step()
    return policy


@pytest.mark.parametrize("fields", FIELDS, ids=str)
def test_a_seed_among_others_is_the_seed_alone(fields, config, feature_set):
    together = train_seeds(config(**fields), feature_set, [3, 0, 7], **TRAINING)
    alone = train_alone(config(**fields), feature_set, 0)
    for name, parameter in alone.heads.state_dict().items():
        torch.testing.assert_close(together[1].heads.state_dict()[name], parameter, atol=1e-6, rtol=1e-4)
    weights = [next(policy.heads.translation.parameters()) for policy in together]
    assert not torch.equal(weights[0], weights[1]) and not torch.equal(weights[1], weights[2])


def test_heat_maps_are_not_trained_without_points(config, feature_set):
    untold = LeRobotDataset(feature_set.repo_id, root=feature_set.root)
    del untold.meta.info.features["observation.points.base"]
    with pytest.raises(InputError, match="--points=true"):
        train_seeds(config(readout="heat_maps"), untold, [0], **TRAINING)


@pytest.fixture
def threads():
    """Put the number of torch's threads back."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("readout", ["cls", "spatial_softmax"])
def test_weights_do_not_depend_on_the_number_of_cores(readout, config, feature_set, threads):
    trained = []
    for number in (1, 2):
        torch.set_num_threads(number)
        (policy,) = train_seeds(config(readout=readout, head_hidden_dim=256), feature_set, [0], **TRAINING)
        trained.append(policy.heads.state_dict())
        assert torch.get_num_threads() == number
    assert all(torch.equal(trained[0][name], trained[1][name]) for name in trained[0])


def test_gradients_are_clipped_for_each_seed_by_itself(config, feature_set, monkeypatch):
    """With a bound that every step exceeds, the parity above holds only if no seed's norm reaches another's."""
    from lerobot.optim import AdamWConfig

    bounded = config()
    monkeypatch.setattr(type(bounded), "get_optimizer_preset", lambda self: AdamWConfig(1e-3, grad_clip_norm=1e-3))
    together = train_seeds(bounded, feature_set, [0, 1], **TRAINING)
    alone = train_alone(bounded, feature_set, 1)
    weight = together[1].heads.translation.weight
    torch.testing.assert_close(weight, alone.heads.translation.weight, atol=1e-6, rtol=1e-4)


@pytest.mark.parametrize("fields", [{}, {"use_state": True}, {"readout": "attention"}], ids=str)
@pytest.mark.parametrize("validation", ["feature_set", "other_set"])
def test_the_held_out_error_is_that_of_every_fourth_episode(
    validation, fields, config, feature_set, request, tmp_path
):
    """Of the training set or of another, which is normalised as the training set was."""
    policies = train_seeds(config(**fields), feature_set, [0], **TRAINING)
    dataset, stats = request.getfixturevalue(validation), feature_set.meta.stats
    preprocess, _ = make_pre_post_processors(policies[0].config, dataset_stats=stats)
    save_checkpoint(policies[0], feature_set, tmp_path)
    measured = heldout_mse(tmp_path, dataset, HELD_OUT)
    items = [
        item for item in chunked(dataset, policies[0].config.chunk_size) if int(item["episode_index"]) in HELD_OUT
    ]
    batch = preprocess(torch.utils.data.default_collate(items))
    policies[0].patches_root = dataset.root
    error = (policies[0].predict_action_chunk(batch) - batch["action"])[~batch["action_is_pad"]][:, :3]
    assert measured == pytest.approx(error.pow(2).mean().item(), rel=1e-5)


def test_without_a_held_out_episode_there_is_no_error(config, feature_set, tmp_path):
    (policy,) = train_seeds(config(), feature_set, [0], epochs=1, batch_size=16)
    save_checkpoint(policy, feature_set, tmp_path)
    assert heldout_mse(tmp_path, feature_set, []) is None


def test_the_held_out_error_of_a_checkpoint_from_a_gpu_is_measured_here(config, feature_set, tmp_path):
    """There is none: its files say that it was."""
    (policy,) = train_seeds(config(use_state=True), feature_set, [0], **TRAINING)
    save_checkpoint(policy, feature_set, tmp_path)
    before = heldout_mse(tmp_path, feature_set, HELD_OUT)
    path = tmp_path / "policy_preprocessor.json"
    path.write_text(path.read_text().replace('"device": "cpu"', '"device": "cuda"'))
    assert "cuda" in path.read_text() and heldout_mse(tmp_path, feature_set, HELD_OUT, device="cpu") == before


def test_a_checkpoint_is_lerobots_own_and_acts_alike(config, feature_set, tmp_path):
    trained = train_seeds(config(use_state=True), feature_set, [0, 1], **TRAINING)
    for seed, policy in enumerate(trained):
        save_checkpoint(policy, feature_set, tmp_path / str(seed))
    for seed, policy in enumerate(trained):
        loaded = PolicyAgent.from_pretrained(tmp_path / str(seed), "cpu").policy
        assert loaded.config.input_features == policy.config.input_features
        for name, tensor in policy.state_dict().items():
            assert torch.equal(loaded.state_dict()[name], tensor)


def test_images_are_refused(config, feature_set, monkeypatch):
    features = {k: v for k, v in feature_set.meta.features.items() if "features" not in k}
    features["observation.images.base"] = {
        "dtype": "video",
        "shape": (224, 224, 3),
        "names": ["height", "width", "channels"],
    }
    monkeypatch.setattr(type(feature_set.meta), "features", features)
    with pytest.raises(ValueError, match="has no observation.features.base"):
        train_seeds(config(), feature_set, [0], **TRAINING)
