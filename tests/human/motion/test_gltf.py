"""Animations of glTF skins: round trips, interpolation, containers, and broken files that end in
one line."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from measured import cost_of
from motion_files import (
    VRM,
    Clip,
    Glb,
    as_local,
    glb_of,
    pelvis_path,
    random_motion,
    skeleton,
    tiny_body,
    vrma_of,
    world_rotations,
)
from scipy.spatial.transform import Rotation

from dyngs.core.errors import DyngsError
from dyngs.human.body.joints import JOINT_NAMES
from dyngs.human.motion.gltf import read_gltf
from dyngs.human.motion.motion import Motion
from dyngs.human.motion.retarget import retarget

BODY = tiny_body()
MOTION = random_motion(5, angle=0.8)
OWN = skeleton()


def clip(**changes: object) -> Clip:
    """The motion on our own skeleton."""
    return Clip(
        as_local(MOTION, OWN),
        pelvis_path(BODY, MOTION),
        **changes,  # pyright: ignore[reportArgumentType]
    )


def two_joints(**changes: object) -> Glb:
    """A joint at (0, 1, 0) on one that turns about z from 0 to 90 degrees within a second."""
    own = type(OWN)(("root", "tip"), (-1, 0), np.array([[0.0, 0, 0], [0, 1, 0]]))
    local = np.stack(
        [[Rotation.from_euler("z", a, degrees=True).as_matrix(), np.eye(3)] for a in (0, 90)]
    )
    return glb_of(
        own,
        Clip(
            local,
            np.zeros((2, 3)),
            fps=1.0,
            **changes,  # pyright: ignore[reportArgumentType]
        ),
    )


def same(found: Motion, expected: Motion, atol: float = 1e-5) -> None:
    """World rotations of all joints, and the path of the pelvis from its start."""
    ours, theirs = (
        world_rotations(x.poses.double().numpy(), OWN.parents) for x in (found, expected)
    )
    np.testing.assert_allclose(ours, theirs, atol=atol)
    moved, wanted = (x.trans.numpy() - x.trans.numpy()[0] for x in (found, expected))
    np.testing.assert_allclose(moved, wanted, atol=atol)


# --- round trips
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("interpolation", ["LINEAR", "STEP", "CUBICSPLINE"])
def test_round_trip_of_a_body(tmp_path: Path, interpolation: str) -> None:
    path = glb_of(OWN, clip(interpolation=interpolation)).write(tmp_path / "x.glb")
    source = read_gltf(path)
    assert source.names == JOINT_NAMES
    assert source.world_is_y_up
    same(retarget(source, BODY), MOTION)


@pytest.mark.parametrize("bind_matrices", [True, False])
def test_joints_with_axes_of_their_own(tmp_path: Path, bind_matrices: bool) -> None:
    """Without bind matrices, the nodes as they stand are the rest pose."""
    axes = Rotation.from_rotvec(np.random.default_rng(0).normal(size=(55, 3))).as_matrix()
    path = glb_of(OWN, clip(axes=axes, bind_matrices=bind_matrices)).write(tmp_path / "x.glb")
    same(retarget(read_gltf(path), BODY), MOTION)


def test_a_mesh_bound_in_other_axes_and_units(tmp_path: Path) -> None:
    """Centimetres and z up below an armature that turns and scales, as exporters write it."""
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # z up from y up
    own = type(OWN)(OWN.names, OWN.parents, 100 * OWN.rest @ turn.T)
    above = np.eye(4)
    above[:3, :3] = 0.01 * turn.T
    moved = Clip(
        turn @ as_local(MOTION, OWN) @ turn.T, 100 * pelvis_path(BODY, MOTION) @ turn.T, above=above
    )
    same(retarget(read_gltf(glb_of(own, moved).write(tmp_path / "x.glb")), BODY), MOTION)


def test_the_text_form_with_its_buffer_inside_or_beside_it(tmp_path: Path) -> None:
    glb = glb_of(OWN, clip())
    inside = "data:application/octet-stream;base64," + base64.b64encode(glb.data).decode()
    (tmp_path / "a b.bin").write_bytes(glb.data)
    expected = read_gltf(glb.write(tmp_path / "x.glb"))
    for uri in (inside, "a%20b.bin"):
        document = {**glb.json, "buffers": [{"byteLength": len(glb.data), "uri": uri}]}
        (tmp_path / "x.gltf").write_text(json.dumps(document))
        found = read_gltf(tmp_path / "x.gltf")
        np.testing.assert_array_equal(found.rotations, expected.rotations)
        np.testing.assert_array_equal(found.positions, expected.positions)


# --- VRM animations
# ----------------------------------------------------------------------------------------------

BONES = skeleton(tuple(VRM))


def vrma(**changes: object) -> Glb:
    """The motion as a VRM animation."""
    moved = Clip(
        as_local(MOTION, BONES),
        pelvis_path(BODY, MOTION),
        bind_matrices=False,
        **changes,  # pyright: ignore[reportArgumentType]
    )
    return vrma_of(BONES, moved)


def test_a_vrm_animation_moves_the_bones_that_it_names(tmp_path: Path) -> None:
    """All bones move except jaw and eyes, which VRM does not animate, also with other axes in the
    rest pose and facing -z."""
    own = as_local(MOTION, BONES)
    own_poses = np.zeros((5, 55, 3))
    rows = [JOINT_NAMES.index(name) for name in BONES.names]
    own_poses[:, rows] = Rotation.from_matrix(own.reshape(-1, 3, 3)).as_rotvec().reshape(5, -1, 3)
    expected = world_rotations(own_poses, OWN.parents)
    axes = Rotation.from_rotvec(
        np.random.default_rng(1).normal(size=(len(BONES.names), 3))
    ).as_matrix()
    for changes in ({}, {"axes": axes}):
        source = read_gltf(vrma(**changes).write(tmp_path / "x.vrma"))
        found = retarget(source, BODY)
        ours = world_rotations(found.poses.double().numpy(), OWN.parents)
        np.testing.assert_allclose(ours[:, rows], expected[:, rows], atol=1e-5)
        moved = found.trans.numpy() - found.trans.numpy()[0]
        np.testing.assert_allclose(moved, MOTION.trans.numpy() - MOTION.trans.numpy()[0], atol=1e-5)


# --- sampling
# ----------------------------------------------------------------------------------------------


def angles_of(path: Path, fps: float) -> np.ndarray:
    return Rotation.from_matrix(read_gltf(path, fps).rotations[:, 0]).as_euler("xyz", degrees=True)[
        :, 2
    ]


def test_between_keys(tmp_path: Path) -> None:
    """Turning at constant speed; jumping; and easing in and out as 3 t^2 - 2 t^3."""
    path = tmp_path / "x.glb"
    two_joints(interpolation="LINEAR").write(path)
    np.testing.assert_allclose(angles_of(path, 4), [0, 22.5, 45, 67.5, 90], atol=1e-4)
    np.testing.assert_allclose(
        read_gltf(path, 2).positions[1, 1], [-(0.5**0.5), 0.5**0.5, 0], atol=1e-6
    )
    two_joints(interpolation="STEP").write(path)
    np.testing.assert_allclose(angles_of(path, 4), [0, 0, 0, 0, 90], atol=1e-4)
    two_joints(interpolation="CUBICSPLINE").write(path)
    ease = 3 * 0.25**2 - 2 * 0.25**3
    x = ease * np.sin(np.pi / 4)
    w = 1 - ease + ease * np.cos(np.pi / 4)
    np.testing.assert_allclose(angles_of(path, 4)[1], np.degrees(2 * np.arctan2(x, w)), atol=1e-4)


def test_tangents_of_cubic_splines(tmp_path: Path) -> None:
    """A cube t^3 of the place is met exactly: its derivatives at the keys are 0 and 3."""
    glb = two_joints()
    glb.json["animations"][0]["channels"] = [
        {"sampler": 0, "target": {"node": 0, "path": "translation"}}
    ]
    values = np.array([[0, 0, 0], [0, 0, 0], [0, 0, 0], [0, 3, 0], [0, 1, 0], [0, 0, 0]])
    output = glb.add(values, "VEC3")
    times = glb.json["animations"][0]["samplers"][0]["input"]
    glb.json["animations"][0]["samplers"] = [
        {"input": times, "output": output, "interpolation": "CUBICSPLINE"}
    ]
    found = read_gltf(glb.write(tmp_path / "x.glb"), 10).positions[:, 0, 1]
    np.testing.assert_allclose(found, np.linspace(0, 1, 11) ** 3, atol=1e-6)


def test_one_of_several_animations(tmp_path: Path) -> None:
    glb = two_joints()
    walk = glb.json["animations"][0]
    turns = glb.add(Rotation.from_rotvec([[0, 0, 0], [0, 0, np.radians(40)]]).as_quat(), "VEC4")
    sampler = {**walk["samplers"][0], "output": turns}
    glb.json["animations"].append(
        {"name": "Nod\n2", "samplers": [sampler], "channels": walk["channels"][:1]}
    )
    path = glb.write(tmp_path / "x.glb")
    with pytest.raises(DyngsError, match=r"several animations; choose one of 'Walk', 'Nod.n2'"):
        read_gltf(path)
    with pytest.raises(DyngsError, match=r"no animation 'Run'; it has 'Walk', 'Nod.n2'"):
        read_gltf(path, clip="Run")
    last = read_gltf(path, clip="Nod\n2").rotations[-1, 0]
    assert Rotation.from_matrix(last).magnitude() == pytest.approx(np.radians(40), rel=1e-5)


# --- broken files
# ----------------------------------------------------------------------------------------------


def _sampler(glb: Glb, **changes: object) -> None:
    glb.json["animations"][0]["samplers"][0].update(changes)


def _node(glb: Glb, **changes: object) -> None:
    glb.json["nodes"][0].update(changes)


BREAKS: dict[str, tuple[Callable[[Glb], object], str]] = {
    "no animation": (lambda g: g.json.pop("animations"), "no animation moves its joints"),
    "old": (lambda g: g.json["asset"].update(version="1.0"), "version is not 2"),
    "no asset": (lambda g: g.json.pop("asset"), "cannot be read"),
    "text": (lambda g: _node(g, scale="here"), "cannot be read"),
    "beyond bounds": (
        lambda g: [n.update(scale=[1e9] * 3, translation=[1e9] * 3) for n in g.json["nodes"]],
        "out of range",
    ),
    "NaN": (lambda g: _node(g, scale=[1, 1, float("nan")]), "out of range"),
    "no child": (lambda g: (_node(g, children=[7]), g.json.pop("skins")), "cannot be read"),
    "cycle": (lambda g: g.json["nodes"][1].update(children=[0]), "its own ancestor"),
    "no joint": (lambda g: g.json["skins"][0].update(joints=[0, 1, 9]), "cannot be read"),
    "flat": (lambda g: setattr(g, "data", b"\0" * 64 + g.data[64:]), "flat or mirrored"),
    "mirror": (lambda g: _node(g, scale=[-1, 1, 1]), "node 0 is mirrored"),
    "zero": (
        lambda g: g.json["nodes"].append({"rotation": [0] * 4, "children": [0]}),
        "cannot be read",
    ),
    "no accessor": (lambda g: _sampler(g, output=99), "accessor 99 is broken"),
    "kind": (lambda g: _sampler(g, output=1), "accessor 1 must hold VEC4, not 'SCALAR'"),
    "sparse": (lambda g: g.json["accessors"][1].update(sparse={}), "accessor 1 is sparse"),
    "outside": (
        lambda g: g.json["bufferViews"][1].update(byteOffset=10**15),
        "accessor 1 is broken",
    ),
    "past the end": (
        lambda g: g.json["accessors"][1].update(count=1000),
        "accessor 1 is broken",
    ),
    "offset": (lambda g: g.json["accessors"][1].update(byteOffset=4), "accessor 1 is broken"),
    "negative": (lambda g: g.json["accessors"][1].update(byteOffset=-4), "accessor 1 is broken"),
    "meshopt": (
        lambda g: g.json["bufferViews"][1].update(extensions={"EXT_meshopt_compression": {}}),
        "is compressed",
    ),
    "interpolation": (lambda g: _sampler(g, interpolation="NONE"), "cannot be read"),
    "too few": (lambda g: _sampler(g, interpolation="CUBICSPLINE"), "invalid .* keys of node"),
    "no sampler": (
        lambda g: g.json["animations"][0]["channels"][0].update(sampler=9),
        "cannot be read",
    ),
    "falling": (
        lambda g: _sampler(g, input=g.add(np.array([1.0, 0.0]), "SCALAR")),
        "invalid .* keys of node",
    ),
    "endless": (
        lambda g: _sampler(g, input=g.add(np.array([0, 1e8]), "SCALAR")),
        "exceed the limit",
    ),
    "infinite": (
        lambda g: _sampler(g, input=g.add(np.array([0, np.inf]), "SCALAR")),
        "NaN or huge",
    ),
    "weights only": (
        lambda g: [c["target"].update(path="weights") for c in g.json["animations"][0]["channels"]],
        "moves no joint",
    ),
}


@pytest.mark.parametrize("case", BREAKS)
def test_broken_files_say_what_is_wrong(tmp_path: Path, case: str) -> None:
    glb = two_joints()
    read_gltf(glb.write(tmp_path / "x.glb"))
    spoil, problem = BREAKS[case]
    spoil(glb)
    with pytest.raises(DyngsError, match=problem) as caught:
        read_gltf(glb.write(tmp_path / "x.glb"))
    assert str(caught.value).startswith(str(tmp_path / "x.glb"))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "uri",
    [
        "../secret.bin",
        "/etc/hostname",
        "http://host/x.bin",
        "file:x",
        "a\\b",
        "%2e%2e/secret.bin",
        "",
        "a\0b",
    ],
)
def test_buffers_elsewhere_are_not_touched(tmp_path: Path, uri: str) -> None:
    glb = two_joints()
    folder = tmp_path / "inner"
    folder.mkdir()
    (tmp_path / "secret.bin").write_bytes(glb.data)
    document = {**glb.json, "buffers": [{"byteLength": len(glb.data), "uri": uri}]}
    (folder / "x.gltf").write_text(json.dumps(document))
    with pytest.raises(DyngsError, match="is not a file next to it"):
        read_gltf(folder / "x.gltf")


def _shared_sampler(glb: Glb) -> None:
    """Ten thousand channels of one accessor with a thousand keys."""
    times = glb.add(np.zeros(1000), "SCALAR")
    values = glb.add(np.ones((1000, 4)), "VEC4")
    animation = glb.json["animations"][0]
    animation["samplers"][0].update(input=times, output=values)
    animation["channels"] = [{"sampler": 0, "target": {"node": 0, "path": "rotation"}}] * 10_000


HOSTILE: dict[str, tuple[Callable[[Glb], object], str]] = {
    "keys 2.8 hours apart": (
        lambda g: _sampler(g, input=g.add(np.array([0, 10_080.0]), "SCALAR")),
        "exceed the limit",
    ),
    "joints": (lambda g: g.json["skins"][0].update(joints=[0] * 5000), "5,000 joints"),
    "one sampler": (_shared_sampler, "numbers exceed the limit"),
    "a count": (lambda g: g.json["accessors"][1].update(count=2**62), "exceed the limit"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_files_cost_little(tmp_path: Path, case: str) -> None:
    glb = two_joints()
    spoil, problem = HOSTILE[case]
    spoil(glb)
    path = glb.write(tmp_path / "x.glb")

    def read() -> None:
        with pytest.raises(DyngsError, match=problem):
            read_gltf(path)

    memory, seconds = cost_of(read)
    assert memory < 100e6
    assert seconds < 20
