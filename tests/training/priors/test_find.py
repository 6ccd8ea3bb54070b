from __future__ import annotations

from pathlib import Path

import torch
from tiny_captures import edit_json
from tiny_priors import with_priors

from dyngs.config import Config
from dyngs.config.io import load_config
from dyngs.data.loader import ImageLoader
from dyngs.data.read import read_capture
from dyngs.training.new_trainer import assemble
from dyngs.training.priors.find import used_priors
from dyngs.training.priors.used import UsedPriors

KEYS = ("depth_file_path", "flow_file_path", "motion_mask_path")


def config_of(root: Path, *changes: str) -> Config:
    lines = [
        f"data.root={root}",
        "data.test_every=0",
        "train.steps=6",
        "init.num_random=20",
        "model.motion_from=0.1",
    ]
    return load_config("dynamic", [*lines, *changes])


def found(root: Path, *changes: str, moves: bool = True) -> UsedPriors:
    config = config_of(root, *changes)
    capture = read_capture(config.data)
    images = ImageLoader(capture.splits["train"], config.data, with_maps=True)
    return used_priors(config, capture, images, moves=moves)


def test_priors_of_noise_are_ignored_with_one_line_each(tmp_path: Path) -> None:
    priors = found(with_priors(tmp_path))
    assert (priors.depth, priors.tracks, priors.masks) == (None, None, False)
    assert not priors.flow_to
    assert [line.partition(":")[0].partition(" (")[0] for line in priors.lines] == [
        "depth maps",
        "optical flow",
        "tracks",
        "motion masks",
    ]
    assert all(": ignored" in line for line in priors.lines)


def test_priors_that_are_not_requested_are_not_read(tmp_path: Path) -> None:
    with_priors(tmp_path)
    (tmp_path / "tracks.npz").write_bytes(b"")
    assert found(tmp_path, "train.priors=[]").lines == ()
    assert [line[:5] for line in found(tmp_path, "train.priors=[depth]").lines] == ["depth"]


def test_where_nothing_moves_depth_alone_is_looked_at(tmp_path: Path) -> None:
    assert [line[:5] for line in found(with_priors(tmp_path), moves=False).lines] == ["depth"]


def test_ignored_priors_do_not_change_a_run(tmp_path: Path) -> None:
    """The same bytes as without them."""
    trained = []
    for name in ("with", "without"):
        root = tmp_path / name
        root.mkdir()
        with_priors(root)
        if name == "without":
            edit_json(
                root / "transforms_train.json",
                lambda c: (
                    c.pop("tracks_file_path")
                    and [frame.pop(key) for frame in c["frames"] for key in KEYS]
                ),
            )
        trainer = assemble(config_of(root))
        findings = [trainer.step().finding for _ in range(6)]
        assert ("ignored" in (findings[0] or "")) == (name == "with")
        trained.append(trainer.checkpoint().tensors)
    assert trained[0].keys() == trained[1].keys()
    for name, x in trained[0].items():
        torch.testing.assert_close(x, trained[1][name], rtol=0, atol=0, equal_nan=True)
