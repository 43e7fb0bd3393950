"""What a policy is told: sentences by a real encoder, by number, and a refusal of what it cannot know."""

import json
import shutil

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies.factory import make_policy

from lerobot_constructskill.errors import FieldError, InputError
from lerobot_constructskill.policies.frozen_vit.configuration_frozen_vit import FUSIONS
from lerobot_constructskill.policies.frozen_vit.language import CONTRACT, NUMBER, Told, sentence_encoder, sentences_of
from lerobot_constructskill.policies.frozen_vit.modeling_frozen_vit import FrozenViTChunkPolicy
from lerobot_constructskill.policies.frozen_vit.train_seeds import save_checkpoint, train_seeds
from lerobot_constructskill.rollout.offline import heldout_mse
from lerobot_constructskill.wordings import REWORDINGS

GREY, BLUE = "Put the brick into the grey bin.", "Put the brick into the blue bin."
TRAINING = {"epochs": 60, "batch_size": 16, "held_out": [6, 7]}
HEADS = {"head_hidden_dim": 64, "optimizer_lr": 3e-3}


def test_a_sentence_has_one_vector_whatever_stands_beside_it():
    encoder = sentence_encoder("minilm")
    one, both = encoder.encode([GREY]), encoder.encode([BLUE, GREY])
    assert torch.equal(one[0], both[1]) and one.norm() == pytest.approx(1)
    near, far = encoder.encode(["Place the brick in the bin that is grey.", "The crane lifts a window."]) @ one[0]
    assert near > 0.8 > far + 0.3


@pytest.fixture(scope="module")
def error(told_set, config, tmp_path_factory):
    """The held-out error in m2 of a policy that is trained with some fields."""

    def train(**fields) -> float:
        filled = config(**HEADS, **fields)
        (policy,) = train_seeds(filled, told_set, [0], **TRAINING)
        folder = tmp_path_factory.mktemp("told") / "checkpoint"
        save_checkpoint(policy, told_set, folder)
        return heldout_mse(folder, told_set, TRAINING["held_out"], backbone_path=filled.backbone_path)

    return train


def test_a_wording_counts_less_than_the_task():
    """Also one that is never trained with: its distance from its own task's sentence, by that between two tasks."""
    orders = [sentence for sentence in REWORDINGS if sentence.startswith("Put the")]
    told = Told("minilm", [[sentence] for sentence in orders])
    between = torch.cdist(told(orders), told(orders)).fill_diagonal_(torch.inf).min(dim=1).values
    for number, sentence in enumerate(orders):
        for wordings in REWORDINGS[sentence]:
            distances = torch.cdist(told(wordings), told(orders))
            assert (distances.argmin(dim=1) == number).all()
            assert (distances[:, number] < between[number] / 2).all()


def test_a_single_tasks_sentence_says_nothing(told_set, config, caplog):
    told = Told("minilm", [[GREY]])
    assert told([GREY, BLUE]).shape == (2, 0)
    assert torch.isfinite(told.scale)
    single = config(language="minilm", sentences=[[GREY]])
    assert make_policy(single, ds_meta=told_set.meta).heads.film is None
    assert "asked in one sentence, so language=minilm tells the policy nothing" in caplog.text


def test_sentences_that_an_encoder_takes_for_one_say_nothing():
    told = Told("minilm", [[GREY], [GREY.upper()]])
    assert told([GREY, BLUE]).eq(0).all()


@pytest.mark.slow
@pytest.mark.parametrize("language", [NUMBER, "minilm"])
@pytest.mark.parametrize("fusion", FUSIONS)
def test_a_policy_that_is_told_learns_what_another_cannot(error, language, fusion):
    assert error(language=language, language_fusion=fusion) < 0.3 * error()


@pytest.fixture
def told(told_set, config) -> FrozenViTChunkPolicy:
    return make_policy(config(language=NUMBER), ds_meta=told_set.meta)


