"""Any LeRobot checkpoint that looks at one step at a time behind the web socket of vla-evaluation-harness.

    python examples/vla_evaluation_harness/model_server.py --port=8000 --args.policy_type=frozen_vit \
        --args.checkpoint=outputs/train/checkpoints/last/pretrained_model --args.use_select_action=true

The server is the harness's own; this lets LeRobot find its plugins first, and gives a policy the cameras that it was
trained on. `use_select_action` asks the policy at every step, which temporal ensembling needs; without it a chunk is
executed whole.
"""

from vla_eval.model_servers.lerobot import LeRobotModelServer
from vla_eval.model_servers.serve import run_server

from lerobot_constructskill.lerobot_internals import register_third_party_plugins


class ModelServer(LeRobotModelServer):
    """The harness's, which by itself hands out cameras in alphabetical order: the base camera to a wrist policy."""

    def _resolve_image_map(self, images):
        """Each of a policy's cameras is the benchmark's of the same name; with other names, as the harness does it."""
        named = {key.rpartition(".")[2]: key for key in self._expected_image_keys}
        if self._image_keys_arg or not named.keys() <= images.keys():
            return super()._resolve_image_map(images)
        return named


if __name__ == "__main__":
    register_third_party_plugins()
    run_server(ModelServer)
