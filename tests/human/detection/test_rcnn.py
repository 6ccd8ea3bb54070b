"""Torchvision's R-CNNs: which weights they take, and which people they return."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest
import torch
from safetensors.torch import save_file

from dyngs.errors import DyngsError
from dyngs.human.detection.detector import chosen_detector
from dyngs.human.detection.rcnn import LEAST_SCORE, Rcnn

BOX = torch.tensor([[10.0, 10, 50, 90], [200, 10, 240, 90]])


class _Network(torch.nn.Module):
    """Returns what it is given."""

    def __init__(self, found: dict[str, torch.Tensor]) -> None:
        super().__init__()
        self.found = found

    def forward(self, images: list[torch.Tensor]) -> list[dict[str, torch.Tensor]]:
        assert images[0].shape == (3, 100, 300)
        assert images[0].max() <= 1
        return [self.found]


def detector() -> Rcnn:
    """Two people with key points, one of them with a mask, and a dog."""
    made = Rcnn.__new__(Rcnn)
    points = torch.zeros(3, 17, 3)
    points[0, :, 0], points[1, :, 0] = 30, 220
    made._keypoints = _Network(
        {
            "boxes": torch.cat([BOX, BOX[:1]]),
            "labels": torch.tensor([1, 1, 1]),
            "scores": torch.tensor([0.99, 0.9, LEAST_SCORE - 0.1]),
            "keypoints": points,
            "keypoints_scores": torch.tensor([[8.0] * 17, [-8.0] * 17, [0.0] * 17]),
        }
    )
    masks = torch.zeros(2, 1, 100, 300)
    masks[0, 0, 10:90, 10:50] = 1
    boxes, labels, scores = torch.stack([BOX[0], BOX[1]]), torch.tensor([1, 18]), torch.tensor([0.9, 0.9])
    made._masks = _Network({"boxes": boxes, "labels": labels, "scores": scores, "masks": masks})
    return made


def test_people_have_their_own_masks_and_key_points(tmp_path: Path) -> None:
    from dyngs.files.write import write_image

    path = tmp_path / "a.png"
    write_image(path, torch.full((100, 300, 3), 128, dtype=torch.uint8).numpy())
    ((first, second),) = detector().detect([path])
    assert first.mask is not None
    assert (first.mask == 255).sum() == 80 * 40
    assert first.keypoints[0].tolist() == pytest.approx([30, 0, 0.88], abs=0.01)
    assert second.keypoints[0, 2] < 0.2
    assert second.mask is not None
    assert not second.mask.any(), "the dog's mask is not theirs"


def _detection() -> ModuleType:
    try:
        return import_module("torchvision.models.detection")
    except (ImportError, RuntimeError, OSError) as error:
        pytest.skip(f"no torchvision that fits this torch: {error}")


def test_weights_of_other_networks_are_refused(tmp_path: Path) -> None:
    _detection()
    other = tmp_path / "other.safetensors"
    save_file({"fc.weight": torch.zeros(2, 2)}, other)
    with pytest.raises(DyngsError, match="weights of another network"):
        chosen_detector([other], None)
    other.write_bytes(b"rubbish")
    with pytest.raises(DyngsError, match=r"other\.safetensors"):
        chosen_detector([other], None)
    with pytest.raises(DyngsError, match="files that could run code are not read"):
        chosen_detector([tmp_path / "other.pth"], None)
    cut = tmp_path / "cut.safetensors"
    save_file({"roi_heads.keypoint_predictor.kps_score_lowres.weight": torch.zeros(1)}, cut)
    with pytest.raises(DyngsError, match="keypointrcnn_resnet50_fpn"):
        chosen_detector([cut], None)


def test_torchvision_s_own_layout_is_taken(tmp_path: Path) -> None:
    """Random weights in the files' layout; nobody is found by them, but the networks run."""
    detection = _detection()
    from dyngs.files.write import write_image

    files = []
    for name in ("keypointrcnn_resnet50_fpn", "maskrcnn_resnet50_fpn"):
        files.append(tmp_path / f"{name}.safetensors")
        save_file(getattr(detection, name)(weights=None, weights_backbone=None).state_dict(), files[-1])
    write_image(tmp_path / "a.png", torch.full((32, 32, 3), 128, dtype=torch.uint8).numpy())
    assert Rcnn(files).detect([tmp_path / "a.png"]) == [[]]
    with pytest.raises(DyngsError, match="no weights for key points"):
        Rcnn(files[1:])