def test_a_checkpoint_keeps_its_sentences_and_their_encoder(told_set, config, tmp_path):
    filled = config(language="minilm", use_state=True)
    policy = make_policy(filled, ds_meta=told_set.meta)
    policy.save_pretrained(tmp_path)
    loaded = FrozenViTChunkPolicy.from_pretrained(tmp_path, backbone_path=filled.backbone_path)
    assert loaded.config.sentences == [[GREY], [BLUE]]
    assert loaded.encoder_record.sentence_sha256 == sentence_encoder("minilm").sha256
    new = ["Fetch the brick and let it go over the blue bin."]
    assert torch.equal(loaded.told(new), policy.told(new))


@pytest.mark.parametrize("language", [NUMBER, "minilm"])
def test_frames_are_told_in_every_wording_in_turn(language):
    told = Told(language, [[GREY, "Grey it is.", "Grey."], [BLUE]])
    assert told.reworded([GREY, BLUE, GREY, GREY], [3, 4, 5, 7]) == [GREY, BLUE, "Grey.", "Grey it is."]
    near = [(told([wording]) - told([GREY])).norm() for wording in ("Grey it is.", BLUE)]
    assert near[0] == 0 if language == NUMBER else near[0] > 0
    assert near[1] > 0


def test_rewordings_are_those_of_the_data_sets_contract(told_set, tmp_path):
    shutil.copytree(told_set.root, root := tmp_path / "set")
    said = {"tasks": [{"task": "a", "instruction": BLUE, "rewordings": ["Blue it is."]}, {"instruction": "Other."}]}
    (root / CONTRACT).write_text(json.dumps(said))
    assert sentences_of(LeRobotDatasetMetadata("local/told", root=root)) == [[GREY], [BLUE, "Blue it is."]]
    (root / CONTRACT).write_text('{"tasks": 3}')
    with pytest.raises(InputError, match="contract of a data set's tasks"):
        sentences_of(LeRobotDatasetMetadata("local/told", root=root))


def test_another_encoder_than_the_checkpoints_is_refused(told_set, config):
    with pytest.raises(InputError, match="was trained with 000000000000"):
        make_policy(config(language="minilm", language_sha256="0" * 64), ds_meta=told_set.meta)


def test_a_sentence_without_a_number_is_refused(told):
    with pytest.raises(InputError, match=r"not trained on 'Dance\.', but on: Put the brick"):
        told.told(["Dance."])


def test_instructions_need_a_task_in_the_batch(told, images):
    with pytest.raises(InputError, match="the batch has no task"):
        told.predict_action_chunk({"observation.images.base": images})


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ({"language": "latin"}, "language must be one of number, minilm or hf/"),
        ({"language": "minilm", "language_fusion": "add"}, "language_fusion must be one of film, concat"),
        ({"camera": "base+base"}, "camera names one twice"),
        ({"camera": "base+wrist", "readout": "heat_maps"}, "finds points in the picture of one camera"),
    ],
)
def test_what_cannot_be_is_one_sentence(config, fields, sentence):
    with pytest.raises(FieldError, match=sentence):
        config(**fields)


# Several cameras


@pytest.mark.slow
@pytest.mark.parametrize("readout", ["cls", "mean", "spatial_softmax"])
def test_two_cameras_are_read_one_after_the_other(config, images, readout):
    picture = PolicyFeature(FeatureType.VISUAL, (3, 224, 224))
    both = {"observation.images.base": images, "observation.images.wrist": 1 - images}

    def make(camera: str) -> FrozenViTChunkPolicy:
        filled = config(camera=camera, readout=readout)
        filled.input_features = dict.fromkeys(both, picture)
        return FrozenViTChunkPolicy(filled)

    policy = make("base+wrist")
    assert list(policy.config.input_features) == list(both)
    base, wrist = (make(name).head_inputs(both)[0] for name in ("base", "wrist"))
    assert torch.equal(policy.head_inputs(both)[0], torch.cat([base, wrist], dim=1))
    chunk = policy.predict_action_chunk(both)
    changed = policy.predict_action_chunk(both | {"observation.images.wrist": images})
    assert chunk.shape == changed.shape and not torch.equal(chunk, changed)
    with pytest.raises(InputError, match="needs observation.images.base and observation.images.wrist"):
        policy.predict_action_chunk({"observation.images.base": images})
