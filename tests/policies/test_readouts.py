"""Keypoints are computed a few images at a time: they, and their gradient, are those of the formula."""

import pytest
import torch
from torch.func import functional_call, stack_module_state, vmap

from lerobot_constructskill.policies.frozen_vit.readouts import (
    CACHED,
    NEGLIGIBLE,
    SpatialSoftmax,
    _expected_positions,
    _Positions,
)

N, D, K = 49, 12, 5


def keypoints(sharpness: float, seed: int = 0) -> SpatialSoftmax:
    torch.manual_seed(seed)
    readout = SpatialSoftmax(D, K)
    torch.nn.init.normal_(readout.patterns.weight, std=sharpness)
    return readout


@pytest.mark.parametrize("images", [1, CACHED, 2 * CACHED + 3])
@pytest.mark.parametrize("dtype", [torch.float16, torch.float32])
@pytest.mark.parametrize("sharpness", [0.1, 20.0])
def test_positions_and_gradient_are_those_of_the_formula(images, dtype, sharpness):
    readout = keypoints(sharpness)
    patches, gradient = torch.randn(images, N, D).to(dtype), torch.randn(images, 2 * K)
    patterns = readout.patterns.weight.detach().clone().requires_grad_()
    wanted = _expected_positions(patches.float() @ patterns.T)
    wanted.backward(gradient)
    found = readout(patches)
    found.backward(gradient)
    torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(readout.patterns.weight.grad, patterns.grad, rtol=1e-3, atol=1e-4)


def test_no_share_is_a_denormal_number():
    _, shares = _Positions.forward(torch.randn(3, N, D), keypoints(20.0).patterns.weight.detach())
    assert shares.eq(0).any() and shares[shares > 0].min() >= NEGLIGIBLE
    torch.testing.assert_close(shares.sum(dim=-1), torch.ones(3, K))


def test_seeds_that_are_stacked_find_what_each_finds_alone():
    readouts = [keypoints(1.0, seed) for seed in range(3)]
    patches = torch.randn(3, 4, N, D)
    stacked, _ = stack_module_state(readouts)
    stacked = {name: value.detach().requires_grad_() for name, value in stacked.items()}
    found = vmap(lambda own, seen: functional_call(readouts[0], own, (seen,)))(stacked, patches)
    found.square().sum().backward()
    for number, (readout, seen) in enumerate(zip(readouts, patches, strict=True)):
        (alone := readout(seen)).square().sum().backward()
        torch.testing.assert_close(found[number], alone)
        torch.testing.assert_close(stacked["patterns.weight"].grad[number], readout.patterns.weight.grad)
