"""Joint refinement of camera poses, focal lengths and principal points during training.

Poses estimated from images may be off by a few pixels, which blurs the scene. They are refined with
the gradients of the rasterizer, as in BARF (Lin et al. 2021). A similarity of the scene and all
cameras changes no image. Corrections never contain this gauge freedom, so test cameras stay aligned
with the scene.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Iterable, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.state import strip_roles
from dyngs.core.tensor_checks import require_tensor
from dyngs.data.capture import View
from dyngs.data.loader import Image
from dyngs.gaussians.optimizer import AdamState
from dyngs.gaussians.scene import GaussianScene
from dyngs.models.model import Correction
from dyngs.ops.adam import Count, adam_step_
from dyngs.ops.loss import l1_ssim_loss
from dyngs.ops.quaternions import rotation_matrices

# Fraction of the run before refinement starts, since an untrained scene gives useless gradients
STARTS = 0.05
# Initial and final learning rate of poses, in rad and as a fraction of the scene extent, log-linear
# in between
FIRST_RATE, LAST_RATE = 3e-3, 1e-5
# Learning rate of intrinsics over that of poses; a shared lens is updated in every step
LENS_RATE = 0.01
# Fraction of the run before lenses are refined: wrong poses would bias a shared lens
LENS_STARTS = 0.3
# Fewest poses with which a lens is refined: with fewer it cannot be told from a camera shift
MIN_POSES = 8
POSES, LENSES = "poses", "lenses"


class CameraCorrections:
    """Corrections of the cameras of V views, initially zero.

    Views of a static camera share one pose correction, and views with equal intrinsics share one
    lens correction.

    Attributes:
        poses: (P, 6) rotation vectors in rad and translations in units of ``size``, in the camera
            frame.
        lenses: (L, 3) log factor of the focal lengths, and shift of the principal point as a
            fraction of the focal lengths.
    """

    def __init__(self, views: Sequence[View], size: float) -> None:
        self.size = size
        by_pose = {_pose_key(view): view for view in views}
        self._poses = _index_keys(by_pose)
        self._lenses = _index_keys(_lens_key(view) for view in views)
        self.poses = torch.zeros(len(self._poses), 6, device="cpu")
        self.lenses = torch.zeros(len(self._lenses), 3, device="cpu")
        poses_of_lens = Counter(lens for lens, _ in {(_lens_key(x), _pose_key(x)) for x in views})
        self._refined = {key for key, count in poses_of_lens.items() if count >= MIN_POSES}
        self._common = common_motion_basis(list(by_pose.values()), size)

    def rows(self, view: View) -> tuple[int | None, int | None]:
        """Return the rows of the pose and of the lens of a view. None for an unknown pose or a lens
        that is not refined."""
        lens = _lens_key(view)
        row = self._lenses[lens] if lens in self._refined else None
        return self._poses.get(_pose_key(view)), row

    def correct_cameras(self, view: View, cameras: Cameras) -> Cameras:
        """Return corrected ``cameras`` of an image of ``view`` at any scale.

        Views that were not trained on share corrections of the same static camera or lens.
        """
        pose, lens = self.rows(view)
        own = torch.zeros(6, device="cpu") if pose is None else self.poses[pose]
        return apply_correction(
            cameras, own, None if lens is None else self.lenses[lens], self.size
        )

    def correct_view(self, view: View) -> View:
        """Return ``view`` with a corrected camera, in float64."""
        pose, lens = (
            torch.from_numpy(x).double()[None] for x in (view.cam_from_world, view.intrinsics)
        )
        camera = self.correct_cameras(view, Cameras(pose, lens, view.width, view.height))
        return replace(
            view,
            cam_from_world=camera.cam_from_world[0].numpy(),
            intrinsics=camera.intrinsics[0].numpy(),
        )

    def remove_common_motion(self) -> None:
        """Project out the similarity that poses have in common."""
        flat = self.poses.view(-1)
        flat -= self._common @ (self._common.T @ flat)


def apply_correction(cameras: Cameras, pose: Tensor, lens: Tensor | None, size: float) -> Cameras:
    """Return camera ``cameras`` (V = 1) with corrections ``pose`` (6,) and ``lens`` (3,).
    Differentiable."""
    pose = pose.to(cameras.cam_from_world)
    # First order in the quaternion; the error is cubic in the angle.
    rotation = rotation_matrices(torch.cat([pose.new_ones(1), pose[:3] / 2]))
    last = pose.new_tensor([[0.0, 0.0, 0.0, 1.0]])
    motion = torch.cat([torch.cat([rotation, size * pose[3:, None]], 1), last])
    intrinsics = cameras.intrinsics
    if lens is not None:
        lens = lens.to(intrinsics)
        factor = lens[0].exp()
        zero = torch.zeros_like(lens[0])
        rows = [factor, zero, lens[1], zero, factor, lens[2], zero, zero, torch.ones_like(zero)]
        intrinsics = intrinsics @ torch.stack(rows).view(3, 3)
    return Cameras(motion @ cameras.cam_from_world, intrinsics, cameras.width, cameras.height)


def with_camera_gradients(cameras: Cameras) -> Cameras:
    """Return ``cameras`` as leaf tensors that require gradients."""
    pose, intrinsics = (
        x.detach().clone().requires_grad_() for x in (cameras.cam_from_world, cameras.intrinsics)
    )
    return Cameras(pose, intrinsics, cameras.width, cameras.height)


def correction_gradients(
    cameras: Cameras, by_pose: Tensor, by_intrinsics: Tensor, size: float
) -> tuple[Tensor, Tensor]:
    """Return the gradients (6,) and (3,) with respect to a small correction of pose and lens."""
    columns = cameras.cam_from_world.detach()[0, :3]
    forces = by_pose[0, :3]  # both (3, 4)
    turn = torch.linalg.cross(columns, forces, dim=0).sum(1)
    pull = by_intrinsics[0] * cameras.intrinsics.detach()[0]
    focal = cameras.intrinsics.detach()[0].diagonal()[:2]
    lens = torch.cat([pull.diagonal()[:2].sum()[None], by_intrinsics[0, :2, 2] * focal])
    return torch.cat([turn, size * forces[:, 3]]), lens


def common_motion_basis(views: Sequence[View], size: float) -> Tensor:
    """Return an orthonormal basis (6 P, C), C <= 7, of the pose corrections that change no image.

    They are rotation, translation and scaling of the scene with all cameras, to first order.
    """
    poses = np.stack([view.cam_from_world for view in views])
    rotations = poses[:, :3, :3]
    centers = np.linalg.inv(poses)[:, :3, 3]
    centers = (centers - centers.mean(0)) / size
    columns = np.zeros((len(views), 6, 7))
    columns[:, :3, :3] = -rotations
    # Row j of the cross products is the column j of the cross-product matrix.
    crosses = np.cross(centers[:, None], np.eye(3))
    columns[:, 3:, :3] = rotations @ crosses.swapaxes(1, 2)
    columns[:, 3:, 3:6] = -rotations
    columns[:, 3:, 6] = -np.einsum("vij,vj->vi", rotations, centers)
    basis, values, _ = np.linalg.svd(columns.reshape(-1, 7), full_matrices=False)
    return torch.as_tensor(basis[:, values > 1e-9 * values[0]], dtype=torch.float32, device="cpu")


def _pose_key(view: View) -> Hashable:
    return view.cam_from_world.tobytes()


def _lens_key(view: View) -> Hashable:
    return view.intrinsics.tobytes(), view.width, view.height


def _index_keys(keys: Iterable[Hashable]) -> dict[Hashable, int]:
    """Return the index of each distinct key, in order of appearance."""
    return {key: number for number, key in enumerate(dict.fromkeys(keys))}


class CameraRefinement(Correction):
    """Correction that optimises ``CameraCorrections`` with Adam."""

    name = "cameras"

    def __init__(self, views: Sequence[View], size: float, steps: int) -> None:
        self.corrections = CameraCorrections(views, size)
        self._views = views
        self._steps = steps
        self._adam = AdamState.zero(self._values())
        self._updates = {
            name: torch.zeros(len(x), dtype=torch.int64, device="cpu")
            for name, x in self._values().items()
        }

    def before_render(self, image: Image) -> Image:
        return replace(image, cameras=with_camera_gradients(image.cameras))

    @torch.no_grad()
    def after_backward(self, index: int, step: int, image: Image) -> Count:
        """Update the corrections of view ``index``. Return the number of non-finite gradients.

        The gradient with respect to a further correction of the corrected camera is used, since
        small corrections add up.
        """
        rate = self.rate(step)
        cameras = image.cameras
        by_pose = cameras.cam_from_world.grad
        by_intrinsics = cameras.intrinsics.grad
        if rate == 0 or by_pose is None or by_intrinsics is None:
            return 0
        num_skipped = torch.zeros((), dtype=torch.int64, device="cpu")
        gradients = correction_gradients(cameras, by_pose, by_intrinsics, self.corrections.size)
        rates = (rate, LENS_RATE * rate if step >= LENS_STARTS * self._steps else 0.0)
        rows = self.corrections.rows(self._views[index])
        for (name, x), row, gradient, lr in zip(
            self._values().items(), rows, gradients, rates, strict=True
        ):
            if row is None or lr == 0:
                continue
            self._updates[name][row] += 1
            arrays = (x, self._adam.exp_avg[name], self._adam.exp_avg_sq[name])
            own, first, second = (array[row : row + 1] for array in arrays)
            count = int(self._updates[name][row])
            num_skipped += adam_step_(own, gradient[None].to(own), first, second, lr=lr, step=count)
        self.corrections.remove_common_motion()
        return num_skipped

    def rate(self, step: int) -> float:
        """Return the learning rate of poses at ``step``; 0 before refinement starts."""
        progress = (step / self._steps - STARTS) / (1 - STARTS)
        if progress < 0:
            return 0.0
        return FIRST_RATE * (LAST_RATE / FIRST_RATE) ** min(progress, 1.0)

    def state(self) -> dict[str, Tensor]:
        updates = {f"updates.{name}": x for name, x in self._updates.items()}
        return self._values() | updates | strip_roles(self._adam.state())

    def load_state(self, state: dict[str, Tensor]) -> None:
        for name, x in self._values().items():
            x.copy_(require_tensor(name, state[name], tuple(x.shape), x.dtype))
            key = f"updates.{name}"
            updates = require_tensor(key, state[key], (len(x),), torch.int64)
            self._updates[name] = updates.clone()
        self._adam = AdamState.from_state(state, self._values())

    def _values(self) -> dict[str, Tensor]:
        return {POSES: self.corrections.poses, LENSES: self.corrections.lenses}


FIT_UPDATES = 60
# Initial and final learning rate, in rad and as a fraction of the scene extent; log-linear between
FIRST_FIT_RATE, LAST_FIT_RATE = 2e-3, 1e-4
FIT_SSIM_WEIGHT = 0.2


def fit_camera_to_image(
    scene: GaussianScene, image: Image, background: Tensor, size: float
) -> Cameras:
    """Return the camera of ``image`` with its pose fitted to the scene (iNeRF, Yen-Chen et al.
    2021).

    The intrinsics stay fixed.

    Args:
        size: extent of the scene in world units.
    """
    truth = image.composite(background)
    correction = torch.zeros(1, 6, device=image.cameras.cam_from_world.device)
    first = torch.zeros_like(correction)
    second = torch.zeros_like(correction)
    best = correction.clone()
    least = float("inf")
    for update in range(1, FIT_UPDATES + 1):
        camera = with_camera_gradients(apply_correction(image.cameras, correction[0], None, size))
        with torch.enable_grad():
            drawn = scene.render(camera, image.time, background=background)
            loss = l1_ssim_loss(drawn.rgb[0], truth, FIT_SSIM_WEIGHT, image.mask)
            leaves = [camera.cam_from_world, camera.intrinsics]
            by_pose, by_intrinsics = torch.autograd.grad(loss, leaves)
        if float(loss.detach()) < least:
            best = correction.clone()
            least = float(loss.detach())
        rate = FIRST_FIT_RATE * (LAST_FIT_RATE / FIRST_FIT_RATE) ** (update / FIT_UPDATES)
        slope = correction_gradients(camera, by_pose, by_intrinsics, size)[0][None]
        adam_step_(correction, slope, first, second, lr=rate, step=update)
    return apply_correction(image.cameras, best[0], None, size)
