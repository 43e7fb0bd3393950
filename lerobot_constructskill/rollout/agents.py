"""Agents, which act in an environment: any LeRobot policy, and anything else with the methods of `Agent`."""

from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from copy import deepcopy
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any, Protocol, TypedDict

import numpy as np
import torch
from lerobot.envs import preprocess_observation
from lerobot.policies import PreTrainedPolicy, get_policy_class, make_pre_post_processors
from lerobot.utils import ACTION

from lerobot_constructskill.contract import ANY_ACTION, CAMERAS, FULL_ACTION, TASK_ACTION
from lerobot_constructskill.errors import InputError, UserError, one_line
from lerobot_constructskill.files import Json
from lerobot_constructskill.policy_types import read_policy
from lerobot_constructskill.threads import one_thread


@dataclass(frozen=True)
class Observation:
    """What an environment shows of one step.

    Args:
        seen: the environment's observation.
        sim: privileged state, `contract.SIM_STATE` name to float32 array, which only experts may use.
        instruction: the task's sentence.
    """

    seen: dict[str, Any]
    sim: dict[str, np.ndarray]
    instruction: str


class Agent(Protocol):
    """Something that acts in one environment.

    It may have an attribute `cameras`, the names of the cameras that it looks at. Without it, every camera is shown.
    """

    def reset(self, seed: int) -> None:
        """Forget the last episode; `seed` is that of the next one."""

    def act(self, observation: Observation) -> np.ndarray:
        """Return the action of this step, float32 (A,), in metres with the gripper last."""


class _RegisteredStep(TypedDict):
    registry_name: str


PIPELINE = Json("a processor whose steps are all registered", TypedDict("_Pipeline", {"steps": list[_RegisteredStep]}))
"""LeRobot calls any function that a step names as its `class` in place of a name in its registry."""


def _check_files(checkpoint: Path) -> None:
    """Refuse a folder in which reading would hang, or that names functions to call. Names on the Hub pass."""
    for path in checkpoint.glob("*"):
        if path.is_fifo() or path.is_char_device():
            raise InputError(f"'{path}' is not a regular file.")
    for path in checkpoint.glob("policy_*processor.json"):
        PIPELINE.read(path)


class PolicyAgent:
    """A LeRobot policy between its two processors, as `lerobot-eval` runs it.

    A policy that samples its actions draws them from the episode's seed and the step alone.

    Args:
        policy: the policy, in evaluation mode.
        preprocessor: from observations to what the policy reads.
        postprocessor: from the policy's output to actions.
    """

    def __init__(self, policy: PreTrainedPolicy, preprocessor, postprocessor):
        self.policy, self.preprocessor, self.postprocessor = policy.eval(), preprocessor, postprocessor
        self._seed = self._step = 0

    @classmethod
    def from_pretrained(cls, checkpoint: Path | str, device: str | None = None, **overrides: Any) -> "PolicyAgent":
        """Load a checkpoint folder, or a name on the Hub, of any policy type that is installed.

        Args:
            overrides: fields of its configuration; None leaves a field as it is.

        Raises:
            ValueError: its configuration cannot be read, or is of an unknown type.
            OSError: there is no such checkpoint.
        """
        _check_files(Path(checkpoint))
        config = read_policy(checkpoint, **overrides)
        if config.use_peft:
            raise InputError(f"'{checkpoint}' is a PEFT adapter; merge it into its policy first.")
        config.device = device or config.device
        config.pretrained_path = checkpoint
        on_device = {"device_processor": {"device": config.device}}
        try:
            with redirect_stdout(StringIO()):  # LeRobot prints where it loads weights from, for every policy
                policy = get_policy_class(config.type).from_pretrained(checkpoint, config=config)
            processors = make_pre_post_processors(config, str(checkpoint), preprocessor_overrides=on_device)
        except (UserError, OSError, ImportError):
            raise
        except Exception as error:  # whatever a file can do to LeRobot, safetensors and a policy of anybody's
            said = f"{type(error).__name__}: {one_line(error)[:300]}"
            raise InputError(f"The checkpoint '{checkpoint}' cannot be loaded ({said}).") from error
        return cls(policy, *processors)

    @property
    def is_forgetful(self) -> bool:
        """Whether its submodules and processors remember nothing, as a class with an `in_lockstep` of its own says."""
        return "in_lockstep" in vars(type(self.policy))

    @property
    def cameras(self) -> tuple[str, ...]:
        """The cameras that are among the policy's inputs; every camera where it has other names for pictures."""
        named = {camera.key: name for name, camera in CAMERAS.items()}
        pictures = self.policy.config.image_features
        renamed = any(getattr(step, "rename_map", None) for step in getattr(self.preprocessor, "steps", ()))
        if renamed or not pictures.keys() <= named.keys():
            return tuple(CAMERAS)
        return tuple(named[key] for key in pictures)

    @property
    def action(self) -> str:
        """The form of its actions, one of `contract.ACTIONS`, as their number tells."""
        feature = self.policy.config.output_features.get(ACTION)
        return ANY_ACTION if feature is not None and feature.shape == (len(FULL_ACTION),) else TASK_ACTION

    def reset(self, seed: int) -> None:
        self.policy.reset()
        self._seed, self._step = seed, 0

    def act(self, observation: Observation) -> np.ndarray:
        return self.decide(self.see(observation))

    @torch.inference_mode()
    def see(self, observation: Observation) -> dict[str, Any]:
        """Preprocess an observation to the policy's batch of one."""
        with one_thread():
            return self.preprocessor(preprocess_observation(observation.seen) | {"task": [observation.instruction]})

    @torch.inference_mode()
    def decide(self, batch: dict[str, Any]) -> np.ndarray:
        """Return the action for a batch of one.

        Raises:
            ValueError: the policy reads what the batch does not hold.
        """
        (drawn,) = np.random.SeedSequence([self._seed, self._step]).generate_state(1)
        self._step += 1
        device = torch.device(self.policy.config.device)
        amp = torch.autocast(device.type, enabled=self.policy.config.use_amp)
        # On a CPU, torch.manual_seed would note a stack trace for each kind of GPU at every step.
        seed_torch = torch.default_generator.manual_seed if device.type == "cpu" else torch.manual_seed
        with torch.random.fork_rng([device] if device.type == "cuda" else []), amp, observing(batch, OFFERED):
            seed_torch(int(drawn))
            action = self.policy.select_action(batch)
        return self.postprocessor(action).squeeze(0).cpu().numpy()


