"""Joints of other skeletons matched to those of SMPL-X, by the names that common programs give them."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from dyngs.errors import DyngsError
from dyngs.human.template.joints import JOINT_NAMES

_OURS = (
    "pelvis spine1 spine2 spine3 neck head *_collar *_shoulder *_elbow *_wrist *_hip *_knee *_ankle *_foot "
    "*_index# *_middle# *_pinky# *_ring# *_thumb# jaw *_eye"
)
"""Names of SMPL-X; ``*`` stands for left and right, ``#`` for 1, 2 and 3."""


@dataclass(frozen=True)
class Rig:
    """The joint names of one kind of skeleton, in lower case and without punctuation.

    Attributes:
        name: of the program or data set.
        sides: text for ``*``: left and right.
        words: a name for each word of ``_OURS``; ``a|b`` is a or b, ``-`` none. Words at the end may be missing.
        segments: text for ``#``.
    """

    name: str
    sides: tuple[str, str]
    words: str
    segments: tuple[str, str, str] = ("1", "2", "3")

    def joints(self) -> Iterator[tuple[str, tuple[str, ...]]]:
        """Yield each joint of SMPL-X with the names that it may have here."""
        for ours, theirs in zip(_OURS.split(), self.words.split(), strict=False):
            for our_side, side in zip(("left", "right"), self.sides, strict=True) if "*" in ours else [("", "")]:
                for i, segment in enumerate(self.segments, 1) if "#" in ours else [("", "")]:
                    names = theirs.replace("*", side).replace("#", segment).split("|")
                    yield ours.replace("*", our_side).replace("#", str(i)), tuple(names)


_MIXAMO_LIMBS = "*shoulder *arm *forearm *hand *upleg *leg *foot *toebase|*toe"
RIGS = (
    Rig(
        "SMPL-X",
        ("left", "right"),
        "pelvis spine1 spine2 spine3 neck head *collar *shoulder *elbow *wrist *hip *knee *ankle *foot "
        "*index# *middle# *pinky# *ring# *thumb# jaw *eye|*eyesmplhf",
    ),
    Rig(
        "SMPL",
        ("l", "r"),
        "pelvis spine1 spine2 spine3 neck head *collar *shoulder *elbow *wrist *hip *knee *ankle *foot|*toe",
    ),
    Rig(
        "Mixamo",
        ("left", "right"),
        f"hips spine spine1 spine4|spine3|spine2 neck head {_MIXAMO_LIMBS} "
        "*handindex# *handmiddle# *handpinky# *handring# *handthumb#",
    ),
    Rig(
        "VRM",
        ("left", "right"),
        "hips spine chest upperchest neck head *shoulder *upperarm *lowerarm *hand *upperleg *lowerleg *foot *toes "
        "*index# *middle# *little# *ring# *thumb# jaw *eye",
        ("proximal", "intermediate", "distal"),
    ),
    Rig(
        "VRoid",
        ("l", "r"),
        "chips cspine cchest cupperchest cneck chead *shoulder *upperarm *lowerarm *hand *upperleg *lowerleg *foot "
        "*toebase *index# *middle# *little# *ring# *thumb#",
    ),
    Rig("CMU", ("left", "right"), f"hips lowerback spine spine1 neck head {_MIXAMO_LIMBS}"),
    Rig(
        "Poser",
        ("left", "right"),
        "hips chest chest2 chest4|chest3 neck head *collar *shoulder *elbow *wrist *hip *knee *ankle *toe",
    ),
    Rig(
        "DAZ",
        ("l", "r"),
        "hip abdomen chest - neck head *collar *shldr *forearm *hand *thigh *shin *foot *toe "
        "*index# *mid# *pinky# *ring# *thumb#",
    ),
    Rig(
        "Biped",
        ("l", "r"),
        "pelvis spine spine1 spine2 neck head *clavicle *upperarm *forearm *hand *thigh *calf *foot *toe0 "
        "*finger1# *finger2# *finger4# *finger3# *finger0#",
        ("", "1", "2"),
    ),
    Rig(
        "Unreal",
        ("l", "r"),
        "pelvis spine01 spine02 spine05|spine04|spine03 neck01 head "
        "clavicle* upperarm* lowerarm* hand* thigh* calf* foot* ball* index#* middle#* pinky#* ring#* thumb#*",
        ("01", "02", "03"),
    ),
    Rig(
        "MakeHuman",
        ("l", "r"),
        "hips spine1 spine2 spine3 neck head clavicle* uparm* loarm* hand* upleg* loleg* foot* toe* "
        "index#* middle#* pinky#* ring#* thumb#*",
    ),
    Rig(
        "Anny",
        ("l", "r"),
        "root spine04 spine03 spine02 neck01 head "
        "clavicle* upperarm01* lowerarm01* wrist* upperleg01* lowerleg01* foot* toe11* "
        "finger2#* finger3#* finger5#* finger4#* finger1#*",
    ),
)
"""Rocketbox avatars use Biped, VALID avatars Mixamo, the cgspeed conversions of CMU either CMU or DAZ."""

_NEEDED = (
    "pelvis",
    *(f"{side}_{x}" for x in ("hip", "knee", "ankle", "shoulder", "elbow") for side in ("left", "right")),
)


def match_joints(path: Path, names: Sequence[str]) -> dict[str, int]:
    """Return the joints of SMPL-X that a skeleton with these joint names has, with their indices in ``names``.

    Case, punctuation and a prefix before the name of the pelvis (``mixamorig:``, ``Bip01``) do not matter. The rig that
    matches most joints of the body is chosen.

    Raises:
        DyngsError: the pelvis, a leg or an arm is missing; names the joint and the file ``path``.
    """
    plain = [re.sub(r"[^a-z0-9]", "", name.lower()) for name in names]
    best: dict[str, int] = {}
    best_rig, best_rank = RIGS[0], (-1, -1)
    for rig in RIGS:
        wanted = dict(rig.joints())
        for prefix in _prefixes(plain, wanted["pelvis"]):
            found = _found(wanted, {x.removeprefix(prefix): i for i, x in reversed([*enumerate(plain)])})
            rank = (sum(name in found for name in _NEEDED), sum(name in found for name in JOINT_NAMES[:22]))
            if rank > best_rank:
                best, best_rig, best_rank = found, rig, rank
    wanted = dict(best_rig.joints())
    missing = [" or ".join(wanted[name]) for name in _NEEDED if name not in best]
    if missing:
        known = ", ".join(rig.name for rig in RIGS)
        raise DyngsError(
            f"{path}: unknown joint names; compared with {best_rig.name}, the most similar rig, it lacks "
            f"{', '.join(missing)}; rename its joints (known rigs: {known})"
        )
    return best


def _prefixes(names: list[str], pelvis: tuple[str, ...]) -> list[str]:
    """Return at most four distinct prefixes of a name of the pelvis, the empty one first."""
    found = [name.removesuffix(end) for name in names for end in pelvis if name.endswith(end)]
    return list(dict.fromkeys(["", *found]))[:4]


def _found(wanted: dict[str, tuple[str, ...]], there: dict[str, int]) -> dict[str, int]:
    """Return the index of the first name that is present, for each joint that has one."""
    hits = {ours: [there[name] for name in names if name in there] for ours, names in wanted.items()}
    return {ours: indices[0] for ours, indices in hits.items() if indices}
