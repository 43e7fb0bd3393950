"""A recipe is trained again: the honest entry is the same to the last bit, and each forged one is told from it."""

import hashlib
import json
import os
import shutil

import pytest
import yaml
from commands import call
from forge import declare, edit

from lerobot_constructskill.board.declaration import Trained
from lerobot_constructskill.board.recipe import check_plain, starts_from
from lerobot_constructskill.board.recovered import Lost, path_of, read_recovered
from lerobot_constructskill.board.retrain import study_of
from lerobot_constructskill.board.submission import RECIPE_FILE, read_submission, write_submission
from lerobot_constructskill.errors import InputError

RECIPE = {
    "name": "tiny",
    "settings": {"fixed": {"data": "smoke --noise.sigma=0.001", "env": {"task": "brick_to_bin"}, "training": {}}},
    "variants": {"ours": {"policy": {"type": "frozen_vit", "backbone": "efficientnet_lite0"}, "seeds": 2}},
}
"""Plain data."""


@pytest.mark.parametrize(
    ("where", "value", "said"),
    [
        ("data", "/home/ada/set.yaml", "names no file, and settings.fixed.data is"),
        ("data", "smoke --root=../set", "names no file, and settings.fixed.data is"),
        ("data", "mine", "names shipped configurations, and settings.fixed.data is 'mine'"),
        ("data", "smoke 'x", "quotation marks"),
        ("task", "plan:~/wall.yaml", "names no file"),
        ("task", "plan:wall", "names shipped plans"),
        ("backbone_path", "weights", "names no file"),
        ("pretrained_path", "ada/policy", "names no file, .*'ada/policy' without pretrained_revision, a commit"),
        ("backbone", "model.safetensors", "names no file"),
        ("dagger", "./rounds", "names no file"),
        (
            "backbone",
            "hf/ada/encoder",
            "by their commit, NAME@COMMIT: variants.ours.policy.backbone is 'hf/ada/encoder'",
        ),
        ("backbone", "hf/ada/encoder@main", "by their commit"),
        ("vlm_model_name", "ada/vlm", "by their commit"),
    ],
)
def test_a_recipe_is_plain_data(where, value, said):
    recipe = json.loads(json.dumps(RECIPE))
    check_plain(recipe)
    of = {"data": recipe["settings"]["fixed"], "task": recipe["settings"]["fixed"]["env"]}
    of |= {"dagger": recipe["variants"]["ours"]}
    of.get(where, recipe["variants"]["ours"]["policy"])[where] = value
    with pytest.raises(InputError, match=said):
        check_plain(recipe)


def test_weights_of_one_commit_on_the_hub_are_plain_data():
    recipe = json.loads(json.dumps(RECIPE))
    policy = recipe["variants"]["ours"]["policy"]
    policy |= {"pretrained_path": "lerobot/smolvla_base", "pretrained_revision": "0a" * 20}
    check_plain(recipe)
    assert starts_from(policy) == f"lerobot/smolvla_base@{'0a' * 20}"
    assert not starts_from(RECIPE["variants"]["ours"]["policy"])
    encoder = f"hf/ada/encoder@{'0a' * 20}"
    check_plain(named := json.loads(json.dumps(RECIPE).replace("efficientnet_lite0", encoder)))
    assert starts_from(named["variants"]["ours"]["policy"]) == encoder
    check_plain({"variants": {"policy": {"data": "precise/tile_to_grid", "policy": {"type": "act"}}}})
    for changed in (
        {"pretrained_path": "../smolvla_base"},
        {"pretrained_path": "a/b/c"},
        {"pretrained_revision": "main"},
    ):
        policy |= {"pretrained_path": "lerobot/smolvla_base", "pretrained_revision": "0a" * 20} | changed
        with pytest.raises(InputError, match="names no file"):
            check_plain(recipe)


def test_whether_an_entry_is_one_policy_is_told_by_its_weights():
    weights = {"a": ["0" * 64, "1" * 64], "b": ["0" * 64, "1" * 64]}
    assert Trained("2" * 64, weights, {}).policies == "one"
    assert Trained("2" * 64, weights | {"b": ["1" * 64, "0" * 64]}, {}).policies == "several"
    assert Trained("2" * 64, weights | {"b": ["0" * 64, None]}, {}).policies == "one", "of the seeds that have both"
    assert Trained("2" * 64, {"a": weights["a"]}, {}).policies is None
    assert Trained("2" * 64, dict.fromkeys("ab", [None, None]), {}).policies is None