OFFERED = "obs_type=pixels_agent_pos has the wrist camera and the state; pixels has the base camera alone"


@contextmanager
def observing(shown: Container[str], offered: str) -> Iterator[None]:
    """Turn the KeyError of a policy that reads an observation which it is not shown into a sentence.

    Args:
        shown: names of the observations that it is shown.
        offered: which observations there are and where.

    Raises:
        InputError: inside the block a policy looked for another observation.
    """
    try:
        yield
    except KeyError as error:
        name = str(error).strip("'")
        if not name.startswith("observation.") or name in shown:
            raise
        raise InputError(f"The policy reads {name}, which it is not shown: {offered}.") from error


class Lockstep:
    """Many agents that act once in each step. What several policies of a class compute alike is computed once.

    A policy class takes part by an attribute `in_lockstep`. Called with its policies by number, it returns a function
    from their preprocessed batches by number to batches that `select_action` takes as well. In place of a batch it may
    return an exception. The attribute also says that nothing of an episode outlasts `reset`, and that submodules and
    processors remember nothing between two steps: copies that share these then share out the episodes of an agent.
    """

    def __init__(self, agents: Sequence[Agent]):
        self._agents = agents
        by_class: dict[type, dict[int, PreTrainedPolicy]] = {}
        for number, agent in enumerate(agents):
            if isinstance(agent, PolicyAgent):
                by_class.setdefault(type(agent.policy), {})[number] = agent.policy
        self._shared = {
            tuple(policies): kind.in_lockstep(policies)
            for kind, policies in by_class.items()
            if hasattr(kind, "in_lockstep")
        }

    def act(self, observations: Mapping[int, Observation]) -> dict[int, np.ndarray | Exception]:
        """The action of every agent, by number, or the exception that it raised."""
        acting = {number: self._agents[number] for number in observations}
        policies = {number: agent for number, agent in acting.items() if isinstance(agent, PolicyAgent)}
        batches = {number: caught(agent.see, observations[number]) for number, agent in policies.items()}
        for numbers, share in self._shared.items():
            own = {number: batches[number] for number in numbers if isinstance(batches.get(number), Mapping)}
            seen = caught(share, own)
            batches |= dict.fromkeys(own, seen) if isinstance(seen, Exception) else seen
        decided = {
            number: batch if isinstance(batch, Exception) else caught(policies[number].decide, batch)
            for number, batch in batches.items()
        }
        others = acting.keys() - policies.keys()
        return decided | {number: caught(acting[number].act, observations[number]) for number in others}


def copies(agent: Agent, count: int) -> list[Agent]:
    """Agents that act alike, each with a memory of its own. Policies share their weights, or all that forgets."""
    shared = []
    if isinstance(agent, PolicyAgent):
        parts = [*agent.policy.children(), agent.preprocessor, agent.postprocessor]
        shared = parts if agent.is_forgetful else [*agent.policy.parameters()]
    return [agent, *(deepcopy(agent, {id(one): one for one in shared}) for _ in range(count - 1))]


def caught(call: Callable[..., Any], *args: Any) -> Any:
    """What a call returns, or the exception that it raises."""
    try:
        return call(*args)
    except Exception as error:
        return error
