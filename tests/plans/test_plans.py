"""Plans: what is read, refused, drawn, measured, and made of an IFC file."""

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from commands import call, call_inside

from lerobot_constructskill.contract import MAX_PLACEMENTS, SHIPPED, SIM_STATE, get_task
from lerobot_constructskill.demos.settings import GenerateConfig, frames_digest
from lerobot_constructskill.envs.configuration_constructskill import ConstructSkillEnvConfig
from lerobot_constructskill.errors import FieldError, InputError, MissingError
from lerobot_constructskill.plans.check import check_plan, complaints
from lerobot_constructskill.plans.ifc import plan_of
from lerobot_constructskill.plans.measure import measure
from lerobot_constructskill.plans.plan import KINDS, PLAN, SUPPLIES, read_plan, written
from lerobot_constructskill.presets import names
from lerobot_constructskill.scripts.plan import plan as show_plan

BRICK = KINDS["brick"].size
FLAT = {"a": {"kind": "brick", "at": [-0.4, -0.25]}, "b": {"kind": "brick", "beside": "a"}}


def plan(**elements):
    return PLAN.parse(written({"elements": elements}), "It")


@pytest.mark.parametrize("name", names("plan"))
def test_every_shipped_plan_can_be_built_and_says_where_its_tolerance_comes_from(name):
    read = read_plan(name)
    assert list(complaints(read)) == [] and read.standard and read.instruction.endswith(".")
    assert PLAN.parse(written(read.facts()), "It") == read


@pytest.mark.parametrize("task", [task for task in SHIPPED.values() if task.plan], ids=lambda task: task.name)
def test_a_task_of_a_plan_names_one_that_there_is(task):
    assert task.plan in names("plan")


def test_an_element_continues_and_stands_on_what_really_lies_there():
    read = plan(**FLAT, c={"kind": "brick", "on": ["a", "b"]})
    sizes = [(0.212, 0.065, 0.102), (0.208, 0.065, 0.100), BRICK]
    seen = {0: (-0.403, -0.248, 0.051)}
    first, second, third = read.resting(sizes, lambda number, place: seen.get(number, place))
    assert first == pytest.approx((-0.4, -0.25, 0.051))
    assert second == pytest.approx((-0.403 + 0.210 + 0.010, -0.248, 0.050))
    assert third[0] == pytest.approx((seen[0][0] + second[0]) / 2) and third[1] == pytest.approx(-0.248)
    higher, lower, inner, outer = 0.102, 0.100, 0.005, 0.105
    assert third[2] == pytest.approx(higher - (higher - lower) * inner / (inner + outer) + 0.05, abs=1e-5)


def test_what_stands_on_one_or_on_even_supports_stands_on_their_tops():
    for on in (["a"], ["a", "b"]):
        assert plan(**FLAT, c={"kind": "brick", "on": on}).drawn[2][2] == pytest.approx(0.15)


@pytest.mark.parametrize(
    ("elements", "said"),
    [
        ({}, "1 to 9 elements, not 0"),
        ({f"e{number}": FLAT["a"] for number in range(100)}, "1 to 9 elements, not 100"),
        ({"a": {"kind": "brick", "at": [float("nan"), 0]}}, r"elements.a.*at must be .* finite number"),
        ({"a": {"kind": "brick", "at": [0.1]}}, "'a' has at .0.1., which must be x and y"),
        ({"a": {"kind": "stone", "at": [0, 0]}}, "kind must be one of brick, post, beam"),
        ({"a": {"kind": "brick"}}, "'a' needs one place"),
        ({"a": FLAT["a"] | {"beside": "b"}, "b": FLAT["a"]}, "'a' needs one place"),
        ({"a": {"kind": "brick", "beside": "b"}, "b": {"kind": "brick", "beside": "a"}}, "'a' names 'b'.*laid before"),
        ({"a": {"kind": "brick", "beside": "z"}}, "'a' names 'z', which is not in the plan"),
        ({"a": FLAT["a"], "b": {"kind": "brick", "on": ["a", "a"]}}, "'b' names 'a' twice in `on`"),
    ],
    ids=str,
)
def test_what_is_no_plan_is_refused_in_one_sentence_that_names_the_element(elements, said):
    with pytest.raises(InputError, match=said) as refused:
        plan(**elements)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("other", "said"),
    [
        ({"at": [-0.4, -0.27]}, "'a' and 'x' are in one place"),
        ({"at": [0.5, -0.25]}, "'x' lies .* m from the robot's base"),
        ({"at": [-0.55, -0.05]}, "'x' lies .* m from the robot's base"),
        ({"at": [-0.1, 0.1]}, "'x' lies where elements wait"),
        ({"at": [-0.15, -0.25], "on": ["a"]}, "'x' does not reach 'a'.* hang in the air"),
        ({"at": [-0.28, -0.25], "on": ["a"]}, "'x' would tip over"),
        ({"at": [-0.4, -0.33]}, "no room for the fingers at 'x' beside 'a'"),
    ],
    ids=str,
)
def test_what_the_robot_cannot_build_is_refused_and_the_element_named(other, said):
    read = plan(a=FLAT["a"], x={"kind": "brick"} | other)
    with pytest.raises(InputError, match=said):
        check_plan(read)


