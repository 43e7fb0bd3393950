"""Where a picture shows things, said from their poses alone."""

import numpy as np
import pytest

from lerobot_constructskill.contract import CAMERAS, IMAGE_SIZE
from lerobot_constructskill.envs.gym_env import ConstructSkillEnv
from lerobot_constructskill.errors import InputError
from lerobot_constructskill.features.points import POSES, find_points
from lerobot_constructskill.policies.frozen_vit.readouts import POINTS

UPRIGHT = [1.0, 0.0, 0.0, 0.0]
DOWNWARD = [0.0, 1.0, 0.0, 0.0]


def columns(**positions) -> dict[str, np.ndarray]:
    """Of one frame; what is not said is at the origin, under a hand that points down."""
    poses = {name: [*positions.get(name, (0, 0, 0)), *(DOWNWARD if name == "hand" else UPRIGHT)] for name in POINTS}
    return {POSES[name]: np.array([pose], dtype=np.float32) for name, pose in poses.items()}


def found(point: str, camera: str, crop=None, **positions) -> np.ndarray:
    at = 2 * POINTS.index(point)
    return find_points(columns(**positions), camera, crop)[0, at : at + 2]


def test_what_the_base_camera_looks_at_is_in_the_middle_and_what_is_higher_is_further_up():
    target = np.array(CAMERAS["base"].target)
    np.testing.assert_allclose(found("object", "base", object=target), 0, atol=1e-6)
    x, y = found("object", "base", object=target + [0, 0, 0.1])
    assert abs(x) < 1e-6 and y < -0.05
    assert found("object", "base", object=target + [0.1, 0, 0])[0] > 0.03  # it looks from behind the robot's right


@pytest.mark.parametrize(
    ("point", "camera", "place"),
    [*((point, "base", (5.0, -5.0, 0.0)) for point in POINTS), ("object", "wrist", (5.0, 5.0, 0.0))],
)
def test_a_point_outside_the_picture_is_on_its_edge(point, camera, place):
    assert np.abs(found(point, camera, **{point: place})).max() == 1


def test_a_part_of_the_picture_has_its_own_middle_and_size():
    position = np.array(CAMERAS["base"].target) + [0.2, 0.1, 0.1]
    x, y = (found("object", "base", object=position) + 1) / 2  # in shares of the picture
    left, top = round((x - 0.05) * IMAGE_SIZE) / IMAGE_SIZE, round((y - 0.15) * IMAGE_SIZE) / IMAGE_SIZE
    crop = [left, top, left + 56 / IMAGE_SIZE, top + 112 / IMAGE_SIZE]
    within = (x - left) / 0.25 * 2 - 1, (y - top) / 0.5 * 2 - 1
    np.testing.assert_allclose(found("object", "base", crop, object=position), within, atol=1e-5)
    assert abs(within[0] - within[1]) > 0.1


def test_the_wrist_camera_sees_the_same_wherever_hand_and_object_go_together():
    seen = []
    for away in ([0, 0, 0], [0.3, -0.2, 0.1]):
        hand, brick = np.add([0.1, 0.0, 0.3], away), np.add([0.12, 0.01, 0.1], away)
        seen.append(found("object", "wrist", hand=hand, object=brick))
    np.testing.assert_allclose(*seen, atol=1e-5)
    assert (np.abs(seen[0]) < 1).all()


def test_a_set_that_does_not_say_where_things_are_is_a_sentence():
    with pytest.raises(InputError, match=r"has no sim\.bin_position, sim\.object_pose, sim\.tcp_pose"):
        find_points({}, "base")
    with pytest.raises(InputError, match="Where 'top' looks from is not known"):
        find_points(columns(), "top")


@pytest.mark.sim
@pytest.mark.parametrize("camera", CAMERAS)
def test_the_object_is_where_it_is_said_to_be_in_a_rendered_picture(camera):
    """The pixel there is as red as a brick, and few others are."""
    env = ConstructSkillEnv("brick_to_bin_shifted", "pixels_agent_pos")
    for seed in range(3):
        observation, _ = env.reset(seed=seed)
        red, _, blue = np.moveaxis(observation["pixels"][camera].astype(int), -1, 0)
        state = {f"sim.{name}": value[None] for name, value in env.privileged_state().items()}
        x, y = find_points(state, camera)[0, :2]
        row, column = (int((place + 1) / 2 * IMAGE_SIZE) for place in (y, x))
        brick = red > 1.5 * blue
        assert brick[row, column] and brick.mean() < (0.01 if camera == "base" else 0.3)
    env.close()
