"""Two sides are brought together by where and from which starts they were evaluated, and judged over seeds."""

import json
from pathlib import Path

import pytest

from lerobot_constructskill.analysis.stats.comparisons import Conclusion
from lerobot_constructskill.comparison.match import Asked, MatchedSides, match
from lerobot_constructskill.comparison.sides import Side, are_apart, conditions, find, read_study
from lerobot_constructskill.comparison.tell import tell
from lerobot_constructskill.contract import TASKS
from lerobot_constructskill.envs.recording import Episode
from lerobot_constructskill.errors import InputError, MissingError, TakenError
from lerobot_constructskill.scripts import compare as script
from lerobot_constructskill.scripts.compare import FAILED, CompareConfig, compare
from lerobot_constructskill.study.rows import read_rows

ENV = {"task": "block_to_bin", "episode_length": 5, "obs_type": "pixels_agent_pos"}
RESULTS = Path(__file__).parents[2] / "results"
GOOD, BAD = [10, 10, 9, 10, 10], [1, 0, 2, 0, 1]


def no_evaluation(*_):
    raise AssertionError("nothing is to be evaluated")


def compared(a: str, b: str, evaluate=no_evaluation, **asked) -> MatchedSides:
    return match(find(a), find(b), Asked(**asked), evaluate, 0.05)


def test_a_study_is_compared_with_recordings(study, recorded):
    published = study(BAD)
    for other in (recorded(GOOD), recorded(GOOD, "one", whole=True)):
        comparison = compared(other, published)
        assert comparison.judgement.conclusion is Conclusion.BETTER and comparison.starts == list(range(1000, 1010))
        assert comparison.rates_a == [count / 10 for count in GOOD]
        assert comparison.rates_b == [count / 10 for count in BAD]
        assert compared(published, other).judgement.conclusion is Conclusion.WORSE


def test_every_published_study_has_a_variant_that_can_be_compared_with():
    for folder in (path.parent for path in RESULTS.glob("*/study.yaml")):
        arms = read_rows(folder / "rows.parquet").query("role == 'variant' and placed.notna()")
        side = read_study(folder, f"{arms['setting'].iloc[0]}/{arms['variant'].iloc[0]}")
        assert conditions(side.env)["task"] in TASKS and "lerobot" in side.versions, folder
        assert side.starts or are_apart(side.starts_of_each), folder


def test_a_failed_training_seed_counts_as_one_that_did_not_place_and_a_missing_one_not_at_all(study):
    comparison = compared(study([10, None, 10, -1, 10]), study(GOOD, "other"))
    assert comparison.rates_a == [1.0, 0.0, 1.0, 1.0] and comparison.judgement.counts_a == (3, 4)


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("task", "brick_on_brick", r"task \(block_to_bin, brick_on_brick\)"),
        ("episode_length", 6, r"episode_length \(5, 6\)"),
        ("obs_type", "pixels", r"obs_type \(pixels_agent_pos, pixels\)"),
        ("perturb", "camera=2", r"perturbation \(none, \+camera=2\+seed=0\)"),
    ],
)
def test_sides_of_other_conditions_are_refused_and_what_differs_is_named(name, value, said, study, recorded):
    published = study(GOOD)
    with pytest.raises(InputError, match=f"cannot be compared: they differ in {said}"):
        compared(published, recorded(GOOD, **{name: value}))
    with pytest.raises(InputError, match=f"and what was asked for cannot be compared: they differ in {said}"):
        compared(published, recorded(GOOD, "same"), env={name: value})


def test_two_spellings_of_a_perturbation_are_one(study, recorded):
    published = study(GOOD, env=ENV | {"perturb": "camera=1, light=2"})
    assert (
        compared(published, recorded(GOOD, perturb="light=2,camera=1")).judgement.conclusion is Conclusion.INCONCLUSIVE
    )