def test_a_low_element_below_one_that_lies_already_is_refused():
    read = plan(
        a={"kind": "post", "at": [-0.32, -0.25]},
        b={"kind": "post", "at": [-0.06, -0.25]},
        c={"kind": "beam", "on": ["a", "b"]},
        d={"kind": "brick", "at": [-0.19, -0.25]},
    )
    assert any("'d' lies below 'c'" in one for one in complaints(read))


def test_what_the_arm_or_the_sizes_leave_no_room_for_is_refused():
    brick = {"kind": "brick"}
    tower = {"a": FLAT["a"]} | {name: brick | {"on": [below]} for below, name in pairwise("abcde")}
    assert [*complaints(plan(**tower))] == ["The top of the element 'e' lies 0.50 m high; the hand lays up to 0.42 m."]
    behind = dict(list(tower.items())[:3]) | {"low": {"kind": "post", "at": [-0.40, -0.43]}}
    assert [*complaints(plan(**behind))] == [
        "There is no room for the arm at 'low' behind 'c', which is higher: lay 'low' first."
    ]
    assert not [*complaints(plan(low=behind.pop("low"), **behind))]
    touching = plan(a=FLAT["a"], b=brick | {"at": [FLAT["a"]["at"][0] + BRICK[0], FLAT["a"]["at"][1]]})
    assert "'a' and 'b' are 0.0 mm apart, and what elements differ in length adds up to 3.6 mm" in "".join(
        complaints(touching)
    )
    x, y = FLAT["a"]["at"]
    between = {"a": FLAT["a"], "c": brick | {"at": [x + 2 * BRICK[0] + 0.0105, y]}, "b": brick | {"beside": "a"}}
    assert "'c' and 'b' are 0.5 mm apart, and what elements differ in length adds up to 7.2 mm" in "".join(
        complaints(plan(**between))
    )
    assert "'a' lies behind the robot" in "".join(complaints(plan(a=brick | {"at": [-0.85, -0.25]})))
    assert not [*complaints(plan(a=FLAT["a"], b=brick | {"beside": "a", "joint": 0.0}))], "it is laid where 'a' ends"
    beams = plan(
        **{name: {"kind": "beam", "at": [-0.25, y]} for name, y in {"a": -0.2, "b": -0.35, "c": -0.5}.items()}
    )
    assert "'b' and 'c' would overlap where they wait" in "".join(complaints(beams))
    side_by_side = plan(
        a={"kind": "post", "at": [-0.4, -0.25]},
        b={"kind": "post", "at": [-0.4, -0.31]},
        x={"kind": "beam", "on": ["a", "b"]},
    )
    assert "'x' lies on 'a' and 'b', which must stand one after the other" in "".join(complaints(side_by_side))


def test_elements_that_wait_leave_the_fingers_room():
    assert len(SUPPLIES) == MAX_PLACEMENTS
    for number, (x, y) in enumerate(SUPPLIES):
        for other_x, other_y in SUPPLIES[:number]:
            assert abs(x - other_x) > BRICK[0] + 0.06 or abs(y - other_y) >= BRICK[1] + 0.06 + 0.03


def state(read, offsets, placed):
    """A privileged state in which elements lie off their places by `offsets` (m)."""
    count, sim = len(read.elements), {name: np.zeros(len(channels)) for name, channels in SIM_STATE.items()}
    places, sizes = np.array(read.drawn), np.array([kind.size for kind in read.kinds])
    poses = sim["object_poses"].reshape(-1, 7)
    poses[:count, :3], poses[:count, 3] = places + offsets, 1
    for name, values in (("object_sizes", sizes), ("bin_interiors", sizes), ("bin_positions", places)):
        sim[name].reshape(-1, 3)[:count] = values
    sim["is_object"][:count], sim["is_placed"][:count] = 1, placed
    return sim


