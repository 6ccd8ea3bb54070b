"""Seeds that are no captures: images, bodies, motions, runs, configurations, text."""

from __future__ import annotations

import json
import pickle
from pathlib import Path

import numpy as np
import torch
from motion_files import Clip, as_local, glb_of, random_motion, skeleton, tiny_body, write_bvh
from moving_scene import row_of_balls
from synthetic_bodies import model, write_npz, write_obj, write_pickle
from tiny_captures import random_pixels, write_image, write_video
from tiny_fields import stirred_field

from dyngs.config import Config, DataConfig, SceneModel
from dyngs.config.io import RESOLVED_NAME, save_config
from dyngs.core.state import strip_roles
from dyngs.deform.fields import field_state
from dyngs.deform.keys import DynamicModel
from dyngs.gaussians.scene import GaussianScene, restore_scene
from dyngs.human.avatar.avatar_file import _KIND as AVATAR_KIND
from dyngs.human.body.joints import JOINT_NAMES
from dyngs.human.motion.amass import write_amass
from dyngs.io.formats import formats
from dyngs.io.formats.splat_file import SplatFile, with_sh_degree
from dyngs.io.tensor_file import write_tensors
from dyngs.models.static_section import StaticModel
from dyngs.runs.checkpoint import Checkpoint, CheckpointInfo, save_checkpoint
from dyngs.runs.stored_file import encode_scene

_INFO = CheckpointInfo(7, 1.0, (1.0, 0.0, 0.0), "white", "classic")


def write_png(root: Path) -> None:
    """Write a PNG with alpha."""
    write_image(root / "a.png", random_pixels(5, 7, 4))


def write_png16(root: Path) -> None:
    """Write a PNG of 16 bits, grey."""
    write_image(root / "a.png", random_pixels(5, 7, 1).astype(np.uint16) * 257)


def write_jpeg(root: Path) -> None:
    """Write a JPEG."""
    write_image(root / "a.jpg", random_pixels(9, 17, 3))


def write_joints_npz(root: Path) -> None:
    """Write 3D joints with their frames."""
    np.savez(root / "a.npz", joints=random_places(2, 17, 4), frames=np.arange(2))


def write_sam_3d_body(root: Path) -> None:
    """Write the 3D key points of an image as SAM 3D Body has them."""
    (root / "a").mkdir()
    fields = {
        "pred_keypoints_3d": random_places(1, 70, 3)[0],
        "pred_cam_t": np.array([0.0, 0.1, 4.0]),
    }
    np.savez(root / "a" / "p0.npz", **fields)  # pyright: ignore[reportArgumentType]


def write_openpose(root: Path) -> None:
    """Write 2D key points of an image as OpenPose does."""
    (root / "a").mkdir()
    points = random_places(1, 25, 3)[0].ravel().tolist()
    (root / "a" / "p0_keypoints.json").write_text(
        json.dumps({"people": [{"pose_keypoints_2d": points}]})
    )


def write_coco(root: Path) -> None:
    """Write 2D key points of an image as COCO has them."""
    points = np.abs(random_places(1, 17, 3)[0]).ravel().tolist()
    fields = {
        "images": [{"id": 1, "file_name": "p0.png"}],
        "annotations": [{"image_id": 1, "keypoints": points}],
    }
    (root / "a.json").write_text(json.dumps(fields))


def random_places(*shape: int) -> np.ndarray:
    """Return places within two metres, the last of each row positive."""
    places = np.random.default_rng(0).uniform(-2, 2, shape)
    places[..., -1] = np.abs(places[..., -1])
    return places


def write_depth_npz(root: Path) -> None:
    """Write a depth map as an array in an archive."""
    np.savez(root / "a.npz", depth=np.full((4, 6), 2.0, np.float32))


def write_flow_npy(root: Path) -> None:
    """Write optical flow as an array."""
    np.save(root / "a.npy", np.ones((4, 6, 2), np.float32))


def write_flo(root: Path) -> None:
    """Write optical flow as Middlebury does."""
    header = np.array([202021.25], "<f4").tobytes() + np.array([6, 4], "<i4").tobytes()
    (root / "a.flo").write_bytes(header + np.ones((4, 6, 2), "<f4").tobytes())


