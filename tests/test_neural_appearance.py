"""The feature MLP: encodings in closed form, the skip connection, gradients to every layer."""

from __future__ import annotations

import math

import pytest
import torch

from stages.neural.appearance import FeatureMlp, positional_encoding


def network(seed: int = 0, **shape: int) -> FeatureMlp:
    return FeatureMlp(torch.Generator().manual_seed(seed), **shape)


def inputs(count: int = 32) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    points = torch.rand(count, 3, generator=generator) - 0.5
    return points, torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)


def test_positional_encoding_is_nerf_s():
    x = torch.tensor([[0.25, -0.5, 0.1]], dtype=torch.float64)
    encoded = positional_encoding(x, 3)[0].tolist()
    expected = x[0].tolist()
    for octave in (1, 2, 4):
        expected += [math.sin(octave * math.pi * c) for c in x[0].tolist()]
        expected += [math.cos(octave * math.pi * c) for c in x[0].tolist()]
    assert encoded == pytest.approx(expected)
    assert positional_encoding(torch.zeros(2, 5, 3), 10).shape == (2, 5, 63)
    assert torch.equal(positional_encoding(x, 0), x)


def test_the_paper_s_shape():
    mlp = network()
    assert [tuple(layer.weight.shape) for layer in mlp.layers] == [
        (256, 90), *[(256, 256)] * 3, (256, 346), *[(256, 256)] * 3,
    ]  # fmt: skip
    features = mlp(*inputs(5))
    assert features.shape == (5, 256)
    colors = mlp.color(features)
    assert colors.shape == (5, 3)
    assert ((colors > 0) & (colors < 1)).all()
    assert network(layers=3, width=16)(*inputs(5)).shape == (5, 16)


def test_the_skip_connection_carries_the_inputs_past_a_dead_layer():
    mlp = network()
    torch.nn.init.zeros_(mlp.layers[3].weight)
    features = mlp(*inputs())
    assert features.std(0).max() > 0.01
    torch.nn.init.zeros_(mlp.layers[4].weight[:, 256:])
    assert mlp(*inputs()).std(0).max() == 0


def test_features_keep_their_size_through_the_layers():
    features = network()(*inputs(512))
    mean_square = (features**2).mean().item()
    assert 0.1 < mean_square < 10  # Kaiming: neither fading nor growing over eight layers


def test_both_inputs_matter():
    mlp = network()
    points, directions = inputs()
    features = mlp(points, directions)
    assert (mlp(points + 0.01, directions) - features).abs().mean() > 1e-3
    assert (mlp(points, -directions) - features).abs().mean() > 1e-3


def test_the_seed_decides():
    points, directions = inputs()
    assert torch.equal(network(1)(points, directions), network(1)(points, directions))
    assert not torch.equal(network(1)(points, directions), network(2)(points, directions))


def test_a_colour_loss_reaches_every_layer_and_is_learned():
    mlp = network(width=32)
    points, directions = inputs(64)
    target = (points > 0).float() * 0.8 + 0.1

    def loss() -> torch.Tensor:
        return ((mlp.color(mlp(points, directions)) - target) ** 2).mean()

    loss().backward()
    for name, parameter in mlp.named_parameters():
        assert parameter.grad.abs().max() > 0, name
    optimizer = torch.optim.Adam(mlp.parameters(), 1e-3)
    first = loss().item()
    for _ in range(60):
        optimizer.zero_grad()
        loss().backward()
        optimizer.step()
    assert loss().item() < 0.3 * first
