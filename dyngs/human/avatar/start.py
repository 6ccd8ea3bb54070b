"""Initial avatars, and avatars restored from checkpoints."""

from __future__ import annotations

from dataclasses import replace

from dyngs.config import Config
from dyngs.core.errors import DyngsError
from dyngs.data.capture import Capture
from dyngs.data.loader import ImageLoader
from dyngs.data.times import evenly_spaced
from dyngs.gaussians import Gaussians
from dyngs.gaussians.initialization import build_colour_training, build_densifier
from dyngs.gaussians.model import GaussianModel
from dyngs.gaussians.scene import restore_appearance
from dyngs.gaussians.schedule import rate_schedule
from dyngs.human.avatar.observations import colour_from_images
from dyngs.human.avatar.pose_fit import PoseRefit
from dyngs.human.avatar.posing import (
    Skeleton,
    new_corrections,
    pixel_size,
    pose_blend_shapes,
    surface_gaussians,
    surface_texels,
)
from dyngs.human.avatar.scene import HumanScene, initial_human_scene
from dyngs.human.avatar.training import HumanTraining, make_outline_loss
from dyngs.human.body.body_reader import load_template, rest_shape
from dyngs.human.keys import NO_BODY, HumanModel
from dyngs.human.motion.motion import CapturedMotion, captured_motion
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.kind import StartContext
from dyngs.models.views import evaluation_background, training_cameras
from dyngs.ops.quaternions import rotation_matrices

MAX_COLOUR_VIEWS = 50  # training images that the initial colours are averaged over


def start(run: StartContext) -> GaussianModel:
    """Create the avatar before the first training step.

    Raises DyngsError: the capture has no body parameters, or the template cannot be read.
    """
    config = run.config
    model = config.model
    assert isinstance(model, HumanModel)
    scene, motion = initialize_human_scene(config, model, run.capture, run.images)
    colours = build_colour_training(run, scene.gaussians, uses_time=False)
    train_views = run.capture.splits["train"]
    cameras = training_cameras(train_views, config.data)
    views = [(camera, view.frame or 0) for camera, view in zip(cameras, train_views, strict=True)]
    outlines = None if colours.network is not None else make_outline_loss(run)
    background = evaluation_background(config.data.background, run.capture.has_alpha)[1]
    refit = (
        PoseRefit(run.images, background, config.train.steps)
        if model.refine and config.train.minutes is None
        else None
    )
    training = HumanTraining(model, motion.frames, rate_schedule(config), views, outlines, refit)
    if model.light and model.refine and colours.network is None:
        # The initial Gaussians are discs on the surface.
        normals = rotation_matrices(scene.gaussians.quats)[..., 2]
        learned = new_corrections(scene.clip, scene.skeleton, scene.anchors, normals)
        scene = replace(scene, learned=learned)
    return GaussianModel(run, scene, training, build_densifier(run), colours)


def restore(model: HumanModel, checkpoint: Checkpoint) -> HumanScene:
    """Restore the avatar of a checkpoint."""
    scene = HumanScene.from_state(
        Gaussians.stored(checkpoint.part("gaussians")), checkpoint.part("model")
    )
    return restore_appearance(scene, model, checkpoint)


def initialize_human_scene(
    config: Config, model: HumanModel, capture: Capture, images: ImageLoader
) -> tuple[HumanScene, CapturedMotion]:
    """Create the initial scene, coloured from the training images; return it with its motion.

    Raises DyngsError: the capture has no body parameters, or the template cannot be read.
    """
    sh_degree = config.stored_sh_degree
    if capture.body is None:
        raise DyngsError(f"{capture.root}: {NO_BODY}")
    if sh_degree > 1:
        raise DyngsError(
            f"model.sh_degree={sh_degree}: avatars support spherical harmonics of degree 0 and 1 "
            "only"
        )
    body_frames = capture.body["train"]
    body = load_template(model)
    vertices, joints = rest_shape(body, body_frames)
    motion = captured_motion(capture.root, body_frames, capture.splits["train"], joints)
    cameras = training_cameras(capture.splits["train"], config.data)
    texels = surface_texels(
        body, model.resolution, vertices, pixel_size(cameras, motion.clip, joints[0])
    )
    gaussians, anchors, normals = surface_gaussians(texels, sh_degree)
    skeleton = Skeleton(joints, body.parents)
    scene = initial_human_scene(gaussians, anchors, skeleton, motion.clip, pose_blend_shapes(body))
    first_images = (images[i] for i in evenly_spaced(len(images), MAX_COLOUR_VIEWS))
    return colour_from_images(scene, motion.rows, normals, first_images), motion