def test_a_wall_is_measured_as_a_mason_does():
    read = read_plan("course_of_three")
    laid = measure(read, state(read, [[0, 0, 0], [0.001, 0.002, 0], [0.004, -0.003, 0.0015]], [1, 1, 1]))
    assert (laid["length"], laid["level"], laid["line"]) == (4.0, 1.5, 3.0)
    assert laid["errors"][2] == [4.0, -3.0, 1.5, 0.0, 0.0]
    begun = measure(read, state(read, np.zeros((3, 3)), [1, 0, 0]))
    assert (begun["length"], begun["level"], begun["line"]) == (None, None, 0.0)
    json.dumps(laid)


def test_a_course_is_of_one_kind_on_one_line():
    read = plan(a=FLAT["a"], post={"kind": "post", "at": [-0.1, -0.25]}, far={"kind": "brick", "at": [-0.4, -0.45]})
    told = measure(read, state(read, np.zeros(3), 1))
    assert (told["level"], told["length"], told["line"]) == (None, None, 0.0)
    two = plan(**FLAT, c={"kind": "brick", "at": [-0.4, -0.45]})
    assert measure(two, state(two, np.array([[0, 0, 0], [0, 0, 0.002], [0, 0, 0.009]]), 1))["level"] == 2.0


def test_a_set_of_plans_has_the_steps_and_the_sentences_that_it_needs():
    for task in ("bond_of_five", "plan:bond_of_five"):
        with pytest.raises(InputError, match="has 5 elements, .* give max_steps=1750, not 1000"):
            GenerateConfig("local/x", task=task)
    with pytest.raises(InputError, match="asked for by one sentence, 'Build the wall after its plan.'"):
        GenerateConfig("local/x", task="plan:course_of_three,plan:lintel_on_posts")
    GenerateConfig("local/x", task="wall", max_steps=2000)
    assert ConstructSkillEnvConfig(plan="bond_of_five").task == "plan:bond_of_five"
    with pytest.raises(FieldError, match="bond_of_five is a task of its own: leave out --env.task=orders"):
        ConstructSkillEnvConfig(task="orders", plan="bond_of_five")


def test_the_words_of_a_plan_decide_nothing(tmp_path):
    digests = set()
    for words in ({}, {"instruction": "Build it.", "standard": "none"}, {"tolerance": 0.004}):
        (tmp_path / "p.yaml").write_text(written({"elements": FLAT} | words))
        digests.add(frames_digest(GenerateConfig("local/x", task=f"plan:{tmp_path / 'p.yaml'}")))
    assert len(digests) == 2


def test_any_plan_is_a_task_of_every_command():
    task = get_task("plan:bond_of_five")
    assert (task.name, task.plan, task.action_names) == (
        "plan:bond_of_five",
        "bond_of_five",
        ("dx", "dy", "dz", "gripper"),
    )
    with pytest.raises(InputError, match="plan:NAME_OR_FILE"):
        get_task("plan:")


@pytest.mark.slow
def test_the_command_checks_draws_and_tells(tmp_path):
    picture = tmp_path / "bond.png"
    assert "5 elements, can be built" in call("constructskill-plan", "bond_of_five", f"--picture={picture}")
    assert picture.stat().st_size > 10_000
    (tmp_path / "two.yaml").write_text(written({"elements": {"a": FLAT["a"], "b": FLAT["a"] | {"at": [0.6, -0.25]}}}))
    assert "'b' lies 1.24 m" in call("constructskill-plan", str(tmp_path / "two.yaml"), fails=True)
    for wrong, said in (("--picture=x.gif", "must be"), ("--out=x.yaml", "out is"), ("--origin=[1]", "must be")):
        status, _, error = call_inside(show_plan.main, "constructskill-plan", "bond_of_five", wrong)
        assert status and said in error


# IFC


def ifc_of(path: Path, boxes) -> Path:
    """An IFC file of boxes: name, size and middle in metres, extruded upward as authoring tools do."""
    import ifcopenshell.api.context
    import ifcopenshell.api.geometry
    import ifcopenshell.api.project
    import ifcopenshell.api.root
    import ifcopenshell.api.unit

    model = ifcopenshell.api.project.create_file()
    ifcopenshell.api.root.create_entity(model, ifc_class="IfcProject", name="a wall")
    ifcopenshell.api.unit.assign_unit(model, length={"is_metric": True, "raw": "MILLIMETERS"})
    parent = ifcopenshell.api.context.add_context(model, context_type="Model")
    body = ifcopenshell.api.context.add_context(
        model, context_type="Model", context_identifier="Body", target_view="MODEL_VIEW", parent=parent
    )
    for name, size, middle in boxes:
        x, y, z = (1000 * edge for edge in size)
        part = ifcopenshell.api.root.create_entity(model, ifc_class="IfcBuildingElementProxy", name=name)
        profile = model.create_entity("IfcRectangleProfileDef", ProfileType="AREA", XDim=x, YDim=y)
        up = model.create_entity("IfcDirection", (0.0, 0.0, 1.0))
        solid = model.create_entity("IfcExtrudedAreaSolid", SweptArea=profile, ExtrudedDirection=up, Depth=z)
        shape = model.create_entity(
            "IfcShapeRepresentation",
            ContextOfItems=body,
            RepresentationIdentifier="Body",
            RepresentationType="SweptSolid",
            Items=[solid],
        )
        ifcopenshell.api.geometry.assign_representation(model, product=part, representation=shape)
        matrix = np.eye(4)
        matrix[:3, 3] = np.array(middle) - [0, 0, size[2] / 2]
        ifcopenshell.api.geometry.edit_object_placement(model, product=part, matrix=matrix)
    model.write(str(path))
    return path


