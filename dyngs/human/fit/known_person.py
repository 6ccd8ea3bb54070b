"""The shape of a person who was fitted before, for new clips of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean

import torch
from torch import Tensor

from dyngs.config import DataConfig
from dyngs.config.io import load_config
from dyngs.core.errors import DyngsError, counted, reading
from dyngs.data.body_frames import read_body_file
from dyngs.data.capture import BodyFrames, View
from dyngs.data.loader import ImageLoader
from dyngs.data.times import evenly_spaced
from dyngs.human.avatar.pose_fit import SILHOUETTES, fitted_to_images
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.body.body import NUM_FITTED, BodyTemplate
from dyngs.human.body.body_reader import has_same_shapes, rest_shape
from dyngs.human.keys import HumanModel
from dyngs.human.motion.motion import CapturedMotion, MotionClip

_BODY, _CONFIG = "body_train.npz", "config.yaml"


def template_of_run(path: Path) -> HumanModel:
    """Return what names the template of an avatar's run, of anything else the free one."""
    model = load_config(path / _CONFIG).model if (path / _CONFIG).is_file() else None
    return (
        HumanModel(body=model.body, uv=model.uv) if isinstance(model, HumanModel) else HumanModel()
    )


def known_shape(path: Path, body: BodyTemplate) -> BodyFrames:
    """Return the body parameters of a person, of whom only the shape counts, which is one of
    ``body``.

    ``path`` is a capture or a folder that ``dyngs data fit`` wrote, or the run of an avatar trained
    on one. Raises DyngsError: none of these, or a shape of another template.
    """
    with reading(path, "give a capture that `dyngs data fit` wrote, or a run trained on it"):
        folder = path
        if (path / _CONFIG).is_file():
            data = load_config(path / _CONFIG).data
            folder = data.root if data.body is None else data.body
        if not (folder / _BODY).is_file():
            raise DyngsError(
                f"{path}: no fitted person there; give a capture that `dyngs data fit` wrote, or its run"
            )
        found = read_body_file(folder / _BODY)
    if not has_same_shapes(body, found):
        raise DyngsError(
            f"{folder / _BODY}: is of another template than {body.name}; name that of the person with --template, or "
            "fit that person with `dyngs data fit` first"
        )
    return found


def with_shape(body: BodyTemplate, known: BodyFrames | None) -> BodyTemplate:
    """Return the template that is fitted: its mean shape is that of a known person, and it has no
    expressions.

    Of a file of SMPL's family it has the first ``NUM_FITTED`` shape parameters.
    """
    vertices, joints = (body.vertices, body.joints) if known is None else rest_shape(body, known)
    shaped = replace(body, vertices=vertices, joints=joints)
    if body.name == "anny" or body.shape_dirs is None or body.joint_shape_dirs is None:
        return shaped
    dirs = body.shape_dirs[..., :NUM_FITTED]
    joint_dirs = body.joint_shape_dirs[..., :NUM_FITTED]
    without = replace(shaped, expression_dirs=None, joint_expression_dirs=None)
    return replace(without, shape_dirs=dirs, joint_shape_dirs=joint_dirs)


def shape_of(body: BodyTemplate, known: BodyFrames) -> torch.Tensor:
    """Return the known shape parameters (B,) of a template with B of them; 0 for those that are not
    known."""
    betas = torch.zeros(body.num_shapes, device="cpu")
    given = torch.from_numpy(known.betas[: len(betas)]).float()
    betas[: len(given)] = given
    return betas


LONGEST_SIDE = 320
"""Of the images whose silhouettes are looked at, px, at most; an avatar trained on smaller ones is
compared at that size, since its edges are those of its images."""
CHECKED = 3  # time steps, at most, at which a view is left out to see what the fit is worth
_FEWEST_VIEWS = 3  # of a time step, so that one of them can be left out


@dataclass(frozen=True)
class KnownAvatar:
    """The avatar of a person, and the longest side of the images it was trained on, px; None: as
    they are."""

    scene: HumanScene
    longest_side: int | None


