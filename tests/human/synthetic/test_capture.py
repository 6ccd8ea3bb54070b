"""The synthetic person: visibility against brute-force ray casting, known colours, files and their
reader."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from itertools import combinations
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from dyngs.api.load import read_capture
from dyngs.config import DataConfig
from dyngs.core.errors import DyngsError
from dyngs.data.body_frames import about_pelvis, rows_of
from dyngs.data.capture import Capture, View
from dyngs.data.geometry import cam_from_opengl
from dyngs.data.synthetic.raytrace import CAMERA_ANGLE_X
from dyngs.data.tracks import read_true_tracks
from dyngs.human.body.body import BodyTemplate, posed_vertices
from dyngs.human.body.body_reader import default_template
from dyngs.human.body.joints import JOINT_NAMES
from dyngs.human.motion.motion import Motion
from dyngs.human.motion.retarget import read_motion
from dyngs.human.synthetic.capture import (
    POINTS,
    HumanOptions,
    PosedMesh,
    random_light,
    render_mesh,
    varied,
    write_human_capture,
    write_walking_capture,
)
from dyngs.human.synthetic.clips import squat, walk
from dyngs.human.synthetic.clothes import dress_body, paint_texture, random_outfit

TINY = HumanOptions(size=24, num_frames=2, num_new=2, num_cameras=3, num_test=1, samples=1)
LIGHT = np.array([0.35, 0.75, 0.56]) / np.linalg.norm([0.35, 0.75, 0.56])


@cache
def body() -> BodyTemplate:
    return default_template()


@cache
def texture() -> np.ndarray:
    return paint_texture(body(), random_outfit(0))


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_human_capture(tmp_path_factory.mktemp("person") / "out", TINY)


def posed(motion: Motion, frame: int) -> np.ndarray:
    exact = body().to(dtype=torch.float64)
    return posed_vertices(exact, motion.poses[[frame]].double(), motion.trans[[frame]].double())[
        0
    ].numpy()


def mesh_of(vertices: np.ndarray, image: np.ndarray) -> PosedMesh:
    uv = body().uv
    uv_faces = body().uv_faces
    assert uv is not None
    assert uv_faces is not None
    return PosedMesh(vertices, body().faces.numpy(), uv.double().numpy(), uv_faces.numpy(), image)


def front_camera(distance: float = 3.5, height: float = 0.95) -> np.ndarray:
    """Looks along -z."""
    pose = np.eye(4)
    pose[:3, 3] = 0.0, height, distance
    return pose


def pixels_of(world_from_cam: np.ndarray, points: np.ndarray, size: int) -> np.ndarray:
    """(P, 2) column and row of points in the world, by the convention of the readers: centres at
    halves."""
    cam_from_world = cam_from_opengl(world_from_cam)
    x, y, z = cam_from_world[:3, :3] @ points.T + cam_from_world[:3, 3:]
    focal = 0.5 * size / np.tan(0.5 * CAMERA_ANGLE_X)
    return np.stack([0.5 * size + focal * x / z, 0.5 * size + focal * y / z], axis=-1)


def rays_of(world_from_cam: np.ndarray, size: int, samples: int) -> np.ndarray:
    """((size samples)^2, 3) directions through the positions of all pixels, row by row of these
    positions."""
    n = size * samples
    x, y = np.meshgrid(*[((np.arange(n) + 0.5) / n - 0.5) * 2 * np.tan(0.5 * CAMERA_ANGLE_X)] * 2)
    return np.stack([x, -y, -np.ones_like(x)], axis=-1).reshape(-1, 3) @ world_from_cam[:3, :3].T


def cast(
    corners: np.ndarray, origin: np.ndarray, rays: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """First triangle (R,), -1 for none, and barycentrics (R, 3), of all rays with all triangles (T,
    3, 3), by Cramer's rule: origin + t ray = a + u (b - a) + v (c - a)."""
    a, b, c = corners.transpose(1, 0, 2)
    first = b - a
    second = c - a
    start = origin - a
    faces = np.full(len(rays), -1)
    fractions = np.zeros((len(rays), 3))
    normal = np.cross(first, second)
    moment = np.cross(start, first)
    for i, ray in enumerate(rays):
        across = np.cross(ray, second)
        determinant = -normal @ ray
        with np.errstate(divide="ignore", invalid="ignore"):
            u = (start * across).sum(1) / determinant
            v = moment @ ray / determinant
            t = (second * moment).sum(1) / determinant
        t = np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0), t, np.inf)
        if np.isfinite(t.min()):
            faces[i] = k = int(t.argmin())
            fractions[i] = 1 - u[k] - v[k], u[k], v[k]
    return faces, fractions