def test_another_draw_of_a_perturbation_is_another_condition(study, recorded):
    published = study(GOOD, env=ENV | {"perturb": "camera=1"})
    with pytest.raises(InputError, match=r"perturbation \(\+camera=1\+seed=0, \+camera=1\+seed=3\)"):
        compared(published, recorded(GOOD, perturb="camera=1", perturb_seed=3))


def test_starts_are_those_in_common(study):
    whole, later = study(GOOD), study(GOOD, "later", starts=range(1008, 1018))
    comparison = compared(whole, later)
    assert (comparison.starts, comparison.n_starts) == ([1008, 1009], 18)
    assert comparison.rates_a == [1.0, 1.0, 0.5, 1.0, 1.0]
    with pytest.raises(InputError, match="no start in common: .* has 1000 to 1009 and .* has 2000 to 2004"):
        compared(whole, study(GOOD, "elsewhere", starts=range(2000, 2005)))
    assert compared(whole, study(BAD, "bad"), episodes=3).starts == [1000, 1001, 1002]


def test_rows_over_draws_are_not_compared_with_rows_of_one_draw_in_silence(study, recorded):
    own = {"demonstrations": "own"}
    one, drawn, theirs = study(GOOD), study(BAD, "drawn", draws=own), study(BAD, "theirs", draws=own)
    assert "hold for other draws of demonstrations and other training seeds, from the same starts" in tell(
        compared(drawn, theirs), 0.05
    )
    told = tell(compared(one, drawn), 0.05)
    assert "A's interval holds for other training seeds, with" in told and "B's interval holds for other draws" in told
    assert "Demonstrations can make the difference" in told
    assert "What A's holds for, its files do not say." in tell(compared(recorded(GOOD), one), 0.05)


def test_two_rows_of_one_draw_each_say_where_the_draws_are_two(study):
    one, same, other = study(GOOD, data="aa"), study(BAD, "same", data="aa"), study(BAD, "other", data="bb")
    told = "A and B learnt from different demonstrations. Demonstrations can make the difference"
    assert told not in tell(compared(one, same), 0.05) and told in tell(compared(one, other), 0.05)


def test_draws_with_starts_of_their_own_are_compared_with_the_same_draws(study, checkpoints):
    own = {"demonstrations": "own", "starts": "own"}
    comparison = compared(study(GOOD, draws=own), study(BAD, "other", draws=own))
    assert comparison.rates_a == [count / 10 for count in GOOD] and comparison.rates_b == [count / 10 for count in BAD]
    assert "starts 1000 to 1049 (50, 10 a draw)" in tell(comparison, 0.05)
    for other in (study(GOOD, "shared"), checkpoints(2)):
        with pytest.raises(InputError, match="Each draw of '.*' has starts of its own"):
            compared(study(GOOD, f"own {len(other)}", draws=own), other)


def test_draws_with_starts_of_their_own_may_have_different_numbers_of_seeds(study):
    own = {"demonstrations": "own", "starts": "own"}
    one = study([9, 2, 5], draws=own)
    two = study([9, 7, 2, 2, 5, 5], "two", draws=own | {"seeds_a_draw": 2})
    comparison = compared(one, two)
    assert comparison.judgement.counts_a.seeds == comparison.judgement.counts_b.seeds == 3
    assert comparison.rates_b == [0.9, 0.7, 0.2, 0.2, 0.5, 0.5] and len(comparison.starts) == 30
    for name, placed in (("fewer", [9, 7, 2, 2]), ("failed", [9, None, 2, 2])):
        with pytest.raises(InputError, match="has starts of its own: .* and as many draws"):
            compared(one, study(placed, name, draws=own | {"seeds_a_draw": 2}))
    lost = compared(one, study([9, 7, None, None, 5, 5], "lost", draws=own | {"seeds_a_draw": 2}))
    assert lost.rates_b == [0.9, 0.7, 0.0, 0.0, 0.5, 0.5] and len(lost.starts) == 30


