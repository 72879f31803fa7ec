from itertools import pairwise

import numpy as np
import pytest
import torch

from labeling.stages.nets import BatchedAdam, NetBatch, make_nets

CPU = torch.device("cpu")


def make_rngs(count):
    return [np.random.default_rng(seed) for seed in range(count)]


def plain_net(layers, row):
    """Return torch's own net with the parameters of one row of a batch."""
    modules = []
    for k in range(0, len(layers), 2):
        linear = torch.nn.Linear(*layers[k].shape[1:])
        linear.weight.data, linear.bias.data = layers[k][row].T.clone(), layers[k + 1][row, 0].clone()
        modules += [linear, torch.nn.ReLU()]
    return torch.nn.Sequential(*modules[:-1])


def test_a_batch_evaluates_like_plain_nets():
    nets = make_nets(make_rngs(3), 8, 16, CPU, is_zero_at_start=False)
    points = torch.from_numpy(np.random.default_rng(0).normal(size=(3, 50, 3)).astype(np.float32))
    for row in range(3):
        expected = plain_net(nets.layers, row)(points[row])
        torch.testing.assert_close(nets(points)[row], expected, atol=1e-6, rtol=1e-5)
        torch.testing.assert_close(nets.select(torch.tensor([row]))(points[[row]])[0], expected, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize(("hidden_layers", "hidden_units"), [(1, 4), (8, 128)])
def test_shape_of_the_nets(hidden_layers, hidden_units):
    layers = make_nets(make_rngs(2), hidden_layers, hidden_units, CPU, is_zero_at_start=False).layers
    sizes = [3, *[hidden_units] * hidden_layers, 3]
    assert [tuple(layer.shape) for layer in layers[::2]] == [(2, a, b) for a, b in pairwise(sizes)]
    assert all(layer.abs().max() <= layers[2 * (k // 2)].shape[1] ** -0.5 for k, layer in enumerate(layers))
    assert not torch.equal(layers[0][0], layers[0][1])


def test_a_net_follows_from_its_own_generator_alone():
    batch = make_nets(make_rngs(3), 2, 8, CPU, is_zero_at_start=False)
    alone = make_nets([np.random.default_rng(2)], 2, 8, CPU, is_zero_at_start=False)
    for together, single in zip(batch.layers, alone.layers, strict=True):
        assert torch.equal(together[2], single[0])


def test_zero_at_start_is_zero_everywhere_and_can_learn():
    nets = make_nets(make_rngs(1), 3, 16, CPU, is_zero_at_start=True)
    points = torch.randn(1, 20, 3, generator=torch.Generator().manual_seed(0))
    assert not nets(points).any()
    adam = BatchedAdam(nets.layers, 0.01)
    for _ in range(100):
        parameters = [p.requires_grad_() for p in adam.parameters]
        loss = (NetBatch(parameters)(points) - 1.5).square().mean()
        adam.step(torch.autograd.grad(loss, parameters))
    assert float(loss.detach()) < 0.01


def test_adam_takes_the_steps_of_torch():
    start = torch.randn(2, 3, 4, generator=torch.Generator().manual_seed(0))
    target = torch.linspace(-1, 1, 24).reshape(2, 3, 4)
    ours = BatchedAdam([start.clone()], 0.008)
    theirs = start.clone().requires_grad_()
    optimizer = torch.optim.Adam([theirs], lr=0.008)
    for _ in range(30):
        (parameter,) = [p.requires_grad_() for p in ours.parameters]
        ours.step(torch.autograd.grad((parameter - target).square().sum(), [parameter]))
        optimizer.zero_grad()
        (theirs - target).square().sum().backward()
        optimizer.step()
    torch.testing.assert_close(ours.parameters[0].detach(), theirs.detach(), atol=2e-5, rtol=1e-4)


def test_adam_thinned_goes_on_as_if_the_others_had_never_been():
    start = torch.randn(3, 1, 4, generator=torch.Generator().manual_seed(0))
    many, one = BatchedAdam([start.clone()], 0.01), BatchedAdam([start[[1]].clone()], 0.01)
    for step in range(20):
        for adam in (many, one):
            (parameter,) = [p.requires_grad_() for p in adam.parameters]
            adam.step(torch.autograd.grad((parameter - 3).square().sum(), [parameter]))
        if step == 9:
            many.keep(torch.tensor([1]))
    assert torch.equal(many.parameters[0], one.parameters[0])
