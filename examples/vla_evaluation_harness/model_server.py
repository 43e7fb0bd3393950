"""Any LeRobot checkpoint that looks at one step at a time behind the web socket of vla-evaluation-harness.

    python examples/vla_evaluation_harness/model_server.py --port=8000 --args.policy_type=frozen_vit \
        --args.checkpoint=outputs/train/checkpoints/last/pretrained_model --args.use_select_action=true

The server is the harness's own; this lets LeRobot find its plugins first, gives a policy the cameras that it was
trained on, and says what the checkpoint sends and reads: the harness compares that with the benchmark's specification
before the first episode and warns of every field that differs. The benchmark refuses a checkpoint whose actions are
too long or too short for it. `use_select_action` asks the policy at every step, which temporal ensembling needs;
without it the harness executes the checkpoint's `n_action_steps` of each chunk.
"""

from dataclasses import replace
from typing import Any

import constructskill_specs as specs
from vla_eval.model_servers.lerobot import LeRobotModelServer
from vla_eval.model_servers.serve import run_server
from vla_eval.specs import GRIPPER_01, IMAGE_RGB, LANGUAGE, POSITION_DELTA, RAW, STATE_EEF_POS_AA_GRIP, DimSpec

from lerobot_constructskill.contract import ACTION_SCALE, ROTATION, STATE_NAMES, TRANSLATION
from lerobot_constructskill.lerobot_internals import load_plugins


class ModelServer(LeRobotModelServer):
    """The harness's, which by itself hands out cameras in alphabetical order: the base camera to a wrist policy."""

    def _resolve_image_map(self, images):
        """Each of a policy's cameras is the benchmark's of the same name; with other names, as the harness does it."""
        named = {key.rpartition(".")[2]: key for key in self._expected_image_keys}
        if self._image_keys_arg or not named.keys() <= images.keys():
            return super()._resolve_image_map(images)
        return named

    def get_observation_params(self) -> dict[str, Any]:
        """The harness's, and how many numbers the checkpoint sends: the harness only warns where they do not fit."""
        (count,) = self._policy.config.output_features["action"].shape
        return super().get_observation_params() | {"action_length": count}

    def get_action_spec(self) -> dict[str, DimSpec]:
        """The numbers that the checkpoint sends, and whether its training data had them in metres or from -1 to 1."""
        (count,) = self._policy.config.output_features["action"].shape
        turns = {4: (), 5: ROTATION[-1:], 7: ROTATION}.get(count)
        saved = {name: value for step in self._postprocess.steps for name, value in step.state_dict().items()}
        if turns is None or not {"action.min", "action.max"} <= saved.keys():
            return {"actions": replace(RAW, dims=count, description="its training data do not say what they are")}
        low, high = saved["action.min"].cpu(), saved["action.max"].cpu()
        moves = slice(len(TRANSLATION))
        is_metres = max(-low[moves].min(), high[moves].max()) <= ACTION_SCALE
        return {
            "position": specs.POSITION if is_metres else POSITION_DELTA,
            **({"rotation": specs.rotation(turns, is_metres)} if turns else {}),
            "gripper": specs.GRIPPER if low[-1] < 0 else GRIPPER_01,
        }

    def get_observation_spec(self) -> dict[str, DimSpec]:
        """The cameras that the policy knows by name, the instruction, and the state where it reads one."""
        cameras = self._image_keys_arg or {key.rpartition(".")[2]: key for key in self._expected_image_keys}
        state = (self._policy.config.input_features or {}).get(self.state_key)
        is_ours = state and state.shape == (len(STATE_NAMES),)
        spec = STATE_EEF_POS_AA_GRIP if is_ours else DimSpec("state", state.shape[0] if state else 0, "raw")
        return dict.fromkeys(cameras, IMAGE_RGB) | {"language": LANGUAGE} | ({"state": spec} if state else {})


if __name__ == "__main__":
    load_plugins()
    run_server(ModelServer)
