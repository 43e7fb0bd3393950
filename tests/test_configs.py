"""Every shipped YAML is read by the class it is for, and says what it claims to say."""

import math
from dataclasses import replace
from itertools import chain, combinations
from pathlib import Path

import draccus
import lerobot.policies  # noqa: F401  registers the policies
import pytest
import yaml
from draccus.parsers.yaml_loader import FullLoaderWithInclusion
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig, parser
from lerobot.configs.train import TrainPipelineConfig
from lerobot.optim import AdamWConfig
from lerobot.utils.feature_utils import dataset_to_policy_features
from metadata import write_metadata

import lerobot_constructskill.plugin  # noqa: F401
from lerobot_constructskill import presets
from lerobot_constructskill.board.protocol import BOARD_SUITES, PERTURBED_AXES
from lerobot_constructskill.contract import ANY_ACTION, CAMERAS, FPS, TASK_ACTION, TASKS, get_task, held_out
from lerobot_constructskill.demos.columns import demonstration_features
from lerobot_constructskill.demos.recorder import GenerateConfig
from lerobot_constructskill.errors import InputError, MissingError, TakenError
from lerobot_constructskill.parsing import parse, parse_named, read_fields
from lerobot_constructskill.perturbations import AXES
from lerobot_constructskill.policies.frozen_vit.backbones import BACKBONES
from lerobot_constructskill.scripts.config import ConfigConfig, show_or_write, write
from lerobot_constructskill.scripts.study import StudyConfig
from lerobot_constructskill.study.plan import list_runs
from lerobot_constructskill.study.rows import VARIANT
from lerobot_constructskill.study.spec import Study
from lerobot_constructskill.training.recipe import Training

CONFIGS = Path(__file__).parents[1] / "configs"
GENERATE = sorted((CONFIGS / "generate").glob("*.yaml"))
SETS = sorted((CONFIGS / "generate" / "suite").glob("*.yaml"))
SUITE, MANY = ([path for path in SETS if (path.stem in TASKS) == is_one] for is_one in (True, False))
PRECISE = sorted((CONFIGS / "generate" / "precise").glob("*.yaml"))
POLICIES = sorted((CONFIGS / "policy").glob("*.yaml"))
STUDIES = sorted((CONFIGS / "study").glob("*.yaml"))
TRAIN = presets.names("train")


def generate_config(path: Path) -> GenerateConfig:
    return draccus.parse(GenerateConfig, path, args=["--repo_id=local/set"])


@pytest.mark.parametrize("path", GENERATE, ids=lambda path: path.stem)
def test_generation_configs_are_the_papers(path):
    config = generate_config(path)
    assert config.task == ("brick_to_bin_shifted" if "shifted" in path.stem else "brick_to_bin")
    assert config.episodes == {"smoke": 2}.get(path.stem, 80)
    assert config.noise.root[0, 0] == (0.0 if path.stem.endswith("noise_free") else 0.01)


@pytest.mark.parametrize("path", SUITE, ids=lambda path: path.stem)
def test_a_suites_set_is_the_everyday_set_of_its_task(path):
    everyday = generate_config(CONFIGS / "generate" / "fast_wrist.yaml")
    assert generate_config(path) == replace(everyday, task=path.stem)


@pytest.mark.parametrize("path", MANY, ids=lambda path: path.stem)
def test_a_set_of_many_tasks_has_forty_of_each_and_no_loss(path):
    config = generate_config(path)
    assert (len(config.rows), config.episodes, config.video) == ({"orders": 4, "all": 12}[path.stem], 40, "lossless")


@pytest.mark.parametrize("path", PRECISE, ids=lambda path: path.stem)
def test_a_precise_set_is_the_everyday_one_with_noise_to_its_end(path):
    everyday = generate_config(CONFIGS / "generate" / "fast_wrist.yaml")
    noise = replace(everyday.noise, release_sigma=0.003)
    steps = 500 if get_task(path.stem).plan is None else get_task(path.stem).horizon
    precise = replace(everyday, task=path.stem, noise=noise, video="lossless", max_steps=steps)
    failures = {"brick_to_bin_3mm": 3.0}.get(path.stem, everyday.max_failures)
    assert generate_config(path) == replace(precise, max_failures=failures)


