"""Keypoint R-CNN and Mask R-CNN (He et al. 2017) of torchvision, with weights that the user has downloaded."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from dyngs.data.images.images import read_image
from dyngs.errors import DyngsError, printable, reading
from dyngs.human.detection.detector import Detection

LEAST_SCORE = 0.7  # of a detection
SAME_BOX = 0.5  # overlap (IoU) of the boxes of one person in both networks
PERSON = 1  # label in COCO
LOGIT_SCALE = 4.0  # a key point's score is a logit; half as sure as can be at 0
NAMES = "keypointrcnn_resnet50_fpn, and for silhouettes maskrcnn_resnet50_fpn, both trained on COCO"
CONVERT = (
    '`python -c "import sys, torch; from safetensors.torch import save_file; save_file(torch.load(sys.argv[1], '
    'weights_only=True), sys.argv[2])" IN.pth OUT.safetensors`'
)


class Rcnn:
    """Torchvision's R-CNNs; they find several people in an image."""

    name = "R-CNN"

    def __init__(self, weights: Sequence[Path]) -> None:
        """``weights``: files of one network or both. Raises DyngsError: no torchvision, or other weights."""
        try:
            models = importlib.import_module("torchvision.models.detection")
        except (ImportError, RuntimeError, OSError) as error:  # a torchvision of another torch has no operators
            said = printable(str(error), 120)
            raise DyngsError(
                f"--weights needs the torchvision of this torch: pip install torchvision ({said})"
            ) from None
        self._keypoints: nn.Module | None = None
        self._masks: nn.Module | None = None
        empty: dict[str, Any] = {"weights": None, "weights_backbone": None}
        for path in weights:
            state = _state(path)
            if "roi_heads.keypoint_predictor.kps_score_lowres.weight" in state:
                self._keypoints = _loaded(path, models.keypointrcnn_resnet50_fpn(**empty), state)
            elif "roi_heads.mask_predictor.mask_fcn_logits.weight" in state:
                self._masks = _loaded(path, models.maskrcnn_resnet50_fpn(**empty), state)
            else:
                raise DyngsError(f"{path}: holds weights of another network; give torchvision's {NAMES}")
        if self._keypoints is None:
            raise DyngsError(f"{weights[0]}: no weights for key points; give torchvision's {NAMES}")

    @torch.no_grad()
    def detect(self, images: Sequence[Path]) -> list[list[Detection]]:
        """Return the people in each image."""
        return [self._people(read_image(path)[..., :3].permute(2, 0, 1).float() / 255) for path in images]

    def _people(self, image: Tensor) -> list[Detection]:
        assert self._keypoints is not None
        found = _sure(self._keypoints([image])[0])
        masks = None if self._masks is None else _sure(self._masks([image])[0])
        return [
            Detection(_keypoints(points, scores), None if masks is None else _mask_of(box, masks, image.shape[1:]))
            for box, points, scores in zip(found["boxes"], found["keypoints"], found["keypoints_scores"], strict=True)
        ]


def _state(path: Path) -> dict[str, Tensor]:
    """Return the tensors of a file of weights; nothing else in it is loaded."""
    if path.suffix != ".safetensors":
        raise DyngsError(f"{path}: files that could run code are not read; make it .safetensors by {CONVERT}")
    from safetensors.torch import load_file

    with reading(path, "make it anew from the file that torchvision publishes"):
        return load_file(path)


def _loaded(path: Path, network: nn.Module, state: Mapping[str, Tensor]) -> nn.Module:
    with reading(path, f"give torchvision's {NAMES}"):
        network.load_state_dict(state)
    return network.eval()


def _sure(found: Mapping[str, Tensor]) -> dict[str, Tensor]:
    kept = (found["labels"] == PERSON) & (found["scores"] >= LEAST_SCORE)
    return {name: values[kept] for name, values in found.items()}


def _keypoints(points: Tensor, scores: Tensor) -> np.ndarray:
    """Return (17, 3) of positions (17, 3) and logits (17,)."""
    return torch.cat([points[:, :2], (scores / LOGIT_SCALE).sigmoid()[:, None]], dim=1).float().numpy()


def _mask_of(box: Tensor, masks: Mapping[str, Tensor], shape: Sequence[int]) -> np.ndarray:
    """Return the mask (H, W) uint8 of the person in ``box`` (4,); empty where Mask R-CNN saw nobody there."""
    if len(masks["boxes"]):
        overlaps = _overlaps(box, masks["boxes"])
        best = int(overlaps.argmax())
        if overlaps[best] > SAME_BOX:
            return (masks["masks"][best, 0] * 255).round().to(torch.uint8).numpy()
    return np.zeros(tuple(shape), np.uint8)


def _overlaps(box: Tensor, boxes: Tensor) -> Tensor:
    """Return the intersection over union (B,) of a box (4,) with boxes (B, 4): left, top, right, bottom."""
    low, high = torch.maximum(box[:2], boxes[:, :2]), torch.minimum(box[2:], boxes[:, 2:])
    common = (high - low).clamp(min=0).prod(1)
    areas = (boxes[:, 2:] - boxes[:, :2]).prod(1) + (box[2:] - box[:2]).prod()
    return common / (areas - common).clamp(min=1e-9)
