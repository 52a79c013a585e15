"""What to photograph next, from what the held-out photos showed: sentences for somebody who takes photos."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..data.box import looks_inward
from ..data.scene import Scene, View
from ..geometry.frames import focus_point

# Not tuned.
WORSE = 3.0  # dB below the median of the held-out photos, from which one is named
NAMED = 5  # photos at most
WIDE = 45.0  # degrees between neighbouring cameras around something
ALL_AROUND = 200.0  # degrees that cameras cover at least where they are meant to go all around
UNSEEN = 0.05  # share of a photo's ways that no training photo shows
FEW_PHOTOS = 20
RIGHT = 0.5  # IoU below which a class is named


def advice(
    scene: Scene, scores: Sequence[Mapping[str, Any]], per_class_iou: Mapping[str, float], rejected: int = 0
) -> list[str]:
    """Sentences on what to photograph or label next, the most useful first; none where nothing is amiss.

    Args:
        scores: of each held-out photo "name", "psnr" and, where it is known, "unknown": share of its rays' ways that no
            training photo shows.
        rejected: photos of the capture that were left out, blurred ones for instance; not second copies of others.
    """
    views = {view.name: view for view in scene.views}
    told = [*_bad_places(scores, views, [scene.views[i] for i in scene.train]), *_unseen(scores), *_gaps(scene)]
    if len(scene.train) < FEW_PHOTOS:
        told.append(
            f"Only {len(scene.train)} photos were trained on: {FEW_PHOTOS} and more, each overlapping the next by two "
            "thirds, show most things well."
        )
    if rejected > len(scene.views) / 4:
        told.append(
            f"{rejected} photos were left out (see “Photos left out”): take those places again, with a steady hand."
        )
    wrong = sorted((iou, name) for name, iou in per_class_iou.items() if iou < RIGHT)
    for iou, name in wrong[:NAMED]:
        told.append(
            f"The class “{name}” is mostly wrong (IoU {iou:.2f}): label it in more photos, or photograph it closer."
        )
    return told


def _bad_places(scores: Sequence[Mapping[str, Any]], views: Mapping[str, View], trained: Sequence[View]) -> list[str]:
    """Held-out photos far worse than most, each with how far the nearest trained ones are."""
    if len(scores) < 3:
        return []
    median = float(np.median([score["psnr"] for score in scores]))
    bad = sorted((score["psnr"], str(score["name"])) for score in scores if score["psnr"] < median - WORSE)
    told = []
    for psnr, name in bad[:NAMED]:
        near = _nearest(views[name], trained)
        between = f" between {near[0]} and {near[1]}" if len(near) == 2 else ""
        told.append(
            f"What {name} shows is {median - psnr:.0f} dB worse than most: take three to five more photos around its "
            f"place,{between} from slightly different sides."
        )
    return told


def _nearest(view: View, others: Sequence[View]) -> list[str]:
    """Names of the two photos taken nearest to one that look the same way."""
    same = [v for v in others if v.name != view.name and v.camera_to_world[:3, 2] @ view.camera_to_world[:3, 2] > 0.5]
    same.sort(key=lambda v: float(np.linalg.norm(v.camera_to_world[:3, 3] - view.camera_to_world[:3, 3])))
    return [v.name for v in same[:2]]


def _unseen(scores: Sequence[Mapping[str, Any]]) -> list[str]:
    """Held-out photos that look where no training photo does."""
    known = sorted(((s["unknown"], str(s["name"])) for s in scores if s.get("unknown") is not None), reverse=True)
    return [
        f"{share:.0%} of what {name} looks through is in no training photo: take photos that look there from other places."
        for share, name in known[:NAMED]
        if share > UNSEEN
    ]


def _gaps(scene: Scene) -> list[str]:
    """The widest gaps between neighbours, where cameras go around something (z is up); also photos that are held out were
    taken."""
    views = scene.views
    if len(views) < 4 or not looks_inward(views):
        return []
    focus = focus_point([view.camera_to_world for view in views])
    offset = np.stack([view.camera_to_world[:3, 3] - focus for view in views])
    angle = np.degrees(np.arctan2(offset[:, 1], offset[:, 0]))
    order = np.argsort(angle)
    steps = np.diff(np.append(angle[order], angle[order[0]] + 360))
    if 360 - steps.max() < ALL_AROUND:
        return []  # from one side on purpose
    told = []
    for place in np.argsort(-steps)[:2]:
        if steps[place] > WIDE:
            first, second = (views[order[i % len(order)]].name for i in (place, place + 1))
            told.append(
                f"Between {first} and {second} nobody photographed for {steps[place]:.0f}° around the subject: close the "
                "gap with a photo every 10 to 15°."
            )
    return told
