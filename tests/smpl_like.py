"""Body files in the layout of SMPL and SMPL-X made of the free template, as the real ones may not
be passed on.

Mesh and atlas are the free template's; joints are regressed from vertices, the ten shape directions
are the body shapes of the free template, and pose blend shapes are smooth bulges around the joints.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from synthetic_bodies import parents_of, write_npz, write_obj

from dyngs.human.body.body import apply_shape
from dyngs.human.body.body_reader import default_template, read_body
from dyngs.human.body.joints import JOINT_NAMES
from dyngs.human.synthetic import capture as synthetic
from dyngs.human.synthetic.capture import HumanOptions, write_human_capture

NEAR = 60  # vertices that a joint is regressed from
# spread of the pose blend shapes per unit of a rotation, and how far they reach, m
BULGE, WIDTH = 0.01, 0.08
_BODY = 22  # joints that SMPL and SMPL-X share


def smpl_like(kind: str) -> dict[str, Any]:
    """The arrays of a file of ``kind`` "smpl" (24 joints) or "smplx" (55)."""
    body = default_template()
    vertices = body.vertices.double().numpy()
    joints = body.joints.double().numpy()
    weights = body.weights.double().numpy()
    if kind == "smpl":  # hands in the place of fingers, no face
        hands = [
            [JOINT_NAMES.index(f"{side}_{x}1") for x in ("index", "middle", "ring")]
            for side in ("left", "right")
        ]
        of_hand = [
            [i for i, name in enumerate(JOINT_NAMES) if i > 24 and name.startswith(s)]
            for s in ("left", "right")
        ]
        own = [weights[:, rows].sum(1) for rows in of_hand]
        joints = np.concatenate([joints[:_BODY], [joints[rows].mean(0) for rows in hands]])
        head = weights[
            :, [JOINT_NAMES.index(name) for name in ("jaw", "left_eye", "right_eye")]
        ].sum(1)
        weights = np.concatenate([weights[:, :_BODY], np.stack(own, 1)], axis=1)
        weights[:, JOINT_NAMES.index("head")] += head
    assert body.shape_dirs is not None
    generator = np.random.default_rng(0)
    regressor = np.zeros((len(joints), len(vertices)))
    pose_dirs = np.zeros((len(vertices), 3, 9 * (len(joints) - 1)), np.float16)
    for j, joint in enumerate(joints):
        away = np.linalg.norm(vertices - joint, axis=1)
        near = np.argsort(away)[:NEAR]
        wanted = np.append(joint, 1.0)
        system = np.concatenate([vertices[near].T, np.ones((1, NEAR))])
        regressor[j, near] = np.linalg.lstsq(system, wanted, rcond=None)[0]
        if 0 < j < _BODY:
            bulge = (
                BULGE
                * generator.standard_normal((3, 9))
                * np.exp(-((away / WIDTH) ** 2) / 2)[:, None, None]
            )
            pose_dirs[..., 9 * (j - 1) : 9 * j] = bulge
    parents = np.array(parents_of(kind), dtype=np.int64)
    parents[0] = 2**32 - 1
    return {
        "v_template": vertices,
        "f": body.faces.numpy().astype(np.uint32),
        "shapedirs": body.shape_dirs[..., :10].numpy(),
        "posedirs": pose_dirs,
        "J_regressor": regressor,
        "weights": weights,
        "kintree_table": np.stack([parents, np.arange(len(joints))]).astype(np.uint32),
    }


def write_smpl_like(folder: Path, kind: str) -> tuple[Path, Path]:
    """Write such a file and the .obj with its texture coordinates."""
    folder.mkdir(parents=True, exist_ok=True)
    body = default_template()
    assert body.uv is not None
    assert body.uv_faces is not None
    atlas = body.faces.numpy(), body.uv.numpy(), body.uv_faces.numpy()
    return write_npz(folder / f"{kind}.npz", smpl_like(kind)), write_obj(
        folder / f"{kind}.obj", *atlas, len(body.vertices)
    )


def write_capture_of(
    file: Path,
    uv: Path,
    out: Path,
    options: HumanOptions,
    betas: torch.Tensor,
    monkeypatch: pytest.MonkeyPatch,
) -> Path:
    """Write a synthetic capture of the body of a file of 55 joints in the shape ``betas`` (10,),
    with exact poses."""
    body = read_body(file, uv)
    vertices, joints = apply_shape(body, betas)
    shaped = synthetic.replace(body, vertices=vertices, joints=joints)
    monkeypatch.setattr(synthetic, "_person", lambda _: (shaped, betas))
    return write_human_capture(out, options)
