"""Multilayer perceptrons."""

from collections.abc import Sequence

from torch import nn

ACTIVATIONS: dict[str, type[nn.Module]] = {"silu": nn.SiLU, "relu": nn.ReLU}


def mlp(sizes: Sequence[int], activation: str = "silu") -> nn.Sequential:
    """Linear layers of the given sizes with an activation (of ``ACTIVATIONS``) between them, none after the last."""
    layers: list[nn.Module] = []
    for i, (a, b) in enumerate(zip(sizes[:-1], sizes[1:], strict=True)):
        layers += ([ACTIVATIONS[activation]()] if i else []) + [nn.Linear(a, b)]
    return nn.Sequential(*layers)


def zero_output(network: nn.Sequential) -> None:
    """Sets the last linear layer to zero, so that training starts from output zero."""
    last = network[-1]
    assert isinstance(last, nn.Linear)
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
