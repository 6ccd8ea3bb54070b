"""Placeholder in torch."""
from dataclasses import dataclass
import torch
from torch import Tensor
import torch.nn.functional as F

@dataclass(frozen=True)
class PlaneLevel:
    space: Tensor
    time: Tensor

def hexplane_features(coords, time, levels):
    x, y, z = coords.unbind(-1)
    feats = []
    t = torch.full_like(x, 2 * time - 1)
    for lv in levels:
        out = 1
        for p, (a, b) in zip(lv.space, ((x, y), (x, z), (y, z))):
            out = out * F.grid_sample(p.permute(2, 0, 1)[None], torch.stack([a, b], -1)[None, None], align_corners=True, padding_mode="border")[0, :, 0].T
        for p, a in zip(lv.time, (x, y, z)):
            out = out * F.grid_sample(p.permute(2, 0, 1)[None], torch.stack([a, t], -1)[None, None], align_corners=True, padding_mode="border")[0, :, 0].T
        feats.append(out)
    return torch.cat(feats, 1)

def plane_penalty(levels, weights):
    total = 0
    d2 = lambda p, ax: p.diff(n=2, dim=ax).square().mean((1, 2, 3)).sum()
    for lv in levels:
        total = total + weights[0] * 0.5 * (d2(lv.space, 1) + d2(lv.space, 2)) + weights[1] * d2(lv.time, 1) + weights[2] * (1 - lv.time).abs().mean((1, 2, 3)).sum()
    return total
