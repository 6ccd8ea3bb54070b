"""Runs MediaPipe's pose detector; started with the interpreter of MediaPipe's own environment,
which lacks dyngs.

    PYTHON -I mediapipe_worker.py IMAGES OUT

IMAGES is a folder of PNG files in order of time, OUT a folder to which ``NAME.npz`` is written for
each image in which somebody is found: ``landmarks`` (33, 3), column and row in pixels, and
visibility; ``mask`` (H, W) uint8.
"""

import importlib
import sys
from pathlib import Path

NO_MEDIAPIPE = 3  # exit status


def main() -> int:
    """Detect."""
    images = Path(sys.argv[1])
    out = Path(sys.argv[2])
    try:
        np = importlib.import_module("numpy")
        cv2 = importlib.import_module("cv2")
        solutions = importlib.import_module("mediapipe").solutions
    except (ImportError, AttributeError) as error:
        print(error, file=sys.stderr)
        return NO_MEDIAPIPE
    with solutions.pose.Pose(model_complexity=1, enable_segmentation=True) as pose:
        for path in sorted(images.glob("*.png")):
            rgb = np.ascontiguousarray(cv2.imread(str(path))[..., ::-1])
            found = pose.process(rgb)
            if found.pose_landmarks is None or found.segmentation_mask is None:
                continue
            height, width = rgb.shape[:2]
            rows = [
                (x.x * width, x.y * height, x.visibility) for x in found.pose_landmarks.landmark
            ]
            mask = (np.clip(found.segmentation_mask, 0, 1) * 255).round().astype(np.uint8)
            np.savez_compressed(
                out / f"{path.stem}.npz", landmarks=np.array(rows, np.float32), mask=mask
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