@dataclass(frozen=True)
class AvatarPoses:
    """Poses that an avatar found."""

    clip: CapturedMotion  # of all frames; as it was where ``taken`` is false
    before: float  # overlap of silhouettes (IoU) at some time steps, of the avatar
    after: float
    # number of views, which were left out of the fit, that this was measured on; 0: on those fitted
    # to
    left_out: int

    @property
    def taken(self) -> bool:
        """Whether these poses are better than those before."""
        return self.after > self.before

    def summary(self) -> str:
        """Return a line for people."""
        where = (
            f"{counted(self.left_out, 'view')} left out of the fit"
            if self.left_out
            else "the views fitted to"
        )
        what = "taken" if self.taken else "not taken"
        return (
            f"poses by the silhouette of the person's avatar: {what}; overlap on {where} {self.before:.3f} -> "
            f"{self.after:.3f}"
        )


def posed_by_avatar(
    avatar: KnownAvatar, views: Sequence[View], options: DataConfig, start: CapturedMotion
) -> AvatarPoses:
    """Return the poses of a clip in which the avatar has the silhouettes of its images, where that
    is better.

    The size is that of ``start``, or that of the clip of training where the silhouettes show that
    the world has the same unit. Frames of ``start`` without an image keep their poses.
    """
    times = start.clip.times.tolist()
    shown = [replace(x, time=times[start.rows[-1 if x.frame is None else x.frame]]) for x in views]
    side = min(
        LONGEST_SIDE, options.longest_side or LONGEST_SIDE, avatar.longest_side or LONGEST_SIDE
    )
    small = options.model_copy(update={"longest_side": side, "downscale": 1})
    left_out, others = _left_out(shown)
    tested = ImageLoader(left_out or others, small)
    images = ImageLoader(others, small)
    scene = avatar.scene
    clip = start.clip
    size = torch.full_like(start.clip.scale, float(scene.clip.scale.mean()))
    pelvis = scene.skeleton.joints[0]  # stays where it is
    in_size = replace(clip, scale=size, trans=clip.trans + (clip.scale - size)[:, None] * pelvis)
    players = [scene.playing(clip), scene.playing(in_size)]
    tried = [(_overlap(_fitted(player, images), tested), player) for player in players]
    before, (after, best) = _overlap(players[0], tested), max(tried, key=lambda x: x[0])
    if after > before:
        found = _fitted(best, ImageLoader(shown, small)).played
        clip = clip if found is None else _with_rows(best.played or clip, found)
    return AvatarPoses(replace(start, clip=clip), before, after, len(left_out))


def _fitted(player: HumanScene, images: ImageLoader) -> HumanScene:
    nothing = player.gaussians.means.new_zeros(3)
    return fitted_to_images(player, images, nothing, SILHOUETTES).scene


def _left_out(views: Sequence[View]) -> tuple[list[View], list[View]]:
    """Return one view of each of some time steps, and the others of these time steps to fit to.

    Moments with too few views lose none.
    """
    groups: dict[float | None, list[View]] = {}
    for view in views:
        groups.setdefault(view.time, []).append(view)
    enough = [group for group in groups.values() if len(group) >= _FEWEST_VIEWS]
    some = enough or list(groups.values())
    chosen = [some[i] for i in evenly_spaced(len(some), CHECKED)]
    apart = [group[-1] for group in chosen] if enough else []
    return apart, [view for group in chosen for view in group if view not in apart]


@torch.no_grad()
def _overlap(scene: HumanScene, images: ImageLoader) -> float:
    """Return the mean intersection over union of the silhouettes of the person and of images."""
    found = []
    for image in (images[i] for i in range(len(images))):
        drawn = scene.render(image.cameras, image.time, options=scene.options).alpha[0] > 0.5
        truth = drawn if image.alpha is None else image.alpha > 0.5
        found.append(float((drawn & truth).sum() / (drawn | truth).sum().clamp_min(1)))
    return fmean(found)


def _with_rows(clip: MotionClip, found: MotionClip) -> MotionClip:
    """Return the clip with the rows of ``found`` at the times that are in both."""
    rows = torch.searchsorted(clip.times, found.times).clamp_max(len(clip) - 1)

    def put(before: Tensor, after: Tensor) -> Tensor:
        return before.index_copy(0, rows, after.to(before))

    return MotionClip(
        clip.times,
        put(clip.poses, found.poses),
        put(clip.trans, found.trans),
        put(clip.scale, found.scale),
    )
