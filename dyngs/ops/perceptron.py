"""Placeholder in torch."""
from dataclasses import dataclass
import torch
from torch import Tensor

@dataclass(frozen=True)
class Layer:
    weight: Tensor
    bias: Tensor

def perceptron(x, layers, *, skip=None):
    h = x
    for i, l in enumerate(layers):
        if i == skip:
            h = torch.cat([h, x], 1)
        h = torch.addmm(l.bias, h, l.weight.T)
        if i + 1 < len(layers):
            h = h.relu()
    return h
