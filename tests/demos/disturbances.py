"""States that a learner leaves behind: each disturbance brings a fresh episode into one, by actions or by force."""

import numpy as np

from lerobot_constructskill.contract import ACTION_SCALE, GRIPPER_CLOSED, GRIPPER_OPEN
from lerobot_constructskill.demos.expert import Phase, PrivilegedState


def state_of(env) -> PrivilegedState:
    return PrivilegedState(**env.privileged_state())


def drive(env, target, gripper, steps=40, fastest=ACTION_SCALE):
    """Move the hand toward a point and end there, or after `steps`."""
    for _ in range(steps):
        error = np.asarray(target) - state_of(env).tcp
        if np.linalg.norm(error) < 0.01:
            break
        env.step(action(env, np.clip(2 * error, -fastest, fastest), gripper))


def action(env, translation, gripper):
    zeros = np.zeros(env.action_space.shape, dtype=np.float32)
    zeros[:3], zeros[-1] = translation, gripper
    return zeros


def put(env, position, roll=0.0, yaw=0.0):
    """Set the object down somewhere, tipped over by `roll` and turned by `yaw`, and let it settle."""
    import sapien
    from mani_skill.utils.structs import Pose

    a, b = roll / 2, yaw / 2
    rolled, yawed = sapien.Pose(q=[np.cos(a), np.sin(a), 0, 0]), sapien.Pose(position, [np.cos(b), 0, 0, np.sin(b)])
    env._env.object.set_pose(Pose.create(yawed * rolled))
    for _ in range(5):
        env.step(action(env, [0, 0, 0], GRIPPER_OPEN))


def follow(env, expert, until):
    """Follow the advice until a state and its advice are as asked for."""
    for _ in range(300):
        state = state_of(env)
        advice = expert.advise(state)
        if until(state, advice):
            return
        env.step(advice.action)


def nothing(env, expert, rng):
    pass


def hand_anywhere(env, expert, rng):
    drive(env, rng.uniform([-0.15, -0.5, 0.05], [0.15, 0.2, 0.45]), rng.choice([GRIPPER_OPEN, GRIPPER_CLOSED]))


def pushed(env, expert, rng):
    place = state_of(env).object_pose[:3] + [*rng.uniform(-0.04, 0.04, 2), 0.002]
    put(env, place)


def turned(env, expert, rng):
    put(env, state_of(env).object_pose[:3] + [0, 0, 0.002], yaw=rng.uniform(0.1, 0.2) * rng.choice([-1, 1]))


def dropped(env, expert, rng):
    height = rng.uniform(0.02, 0.15)
    follow(env, expert, lambda state, advice: state.object_pose[2] > state.object_size[2] / 2 + height)
    for _ in range(6):
        env.step(action(env, [0, 0, 0], GRIPPER_OPEN))


def dropped_on_the_way(env, expert, rng):
    share = rng.uniform(0.1, 0.4)
    way = state_of(env).bin_position[1] * share
    follow(env, expert, lambda state, advice: abs(state.object_pose[1]) > abs(way) and advice.phase is Phase.CARRY)
    for _ in range(10):
        env.step(action(env, [0, 0, 0], GRIPPER_OPEN))


def off_centre(env, expert, rng):
    state = state_of(env)
    aside = min(0.06, state.object_size[0] / 2 - 0.02) * rng.choice([-1, 1])
    over = state.object_pose[:3] + [aside, 0, state.object_size[2] / 2]
    drive(env, over + [0, 0, 0.04], GRIPPER_OPEN)
    drive(env, over - [0, 0, 0.025], GRIPPER_OPEN)
    for rise in [0, 0, *[0.03] * rng.integers(0, 6)]:
        env.step(action(env, [0, 0, rise], GRIPPER_CLOSED))


def in_the_bin(env, expert, rng):
    state = state_of(env)
    over = state.bin_position + [*rng.uniform(-0.4, 0.4, 2) * state.bin_interior[:2], 0.2]
    drive(env, over, GRIPPER_OPEN)
    drive(env, over - [0, 0, 0.17], GRIPPER_CLOSED, 15)


def beside_the_bin(env, expert, rng):
    state = state_of(env)
    beside = state.bin_position + [-state.bin_interior[0] / 2 - 0.06, 0, 0.2]
    drive(env, beside, GRIPPER_OPEN)
    drive(env, [*beside[:2], 0.06], GRIPPER_OPEN, 40, fastest=0.03)


def closed_in_the_air(env, expert, rng):
    state = state_of(env)
    over = state.object_pose[:3] + [*rng.uniform(-0.03, 0.03, 2), state.object_size[2] / 2 + rng.uniform(0.015, 0.08)]
    drive(env, over + [0, 0, 0.05], GRIPPER_OPEN)
    drive(env, over, GRIPPER_CLOSED)


def landed_on_it(env, expert, rng):
    """A finger has come down on the object, beside its middle."""
    state = state_of(env)
    over = state.object_pose[:3] + rng.choice([-1, 1]) * 0.03 * np.array([0, 1, 0])
    drive(env, over + [0, 0, state.object_size[2] / 2 + 0.05], GRIPPER_OPEN)
    drive(env, over + [0, 0, state.object_size[2] / 2], GRIPPER_OPEN, 15)


def tipped(env, expert, rng):
    state = state_of(env)
    drive(env, state.tcp + [0, 0, 0.15], GRIPPER_OPEN)
    put(env, [*state.object_pose[:2], state.object_size[1] / 2 + 0.005], roll=np.pi / 2)


DISTURBANCES = {
    one.__name__: one
    for one in (
        nothing,
        hand_anywhere,
        pushed,
        turned,
        dropped,
        dropped_on_the_way,
        off_centre,
        in_the_bin,
        beside_the_bin,
        closed_in_the_air,
        landed_on_it,
        tipped,
    )
}


def recover(env, expert, disturbance, seed):
    """Whether the advice leads to success from the disturbed start of `seed`, in how many steps, and if not, whether
    the expert says that it is hopeless."""
    env.reset(seed=seed)
    disturbance(env, expert, np.random.default_rng(seed))
    success, steps, advice, most = False, 0, None, 350 * state_of(env).count
    while not success and steps < most:
        advice = expert.advise(state_of(env))
        if advice.hopeless and steps > 100:
            break
        _, _, success, _, _ = env.step(advice.action)
        steps += 1
    return success, steps, bool(advice.hopeless)
