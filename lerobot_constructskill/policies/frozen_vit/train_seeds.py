"""Many training seeds in one pass over a feature set, each of which ends as an ordinary LeRobot checkpoint.

The heads of every seed are stacked and stepped together. AdamW works element by element, gradients are clipped per
seed and no seed sees another, so a seed trained among others is the seed trained alone, up to rounding. One thread
trains: sums over several depend on their number, and so would the weights on how many cores a machine has.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from copy import deepcopy
from functools import partial
from pathlib import Path

import torch
from lerobot.datasets import LeRobotDataset
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.utils import ACTION, OBS_STATE
from torch import Tensor, nn
from torch.func import functional_call, stack_module_state, vmap

from lerobot_constructskill.errors import InputError
from lerobot_constructskill.progress import Progress
from lerobot_constructskill.threads import one_thread

from .batches import Rows
from .configuration_frozen_vit import FrozenViTChunkConfig
from .feature_sets import open_patches
from .heads import ChunkHeads, heads_loss
from .language import Told
from .modeling_frozen_vit import FrozenViTChunkPolicy


def train_seeds(
    config: FrozenViTChunkConfig,
    dataset: LeRobotDataset,
    seeds: Sequence[int],
    epochs: int,
    batch_size: int,
    held_out: Sequence[int] = (),
) -> list[FrozenViTChunkPolicy]:
    """Train one policy per seed on a feature set, and return them in the order of the seeds.

    A seed decides the first weights of its heads, as in `lerobot-train --seed`, and the order of its samples. The
    policies share one backbone. Where the readout learns, each step holds tens of megabytes of patches per seed.

    Args:
        epochs: times that each frame that is not held out is seen.
        batch_size: frames per step and seed.
        held_out: numbers of the held-out episodes.

    Raises:
        ValueError: the data set has images in place of features, they are another encoder's, or it does not say where
            the points are that the readout learns to find.
    """
    template = make_policy(deepcopy(config), ds_meta=dataset.meta)
    if template.config.feature_column is None:
        raise InputError(
            f"'{dataset.repo_id}' has no {template.config.feature_key}: seeds train together on features, which "
            "constructskill-encode makes of a data set."
        )
    preprocess, _ = make_pre_post_processors(template.config, dataset_stats=dataset.meta.stats)
    table = _read_table(template, dataset, preprocess)
    inputs = _head_inputs(template, table)
    is_held_out = torch.isin(_episodes(dataset), torch.tensor(list(held_out), dtype=torch.int64))
    rows = torch.nonzero(~is_held_out).squeeze(1)
    heads = [_fresh_heads(template, seed) for seed in seeds]
    n_steps = epochs * -(-len(rows) // batch_size)
    batches = Progress(_batches(rows, seeds, epochs, batch_size), f"training {len(seeds)} seeds", n_steps, unit="step")
    with one_thread():
        _step_together(heads, template.config, inputs, table, batches, n_steps)
    return [with_heads(template, its_heads) for its_heads in heads]


def save_checkpoint(policy: FrozenViTChunkPolicy, dataset: LeRobotDataset, folder: Path) -> None:
    """Write what `lerobot-eval --policy.path=<folder>` loads: configuration, weights and the two processors."""
    policy.save_pretrained(folder)
    for processor in make_pre_post_processors(policy.config, dataset_stats=dataset.meta.stats):
        processor.save_pretrained(folder)


def _batches(rows: Tensor, seeds: Sequence[int], epochs: int, batch_size: int) -> Iterator[Tensor]:
    """Yield batches of rows (S, B), a line for each seed: every row once per epoch, in the seed's own order."""
    generators = [torch.Generator().manual_seed(seed) for seed in seeds]
    for _ in range(epochs):
        orders = [rows[torch.randperm(len(rows), generator=generator)] for generator in generators]
        yield from torch.stack(orders).split(batch_size, dim=1)


def _episodes(dataset: LeRobotDataset) -> Tensor:
    return torch.as_tensor(dataset.hf_dataset.with_format("numpy")["episode_index"][:]).flatten()