def write_tracks(root: Path) -> None:
    """Write two tracks in three images."""
    names = np.array(["0", "1", "2"])
    np.savez(
        root / "a.npz",
        xy=np.ones((3, 2, 2), np.float32),
        visible=np.ones((3, 2), bool),
        names=names,
    )


def write_exr(root: Path) -> None:
    """Write an EXR of floats with alpha."""
    write_image(root / "a.exr", random_pixels(5, 7, 4).astype(np.float32) / 255)


def write_tiff(root: Path) -> None:
    """Write a TIFF."""
    write_image(root / "a.tif", random_pixels(5, 7, 3))


def write_mp4(root: Path) -> None:
    """Write a video of three frames."""
    write_video(root / "a.mp4", 3)


def write_fits(root: Path) -> None:
    """Write a pickle of arrays in a dictionary, as current NumPy does."""
    (root / "a.pkl").write_bytes(
        pickle.dumps({"pose": np.ones((2, 72)), "names": ["a", "b"], "scale": 1.5, 3: (1, None)})
    )


def write_old_fits(root: Path) -> None:
    """Write a pickle of protocol 0 with an array of objects and text."""
    fits = {
        "pose": np.ones((2, 3), np.float32),
        "o": np.array([1, "x", None], dtype=object),
        "b": b"ab",
        "t": "caf\u00e9",
    }
    (root / "a.pkl").write_bytes(pickle.dumps(fits, 0))


def write_smpl_npz(root: Path) -> None:
    """Write an SMPL body as .npz."""
    write_npz(root / "a.npz", model("smpl", directions=2))


def write_smpl_pickle(root: Path) -> None:
    """Write an SMPL body as a pickle, with a sparse regressor as in the real files."""
    import scipy.sparse

    arrays = model("smpl", directions=2)
    write_pickle(
        root / "a.pkl", arrays | {"J_regressor": scipy.sparse.csc_matrix(arrays["J_regressor"])}
    )


def write_smplx_with_uv(root: Path) -> None:
    """Write an SMPL-X body, and an OBJ with its texture coordinates."""
    arrays = model("smplx", directions=2)
    write_npz(root / "a.npz", arrays)
    write_obj(
        root / "uv.obj", arrays["f"].astype(np.int64), arrays["vt"], arrays["ft"].astype(np.int64)
    )


def write_smplh_motion(root: Path) -> None:
    """Write a motion of SMPL-H as in AMASS."""
    motion = random_motion(3)
    poses = motion.for_joints(52).poses.reshape(3, -1).numpy()
    rest = {
        "betas": np.zeros(16),
        "gender": np.array("neutral"),
        "mocap_framerate": np.array(120.0),
    }
    np.savez(root / "a.npz", poses=poses, trans=motion.trans.numpy(), **rest)


def write_own_motion(root: Path) -> None:
    """Write a motion as dyngs does."""
    write_amass(random_motion(3), root / "a.npz")


def write_walk_bvh(root: Path) -> None:
    """Write a motion of SMPL's joints as BVH."""
    own = skeleton(JOINT_NAMES[:22])
    motion = random_motion(3)
    write_bvh(root / "a.bvh", own, as_local(motion, own), motion.trans.double().numpy())


def write_walk_glb(root: Path) -> None:
    """Write a motion of SMPL's joints as glTF, linear."""
    own = skeleton(JOINT_NAMES[:22])
    motion = random_motion(3)
    glb_of(own, Clip(as_local(motion, own), motion.trans.double().numpy())).write(root / "a.glb")


def write_cubic_glb(root: Path) -> None:
    """Write a motion of SMPL's joints as glTF, with cubic splines and a node above the root."""
    own = skeleton(JOINT_NAMES[:22])
    motion = random_motion(3)
    clip = Clip(
        as_local(motion, own),
        motion.trans.double().numpy(),
        interpolation="CUBICSPLINE",
        above=np.eye(4),
    )
    glb_of(own, clip).write(root / "a.glb")


def write_splats(root: Path) -> None:
    """Write a .ply of five Gaussians."""
    formats.write_splats(root / "a.ply", SplatFile(row_of_balls(), world_offset=(1.0, 2.0, 3.0)))


def write_packed(name: str, root: Path) -> None:
    """Write a file of Gaussians in the format called ``name``, with harmonics where it holds
    any."""
    own = formats.format_by_name(name)
    splat = SplatFile(with_sh_degree(row_of_balls(), min(own.max_degree, 1)), up="y")
    formats.write_splats(root / f"a{own.suffixes[0]}", splat)