@pytest.mark.parametrize("path", [path for path in GENERATE if path.stem.endswith("noise_free")], ids=lambda p: p.stem)
def test_a_noise_free_twin_differs_in_its_noise_alone(path):
    twin = generate_config(path.with_stem(path.stem.removesuffix("_noise_free")))
    config = generate_config(path)
    assert replace(config, noise=twin.noise) == twin


def test_executed_labels_differ_from_fast_in_the_labels_alone():
    fast, executed = (generate_config(CONFIGS / "generate" / f"fast{end}.yaml") for end in ("", "_executed_labels"))
    assert executed.labels == "executed" and replace(executed, labels="clean") == fast


@pytest.mark.parametrize("path", STUDIES, ids=lambda path: path.stem)
def test_a_study_is_runs_that_can_be_made(path):
    """Every field of it is one that something has, and policies are evaluated in the task that they learn."""
    for run in list_runs(parse(StudyConfig, [], path).study):
        learnt = [[task.name for task in data.node.config.rows] for data in run.arm.validated_on]
        assert all(run.arm.env["task"] in names for names in learnt)


def test_the_perturbed_study_has_every_level_of_the_boards_axes_beside_the_task_as_it_is():
    study = parse(StudyConfig, [], CONFIGS / "study" / "perturbed.yaml")
    levels = {axis: range(1, len(AXES[axis].levels) + 1) for axis in PERTURBED_AXES}
    sweeps = {axis: ["control", *(f"{axis}_{level}" for level in those)] for axis, those in levels.items()}
    assert study.analysis.sweeps == sweeps
    control = study.settings.pop("control")
    for setting, of in study.settings.items():
        perturbed = control.env | {"perturb": "=".join(setting.split("_"))}
        assert of == replace(control, env=perturbed)


@pytest.mark.parametrize("path", STUDIES, ids=lambda path: path.stem)
def test_no_two_sets_of_a_setting_are_one(path):
    """A flag over a set that changes nothing would compare a policy with itself."""
    study = parse(StudyConfig, [], path).study
    for setting in study.settings:
        configs = [
            parse_named(GenerateConfig, "generate", data, ["--repo_id=local/set"]) for data in study.data_of(setting)
        ]
        assert not [(a, b) for a, b in combinations(configs, 2) if a == b]


def seeds_of(runs):
    """Seeds of initial states that runs use: of attempted demonstrations and of evaluation episodes."""
    sets = {run.arm.demonstrations.node for run in runs if run.arm.demonstrations}
    lists = [run.arm.starts for run in runs] + [node.starts for node in sets]
    return set(chain(*lists, *(run.plan.config.starts for run in runs if run.plan)))


def test_nothing_was_chosen_on_draws_or_starts_that_are_reported():
    seeds = {path.stem: seeds_of(list_runs(parse(StudyConfig, [], path).study)) for path in STUDIES}
    for reported in ("draws", "draws_number"):
        for name, others in seeds.items():
            assert name == reported or not seeds[reported] & others, f"{reported} and {name}"


@pytest.mark.parametrize("choice", [path.stem for path in STUDIES if path.stem.endswith("_choice")])
def test_a_choice_is_made_on_other_starts_and_training_seeds_than_its_study_reports(choice):
    """Their demonstrations may be the same: a page that reports the study says so."""
    chosen, reported = (
        list_runs(parse(StudyConfig, [], CONFIGS / "study" / f"{name}.yaml").study)
        for name in (choice, choice.removesuffix("_choice"))
    )
    starts = [set(chain(*(run.arm.starts for run in runs))) for runs in (chosen, reported)]
    assert not starts[0] & seeds_of(reported) and not starts[1] & seeds_of(chosen)
    trained_with = [{run.seed for run in runs if run.arm.role == VARIANT} for runs in (chosen, reported)]
    assert not trained_with[0] & trained_with[1]


def test_the_papers_study_holds_its_52_runs():
    """Ten seeds of four backbones, three of four ablations; the study has more seeds of some."""
    config = parse(StudyConfig, [], CONFIGS / "study" / "paper.yaml")
    assert all(variant.seeds >= 10 for variant in config.study.variants.values())
    policies = {name: variant.policy for name, variant in config.study.variants.items()}
    backbones = {name for name, spec in BACKBONES.items() if spec.repo_id}
    assert {policies[name]["backbone"] for name in backbones} == backbones
    plain = policies["dinov2_vits14"]
    different = {name: set(policies[name].items()) - set(plain.items()) for name in set(policies) - backbones}
    assert different == {
        "no_chunking": {("chunk_size", 1)},
        "no_ensembling": {("temporal_ensemble_coeff", None)},
        "regression_gripper": {("gripper_head", "regression")},
        "no_noise": set(),
        "converged": {("optimizer_lr", 0.0003)},
    }
    assert set(combinations(backbones, 2)) <= {
        pair for a, b in config.analysis.comparisons for pair in ((a, b), (b, a))
    }


