"""Runs MediaPipe's pose detector; executed by the interpreter of an environment without dyngs.

    PYTHON -I mediapipe_worker.py IMAGES OUT

IMAGES is a folder of PNG files. For each image with a person, ``NAME.npz`` is
written to the folder OUT with ``landmarks`` (33, 3): column, row (px) and visibility;
``positions`` (33, 3): relative to the hips, m, x right, y down, z away from the camera; and
``mask`` (H, W) uint8.
"""

import importlib
import sys
from pathlib import Path

NO_MEDIAPIPE = 3  # exit status


def main() -> int:
    """Detect the person in all images; return the exit status."""
    images = Path(sys.argv[1])
    out = Path(sys.argv[2])
    try:
        np = importlib.import_module("numpy")
        cv2 = importlib.import_module("cv2")
        solutions = importlib.import_module("mediapipe").solutions
    except (ImportError, AttributeError) as error:
        print(error, file=sys.stderr)
        return NO_MEDIAPIPE
    with solutions.pose.Pose(
        static_image_mode=True, model_complexity=1, enable_segmentation=True
    ) as pose:
        for path in sorted(images.glob("*.png")):
            rgb = np.ascontiguousarray(cv2.imread(str(path))[..., ::-1])
            result = pose.process(rgb)
            if result.pose_landmarks is None or result.segmentation_mask is None:
                continue
            height, width = rgb.shape[:2]
            rows = [
                (x.x * width, x.y * height, x.visibility) for x in result.pose_landmarks.landmark
            ]
            positions = [(x.x, x.y, x.z) for x in result.pose_world_landmarks.landmark]
            mask = (np.clip(result.segmentation_mask, 0, 1) * 255).round().astype(np.uint8)
            np.savez_compressed(
                out / f"{path.stem}.npz",
                landmarks=np.array(rows, np.float32),
                positions=np.array(positions, np.float32),
                mask=mask,
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
