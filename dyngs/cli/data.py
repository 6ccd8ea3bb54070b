"""``dyngs data``: inspect and synthesise captures, estimate poses, fit bodies, convert motions."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dyngs.cli import arguments as args
from dyngs.cli.output import ProgressBar, print_lines, print_notes
from dyngs.core.errors import DyngsError, format_count, quote_path

if TYPE_CHECKING:
    from dyngs.human.fit.fitted_capture import KnownAvatar

SYNTHETIC_SCENES = ("still", "spin", "room", "roll", "human", "people")
"""Scenes of ``dyngs data synth``, listed here because the parser must not import numpy."""
_OF_A_FIT = {
    "keypoints": ("PATH", "2D key points: a folder of OpenPose files, or a COCO file"),
    "masks": ("DIR", "masks of the person (white), with the names of the images"),
    "joints": (
        "PATH",
        "3D joints of another program (.npz), or an output folder of SAM 3D Body",
    ),
    "person": (
        "PATH",
        "fitted capture or avatar run of the same person: the shape is kept and only poses are "
        "fitted, to the silhouettes of the avatar if given",
    ),
}
"""Options of ``dyngs data fit`` that are fields of ``FitInputs``."""
_OF_A_TEMPLATE = {
    "template": (
        "FILE",
        "SMPL, SMPL-H or SMPL-X file to fit instead of the free template",
    ),
    "uv": ("FILE", ".obj with the texture coordinates of --template if it has none"),
}
VERBS = ("inspect", "sfm", "fit", "people", "motion", "synth", "scans")


def add_parser(commands: args.Commands) -> None:
    about = (
        "inspect a capture, estimate poses, fit a body, convert a motion, write a synthetic capture"
    )
    verbs = commands.add_parser("data", help=about).add_subparsers(
        title="commands", metavar="COMMAND", required=True
    )
    _add_inspect(verbs)
    _add_sfm(verbs)
    _add_fit(verbs)
    _add_people(verbs)
    _add_motion(verbs)
    _add_synth(verbs)
    _add_scans(verbs)


def _add_inspect(verbs: args.Commands) -> None:
    parser = args.add_command(
        verbs,
        "inspect",
        run_inspect,
        "print the contents and problems of a capture, photos or a video",
        "Print views, sizes, intrinsics, times, points, masks and detected problems. For videos "
        "without poses: size, frame rate, length, sound, sharpness, motion and the next command.",
    )
    path = "capture (folder or .zip), video, or folder of photos or videos"
    parser.add_argument("path", type=args.input_path, metavar="PATH", help=path)
    args.add_overrides(parser, "data.key=value", "keys of data, such as data.format=colmap")
    parser.add_argument(
        "--image",
        type=args.output_path,
        metavar="FILE",
        help="write an image of cameras and points",
    )
    parser.add_argument("--deep", action="store_true", help="decode all images in full (slow)")
    args.add_json(parser)


def _add_sfm(verbs: args.Commands) -> None:
    about = "Estimate camera poses with COLMAP's structure from motion. OUT is a capture for `dyngs train`."
    parser = args.add_command(
        verbs, "sfm", run_sfm, "estimate camera poses of photos or a video", about
    )
    images = "folder or .zip of photos, a video file, or a folder of simultaneous videos"
    parser.add_argument("images", type=args.input_path, metavar="IMAGES", help=images)
    parser.add_argument("out", type=args.output_path, metavar="OUT", help="a new folder")
    parser.add_argument("--matching", choices=("auto", "exhaustive", "sequential"), default="auto")
    parser.add_argument(
        "--masks", type=args.input_path, metavar="DIR", help="masks of the photos, white = keep"
    )
    frames = "number of video frames to use (default 100; with several videos up to 300 each)"
    kind = args.integer_type("a number of frames", 2, 10**6)
    parser.add_argument("--frames", type=kind, metavar="N", help=frames)
    args.add_threads(parser)
    args.add_overrides(parser, "data.key=value", "data.follow_links")


def _add_fit(verbs: args.Commands) -> None:
    parser = args.add_command(
        verbs,
        "fit",
        run_fit,
        "fit a body template to images of a person",
        "Fit the free body template or an SMPL model to the silhouettes of a person: one shape and "
        "skeleton, and a pose per frame. OUT is a capture for `dyngs train human`.",
    )
    about = "capture folder, or a video or image folder of one fixed camera"
    parser.add_argument("capture", type=args.input_path, metavar="CAPTURE", help=about)
    parser.add_argument("out", type=args.output_path, metavar="OUT", help="a new folder")
    for name, (metavar, about) in (_OF_A_FIT | _OF_A_TEMPLATE).items():
        parser.add_argument(f"--{name}", type=args.input_path, metavar=metavar, help=about)
    args.add_overrides(parser, "data.key=value", "keys of data")


def _add_people(verbs: args.Commands) -> None:
    parser = args.add_command(
        verbs,
        "people",
        run_people,
        "detect a person in a video and fit a body template",
        "Detect a person, their silhouette and key points with MediaPipe, track them through the "
        "clip, and fit the body as `dyngs data fit`. OUT is a capture for `dyngs train human`. "
        "MediaPipe runs in a separate Python environment.",
    )
    about = "video or image folder of one fixed camera, or a capture with cameras"
    parser.add_argument("clip", type=args.input_path, metavar="CLIP", help=about)
    parser.add_argument("out", type=args.output_path, metavar="OUT", help="a new folder")
    about = "number of the person, as this command lists them (default: seen largest and longest)"
    parser.add_argument(
        "--person", type=args.integer_type("a person", 1, 1000), metavar="N", help=about
    )
    about = "Python interpreter of an environment with MediaPipe (default: $DYNGS_MEDIAPIPE)"
    parser.add_argument("--mediapipe", type=args.input_path, metavar="PYTHON", help=about)
    args.add_overrides(parser, "data.key=value", "keys of data")


def _add_motion(verbs: args.Commands) -> None:
    parser = args.add_command(
        verbs,
        "motion",
        run_motion,
        "retarget an AMASS, BVH or glTF motion to the body template",
        "Read a motion, retarget it to the skeleton of the template, and write it as .npz in the "
        "layout of AMASS SMPL-X, y up.",
    )
    parser.add_argument(
        "file",
        type=args.input_path,
        metavar="FILE",
        help="AMASS, SMPL-X .npz, .bvh, .glb, .gltf, .vrma",
    )
    parser.add_argument("out", type=args.output_path, metavar="OUT.npz", help="a new file")
    parser.add_argument(
        "--fps",
        type=float,
        metavar="F",
        help="frame rate to resample to, or of an .npz without one",
    )
    parser.add_argument(
        "--up", choices=("auto", "y", "z"), default="auto", help="up axis of an .npz (default auto)"
    )
    parser.add_argument(
        "--clip", metavar="NAME", help="name of the animation in a glTF file with several"
    )
    parser.add_argument(
        "--body",
        type=args.input_path,
        metavar="BODY",
        help="body template (default: that of dyngs)",
    )


def _add_synth(verbs: args.Commands) -> None:
    parser = args.add_command(
        verbs,
        "synth",
        run_synth,
        "write a synthetic capture",
        "Ray trace a built-in scene as a capture in the layout of NeRF-synthetic, or D-NeRF for "
        "moving scenes. still: a still life. spin: a rotating die and a rolling ball. room: videos "
        "of a static room with a hopping ball, from fixed cameras. roll: a rolling striped ball. "
        "human: a walking person with exact body parameters. people: one capture per person with "
        "depth maps and key points, to train networks that predict people.",
    )
    parser.add_argument(
        "scene", choices=SYNTHETIC_SCENES, metavar="NAME", help=", ".join(SYNTHETIC_SCENES)
    )
    parser.add_argument("out", type=args.output_path, metavar="OUT", help="a new folder")
    number = args.integer_type("a number", 1, 10**6)
    for name, about in (
        ("size", "width and height in pixels (default 128, for people 256)"),
        ("views", "training views; time steps for fixed cameras, human and people (48, 12 and 1)"),
        ("cameras", "training cameras of human, people and fixed cameras (8, 24 and 8)"),
        ("people", "number of people of the scene people (default 100)"),
    ):
        parser.add_argument(f"--{name}", type=number, metavar="N", help=about)
    style = (
        "cameras of moving scenes: a new position at each time (teleport, default), one moving "
        "camera, or fixed cameras (default of room)"
    )
    parser.add_argument("--style", choices=("teleport", "moving", "fixed"), help=style)
    seed = "random seed of cameras, clothes (human) and people (default 0)"
    parser.add_argument(
        "--seed", type=args.integer_type("a seed", 0, 10**9), metavar="N", help=seed
    )


def _add_scans(verbs: args.Commands) -> None:
    parser = args.add_command(
        verbs,
        "scans",
        run_scans,
        "render textured scans of people as captures",
        "Render .obj and .glb files, such as those of THuman2.0 and RenderPeople, from a ring of "
        "cameras: one capture per person with silhouettes and depth maps, for `dyngs train gps`. "
        "Scans are y up; people are scaled to 1.8 m.",
    )
    about = "folder that holds the scans, in any subfolders"
    parser.add_argument("folder", type=args.input_path, metavar="FOLDER", help=about)
    parser.add_argument("out", type=args.output_path, metavar="OUT", help="a new folder")
    kind = args.integer_type("a number", 0, 10**6)
    for name, default, about in (
        ("size", 256, "width and height of the images in pixels (default 256)"),
        ("cameras", 24, "cameras on the ring (default 24)"),
        ("seed", 0, "random seed of the rings (default 0)"),
    ):
        parser.add_argument(f"--{name}", type=kind, default=default, metavar="N", help=about)


def run_inspect(arguments: argparse.Namespace) -> int:
    """Print a report on a capture or on videos without poses."""
    from dyngs.capture.inspection import format_report, inspect_capture, inspect_photos
    from dyngs.capture.sfm.unposed import is_unposed, is_videos
    from dyngs.data.read import capture_folder

    arguments.path = capture_folder(arguments.path)
    if is_videos(arguments.path):
        return _inspect_videos(arguments)
    # The full size is reported, instead of that in training.
    options = args.data_section(["data.longest_side=0", *arguments.overrides]).model_copy(
        update={"root": arguments.path}
    )
    is_photos = is_unposed(options)
    report = inspect_photos(options) if is_photos else inspect_capture(options, arguments.deep)
    if report.capture is None and not is_photos:
        for problem in report.problems[1:]:
            print_lines(f"also: {problem}")
        raise DyngsError(report.problems[0])
    if report.capture is None and arguments.image is not None:
        raise DyngsError(
            f"{arguments.path}: photos have no poses to draw; run `dyngs data sfm` first"
        )
    if arguments.json:
        found = {"facts": dict(report.facts), "problems": report.problems}
        print(json.dumps({"path": str(report.root), **found}, indent=2))
    else:
        print_lines(format_report(report))
    if report.capture is not None and arguments.image is not None:
        from dyngs.capture.inspection import draw_cameras

        draw_cameras(report.capture, arguments.image)
        if not arguments.json:
            print(f"written: {arguments.image}")
    return 0


def _inspect_videos(arguments: argparse.Namespace) -> int:
    from dyngs.capture.inspection import video_report

    if arguments.image is not None:
        raise DyngsError(
            f"{arguments.path}: videos have no poses to draw; run `dyngs data sfm` first"
        )
    if arguments.json:
        raise DyngsError(f"{arguments.path}: --json is not supported for videos; remove it")
    print_lines(video_report(arguments.path))
    return 0


def run_sfm(arguments: argparse.Namespace) -> int:
    """Estimate poses and print the next commands."""
    from dyngs.capture.sfm.colmap import SfmOptions
    from dyngs.capture.sfm.estimate import estimate_poses
    from dyngs.capture.sfm.several_videos import poses_of_videos
    from dyngs.capture.sfm.unposed import is_several_videos
    from dyngs.data.read import capture_folder

    limits = args.data_section(arguments.overrides)
    out = arguments.out
    images = capture_folder(arguments.images)
    several = is_several_videos(images)
    if several and (arguments.matching != "auto" or arguments.masks is not None):
        raise DyngsError(f"{images}: --matching and --masks are not supported for several videos")
    options = SfmOptions(
        matching=arguments.matching,
        num_frames=arguments.frames,
        masks=arguments.masks,
        num_threads=arguments.threads,
        follow_links=limits.follow_links,
    )
    with ProgressBar() as report:
        if several:
            said = poses_of_videos(images, out, options, report)
        else:
            said = estimate_poses(images, out, options, report).summary()
    print_lines(f"{said}\nnext: dyngs data inspect {quote_path(out)} --image cameras.png")
    print(f"      dyngs train {'dynamic' if several else 'static'} {quote_path(out)}")
    return 0


def run_fit(arguments: argparse.Namespace) -> int:
    """Fit a body; print the quality of the fit and the next command."""
    from dyngs.human.fit.fitted_capture import FitInputs, write_fitted_capture
    from dyngs.human.keys import HumanModel

    options = args.data_section(arguments.overrides).model_copy(update={"root": arguments.capture})
    passed = {name: getattr(arguments, name) for name in _OF_A_FIT}
    if arguments.uv is not None and arguments.template is None:
        raise DyngsError(
            f"--uv {arguments.uv} requires --template; the free template has texture coordinates"
        )
    with ProgressBar() as report:
        template = HumanModel(body=arguments.template, uv=arguments.uv)
        inputs = FitInputs(**passed, avatar=_avatar_in(arguments.person), template=template)
        result = write_fitted_capture(options, arguments.out, report, inputs)
    files = {"model.body": result.model.body, "model.uv": result.model.uv}
    keys = "".join(f" {key}={quote_path(path)}" for key, path in files.items() if path is not None)
    print_lines(f"{result.summary}\nnext: dyngs train human {quote_path(result.root)}{keys}")
    return 0


def run_people(arguments: argparse.Namespace) -> int:
    """Detect a person and fit a body; print a summary and the next command."""
    from dyngs.human.detect.detect_person import write_detected_person
    from dyngs.human.detect.detector import MediaPipe

    options = args.data_section(arguments.overrides).model_copy(update={"root": arguments.clip})
    if arguments.person is not None:
        options = options.model_copy(update={"person": arguments.person})
    detector = MediaPipe(arguments.mediapipe)
    with ProgressBar() as report:
        result = write_detected_person(options, arguments.out, detector, report)
    print_lines(f"{result.summary}\nnext: dyngs train human {quote_path(result.root)}")
    return 0


def _avatar_in(person: Path | None) -> KnownAvatar | None:
    """Return the avatar if ``person`` is an avatar run, else None."""
    from dyngs.config.io import RESOLVED_NAME

    if person is None or not (person / RESOLVED_NAME).is_file():
        return None
    from dyngs.human.avatar.scene import as_human_scene
    from dyngs.human.fit.fitted_capture import KnownAvatar
    from dyngs.runs.checkpoint import load_run

    run = load_run(person)
    scene = as_human_scene(run.scene)
    return None if scene is None else KnownAvatar(scene, run.config.data.longest_side)


def run_motion(arguments: argparse.Namespace) -> int:
    """Convert the motion and print a summary."""
    from dyngs.human.body.body_reader import default_template, read_body
    from dyngs.human.motion.amass import write_amass
    from dyngs.human.motion.retarget import read_motion

    out: Path = arguments.out
    if out.exists():
        raise DyngsError(f"{out}: already exists; give the name of a new file")
    if out.suffix.lower() != ".npz":
        raise DyngsError(f"{out}: motions are written as .npz; give a name with this suffix")
    body = default_template() if arguments.body is None else read_body(arguments.body)
    motion = read_motion(arguments.file, body, arguments.fps, arguments.up, arguments.clip)
    write_amass(motion, out)
    count = len(motion.poses)
    length = f"{format_count(count, 'frame')}, {(count - 1) / motion.fps:.2f} s"
    print(f"written: {out}\n         {length} at {motion.fps:g} frames per second")
    print_notes(motion.notes)
    return 0


def run_synth(arguments: argparse.Namespace) -> int:
    """Write the capture and print the command that trains on it."""
    from dyngs.data.synthetic import captures as synthetic
    from dyngs.human.synthetic.capture import (
        HumanOptions,
        PeopleOptions,
        write_human_capture,
        write_people,
    )
    from dyngs.io.outputs import require_new_folder

    scene = arguments.scene
    out: Path = arguments.out
    moving = {"views": "num_times", "cameras": "num_cameras", "style": "style"}
    options, names, preset = {
        "still": (synthetic.StaticOptions, {"views": "num_train"}, "static"),
        "human": (HumanOptions, {"views": "num_frames", "cameras": "num_cameras"}, "human"),
        "people": (
            PeopleOptions,
            {"views": "frames", "cameras": "cameras", "people": "people"},
            "gps",
        ),
    }.get(scene, (synthetic.DynamicOptions, moving, "dynamic"))
    names = {"size": "size", "seed": "seed", **names}
    given: dict[str, Any] = {}
    for option in ("size", "views", "cameras", "people", "style", "seed"):
        value = getattr(arguments, option)
        if value is not None and option not in names:
            raise DyngsError(f"--{option} does not apply to the scene {scene}; remove it")
        if value is not None:
            given[names[option]] = value
    if scene == "people":
        with ProgressBar() as report:
            write_people(out, options(**given), report)
    else:
        require_new_folder(out)
        if scene == "still":
            synthetic.write_static_capture(out, options(**given))
        elif scene == "human":
            write_human_capture(out, options(**given))
        else:
            usual = "fixed" if "num_cameras" in given else None
            synthetic.write_dynamic_capture(scene, out, options(**{"style": usual} | given))
    print(f"written: {out}\nnext:    dyngs train {preset} {quote_path(out)}")
    return 0


def run_scans(arguments: argparse.Namespace) -> int:
    """Write the captures and print the command that trains on them."""
    from dyngs.human.synthetic.capture import PeopleOptions
    from dyngs.human.synthetic.scans import write_scans

    out: Path = arguments.out
    options = PeopleOptions(size=arguments.size, cameras=arguments.cameras, seed=arguments.seed)
    with ProgressBar() as report:
        count = write_scans(arguments.folder, out, options, report)
    print(f"written: {out}, {format_count(count, 'capture')}")
    print(f"next:    dyngs train gps {quote_path(out)}")
    return 0