def test_the_papers_recipe_is_the_papers():
    """Spec, sections 4 and 5: what paper.yaml leaves to defaults, as numbers of their own."""
    config = parse(StudyConfig, [], CONFIGS / "study" / "paper.yaml")
    arms = {run.arm.name: run.arm for run in list_runs(config.study) if run.arm.role == VARIANT}
    for name in arms.keys() - {"converged"}:
        policy, optimizer = arms[name].learner.config, arms[name].learner.config.get_optimizer_preset()
        assert arms[name].training == Training(epochs=150, batch_size=256, holdout=8)
        assert (type(optimizer), optimizer.lr) == (AdamWConfig, 1e-3) and policy.get_scheduler_preset() is None
    assert Study.__dataclass_fields__["episodes"].default == 10


@pytest.mark.parametrize("suite", ["ladder", "joints"])
def test_the_precise_study_has_the_boards_settings(suite):
    precise = parse(StudyConfig, [], CONFIGS / "study" / "precise.yaml").study
    for name, setting in BOARD_SUITES[suite].settings.items():
        fields = precise.settings[name].env
        assert (fields["task"], fields["episode_length"]) == (setting.task, setting.episode_length)
        assert range(precise.eval_seed, precise.eval_seed + precise.episodes) == setting.starts


@pytest.fixture
def study_of(tmp_path):
    """A study of one variant, whose policy is as said."""

    def make(policy: str) -> StudyConfig:
        file = tmp_path / "mine.yaml"
        lines = [
            "name: mine",
            "settings: {brick: {data: fast_wrist, env: {obs_type: pixels_agent_pos}}}",
            f"variants: {{ours: {{policy: {policy}}}}}",
        ]
        file.write_text("\n".join(lines))
        return parse(StudyConfig, [], file)

    return make


@pytest.mark.parametrize("path", POLICIES, ids=lambda path: path.stem)
def test_a_policy_is_named_in_a_file_that_lies_anywhere(path, study_of):
    fields = yaml.safe_load(path.read_text())
    (run, *_) = list_runs(study_of(f"!policy {path.stem}").study)
    assert fields == {name: getattr(run.arm.learner.config, name) for name in fields}
    with_another = study_of(f"!policy {{preset: {path.stem}, camera: base, crop: [0, 0, 0.5, 0.5]}}").study
    assert with_another.variants["ours"].policy == fields | {"camera": "base", "crop": [0, 0, 0.5, 0.5]}


def test_a_policy_that_is_not_there_is_refused_with_those_that_are(study_of):
    with pytest.raises(MissingError, match="no policy configuration 'exact'; the configurations are: .*precise"):
        study_of("!policy exact")
    with pytest.raises(InputError, match="such as `preset: precise`"):
        study_of("!policy {camera: base}")
    with pytest.raises(InputError, match="a mapping"):
        study_of("!policy [precise]")


def test_cut_to_fewer_seeds_every_variant_and_reference_has_them():
    cut = parse(StudyConfig, ["--seeds=2"], CONFIGS / "study" / "representation.yaml").study
    assert {variant.seeds for variant in cut.variants.values()} == {2} and max(cut.references.values()) == 2


def test_no_two_generation_configs_make_the_same_set():
    made = {name: generate_config(presets.find("generate", name)) for name in presets.names("generate")}
    assert not [(a, b) for a, b in combinations(made, 2) if made[a] == made[b]]


@pytest.fixture
def train_config(monkeypatch):
    """Read a file as `lerobot-train --config_path` does; it keeps `policy.path` of a file in module globals."""
    monkeypatch.setattr(parser, "_config_path_args", {})
    monkeypatch.setattr(parser, "_config_yaml_overrides", {})

    @parser.wrap()
    def parse(config: TrainPipelineConfig) -> TrainPipelineConfig:
        return config

    def read(path: Path, *flags: str) -> TrainPipelineConfig:
        monkeypatch.setattr("sys.argv", ["lerobot-train", f"--config_path={path}", *flags])
        return parse()

    return read