def test_a_failed_seed_whose_draw_has_starts_of_its_own_placed_nothing(study):
    own = {"demonstrations": "own", "starts": "own"}
    comparison = compared(study([9, None, 8, 7], draws=own), study([5, 5, 5, 5], "other", draws=own))
    assert comparison.rates_a == [0.9, 0.0, 0.8, 0.7] and len(comparison.starts) == 40
    assert "starts 1000 to 1039 (40, 10 a draw)" in tell(comparison, 0.05)
    two = compared(study([9, None], "two", draws=own), study([5, 5], "both", draws=own))
    assert two.rates_a == [0.9, 0.0] and len(two.starts) == 20


def test_seeds_of_one_draw_count_as_one(study, recorded):
    draws = {"demonstrations": "own", "seeds_a_draw": 2}
    pairs, other = study([9, 7, 2, 2, 5, 5], draws=draws), study([5] * 6, "other", draws=draws)
    judgement = compared(pairs, other).judgement
    told = tell(compared(pairs, other), 0.05)
    assert "draws that placed" in told and "permutation of draws" in told
    mixed = tell(compared(pairs, study([5] * 6, "of one draw")), 0.05)
    assert "units that placed" in mixed and "A unit is a draw of A and a seed of B." in mixed
    unknown = tell(compared(pairs, recorded([5] * 6)), 0.05)
    assert "A unit is a draw of A and a seed of B." in unknown and "None" not in unknown
    assert "What B's holds for, its files do not say." in unknown
    alone = tell(compared(study([9, 2, 5], "one a draw", draws={"demonstrations": "own"}), other), 0.05)
    assert "A unit is a seed of A and a draw of B." in alone, "though their intervals hold for the same"
    assert "Make more draws of both." in tell(
        compared(study([9, 7], "a", draws=draws), study([1, 2], "b", draws=draws)), 0.05
    )
    (unfinished,) = {compared(study([9, 7], "of one", draws=draws), other).judgement.counts_a.seeds}
    assert unfinished == 1, "one draw is one draw, also where no other has been run yet"
    assert (judgement.counts_a.seeds, judgement.mean_a.value) == (3, pytest.approx(0.5))
    alone = compared(study([8, 2, 5], "alone"), study([5] * 3, "three")).judgement
    assert judgement.mean_a == pytest.approx(alone.mean_a) and judgement.p_value == alone.p_value


def test_checkpoints_are_evaluated_where_the_other_side_was(study, checkpoints):
    seen = []

    def evaluate(found, env, starts):
        seen.append((len(found.folders), env, list(starts)))
        return Side(found.name, "checkpoints", env, [dict.fromkeys(starts, True)] * len(found.folders), {})

    env = {"task": "block_to_bin", "episode_length": 7, "light_robot": False}
    assert compared(checkpoints(2), study(BAD, env=env), evaluate, episodes=4).judgement.mean_a.value == 1
    assert seen == [(2, env, [1000, 1001, 1002, 1003])]
    with pytest.raises(InputError, match="add --task"):
        compared(checkpoints(2, "one"), checkpoints(3, "two"), evaluate)
    seen.clear()
    compared(str(checkpoints(2, "a")), checkpoints(3, "b", ""), evaluate, env={"task": "block_to_bin"}, seed=7)
    assert seen == [(n, {"task": "block_to_bin"}, list(range(7, 57))) for n in (2, 3)]


def test_what_is_no_side_is_refused(study, recorded, checkpoints, tmp_path):
    published, train = study(GOOD), checkpoints(2)
    refusals = {
        "nowhere/seed_*": "There is no folder 'nowhere/seed_",
        str(tmp_path): "is no checkpoint .config.json., no output of lerobot-train",
        f"{tmp_path}/study:block/theirs": "has no variant 'block/theirs'; name one as in .*; it has: block/ours",
        f"{tmp_path}/study": "name one as in .*:setting/variant; it has: block/ours",
        f"{train},{recorded(GOOD)}": "of several kinds .checkpoint, recordings.",
        f"{train},{tmp_path}/train/seed_1": "names a folder twice",
    }
    for text, said in refusals.items():
        with pytest.raises((InputError, MissingError), match=said):
            compared(text, published)
    with pytest.raises(InputError, match="leave out --seed"):
        compared(published, study(GOOD, "two"), seed=1000)
    with pytest.raises(InputError, match="is on both sides"):
        compared(published, published)
    with pytest.raises(InputError, match="Every training seed of '.*' failed, so there is nothing"):
        compared(published, study([None, None], "failed"))
    with pytest.raises(InputError, match="No run of 'block/ours' in '.*' has been made"):
        compared(published, study([-1], "missing"))
    with pytest.raises(TakenError, match="exists already"):
        compare(CompareConfig(published, study(BAD, "b"), out=tmp_path))