WALL = [
    ("top", BRICK, (9.71, 4.75, 0.15)),
    ("brick 2", BRICK, (9.82, 4.75, 0.05)),
    ("brick 1", BRICK, (9.60, 4.75, 0.05)),
    ("slab", (3.0, 3.0, 0.2), (10.0, 5.0, -0.1)),
]


@pytest.mark.slow
def test_an_ifc_file_becomes_a_plan_that_can_be_built(tmp_path):
    pytest.importorskip("ifcopenshell", reason="extra bim")
    made, path = tmp_path / "wall.yaml", ifc_of(tmp_path / "wall.ifc", WALL)
    told = call("constructskill-plan", str(path), f"--out={made}", "--origin=[-0.4, -0.25]")
    assert "3 elements, can be built" in told and str(made) in told
    again = path.rename(tmp_path / "WALL.IFC")
    assert str(made) in call("constructskill-plan", str(again), f"--out={made}", "--origin=[-0.4, -0.25]")
    own = tmp_path / "own.yaml"
    own.write_text("instruction: mine\n")
    assert "was not made of an IFC file" in call("constructskill-plan", str(again), f"--out={own}", fails=True)
    assert own.read_text() == "instruction: mine\n"
    read = read_plan(str(made))
    assert list(read.elements) == ["brick_1", "brick_2", "top"] and read.elements["top"].on == ["brick_1", "brick_2"]
    np.testing.assert_allclose(
        read.drawn, [[-0.4, -0.25, 0.05], [-0.18, -0.25, 0.05], [-0.29, -0.25, 0.15]], atol=1e-4
    )


def test_what_is_left_out_of_an_ifc_file_is_told_and_names_may_be_of_any_language(tmp_path, caplog):
    pytest.importorskip("ifcopenshell", reason="extra bim")
    boxes = [("Stürz 1", *WALL[2][1:]), ("x" * 120, *WALL[1][1:]), ("half", (0.1, *BRICK[1:]), (9.3, 4.75, 0.05))]
    assert [*plan_of(ifc_of(tmp_path / "wall.ifc", boxes), (-0.4, -0.25))["elements"]] == ["Sturz_1", "x" * 40]
    assert "1 element of" in caplog.text and "left out" in caplog.text and "'half' (100 x 65 x 100 mm)" in caplog.text


def test_no_element_of_an_ifc_file_takes_the_name_of_another(tmp_path):
    pytest.importorskip("ifcopenshell", reason="extra bim")
    names = ("a", "a", "a_2")
    path = ifc_of(tmp_path / "wall.ifc", [(name, *box[1:]) for name, box in zip(names, WALL[:3], strict=True)])
    assert len(plan_of(path, (-0.4, -0.25))["elements"]) == 3


def test_ifc_files_that_make_no_plan_are_refused(tmp_path):
    pytest.importorskip("ifcopenshell", reason="extra bim")
    with pytest.raises(MissingError, match="There is no file"):
        plan_of(tmp_path / "none.ifc")
    (tmp_path / "text.ifc").write_text("hello")
    with pytest.raises(InputError, match="is not an IFC file"):
        plan_of(tmp_path / "text.ifc")
    with pytest.raises(InputError, match="no element of a known kind and size .*brick 210 x 65 x 100 mm"):
        plan_of(ifc_of(tmp_path / "slab.ifc", WALL[-1:]))
    with pytest.raises(InputError, match="'brick_1', lies at x = 9.6 m.*--origin"):
        plan_of(ifc_of(tmp_path / "far.ifc", WALL))
    with pytest.raises(InputError, match="'top' in .* hangs in the air"):
        plan_of(ifc_of(tmp_path / "air.ifc", [WALL[0], ("brick", BRICK, (9.2, 4.75, 0.05))]), (-0.4, -0.25))