@pytest.fixture
def written(tmp_path):
    """Write a configuration of training for a set of n demonstrations of 104 frames."""

    def write_for(name: str, n: int = 80, **options) -> Path:
        root = tmp_path / f"set_{n}"
        return write(
            ConfigConfig(f"train/{name}", root if root.exists() else write_metadata(root, [104] * n), **options)
        )

    return write_for


@pytest.mark.parametrize("name", TRAIN)
@pytest.mark.parametrize("n", [2, 100])
def test_training_holds_out_every_eighth_episode_and_no_other(name, n, written, train_config, tmp_path):
    config = train_config(written(name, n), f"--output_dir={tmp_path / 'out'}")
    assert config.dataset.root == str(tmp_path / f"set_{n}")
    assert config.dataset.episodes == [i for i in range(n) if i not in held_out(n)] + held_out(n)
    assert math.ceil(n * config.dataset.eval_split) == len(held_out(n))
    assert bool(config.eval_steps) == (n >= 8) and config.steps % config.save_freq == 0


STEPS = {
    "act": 100_000,
    "diffusion": 20_000,
    "frozen_vit_fast": 1140,
    "frozen_vit_keypoints": 1428,
    "pi0": 3000,
    "pi05": 3000,
    "smolvla": 20_000,
}
"""What 80 demonstrations of the everyday sets are trained for."""


@pytest.mark.parametrize("name", STEPS)
def test_eighty_demonstrations_are_trained_as_long_as_before(name, written):
    fields = yaml.safe_load(written(name).read_text())
    assert fields["steps"] == pytest.approx(STEPS[name], rel=0.05)


def test_passes_are_counted_in_frames_that_are_trained_on(written):
    fields = yaml.safe_load(written("frozen_vit_fast", n=16, epochs=7).read_text())
    assert fields["steps"] == fields["save_freq"] == 7 * math.ceil(14 * 104 / 64)
    often = yaml.safe_load(written("act", n=16, epochs=8).read_text())
    assert often["steps"] == 8 * 14 * 104 / 8 == 4 * often["save_freq"], "five checkpoints are not equally far apart"


@pytest.mark.parametrize("name", TRAIN)
def test_what_is_written_is_plain_yaml_with_every_field_of_the_policy(name, written, tmp_path):
    file = written(name, out=tmp_path / "mine" / "file.yaml")
    template, fields = read_fields(CONFIGS / "train" / f"{name}.yaml"), yaml.safe_load(file.read_text())
    assert file == tmp_path / "mine" / "file.yaml" and fields["policy"] == template["policy"]
    assert not {"epochs", "checkpoints"} & fields.keys()


def test_a_file_lies_beside_its_set_and_says_of_which_it_is(written, tmp_path):
    small, large = written("act", n=7), written("act", n=8)
    assert (small, large) == (tmp_path / "set_7_act.yaml", tmp_path / "set_8_act.yaml")
    assert "7 demonstrations, too few for every eighth to be held out" in small.read_text()
    assert f"{tmp_path / 'set_8'}: 8 demonstrations, 1 of them held out; 110 epochs." in large.read_text()


def test_a_file_of_the_users_is_not_written_over(written, tmp_path):
    file = written("act", 9)
    file.write_text(f"{file.read_text()}\n")
    assert written("act", 9, epochs=3) == file, "one of its own is made anew"
    file.write_text("batch_size: 1\n")
    with pytest.raises(TakenError, match=f"{file} exists and was not written by constructskill-config: name another"):
        written("act", 9)


def test_a_set_in_lerobots_cache_or_on_the_hub_is_named_alone(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        "lerobot_constructskill.dataset.hub.locate", lambda *_: write_metadata(tmp_path / "c", [9] * 8)
    )
    file = write(ConfigConfig("train/act", repo_id="alice/bricks"))
    dataset = yaml.safe_load(file.read_text())["dataset"]
    assert file == tmp_path / "outputs/bricks_act.yaml"
    assert dataset["repo_id"] == "alice/bricks" and "root" not in dataset


