"""Curved triangles in training: where they are and their colours first, textures after that."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from dyngs.baselines.triangles.densify import Change, change
from dyngs.baselines.triangles.first import first_surface
from dyngs.baselines.triangles.keys import BgTriangleModel
from dyngs.baselines.triangles.patches import Patches, flat_triangles
from dyngs.baselines.triangles.scene import (
    TriangleOptions,
    TriangleScene,
    rendering_of,
    scene_options,
    stored_triangles,
)
from dyngs.baselines.triangles.tallies import Tallies, most_pixels, slopes_of
from dyngs.core.conventions import SH_C0, num_sh_terms
from dyngs.core.errors import DyngsError, counted
from dyngs.core.state import State, prefixed
from dyngs.data.loader import Image
from dyngs.gaussians.optimizer import AdamState
from dyngs.gaussians.start import StartValues, initial_gaussians, surroundings
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.kind import RunStart
from dyngs.models.model import Drawn, Model, Updated
from dyngs.models.schedule import scaled
from dyngs.models.views import evaluation_background
from dyngs.ops.patches import NUM_POINTS, lattice_size

EVERY, LEAST_EVERY, UNTIL = 300, 50, 18_000
"""Steps between changes of a 30,000-step run, the fewest in any run, and after how many of 30,000
none is changed."""
# Learning rate of control points at first and at the end, in half sides of the scene
POSITION_RATE, LAST_POSITION_RATE = 4e-3, 2e-4
COLOUR_RATE = 0.01
TEXTURE_FROM = 0.7  # Fraction of the run after which textures are learned in place of colours
HARMONICS_SLOWER = 20.0  # than colours
LAST_COLOUR = 0.1  # Of their learning rate, at the end of each stage
VALUE_BYTES = 1.3  # In a file, per value of a triangle
FEWEST = 100  # Fewest triangles that a limit on the file must have room for
RADIUS = 1.5  # Of the first triangles, in mean distances of their points' three nearest neighbours
INNER = 0.02  # Fraction of the points on either side that does not count for the scene's size
NUM_FIRST = 2000  # Triangles that a run begins with, at most
LEAST_SHOWN = 1.0  # px of some training view, of each triangle that stays


First = Callable[[RunStart, BgTriangleModel], tuple[Patches, float]]
"""What the first step begins with, in place of what was there before: triangles, and half the side
of their scene."""


class TriangleTraining(Model[TriangleScene]):
    """See the module."""

    def __init__(
        self,
        run: RunStart,
        patches: Patches,
        unit: float,
        model: BgTriangleModel,
        first: First | None = None,
    ) -> None:
        self._run, self._model, self._unit, self._first = run, model, unit, first
        options = scene_options(model, unit)
        behind = evaluation_background(run.config.data.background, run.capture.has_alpha)[1]
        self._like = TriangleScene(patches, unit, options, behind)
        self._begin(patches)

    def _begin(self, patches: Patches) -> None:
        """Learn ``patches`` from now on, with empty moments and tallies."""
        self._take(patches)
        self._adam = AdamState.zero(self._patches.tensors)

    def _take(self, patches: Patches) -> None:
        self._patches = patches.of(
            {name: x.detach().requires_grad_() for name, x in patches.tensors.items()}
        )
        self._tallies, self._now = Tallies(len(patches)), Tallies(len(patches))

    @property
    def scene(self) -> TriangleScene:
        return replace(self._like, patches=self._patches)

    @property
    def options(self) -> TriangleOptions:
        """How it is drawn."""
        return self._like.options

    @property
    def leaves(self) -> Sequence[Tensor]:
        return list(self._patches.tensors.values())

    @property
    def is_textured(self) -> bool:
        """Whether textures are learned, and no triangle comes or goes."""
        return self._patches.texture > 0

    def _begin_on_surface(self) -> None:
        """Go on with what the first step begins with."""
        if self._first is None:
            return
        patches, unit = self._first(self._run, self._model)
        self._first = None
        self._set_unit(unit)
        self._begin(patches)

    def _set_unit(self, unit: float) -> None:
        self._unit = unit
        self._like = replace(self._like, unit=unit, options=scene_options(self._model, unit))

    def draw(self, image: Image, step: int, background: Tensor, *, depth: bool = False) -> Drawn:
        self._begin_on_surface()
        options = replace(self._like.options, depth="expected" if depth else "none")
        view = self.scene.view(image.cameras, options)
        if not self.is_textured:
            self._now.count(view.places, slopes_of(image.composite(background)))
        return Drawn(rendering_of([view], background, options))

    def tallies(self, step: int) -> Sequence[Tensor]:
        return [] if self.is_textured else list(self._now.tensors().values())

    def update(self, step: int) -> Updated:
        steps = self._run.config.train.steps
        patches = self._patches
        grad = patches.points.grad
        if not self.is_textured and grad is not None:
            self._now.gradients += grad.norm(dim=-1).sum(1) * self._now.views
            self._tallies.add(self._now)
            self._now = Tallies(len(patches))
        rates = self._rates(step)
        updates = [self._adam.update(name, x, rates[name]) for name, x in patches.tensors.items()]
        bad = self._adam.steps_(updates, step=step)
        for x in self.leaves:
            x.grad = None
        if step == steps:
            return self._finished(bad)
        if not self.is_textured and self._first_texture <= step:
            if self._tallies.views >= LEAST_EVERY:
                self._change(0, 1)  # what is useless goes, and nothing is split
            self._texture()
            return Updated(
                bad, f"textures are learned from now on, on {len(patches):,} triangles", True
            )
        return self._changed(step, bad) if self._is_due(step) else Updated(bad)

    def _rates(self, step: int) -> dict[str, float]:
        """Return the learning rate of each tensor in ``step``."""
        steps = self._run.config.train.steps
        moved = step / steps
        position = self._unit * POSITION_RATE ** (1 - moved) * LAST_POSITION_RATE**moved
        begun = self._first_texture if self.is_textured else 0
        end = steps if self.is_textured else self._first_texture
        colour = COLOUR_RATE * LAST_COLOUR ** min(1.0, max(0, step - begun) / max(1, end - begun))
        return {"points": position, "colours": colour, "harmonics": colour / HARMONICS_SLOWER}

    def _texture(self) -> None:
        """Learn textures from now on, with the moments of what stays as it is."""
        before = self._adam
        self._begin(self._patches.textured(self._model.texture))
        for name in ("points", "harmonics"):
            self._adam.exp_avg[name] = before.exp_avg[name]
            self._adam.exp_avg_sq[name] = before.exp_avg_sq[name]

    @property
    def _interval(self) -> int:
        return max(LEAST_EVERY, scaled(EVERY, self._run.config.train.steps))

    def _is_due(self, step: int) -> bool:
        return not self.is_textured and step % self._interval == 0 and step <= self._last_change

    @property
    def _last_change(self) -> int:
        return min(scaled(UNTIL, self._run.config.train.steps), self._first_texture)

    @property
    def _first_texture(self) -> int:
        return round(TEXTURE_FROM * self._run.config.train.steps)

    def _changed(self, step: int, bad: Tensor | int) -> Updated:
        rounds = 1 + (self._last_change - step) // self._interval
        self._change(self._model.max_triangles, rounds)
        return Updated(bad, is_rearranged=True)

    def _finished(self, bad: Tensor | int) -> Updated:
        """Remove what no training view shows."""
        images = self._run.images
        shown = most_pixels(self.scene, (images[i].cameras for i in range(len(images))))
        count = len(self._patches)
        stays = shown >= LEAST_SHOWN
        if bool(stays.all()) or not bool(stays.any()):
            return Updated(bad)
        none = {name: x.detach()[:0] for name, x in self._patches.tensors.items()}
        self._apply(Change(stays.nonzero()[:, 0], none))
        gone = f"{count - len(self._patches):,} of {counted(count, 'triangle')} are removed"
        return Updated(
            bad, f"{gone}: no training view shows more than {LEAST_SHOWN:g} px of them", True
        )

    def _change(self, most: int, rounds: int) -> None:
        """Remove and split; see ``change``."""
        self._apply(change(self._patches, self._tallies, self._unit, most, rounds))

    def _apply(self, found: Change) -> None:
        adam = AdamState(
            {name: found.of_moments(name, x) for name, x in self._adam.exp_avg.items()},
            {name: found.of_moments(name, x) for name, x in self._adam.exp_avg_sq.items()},
        )
        self._take(
            self._patches.of({name: found.of(name, x) for name, x in self._patches.tensors.items()})
        )
        self._adam = adam

    def state(self) -> State:
        kept = prefixed("adam", self._adam.state()) | prefixed("tallies", self._tallies.state())
        return self.scene.state() | kept

    def restore(self, checkpoint: Checkpoint) -> None:
        patches, unit = stored_triangles(checkpoint)
        self._first = None
        self._set_unit(unit)
        self._take(patches)
        self._adam = AdamState.restored(checkpoint.part("adam"), self._patches.tensors)
        self._tallies = Tallies.restored(checkpoint.part("tallies"), len(patches))

    def place(self, device: torch.device) -> None:
        if device.type != "cpu":
            raise DyngsError("model.kind=bg_triangle is trained on the CPU: give run.device=cpu")


def start(run: RunStart) -> TriangleTraining:
    """Return triangles turned at random at the first points of a capture, in whose place those of a
    surface come.

    Raises DyngsError: the points are no scene, or ``budget.max_mb`` has no room.
    """
    model = run.config.model
    assert isinstance(model, BgTriangleModel)
    megabytes = run.config.budget.max_mb
    model = model if megabytes is None else _within(model, megabytes)
    return TriangleTraining(
        run, *_at_points(run, model), model, first=_on_surface if model.gaussian_steps else None
    )


def _within(model: BgTriangleModel, megabytes: float) -> BgTriangleModel:
    """Return ``model`` with as many triangles as a file of so many 1e6 bytes holds at the usual
    precision."""
    values = 3 * (NUM_POINTS + lattice_size(model.texture) + num_sh_terms(model.sh_degree) - 1)
    most = int(1e6 * megabytes / (VALUE_BYTES * values))
    if most < FEWEST:
        raise DyngsError(
            f"budget.max_mb={megabytes:g}: has no room for {FEWEST} triangles; "
            f"{1e-6 * FEWEST * VALUE_BYTES * values * 1.05:.2g} would do"
        )
    return model.model_copy(update={"max_triangles": min(most, model.max_triangles)})


def _at_points(run: RunStart, model: BgTriangleModel) -> tuple[Patches, float]:
    """Return triangles turned at random, and half the side of the scene."""
    values = StartValues(max_gaussians=min(NUM_FIRST, model.max_triangles))
    first = initial_gaussians(surroundings(run.capture), run.config.init, values, 0, run.generator)
    ends = first.means.quantile(torch.tensor([INNER, 1 - INNER], device="cpu"), dim=0)
    unit = float((ends[1] - ends[0]).max()) / 2
    if not unit > 0:
        raise DyngsError(
            f"{run.config.data.root}: the {len(first.means)} first points are all in one place, where there are no "
            "triangles: give init.kind=random"
        )
    radius = first.log_scales.exp().amax(1).clamp(max=unit / 2) * RADIUS
    corners = first.means[:, None] + radius[:, None, None] * _random_triangles(
        len(first.means), run.generator
    )
    colours = 0.5 + SH_C0 * first.sh[:, 0]
    return _flat(corners, colours[:, None].repeat(1, 3, 1), model), unit


def _on_surface(run: RunStart, model: BgTriangleModel) -> tuple[Patches, float]:
    """Return triangles on the surface of Gaussians, and half the side of the scene."""
    found = first_surface(run, model.gaussian_steps, min(NUM_FIRST, model.max_triangles))
    corners = found.corners.flatten(0, 1)
    unit = float((corners.amax(0) - corners.amin(0)).max()) / 2
    return _flat(found.corners, found.colours, model), unit


def _flat(corners: torch.Tensor, colours: torch.Tensor, model: BgTriangleModel) -> Patches:
    harmonics = torch.zeros((len(corners), num_sh_terms(model.sh_degree) - 1, 3), device="cpu")
    return Patches(flat_triangles(corners), flat_triangles(colours), harmonics)


def _random_triangles(count: int, generator: torch.Generator) -> torch.Tensor:
    """Return (count, 3, 3) corners of equilateral triangles in circles of radius 1, turned at
    random."""
    axes = torch.randn((count, 2, 3), generator=generator, device="cpu")
    one = torch.nn.functional.normalize(axes[:, 0], dim=1)
    other = torch.nn.functional.normalize(torch.linalg.cross(one, axes[:, 1]), dim=1)
    angles = torch.arange(3, device="cpu") * (2 * torch.pi / 3)
    return angles.cos()[:, None] * one[:, None] + angles.sin()[:, None] * other[:, None]


def restore(model: BgTriangleModel, checkpoint: Checkpoint) -> TriangleScene:
    """Return the scene of a checkpoint."""
    patches, unit = stored_triangles(checkpoint)
    behind = evaluation_background(checkpoint.info.background, False)[1]
    return TriangleScene(patches, unit, scene_options(model, unit), behind)