def write_still_run(root: Path) -> None:
    """Write a run of a static scene."""
    save_config(
        Config(data=DataConfig.model_validate({"root": "capture"}), model=StaticModel()),
        root / RESOLVED_NAME,
    )
    save_checkpoint(root, Checkpoint(_INFO, _gaussians()), 1.0)


def write_moving_runs(kind: str, root: Path) -> None:
    """Write a run of a moving scene with a field of ``kind``."""
    config, tensors = _moving(kind)
    save_config(config, root / RESOLVED_NAME)
    save_checkpoint(root, Checkpoint(_INFO, tensors), 1.0)


def write_scene_file_still(root: Path) -> None:
    """A run that is only ``scene.dyngs``."""
    model = StaticModel()
    save_config(
        Config(data=DataConfig.model_validate({"root": "capture"}), model=model),
        root / RESOLVED_NAME,
    )
    (root / "scene.dyngs").write_bytes(encode_scene(_scene_info(), _scene(_gaussians(), model), {}))


def write_scene_file_moving(root: Path) -> None:
    """The same of a scene that moves, with steps."""
    config, tensors = _moving("control_nodes")
    save_config(config, root / RESOLVED_NAME)
    steps = {
        f"gaussians.{name}": 0.01
        for name in ("means", "quats", "log_scales", "logit_opacities", "sh_base")
    }
    (root / "scene.dyngs").write_bytes(
        encode_scene(_scene_info(), _scene(tensors, config.model), steps)
    )


def write_person(root: Path) -> None:
    """Write an avatar of three Gaussians on 24 joints."""
    n, k = 3, 2
    joints = tiny_body(24).joints
    parents = tiny_body(24).parents
    count = len(joints)
    generator = torch.Generator().manual_seed(0)
    shapes = {"means": (3,), "quats": (4,), "log_scales": (3,), "logit_opacities": (), "sh": (1, 3)}
    tensors = {
        f"gaussians.{name}": torch.rand(n, *shape, generator=generator)
        for name, shape in shapes.items()
    }
    tensors |= {
        f"anchors.{name}": torch.rand(n, width, generator=generator)
        for name, width in (("points", 3), ("uv", 2))
    }
    tensors |= {
        "anchors.size": torch.ones(n),
        "anchors.height": torch.zeros(n),
        "anchors.barycentric": torch.ones(n, 3) / 3,
    }
    tensors |= {
        "anchors.weights": torch.full((n, k), 0.5),
        "anchors.joints": torch.tensor([[0, 1]] * n).byte(),
    }
    tensors |= {"anchors.face": torch.zeros(n, dtype=torch.int32)}
    tensors |= {
        "skeleton.joints": joints,
        "skeleton.template_joints": joints,
        "skeleton.parents": torch.tensor(parents),
    }
    tensors |= {"fit.turns": torch.zeros(count, 3), "fit.log_scale": torch.zeros(1)}
    tensors |= {
        "reference.poses": torch.zeros(count, 3),
        "reference.trans": torch.zeros(3),
        "reference.scale": torch.ones(1),
    }
    header = {
        "step": 7,
        "extent": 1.0,
        "world_offset": [0.0, 0.0, 0.0],
        "background": "white",
        "near": 0.2,
        "eps2d": 0.3,
    }
    template = {"file": "body.npz", "sha256": "0" * 64, "packaged": False}
    own = {name: x.contiguous().clone() for name, x in tensors.items()}
    write_tensors(
        root / "a.safetensors",
        AVATAR_KIND,
        own,
        {**header, "rasterize_mode": "classic", "template": template},
    )


def write_preset(root: Path) -> None:
    """Write a preset with keys of every kind."""
    data = "data:\n  root: capture\n  downscale: 2\n"
    model = "model:\n  kind: dynamic\n  sh_degree: 2\n  deform:\n    kind: hexplane\n    levels: [1, 2]\n"
    text = data + model + "    lr_planes: 1e-3\ntrain:\n  steps: 30000\nrun:\n  name: night\n"
    (root / "a.yaml").write_text(text)


