"""Any LeRobot checkpoint, also one of frozen_vit, behind the web socket of vla-evaluation-harness.

    python examples/vla_evaluation_harness/model_server.py --port=8000 --args.policy_type=frozen_vit \
        --args.checkpoint=outputs/train/checkpoints/last/pretrained_model --args.use_select_action=true

The server is the harness's own; this only lets LeRobot find its plugins first. `use_select_action` asks the policy at
every step, which temporal ensembling needs; without it a chunk is executed whole.
"""

from vla_eval.model_servers.lerobot import LeRobotModelServer
from vla_eval.model_servers.serve import run_server

from lerobot_constructskill.lerobot_internals import register_third_party_plugins

if __name__ == "__main__":
    register_third_party_plugins()
    run_server(LeRobotModelServer)