def slow_normals(mesh: PosedMesh) -> np.ndarray:
    total = np.zeros_like(mesh.vertices)
    for face in mesh.faces:
        a, b, c = mesh.vertices[face]
        total[face] += np.cross(b - a, c - a)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)


def slow_texture(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Bilinear between the centres of texels."""
    size = len(image)
    column = np.clip(uv[0] * size - 0.5, 0, size - 1)
    row = np.clip((1 - uv[1]) * size - 0.5, 0, size - 1)
    color = np.zeros(3)
    for i in range(size):
        for j in range(size):
            color += max(0.0, 1 - abs(row - i)) * max(0.0, 1 - abs(column - j)) * image[i, j]
    return color


# --- images
# ---------------------------------------------------------------------------------------------------------


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), size=st.integers(1, 9), samples=st.integers(1, 3))
def test_images_are_those_of_casting_every_ray_at_every_triangle(
    seed: int, size: int, samples: int
) -> None:
    """Of random triangles through each other, with perspective, texture, light and straight
    alpha."""
    make = np.random.default_rng(seed)
    mesh = PosedMesh(
        vertices=make.uniform(-1, 1, (12, 3)),
        faces=make.permutation(list(combinations(range(12), 3)))[:8],
        uv=make.uniform(0, 1, (10, 2)),
        uv_faces=make.integers(0, 10, (8, 3)),
        texture=make.uniform(0, 1, (4, 4, 3)),
    )
    pose = front_camera(2.5, 0.1)
    faces, fractions = cast(mesh.vertices[mesh.faces], pose[:3, 3], rays_of(pose, size, samples))
    normals = slow_normals(mesh)
    colors = np.zeros((len(faces), 4))
    for i in np.flatnonzero(faces >= 0):
        normal = fractions[i] @ normals[mesh.faces[faces[i]]]
        light = 0.6 + 0.45 * max(normal @ LIGHT / np.linalg.norm(normal), 0.0)
        rgb = np.minimum(
            light * slow_texture(mesh.texture, fractions[i] @ mesh.uv[mesh.uv_faces[faces[i]]]), 1.0
        )
        colors[i] = *rgb, 1.0
    sums = colors.reshape(size, samples, size, samples, 4).sum((1, 3))
    found = render_mesh(mesh, pose, size, samples)
    np.testing.assert_allclose(found[..., 3], sums[..., 3] / samples**2, atol=1e-12)
    np.testing.assert_allclose(
        found[..., :3] * found[..., 3:], sums[..., :3] / samples**2, atol=1e-6
    )


def test_the_silhouette_is_that_of_the_posed_mesh() -> None:
    """Rays at every pixel, against the full mesh."""
    vertices = posed(squat(body(), 2), 1)
    pose = front_camera(3.0, 0.8)
    size = 16
    faces, _ = cast(vertices[body().faces.numpy()], pose[:3, 3], rays_of(pose, size, 1))
    found = render_mesh(mesh_of(vertices, texture()), pose, size, 1)[..., 3]
    assert set(np.unique(found)) == {0.0, 1.0}
    np.testing.assert_array_equal(found == 1.0, (faces >= 0).reshape(size, size))
    assert 15 < found.sum() < 100


def test_a_texel_is_seen_where_the_surface_is() -> None:
    """A red spot of 9 x 9 texels about the middle of a triangle on the chest appears there and
    nowhere else."""
    vertices = posed(walk(body(), 1), 0)
    size = 64
    mesh = mesh_of(vertices, np.full((512, 512, 3), 0.5))
    pose = front_camera()
    middles = body().vertices.numpy()[mesh.faces].mean(1)
    face = int(np.linalg.norm(middles - [0.05, 0.45, 0.15], axis=1).argmin())
    u, v = mesh.uv[mesh.uv_faces[face]].mean(0)
    row = int((1 - v) * 512)
    column = int(u * 512)
    mesh.texture[row - 4 : row + 5, column - 4 : column + 5] = [0.5, 0.0, 0.0]
    found = render_mesh(mesh, pose, size, 4)
    redness = (found[..., 0] - found[..., 1]) * found[..., 3]
    place = pixels_of(pose, vertices[mesh.faces[face]].mean(0)[None], size)[0]
    rows, columns = np.indices(redness.shape) + 0.5
    middle = np.array([(columns * redness).sum(), (rows * redness).sum()]) / redness.sum()
    np.testing.assert_allclose(middle, place, atol=0.25)
    assert redness[int(place[1]), int(place[0])] > 0.1
    assert (redness[np.hypot(columns - place[0], rows - place[1]) > 3] == 0).all()


def test_the_left_hand_is_on_the_left_of_the_person() -> None:
    """An image from the front shows it on the right, one from behind on the left; it is painted by
    its vertices."""
    at_rest = body().vertices.double().numpy()
    mesh = mesh_of(at_rest + np.array([0.0, 0.83, 0.0]), np.ones((128, 128, 3)))
    wrist = body().joints[JOINT_NAMES.index("left_wrist"), 0].item()
    for corners, corners_uv in zip(mesh.faces, mesh.uv_faces, strict=True):
        if at_rest[corners, 0].min() > wrist:
            u, v = mesh.uv[corners_uv].mean(0)
            mesh.texture[int((1 - v) * 128), int(u * 128)] = [0.0, 1.0, 0.0]
    behind = front_camera()
    behind[:3, :3] = np.diag([-1.0, 1, -1])
    behind[2, 3] = -3.5
    for pose, side in ((front_camera(), 1), (behind, -1)):
        found = render_mesh(mesh, pose, 48, 2)
        greenness = (found[..., 1] - found[..., 0]) * found[..., 3]
        columns = np.indices(greenness.shape)[1][greenness > 0.1] - 23.5
        assert len(columns) > 3
        assert (columns * side > 10).all()


def test_what_is_behind_the_camera_is_refused() -> None:
    with pytest.raises(ValueError, match="in front of the camera"):
        render_mesh(
            mesh_of(body().vertices.double().numpy(), texture()), front_camera(0.0, 0.0), 8, 1
        )


# --- files
# ------------------------------------------------------------------------------------------------------------


def pixels(path: Path) -> np.ndarray:
    return np.asarray(oiio.ImageBuf(str(path)).get_pixels(oiio.UINT8))


def files(folder: Path) -> dict[str, bytes]:
    return {
        p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()
    }


def captured(folder: Path) -> Capture:
    return read_capture(DataConfig(root=folder))  # type: ignore[call-arg]


def seen_at(view: View, points: np.ndarray) -> np.ndarray:
    """(P, 2) column and row."""
    u, v, w = view.intrinsics @ (
        view.cam_from_world[:3, :3] @ points.T + view.cam_from_world[:3, 3:]
    )
    return np.stack([u / w, v / w], axis=-1)


def test_one_seed_gives_the_same_bytes(root: Path, tmp_path: Path) -> None:
    assert files(write_human_capture(tmp_path / "again", TINY)) == files(root)


def test_another_seed_is_another_person_of_another_size(root: Path, tmp_path: Path) -> None:
    """The parameters say how tall; the silhouette is that of the dressed template."""
    other = write_human_capture(tmp_path / "other", replace(TINY, seed=3))
    assert files(other).keys() == files(root).keys()
    outfit = random_outfit(3)
    motion = read_motion(other / "body_train.npz", body())
    torch.testing.assert_close(motion.scale, torch.full((2,), outfit.size))
    torch.testing.assert_close(motion.trans, outfit.size * walk(body(), 2).trans)
    exact = dress_body(body(), outfit).to(dtype=torch.float64)
    vertices = posed_vertices(
        exact, motion.poses.double(), motion.trans.double(), scale=motion.scale.double()
    )
    for view in captured(other).splits["train"][:3]:
        is_person = pixels(view.image_path)[..., 3] == 255
        positions = seen_at(view, vertices[0].numpy())
        for found, expected in zip(np.nonzero(is_person), positions.T[::-1], strict=True):
            # pixels: centres are sampled
            assert expected.min() - 0.5 <= found.min() + 0.5 <= expected.min() + 2
            assert expected.max() - 2 <= found.max() + 0.5 <= expected.max() + 0.5
    assert (
        pixels(root / "images/train/f000_c00.png") != pixels(other / "images/train/f000_c00.png")
    ).any()


def test_varied_people_differ_in_body_light_and_clip(root: Path, tmp_path: Path) -> None:
    """Each by its own; body parameters are in the template's own shape space, and are exact."""
    plain = files(root)
    for name in ("light_seed", "clip_seed"):
        some = files(
            write_human_capture(tmp_path / name, replace(TINY, num_new=0, num_test=0, **{name: 3}))
        )
        assert some["images/train/f000_c00.png"] != plain["images/train/f000_c00.png"]
        assert (some["body_train.npz"] != plain["body_train.npz"]) == (name == "clip_seed")
    person = write_human_capture(tmp_path / "varied", varied(TINY, 3))
    given = captured(person).body
    assert given is not None
    assert given["train"].shape_space == "anny"
    with np.load(person / "body_pose.npz") as pose, np.load(person / "body_train.npz") as train:
        assert np.abs(pose["poses"] - train["poses"]).max() > 0.1
        np.testing.assert_array_equal(pose["betas"], train["betas"])


def test_light_comes_from_above_and_not_too_bright() -> None:
    for seed in range(5):
        light = random_light(seed)
        assert light.towards[1] >= 0
        assert light == random_light(seed)
        assert light != random_light(seed + 1)
        assert all(0.6 < light.ambient[0] + channel < 1.15 for channel in light.diffuse)


def test_the_layout_is_read_as_a_person(root: Path) -> None:
    capture = captured(root)
    assert (capture.format, capture.warnings, capture.has_alpha) == ("body_json", (), True)
    seen = {
        str(split): [(v.frame, v.camera_id, v.time) for v in views]
        for split, views in capture.splits.items()
    }
    assert seen == {
        "train": [(f, c, float(f)) for f in range(2) for c in range(3)],
        "test": [(f, 3, float(f)) for f in range(2)],
        "val": [],
        "pose": [(f, 3, float(f)) for f in range(2)],
    }
    fields = json.loads((root / "transforms_pose.json").read_text())
    assert set(fields) == {"w", "h", "fl_x", "fl_y", "cx", "cy", "frames"}
    assert fields["frames"][1]["file_path"] == "images/pose/f001_c03.png"


def test_the_parameters_pose_the_template_as_the_images_show_it(root: Path) -> None:
    """Through the readers: the pelvis lies inside the silhouette, and the silhouette just fills the
    posed vertices'."""
    capture = captured(root)
    assert capture.body is not None
    exact = body().to(dtype=torch.float64)
    for split, views in capture.splits.items():
        if not views:
            continue
        own = about_pelvis(capture.body[split], exact.joints[0].numpy())
        rows = rows_of(root, own, views)
        poses, trans, scale = (torch.from_numpy(x[rows]) for x in (own.poses, own.trans, own.scale))
        assert (scale == 1).all()
        for view, vertices, shift in zip(
            views, posed_vertices(exact, poses, trans).numpy(), trans.numpy(), strict=True
        ):
            is_person = pixels(view.image_path)[..., 3] == 255
            column, row = seen_at(view, (exact.joints[0].numpy() + shift)[None])[0].astype(int)
            assert is_person[row, column]
            positions = seen_at(view, vertices)
            rows_seen, columns_seen = np.nonzero(is_person)
            for found, expected in ((columns_seen, positions[:, 0]), (rows_seen, positions[:, 1])):
                assert expected.min() - 0.5 <= found.min() + 0.5 <= expected.min() + 2
                assert expected.max() - 2 <= found.max() + 0.5 <= expected.max() + 0.5
            hull = ConvexHull(positions).equations
            centers = np.stack([columns_seen, rows_seen], axis=-1) + 0.5
            assert (centers @ hull[:, :2].T + hull[:, 2] <= 1e-9).all()


def test_motions_of_the_files_are_those_of_the_clips(root: Path) -> None:
    for name, clip in (("train", walk), ("pose", squat)):
        found = read_motion(root / f"body_{name}.npz", body())
        expected = clip(body(), 2)
        assert torch.equal(found.poses, expected.poses)
        assert torch.equal(found.trans, expected.trans)


def test_cameras_stand_around_the_person_and_see_all_of_it(tmp_path: Path) -> None:
    """Nothing touches the border; test cameras stand between training cameras, at 22.5 degrees of
    eight."""
    options = replace(TINY, size=16, num_frames=1, num_new=1, num_cameras=8, num_test=2)
    capture = captured(write_human_capture(tmp_path / "out", options))
    azimuths: dict[str, list[float]] = {}
    for split, views in capture.splits.items():
        for view in views:
            alpha = pixels(view.image_path)[..., 3]
            assert not np.concatenate([alpha[[0, -1]], alpha[:, [0, -1]].T]).any()
            center = -view.cam_from_world[:3, :3].T @ view.cam_from_world[:3, 3]
            azimuths.setdefault(str(split), []).append(
                np.degrees(np.arctan2(center[0], center[2])) % 360
            )
    np.testing.assert_allclose(azimuths["train"], 45.0 * np.arange(8), atol=1e-9)
    np.testing.assert_allclose(azimuths["test"], [22.5, 202.5])
    assert azimuths["pose"] == azimuths["test"]


def test_one_frame_without_test_cameras_is_enough(tmp_path: Path) -> None:
    out = write_human_capture(
        tmp_path / "out", replace(TINY, num_frames=1, num_cameras=1, num_test=0)
    )
    assert set(files(out)) == {
        "transforms_train.json",
        "body_train.npz",
        "images/train/f000_c00.png",
    }


@pytest.mark.parametrize("changes", [{"size": 0}, {"samples": 0}, {"num_test": -1}, {"seed": -1}])
def test_what_cannot_be_taken_is_refused(changes: dict[str, int], tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match=f"{next(iter(changes))}.* of at least"):
        write_human_capture(tmp_path / "out", replace(TINY, **changes))
    assert not (tmp_path / "out").exists()


def test_a_used_folder_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("keep")
    with pytest.raises(DyngsError, match="exists already"):
        write_human_capture(tmp_path, TINY)
    assert list(files(tmp_path)) == ["mine.txt"]


# --- a walk in the layout of D-NeRF
# ---------------------------------------------------------------------------------


def test_a_walk_is_seen_once_per_time_and_its_true_tracks_lie_on_the_person(tmp_path: Path) -> None:
    options = HumanOptions(size=48, num_frames=5, num_test=2, samples=1)
    capture = captured(write_walking_capture(tmp_path / "out", options))
    train = capture.splits["train"]
    test = capture.splits["test"]
    assert [view.time for view in train] == [0.0, 0.25, 0.5, 0.75, 1.0]
    assert [view.time for view in test] == [0.125, 0.625]
    assert len({view.cam_from_world.tobytes() for view in (*train, *test)}) == 7
    tracks = read_true_tracks(capture)
    assert tracks is not None
    assert tracks.points.shape == (9, POINTS, 3)
    for view in (*train, *test):
        row = tracks.views.tolist().index(view.name)
        seen = tracks.visible[row]
        assert 0.2 < seen.mean() < 0.7, "one side of the person is seen"
        columns, rows = seen_at(view, tracks.points[tracks.moments[row]][seen]).T.astype(int)
        covered = np.pad(pixels(view.image_path)[..., 3], 1)
        around = np.max(
            [covered[rows + i, columns + j] for i in range(3) for j in range(3)], axis=0
        )
        assert (around > 0).mean() > 0.97, (
            "fingers are thinner than pixels, whose centres are sampled"
        )
    moved = np.linalg.norm(np.diff(tracks.points, axis=0), axis=-1)
    assert moved.max() > 0.05
    with pytest.raises(DyngsError, match="more times than test images"):
        write_walking_capture(tmp_path / "none", replace(options, num_frames=2))