def write_overrides(root: Path) -> None:
    """Write overrides of keys of every kind, one a line."""
    lines = (
        "data.root=capture",
        "train.steps=2000",
        "model.kind=dynamic",
        "model.deform.kind=mlp",
        "run.name=night",
    )
    lines += (
        "data.frames=0:10:2",
        "model.deform={kind: hexplane, levels: [1, 2]}",
        "data.cache_mb=1e3",
        "run.dir=~/x",
    )
    (root / "a.overrides").write_text("\n".join(lines))


def write_frames_path(root: Path) -> None:
    """Write a camera path of two frames."""
    frame = {
        "cam_from_world": np.eye(4).tolist(),
        "fl_x": 20.0,
        "fl_y": 20.0,
        "cx": 10.0,
        "cy": 7.0,
    }
    frames = [{**frame, "time": 0.0}, {**frame, "time": 1.0}]
    document = {"width": 20, "height": 14, "fps": 30.0, "frames": frames}
    (root / "a.json").write_text(json.dumps(document))


def write_keyframes(root: Path) -> None:
    """Write a camera path of keyframes."""
    frame = {
        "cam_from_world": np.eye(4).tolist(),
        "fl_x": 20.0,
        "fl_y": 20.0,
        "cx": 10.0,
        "cy": 7.0,
    }
    keys = [{**frame, "at": 0.0, "time": 0.0}, {**frame, "at": 0.2, "time": 1.0}]
    document = {"width": 20, "height": 14, "fps": 10, "loop": False, "keyframes": keys}
    (root / "a.json").write_text(json.dumps(document))


def write_nerfstudio_path(root: Path) -> None:
    """Write a camera_path.json of nerfstudio."""
    view = {"camera_to_world": np.eye(4).ravel().tolist(), "fov": 50.0, "render_time": 0.5}
    document = {"camera_type": "perspective", "render_width": 20, "render_height": 14, "fps": 12}
    (root / "a.json").write_text(json.dumps({**document, "camera_path": [view, view]}))


def write_3dgs_cameras(root: Path) -> None:
    """Write a cameras.json of 3DGS."""
    place = {"position": [0.0, 0.0, -4.0], "rotation": np.eye(3).tolist()}
    view = {"width": 20, "height": 14, "fx": 20.0, "fy": 20.0, **place}
    (root / "a.json").write_text(json.dumps([view, view]))


def write_measurement(root: Path) -> None:
    """Write a measured point of ``dyngs tradeoff``."""
    from dataclasses import asdict

    from dyngs.study.measure import Measurement
    from dyngs.study.runs import write_stored

    scores = (3, 30.0, 0.9, 0.1, 29.0, None, 100, 1.5, 7, 1.5)
    point = Measurement("prune=0.5", *scores, ms=3.0, gain=1.1)
    write_stored(root / "a.json", asdict(point))


def write_words(root: Path) -> None:
    """Values of options, one a line: variations, frames, times."""
    lines = ("prune=0.5,0.7", "0:10:2", "0:1:5")
    (root / "a.overrides").write_text("\n".join(lines))


def write_log(root: Path) -> None:
    """Write the log and the timing of a run."""
    (root / "log.jsonl").write_text('{"step": 1, "loss": 0.5}\n{"step": 2, "loss": 0.4}\n')
    (root / "timing.json").write_text('{"seconds_train": {"7": 1.0}}\n')


def _gaussians() -> dict[str, torch.Tensor]:
    return {f"gaussians.{name}": x.contiguous() for name, x in row_of_balls().tensors().items()}


def _scene(tensors: dict[str, torch.Tensor], model: SceneModel) -> GaussianScene:
    return restore_scene(Checkpoint(_INFO, tensors), model)


def _scene_info() -> CheckpointInfo:
    return CheckpointInfo(7, 1.0, (1.0, 0.0, 0.0), "white", "classic")


def _moving(kind: str) -> tuple[Config, dict[str, torch.Tensor]]:
    from tiny_fields import tiny_options

    config = Config(
        data=DataConfig.model_validate({"root": "capture"}),
        model=DynamicModel(deform=tiny_options(kind)),
    )
    state = strip_roles(field_state(stirred_field(kind, num_moving=2)))
    tensors = _gaussians() | {f"model.field.{name}": x.contiguous() for name, x in state.items()}
    tensors["model.rows"] = torch.tensor([1, 3])
    return config, tensors | {"model.times": torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64)}