def _read_table(
    policy: FrozenViTChunkPolicy, dataset: LeRobotDataset, preprocess: Callable[[dict], dict]
) -> dict[str, Tensor]:
    """Return the whole set as one preprocessed batch: features (N, D), `action` (N, T, A), `action_is_pad` (N, T).

    Where the readout finds points, also where they are, (N, 2P).
    """
    config, columns = policy.config, dataset.hf_dataset.with_format("numpy")
    points = [config.point_key] if policy.readout.points else []
    names = [config.feature_key, "index", "task_index", *config.input_features, *points]
    table = {name: torch.as_tensor(columns[name][:]) for name in names if name in columns.column_names}
    episodes = _episodes(dataset)
    last = torch.searchsorted(episodes, episodes, right=True)[:, None] - 1
    rows = torch.arange(len(episodes))[:, None] + torch.arange(config.chunk_size)
    table[ACTION] = torch.as_tensor(columns[ACTION][:])[rows.minimum(last)]
    table[f"{ACTION}_is_pad"] = rows > last
    return {name: value for name, value in preprocess(table).items() if torch.is_tensor(value)}


def _head_inputs(policy: FrozenViTChunkPolicy, table: dict[str, Tensor]) -> tuple[Tensor, ...]:
    """Return what the heads see of every row; patch features that a readout learns from stay on the disk."""
    beside = [table[OBS_STATE]] if policy.config.use_state else []
    if policy.told:
        beside.append(_told(policy.told, table))
    side = (torch.cat(beside, dim=-1),) if beside else ()
    if policy.readout.learns:
        return open_patches(policy.patches_root), *side
    pooled = [policy.pooled(rows) for rows in _split(table)]
    return torch.cat(pooled), *side


def _told(told: Told, table: dict[str, Tensor]) -> Tensor:
    """The vectors of what every row is told, (N, D)."""
    sentences = [*told.sentences]
    asked = [sentences[number] for number in table["task_index"].tolist()]
    reworded = told.reworded(asked, table["index"].tolist())
    known = {sentence: place for place, sentence in enumerate(dict.fromkeys(reworded))}
    return told([*known])[[known[sentence] for sentence in reworded]]


def _split(table: dict[str, Tensor], size: int = 256) -> Iterator[dict[str, Tensor]]:
    """Yield a table in pieces: patch features take 0.4 MB a row."""
    for first in range(0, len(table[ACTION]), size):
        yield {name: column[first : first + size] for name, column in table.items()}


def _fresh_heads(policy: FrozenViTChunkPolicy, seed: int) -> ChunkHeads:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return policy.fresh_heads().to(policy.config.device)


def _step_together(
    heads: Sequence[ChunkHeads],
    config: FrozenViTChunkConfig,
    inputs: tuple[Tensor, ...],
    table: dict[str, Tensor],
    batches: Iterable[Tensor],
    n_steps: int,
) -> None:
    """Train `heads` in place."""
    preset, schedule = config.get_optimizer_preset(), config.get_scheduler_preset()
    labels = [table[name] for name in (ACTION, f"{ACTION}_is_pad", config.point_key) if name in table]
    stacked, _ = stack_module_state(list(heads))
    parameters = {name: nn.Parameter(tensor.detach()) for name, tensor in stacked.items()}
    optimizer = preset.build(list(parameters.values()))
    scheduler = schedule.build(optimizer, n_steps) if schedule else None
    memories = [Rows() for _ in inputs]
    for batch in batches:
        wanted = [label[batch] for label in labels]
        seen = [
            memory.read(values, batch.flatten()).unflatten(0, batch.shape).to(config.device)
            for memory, values in zip(memories, inputs, strict=True)
        ]
        made = vmap(lambda own, *seen: functional_call(heads[0], own, seen))(parameters, *seen)
        losses, _ = vmap(partial(heads_loss, config))(*made, *wanted)
        optimizer.zero_grad()
        losses.sum().backward()
        _clip_each(parameters.values(), preset.grad_clip_norm)
        optimizer.step()
        if scheduler:
            scheduler.step()
    for number, own in enumerate(heads):
        own.load_state_dict({name: tensor[number] for name, tensor in parameters.items()})


def _clip_each(parameters: Sequence[Tensor], longest: float) -> None:
    """`torch.nn.utils.clip_grad_norm_` for every seed by itself."""
    gradients = [parameter.grad for parameter in parameters]
    norms = torch.stack([gradient.flatten(1).norm(dim=1) for gradient in gradients]).norm(dim=0)
    scale = (longest / (norms + 1e-6)).clamp(max=1.0)
    for gradient in gradients:
        gradient.mul_(scale.view(-1, *[1] * (gradient.ndim - 1)))


def with_heads(template: FrozenViTChunkPolicy, heads: ChunkHeads) -> FrozenViTChunkPolicy:
    """Return a copy of a policy with other heads and the same backbone."""
    policy = deepcopy(template, {id(template.backbone): template.backbone})
    policy.heads = heads
    return policy