ABOUT = dict.fromkeys(("name", "submitter", "policy", "revision", "data", "training", "compute"), "a test's")
SETTINGS = {"fixed": {"task": "brick_to_bin", "episodes": 2, "episode_length": 8, "first_start": 1000}}
STUDY = {
    "name": "tiny",
    "settings": {"narrow": {"data": "fast --episodes=2", "env": {"task": "brick_to_bin", "episode_length": 8}}},
    "variants": {"ours": {"policy": {"type": "frozen_vit", "backbone": "efficientnet_lite0"}, "seeds": 2}},
    "training": {"epochs": 1, "batch_size": 64, "holdout": 2},
    "episodes": 2,
}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A study of three seeds, an entry of its first two, and the third one's weights and episodes."""
    root = tmp_path_factory.mktemp("retrain")
    for name, content in (("about", ABOUT | {"observes": "pixels"}), ("settings", SETTINGS), ("study", STUDY)):
        (root / f"{name}.yaml").write_text(yaml.safe_dump(content))
    (root / "more.yaml").write_text(
        yaml.safe_dump(STUDY | {"variants": {"ours": STUDY["variants"]["ours"] | {"seeds": 3}}})
    )
    for name, file in (("study", "study"), ("three", "more")):
        where = [f"--root={root / name}", f"--store={root / 'store'}"]
        call("constructskill-study", f"--config_path={root / file}.yaml", *where)
        flags = [f"--study={root / name}", f"--store={root / 'store'}", "--variant=ours"]
        files = [f"--{one}={root / one}.yaml" for one in ("about", "settings")]
        said = call("constructskill-submit", "--suite=bins", *files, *flags, f"--root={root / f'{name}_entry'}")
        assert "with its recipe" in said
    return root


def verify(root, entry, **more):
    return call("constructskill-verify", f"--root={entry}", "--retrain=true", f"--made_in={root / 'again'}", **more)


@pytest.mark.nightly
def test_an_honest_entry_is_the_same_and_a_forged_one_is_told(made, tmp_path):
    entry = made / "study_entry"
    record = f"--record={made / 'verified'}"
    said = call("constructskill-verify", f"--root={entry}", "--retrain=true", f"--made_in={made / 'again'}", record)
    assert "all weights and episodes are the same to the last bit" in said
    verdict = json.loads((made / "verified" / "study_entry.json").read_text())
    assert verdict["level"] == "retrained"
    assert verdict["retrained"] == {"exact": True, "settings": {"fixed": [0.0, 0.0]}}

    submission = read_submission(shutil.copytree(entry, tmp_path / "board" / "entries" / "mine"))
    call("constructskill-recover", f"--root={tmp_path / 'board'}")
    recovered = read_recovered(path_of(tmp_path / "board", "mine"), submission.sha256).rows.values()
    assert {row.key for row in recovered} == {claim.key for claim in submission.claims if not claim.placed}
    assert Lost.UNSEEN not in {row.lost for row in recovered}, "replay, recovery and retraining agree"

    another_number = shutil.copytree(entry, tmp_path / "number")
    recipe = yaml.safe_load((another_number / RECIPE_FILE).read_text())
    assert recipe["variants"]["ours"]["policy"]["type"] == "frozen_vit" and "analysis" not in recipe
    recipe["training"]["epochs"] = 2
    put_recipe(another_number, recipe)
    assert "training seed 0 of fixed has other weights" in verify(made, another_number, fails=True)

    chosen = shutil.copytree(entry, tmp_path / "chosen")
    third = read_submission(made / "three_entry")
    actions = {one.evaluation_seed: one.flat for one in third.claims if one.training_seed == 2}
    edit(
        chosen,
        lambda rows: [row.update(actions=actions[row["evaluation_seed"]]) for row in rows if row["training_seed"]],
    )
    assert "training seed 1 of fixed acts otherwise from start 1000" in verify(made, chosen, fails=True)
    weights = third.declaration.trained.weights["fixed"][2]
    declare(chosen, lambda said: said["trained"]["weights"]["fixed"].__setitem__(1, weights))
    assert "training seed 1 of fixed has other weights" in verify(made, chosen, fails=True)

    elsewhere = shutil.copytree(entry, tmp_path / "elsewhere")
    declare(elsewhere, lambda said: said["trained"]["made_with"].update(processor="Another"))
    assert "Too few training seeds to confirm anything" in verify(made, elsewhere, fails=True)


