"""What the policy computes: bounds, loss, ensembling, thresholds, and what stays frozen."""

import math

import pytest
import torch

from lerobot_constructskill.errors import InputError
from lerobot_constructskill.policies.frozen_vit.configuration_frozen_vit import REGRESSION_LOSSES
from lerobot_constructskill.policies.frozen_vit.modeling_frozen_vit import POOLED, ensemble
from lerobot_constructskill.policies.frozen_vit.readouts import READOUTS, SpatialSoftmax

pytestmark = pytest.mark.usefixtures("by_pytorch")

ABLATIONS = [{}, {"chunk_size": 1}, {"temporal_ensemble_coeff": None}, {"gripper_head": "regression"}]
OTHER = [
    {"use_state": True},
    {"action_names": ["dx", "dy", "dz", "dyaw", "gripper"]},
    {"regression_weight": 100.0},
    {"head_hidden_dim": 64},
    {"head_hidden_dim": 64, "head_hidden_layers": 3, "regression_loss": "l1", "regression_weight": 10.0},
]
VARIANTS = [*ABLATIONS, *OTHER, *({"readout": name, "use_state": True} for name in READOUTS)]


def logits(policy, translation: float, gripper: list[float]) -> torch.Tensor:
    """A (1, T, A) chunk as the heads give it."""
    chunk = torch.full((1, len(gripper), len(policy.config.action_names)), translation)
    chunk[..., -1] = torch.tensor(gripper)
    return chunk