def test_damaged_files_are_one_sentence(study, recorded, tmp_path):
    published = study(GOOD)
    pattern = recorded(GOOD[:1])
    Episode(1000, **ENV).write(next(tmp_path.glob("recorded/*")))
    with pytest.raises(InputError, match="has two recordings of start 1000"):
        compared(pattern, published)
    next(tmp_path.glob("recorded/*/*.parquet")).write_bytes(b"no")
    with pytest.raises(InputError, match="cannot be read"):
        compared(pattern, published)
    (tmp_path / "study" / "study.yaml").write_text("settings: {}")
    with pytest.raises(InputError, match="does not say how 'block' is evaluated"):
        compared(published, study(BAD, "b"))


def test_the_text_names_sides_versions_and_what_so_many_seeds_cannot_say(study, recorded):
    told = compare(CompareConfig(study(GOOD, "torch_1"), study(BAD, "torch_2")))
    assert "A is better than B." in told and "5 of 5" in told
    assert "They differ in torch (torch_1 and torch_2)." in told
    assert "Both were made with lerobot 0.6.1; processor a CPU." in told
    one = compare(CompareConfig(recorded(GOOD[:1]), study(BAD[:1])))
    assert "One training seed a side tells how these checkpoints do, and nothing of their policies" in one
    assert "This number of seeds does not show which of them is better." in one
    assert "torch (" in one.partition("They differ in ")[2]
    assert "lerobot (unknown and 0.6.1); processor (unknown and a CPU)" in one
    few = compare(CompareConfig(recorded(GOOD[:3], "three"), study(BAD[:3], "few")))
    assert "3 seeds against 3 can show no difference, however large: their p-value is at least 0.1." in few


def test_the_status_fails_only_where_it_is_asked_to_and_a_is_worse(study, capsys, monkeypatch, tmp_path):
    good, bad = study(GOOD), study(BAD, "bad")
    for a, b, flags, status in (
        (bad, good, [], 0),
        (bad, good, ["--fail_if=worse"], FAILED),
        (good, bad, ["--fail_if=worse"], 0),
        (good, study(GOOD, "same"), ["--fail_if=worse"], 0),
        (good, "nowhere", ["--fail_if=worse"], 1),
        (good, bad, ["--fail_if=better"], 1),
        (good, bad, ["third"], 1),
    ):
        monkeypatch.setattr("sys.argv", ["constructskill-compare", a, b, *flags])
        monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
        try:
            script.compare.main()
            found = 0
        except SystemExit as ended:
            found = ended.code
        out, said = capsys.readouterr()
        assert ("put a pattern in quotation marks" in said) == ("third" in flags)
        assert found == status and ("than B." in out or "does not show which" in out) == (status != 1), (flags, out)


def test_every_number_is_in_a_file(study, tmp_path):
    compare(CompareConfig(study(GOOD), study([10, 10, None], "b"), out=tmp_path / "out"))
    told = json.loads((tmp_path / "out" / "comparison.json").read_text())
    assert told["rates_b"] == [1.0, 1.0, 0.0] and told["b"]["seeds"][2] is None
    assert told["judgement"]["conclusion"] == "inconclusive at this number of seeds"
    assert len(told["judgement"]["difference"]) == 3 and told["conditions"]["task"] == "block_to_bin"