def put_recipe(root, recipe):
    (root / RECIPE_FILE).write_text(yaml.safe_dump(recipe))
    sha256 = hashlib.sha256((root / RECIPE_FILE).read_bytes()).hexdigest()
    declare(root, lambda said: said["trained"].update(recipe_sha256=sha256))


def entry_with(recipe, valid, root):
    """The valid submission, with a recipe that nobody followed."""
    whole = read_submission(valid)
    said = whole.declaration
    names = ("about", "suite", "settings", "training_seeds", "backend", "versions")
    told = {name: getattr(said, name) for name in names}
    trained = {"weights": {name: [None, None] for name in said.settings}, "made_with": {}}
    write_submission(root, whole.claims, yaml.safe_dump(recipe), trained, **told)
    return root


PLACE = {"episode_length": 300, "obs_type": "pixels"}
ITS_OWN = RECIPE | {
    "settings": {
        "brick_to_bin_shifted": {"data": "fast_shifted", "env": PLACE | {"task": "brick_to_bin_shifted"}},
        "block_to_bin": {"data": "suite/block_to_bin", "env": PLACE | {"task": "block_to_bin"}},
    },
    "episodes": 2,
    "eval_seed": 5000,
}
"""The recipe of a policy that was evaluated as the valid submission was."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({}, None),
        ({"episodes": 1}, "evaluates block_to_bin otherwise"),
        ({"eval_seed": 5001}, "evaluates block_to_bin otherwise"),
        ({"eval_seed": 1_000_000}, "no start may be in both"),
        ({"references": {"no_op": 1}}, "one variant, and nothing beside it"),
        ({"variants": {"ours": RECIPE["variants"]["ours"] | {"first_seed": 10}}}, "settings and training seeds"),
        ({"variants": {"ours": RECIPE["variants"]["ours"] | {"seeds": 100}}}, "settings and training seeds"),
    ],
    ids=str,
)
def test_a_recipe_of_something_else_is_refused(change, said, valid, tmp_path):
    submission = read_submission(entry_with(ITS_OWN | change, valid, tmp_path / "entry"))
    if said is None:
        assert study_of(submission).name == "tiny"
    else:
        with pytest.raises(InputError, match=said):
            study_of(submission)


def test_an_entry_without_a_recipe_cannot_be_trained_again(valid):
    with pytest.raises(InputError, match="It has no recipe"):
        study_of(read_submission(valid))


THEIRS = """
from dataclasses import dataclass
from pathlib import Path

from lerobot.configs import PreTrainedConfig
from lerobot.policies.act.configuration_act import ACTConfig

Path(__file__).with_name("ran").touch()


@PreTrainedConfig.register_subclass("their_act")
@dataclass
class TheirACTConfig(ACTConfig):
    pass
"""


@pytest.mark.sim
@pytest.mark.slow
def test_code_of_another_package_is_asked_for(valid, tmp_path):
    (tmp_path / "lerobot_policy_theirs.py").write_text(THEIRS)
    metadata = tmp_path / "lerobot_policy_theirs-1.0.dist-info" / "METADATA"
    metadata.parent.mkdir()
    metadata.write_text("Metadata-Version: 2.1\nName: lerobot_policy_theirs\nVersion: 1.0\n")
    policy = {"type": "their_act", "pretrained_backbone_weights": None}
    recipe = ITS_OWN | {"variants": {"ours": {"policy": policy, "seeds": 2}}}
    for own in (recipe := json.loads(json.dumps(recipe)))["settings"].values():
        own["env"]["obs_type"] = "pixels_agent_pos"
    entry = entry_with(recipe, valid, tmp_path / "entries" / "theirs")
    theirs = {"PYTHONPATH": f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}"}
    call("constructskill-verify", f"--root={entry}", "--sample=1", **theirs)
    call("constructskill-board", f"--root={tmp_path}", f"--out={tmp_path / 'site'}", **theirs)
    assert not (tmp_path / "ran").exists(), "nothing of it was imported"
    said = call("constructskill-verify", f"--root={entry}", "--retrain=true", fails=True, **theirs)
    assert "code of another package" in said and "--allow_code=[lerobot_policy_theirs==1.0] allows that" in said