@pytest.mark.parametrize("fields", VARIANTS, ids=str)
def test_every_variant_learns_and_acts(fields, make_policy, make_batch):
    policy = make_policy(**fields).train()
    batch = make_batch(policy)
    optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=1e-2)
    losses = []
    for _ in range(60):
        loss, logs = policy.forward(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.2 * losses[0]
    assert all(type(value) is float for value in logs.values())
    chunk, action = policy.predict_action_chunk(batch), policy.select_action(batch)
    assert chunk.shape == batch["action"].shape and action.shape == chunk[:, 0].shape
    assert chunk[..., :-1].abs().max() <= policy.config.action_scale
    assert set(chunk[..., -1].unique().tolist()) <= {-1.0, 1.0}
    torch.testing.assert_close(action, chunk[:, 0])


def test_only_the_heads_train(make_policy, make_batch, images):
    policy = make_policy().train()
    assert policy.training and not policy.backbone.training
    before = policy(make_batch(policy, 2) | {"observation.images.base": images})[0]
    assert before.requires_grad
    assert {name for name, p in policy.named_parameters() if p.requires_grad} == {
        f"heads.{head}.{kind}" for head in ("translation", "gripper") for kind in ("weight", "bias")
    }
    assert sum(p.numel() for p in policy.get_optim_params()) == 193 * 8 * 4


def test_heads_do_not_depend_on_the_backbones_initialisation(make_policy, weights):
    one, other = make_policy(), make_policy(backbone_path=str(weights("vit_tiny16", seed=1)))
    torch.testing.assert_close(one.heads.gripper.weight, other.heads.gripper.weight)


@pytest.mark.parametrize("regression_loss", REGRESSION_LOSSES)
@pytest.mark.parametrize("gripper_head", ["bce", "regression"])
def test_padded_steps_do_not_count(gripper_head, regression_loss, make_policy, make_batch):
    policy = make_policy(gripper_head=gripper_head, regression_loss=regression_loss)
    batch = make_batch(policy)
    changed = {**batch, "action": batch["action"].clone()}
    changed["action"][batch["action_is_pad"]] = 7.0
    for reduction in ("mean", "none"):
        torch.testing.assert_close(policy.forward(batch, reduction)[0], policy.forward(changed, reduction)[0])


@pytest.mark.parametrize(("regression_loss", "power"), [("mse", 2), ("l1", 1)])
def test_the_loss_is_the_written_one(regression_loss, power, make_policy, make_batch):
    policy = make_policy(regression_loss=regression_loss)
    batch = make_batch(policy)
    raw, target, valid = policy._raw_chunk(batch), batch["action"], ~batch["action_is_pad"]
    translation = (raw[..., :-1] - target[..., :-1])[valid].abs().pow(power).mean()
    p_open = raw[..., -1].sigmoid()[valid]
    label = target[..., -1][valid] > 0
    entropy = -torch.where(label, p_open, 1 - p_open).log().mean()
    torch.testing.assert_close(policy.forward(batch)[0], translation + entropy)
    per_sample = policy.forward(batch, reduction="none")[0]
    n_valid = valid.sum(1)
    torch.testing.assert_close((per_sample * n_valid).sum() / n_valid.sum(), translation + entropy)


@pytest.mark.parametrize("coeff", [-0.1, 0.0, 0.1])
def test_ensembling_is_the_papers_sum(coeff):
    chunks = [torch.randn(2, 8, 4, dtype=torch.float64) for _ in range(5)]
    total = norm = 0
    for k in range(5):  # steps since the chunk was predicted; 0 is the newest
        weight = math.exp(coeff * k)
        total, norm = total + weight * chunks[4 - k][:, k], norm + weight
    torch.testing.assert_close(ensemble(chunks, coeff), total / norm)


def test_the_default_sign_weighs_the_newest_chunk_most():
    votes = [torch.zeros(1, 8, 1) for _ in range(8)]
    shares = []
    for k in range(8):
        one = [vote.clone() for vote in votes]
        one[7 - k][:] = 1.0
        shares.append(ensemble(one, -0.1).item())
    assert shares == sorted(shares, reverse=True)
    assert shares[1] / shares[0] == pytest.approx(math.exp(-0.1))


def test_an_episode_is_ensembled_over_its_last_chunks_and_forgotten_at_reset(make_policy, monkeypatch):
    policy = make_policy(chunk_size=3)
    chunks = [logits(policy, t / 100, [t, t + 10, t + 20]) for t in range(6)]
    fed = iter(chunks + chunks)
    monkeypatch.setattr(policy, "_raw_chunk", lambda batch: next(fed))
    actions = [policy.select_action({}) for _ in range(6)]
    torch.testing.assert_close(actions[5][:, :3], ensemble(chunks[3:], -0.1)[:, :3])
    policy.reset()
    torch.testing.assert_close(policy.select_action({}), actions[0])


@pytest.mark.parametrize(
    ("gripper_head", "raw", "state"),
    [("bce", 0.4, -1.0), ("bce", 0.6, 1.0), ("regression", -0.1, -1.0), ("regression", 0.1, 1.0)],
)
def test_the_gripper_boundary(gripper_head, raw, state, make_policy, monkeypatch):
    policy = make_policy(gripper_head=gripper_head)
    monkeypatch.setattr(policy, "_raw_chunk", lambda batch: logits(policy, 0.0, [raw] * 8))
    assert policy.select_action({})[0, -1] == state


def test_logits_are_ensembled_before_the_threshold(make_policy, monkeypatch):
    policy = make_policy(chunk_size=2)
    fed = iter([logits(policy, 0.0, [9.0, 9.0]), logits(policy, 0.0, [-2.0, -2.0])])
    monkeypatch.setattr(policy, "_raw_chunk", lambda batch: next(fed))
    policy.select_action({})
    assert policy.select_action({})[0, -1] == 1.0


@pytest.mark.parametrize("n_action_steps", [1, 3])
def test_without_ensembling_a_chunk_is_followed(n_action_steps, make_policy, monkeypatch):
    policy = make_policy(temporal_ensemble_coeff=None, n_action_steps=n_action_steps)
    chunks = [torch.rand(1, 8, 4) for _ in range(3)]
    fed = iter(chunks)
    monkeypatch.setattr(policy, "_raw_chunk", lambda batch: next(fed))
    taken = torch.cat([policy.select_action({}) for _ in range(3)])
    expected = torch.cat(chunks)[:, 0] if n_action_steps == 1 else chunks[0][0, :3]
    torch.testing.assert_close(taken[:, :3], expected[:, :3])


@pytest.mark.parametrize("logit", [-30.0, 0.5, 30.0])
def test_a_translation_is_a_tenth_of_a_metre_times_tanh(make_policy, images, logit):
    """Paper, section II."""
    policy = make_policy().eval()
    with torch.no_grad():
        policy.heads.translation.weight.zero_()
        policy.heads.translation.bias.fill_(logit)
    chunk = policy.predict_action_chunk({"observation.images.base": images})
    torch.testing.assert_close(chunk[..., :3], torch.full_like(chunk[..., :3], 0.1 * math.tanh(logit)))


def test_features_give_the_same_action_as_the_image(make_policy, images):
    policy = make_policy().eval()
    feature = policy.backbone(images)
    torch.testing.assert_close(
        policy.predict_action_chunk({"observation.images.base": images}),
        policy.predict_action_chunk({"observation.features.base": feature}),
    )


def test_standardised_features_are_the_same_linear_heads_in_other_units(make_policy, make_batch, tmp_path):
    batch = make_batch(make_policy())
    features = batch[POOLED]
    stats = {"observation.features.base": {"mean": features.mean(0) + 1.0, "std": features.std(0) * 2}}
    standardised = make_policy(standardize_features=True, dataset_stats=stats)
    mean, std = (torch.as_tensor(value) for value in stats["observation.features.base"].values())
    moved = {**batch, POOLED: features * std + mean}
    torch.testing.assert_close(
        standardised.predict_action_chunk(moved), make_policy().predict_action_chunk(batch), atol=1e-5, rtol=1e-4
    )
    standardised.save_pretrained(tmp_path)
    again = type(standardised).from_pretrained(tmp_path, local_files_only=True)
    torch.testing.assert_close(again.predict_action_chunk(moved), standardised.predict_action_chunk(moved))


def test_a_channel_that_no_frame_of_the_training_set_excites_is_not_magnified(make_policy):
    std = torch.ones(make_policy().backbone.spec.feature_dim)
    std[:3] = torch.tensor([0.0, 1e-9, 1e-5])
    stats = {"observation.features.base": {"mean": torch.zeros_like(std), "std": std}}
    assert (make_policy(standardize_features=True, dataset_stats=stats).feature_std == 1).all()


def test_standardised_features_need_statistics(make_policy):
    with pytest.raises(ValueError, match="constructskill-encode"):
        make_policy(standardize_features=True)


def test_a_batch_without_camera_says_what_it_holds(make_policy):
    with pytest.raises(ValueError, match="the batch holds: observation.images.top.*pixels_agent_pos shows"):
        make_policy().select_action({"observation.images.top": torch.zeros(1, 3, 224, 224)})


@pytest.mark.parametrize("name", READOUTS)
def test_a_readout_sees_the_image(name, make_policy, images):
    """What it is given beforehand is what it takes itself, and it tells one image from another."""
    policy = make_policy(readout=name)
    chunk = policy.predict_action_chunk({"observation.images.base": images})
    torch.testing.assert_close(chunk, policy.predict_action_chunk({POOLED: policy.pool(images)}))
    assert not torch.equal(chunk[0], chunk[1])


@pytest.mark.parametrize(("patch", "position"), [(0, (-0.75, -0.75)), (3, (0.75, -0.75)), (14, (0.25, 0.75))])
def test_a_keypoint_is_where_its_pattern_is(patch, position):
    """On a grid of 4 x 4 patches: x to the right, y down."""
    readout = SpatialSoftmax(dim=2, keypoints=1)
    with torch.no_grad():
        readout.patterns.weight.copy_(torch.tensor([[100.0, 0.0]]))
    patches = torch.zeros(1, 16, 2)
    patches[0, patch, 0] = 1
    torch.testing.assert_close(readout(patches), torch.tensor([position]))


def test_heat_maps_learn_where_things_are_and_nothing_acts_on_where_they_are_said_to_be(make_policy, make_batch):
    policy = make_policy(readout="heat_maps").train()
    batch = make_batch(policy)
    first = policy.forward(batch)[1]["point_loss"]
    optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=1e-2)
    for _ in range(60):
        optimizer.zero_grad()
        policy.forward(batch)[0].backward()
        optimizer.step()
    assert (last := policy.forward(batch)[1]["point_loss"]) < 0.7 * first, (first, last)
    untold = {name: value for name, value in batch.items() if "points" not in name}
    torch.testing.assert_close(policy.predict_action_chunk(untold), policy.predict_action_chunk(batch))


def test_the_weight_of_the_points_is_the_configured_one(make_policy, make_batch):
    losses = []
    for weight in (1.0, 3.0):
        policy = make_policy(readout="heat_maps", point_weight=weight)
        losses.append([policy.forward(make_batch(policy), kind)[0] for kind in ("mean", "none")])
        astray = policy.forward(make_batch(policy))[1]["point_loss"]
    torch.testing.assert_close(losses[1][0] - losses[0][0], torch.tensor(2 * astray))
    torch.testing.assert_close((losses[1][1] - losses[0][1]).mean(), torch.tensor(2 * astray))


def test_a_state_that_is_not_shown_is_a_sentence(make_policy, images):
    policy = make_policy(use_state=True).eval()
    with pytest.raises(InputError, match="was trained with observation.state, which obs_type=pixels_agent_pos"):
        policy.select_action({"observation.images.base": images})