def test_training_is_written_for_a_set_alone(tmp_path):
    with pytest.raises(InputError, match="train/act is written for a data set: add --root=FOLDER"):
        write(ConfigConfig("train/act"))
    with pytest.raises(MissingError, match="no configuration 'train/atc'; the configurations are: .*train/act, "):
        write(ConfigConfig("train/atc", Path("anywhere")))
    root = write_metadata(tmp_path / "features", [100] * 9)
    (root / "meta" / "info.json").write_text(
        '{"features": {"observation.features.wrist": {"dtype": "float32", "shape": [2], "names": null}}}'
    )
    assert write(ConfigConfig("train/frozen_vit_precise", root)).is_file()
    with pytest.raises(InputError, match="holds features, which frozen_vit alone can read"):
        write(ConfigConfig("train/act", root))
    with pytest.raises(InputError, match="Flags are for configurations of train/"):
        show_or_write(ConfigConfig("study/paper", Path("anywhere")))


def test_the_tag_has_no_meaning_for_others():
    """LeRobot, and whoever imports the plugin, reads YAML of strangers."""
    for loader in yaml.SafeLoader, yaml.FullLoader, FullLoaderWithInclusion:
        with pytest.raises(yaml.constructor.ConstructorError, match="the tag '!policy'"):
            yaml.load("x: !policy keypoints", loader)


def test_the_tag_opens_no_file(tmp_path, study_of):
    secret = tmp_path / "secret.yaml"
    secret.write_text("type: frozen_vit")
    with pytest.raises(MissingError, match="There is no policy configuration"):
        study_of(f"!policy {secret}")


PUBLISHED = {
    "smolvla": [f"observation.images.camera{i}" for i in (1, 2, 3)],
    "pi0": [f"observation.images.{name}_0_rgb" for name in ("base", "left_wrist", "right_wrist")],
    "pi05": [f"observation.images.{name}_0_rgb" for name in ("base", "left_wrist", "right_wrist")],
}
"""Cameras of lerobot/smolvla_base, lerobot/pi0_base and lerobot/pi05_base."""


def published(kind: str, folder: Path) -> Path:
    """The configuration of published weights, without the weights; six numbers of state and action, as SmolVLA's."""
    images = {name: PolicyFeature(FeatureType.VISUAL, (3, 224, 224)) for name in PUBLISHED[kind]}
    state, action = PolicyFeature(FeatureType.STATE, (6,)), PolicyFeature(FeatureType.ACTION, (6,))
    config = PreTrainedConfig.get_choice_class(kind)(
        device="cpu", input_features=images | {"observation.state": state}, output_features={"action": action}
    )
    config.save_pretrained(folder)
    return folder


@pytest.mark.parametrize("name", ["act", "diffusion", *PUBLISHED, "smolvla_suite", "pi05_suite"])
def test_other_policies_accept_our_features_under_the_names_they_know(name, written, train_config, tmp_path):
    """As far as pi0 and pi0.5 are tested here: their 3 billion parameters are never built."""
    kind = name.removesuffix("_suite")
    base = [f"--policy.path={published(kind, tmp_path)}"] if kind in PUBLISHED else []
    config = train_config(written(name), f"--output_dir={tmp_path / 'out'}", *base)
    config.validate()
    policy, task = config.policy, get_task("brick_to_bin", TASK_ACTION if name == kind else ANY_ACTION)
    columns = demonstration_features(task, ["base", "wrist"])
    features = dataset_to_policy_features(columns)
    policy.output_features = {"action": features.pop("action")}
    policy.input_features = policy.input_features or features
    policy.validate_features()
    renamed = {config.rename_map.get(name, name) for name in features}
    assert renamed <= policy.input_features.keys() and len(renamed) == len(CAMERAS) + 1
    assert policy.type == kind and not policy.push_to_hub
    assert policy.action_feature.shape == ((4,) if name == kind else (7,))
    seconds = policy.n_action_steps / FPS
    assert 0.3 <= seconds <= 0.5 and max(policy.action_delta_indices) < 60


@pytest.mark.parametrize("pattern", ["*/seed_0", "[!p]*/dinov2*", "fixed/*/seed_[0-4]", "a: b: c", '"quoted"*'])
def test_a_pattern_is_taken_as_it_was_typed(pattern):
    """YAML would take the first for an alias and the second for a list, and refuse both."""
    flags = [f"--config_path={CONFIGS / 'study' / 'smoke.yaml'}", f"--only={pattern}"]
    assert parse(StudyConfig, flags).only == pattern
