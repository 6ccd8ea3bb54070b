"""Load scenes and captures from Python, in the unit of the capture's files."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from torch import Tensor

from dyngs.config import DataConfig
from dyngs.core.camera import Cameras
from dyngs.core.state import State
from dyngs.data import read
from dyngs.data.capture import Capture
from dyngs.data.scene_space import change_coordinates
from dyngs.gaussians import Gaussians, TopologyEdit
from dyngs.gaussians.rendering import GaussianRendering, RenderOptions
from dyngs.gaussians.scene import GaussianScene, GaussianTimeStep
from dyngs.io.formats.similarity import Similarity
from dyngs.models.renderable import RunInfo, TimeStep
from dyngs.runs.opened import open_scene


def load(path: Path | str) -> GaussianScene:
    """Load a scene for rendering.

    Coordinates are those of the capture's files, as in ``read_capture``. The attribute ``run`` of
    the scene has the folder, the config and the step of its run.

    Example:

        import torch

        import dyngs

        scene = dyngs.load("runs/lego")
        pose = torch.tensor([[[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]])
        intrinsics = torch.tensor([[[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]])
        camera = dyngs.Cameras(pose, intrinsics, 64, 48)
        image = scene.render(camera, time=0.5).rgb[0]

    Args:
        path: a run folder (its newest checkpoint, or its ``scene.dyngs``), a ``scene.dyngs`` with
            the ``config.yaml`` of its run next to it, an avatar file (``.safetensors``), or a file
            of Gaussians such as a 3DGS ``.ply``.

    Raises:
        DyngsError: nothing is there, it is damaged, or it is something else.
    """
    opened = open_scene(Path(path), with_capture=False)
    scene = opened.scene
    scale = opened.info.world_scale
    if scale != 1:
        options = replace(scene.options, near=scale * scene.options.near)
        gaussians = _scaled(scene.gaussians, scale)
        behind = scene.background
        scene = ScaledScene(
            gaussians=gaussians, options=options, background=behind, scene=scene, scale=scale
        )
    return scene.from_run(RunInfo(Path(path), opened.config, opened.step))


def read_capture(source: DataConfig | Path | str, decode_videos: bool = True) -> Capture:
    """Read the capture in a folder; images are not decoded, only their headers are read.

    Poses and points are in the unit of the files; where these lie far from their origin,
    ``Capture.world_offset`` is subtracted. For arguments, splits, times and errors see
    ``dyngs.data.read.read_capture``.

    Example:

        import dyngs
        from dyngs.data.loader import ImageLoader

        capture = dyngs.read_capture("lego")
        image = ImageLoader(capture.splits["train"])[0].to("cpu")
        image.cameras, image.rgb_premultiplied  # what to render from, and what should come out
    """
    capture = read.read_capture(source, decode_videos)
    return change_coordinates(capture, 1.0, capture.world_offset)


@dataclass(frozen=True)
class _ScaledTimeStep(GaussianTimeStep):
    inner: GaussianTimeStep | None = None  # of the scene that is scaled


@dataclass(frozen=True, kw_only=True, repr=False)
class ScaledScene(GaussianScene):
    """A scene in another unit of length.

    Attributes:
        scene: in scene units.
        scale: length of a scene unit in the other unit.
    """

    scene: GaussianScene
    scale: float

    @property
    def times(self) -> tuple[float, ...]:
        return self.scene.times

    @property
    def is_static(self) -> bool:
        return self.scene.is_static

    @property
    def rows(self) -> Tensor:
        return self.scene.rows

    def time_step(self, time: float | None) -> _ScaledTimeStep:
        inner = self.scene.time_step(time)
        return _ScaledTimeStep(
            _scaled(inner.gaussians, self.scale), inner.time, inner.rest_pose, inner=inner
        )

    def render(
        self,
        cameras: Cameras,
        time: float | TimeStep | None = None,
        *,
        options: RenderOptions | None = None,
        background: Tensor | None = None,
        probe: Tensor | None = None,
    ) -> GaussianRendering:
        options = self.options if options is None else options
        poses = cameras.cam_from_world.clone()
        poses[:, :3, 3] = poses[:, :3, 3] / self.scale
        drawn = self.scene.render(
            replace(cameras, cam_from_world=poses),
            time.inner if isinstance(time, _ScaledTimeStep) else time,
            options=replace(options, near=options.near / self.scale, far=options.far / self.scale),
            background=self.background if background is None else background,
            probe=probe,
        )
        return drawn if drawn.depth is None else replace(drawn, depth=self.scale * drawn.depth)

    def apply_edit(self, edit: TopologyEdit) -> ScaledScene:
        return replace(
            self, scene=self.scene.apply_edit(edit), gaussians=self.gaussians.apply_edit(edit)
        )

    def state(self) -> State:
        return self.scene.state()

    def _model_state(self) -> State:
        return self.scene._model_state()


def _scaled(gaussians: Gaussians, scale: float) -> Gaussians:
    return Similarity(scale=scale).gaussians(gaussians)
