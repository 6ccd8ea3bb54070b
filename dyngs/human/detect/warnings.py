"""What will be bad about a person in a clip, said before anything is fitted.

Local letters: F images of one camera in order of time.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from dyngs.core.errors import counted
from dyngs.human.detect.detector import SURE, Detection

OFTEN = 0.1  # fraction of the images from which on something is said
SMALL = 120.0  # height of a person below which an avatar has little to learn from, px
# sharpness, as a fraction of the clip's median, below which an image is called blurred
BLURRED = 0.3
# width of the shoulders, of the person's height, from which on they are seen from the front or
# behind
FACING = 0.1
_SHOULDERS = (5, 6)
_ANKLES = (15, 16)


def warnings_of(
    images: np.ndarray,
    person: Sequence[Detection | None],
    others: Sequence[Sequence[Detection | None]],
    *,
    alone: bool = True,
) -> list[str]:
    """Return lines on what will be bad.

    Args:
        images: (F, H, W, 3) uint8.
        person: their detection in each image.
        others: the same of the other people.
        alone: there is no other camera.
    """
    seen = [(image, x) for image, x in zip(images, person, strict=True) if x is not None]
    detections = [x for _, x in seen]
    count = len(images)
    beside = sum(any(other[row] is not None for other in others) for row in range(count))
    height = float(np.median([x.height for x in detections]))
    cut = sum(_is_cut_off(x, images.shape[1]) for x in detections)
    sharp = np.array([_sharpness(image, x) for image, x in seen])
    blurred = int((sharp < BLURRED * np.median(sharp)).sum())
    found = {
        f"other people in {beside} of {counted(count, 'image')}; --person 2 takes the next one": beside
        > OFTEN * count,
        f"nobody is found in {count - len(seen)} of {counted(count, 'image')}; these are left out": len(
            seen
        )
        < count,
        f"the feet are cut off or hidden in {cut} of {counted(len(seen), 'image')}; legs will be a guess there": cut
        > OFTEN * len(seen),
        f"the person is {height:.0f} px high; come nearer or record larger images": height < SMALL,
        f"{counted(blurred, 'image')} blurred; more light, or slower motion, helps": blurred
        > OFTEN * len(seen),
        "the person never turns around: what the camera never sees will be a guess": alone
        and not _turns(detections),
    }
    return [line for line, holds in found.items() if holds]


def _is_cut_off(person: Detection, height: int) -> bool:
    ankles = person.keypoints[list(_ANKLES)]
    return bool(
        (ankles[:, 2] < SURE).all()
        or (ankles[:, 1] > height - 2).any()
        or person.box[3] > height - 1.5
    )


def _sharpness(image: np.ndarray, person: Detection) -> float:
    """Return the spread of the Laplacian over that of the grey levels in the person's box."""
    left, top, right, bottom = (max(round(float(edge)), 0) for edge in person.box)
    grey = image[top:bottom, left:right].astype(np.float32).mean(-1)
    return float(ndimage.laplace(grey).std() / max(float(grey.std()), 1.0)) if grey.size else 0.0


def _turns(people: Sequence[Detection]) -> bool:
    """Whether the person is seen from the front and from behind: the left shoulder right of the
    right one, and left."""
    left, right = (np.array([x.keypoints[row] for x in people]) for row in _SHOULDERS)
    sure = (left[:, 2] > SURE) & (right[:, 2] > SURE)
    across = (left[sure, 0] - right[sure, 0]) / np.array([max(x.height, 1.0) for x in people])[sure]
    return bool((across > FACING).any() and (across < -FACING).any())
