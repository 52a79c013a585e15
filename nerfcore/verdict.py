"""What a stage's own figures say of its result: good, weak or failed, in sentences that name a way out.

The limits are not tuned: they tell scraps from surfaces, not good from better.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

LEVELS = ("good", "weak", "failed")
UNRECOGNISABLE, POOR = 12.0, 18.0  # dB; a picture of one colour, the photo's mean, has about 12
STILL_RISING = 1.0  # dB over the second half of the steps
UNSEEN = 6.0  # dB that photos held out may be worse than those trained on
THIN, EMPTY = 0.6, 0.2  # mean opacity of renders of opaque photos
NOTHING = 0.01  # mean opacity of renders before an environment
FLAT = 1.02  # 95th percentile of depth over the 5th
MISSED, PARTLY = 0.02, 0.1  # share of the photos' pixels that show the mesh
SOLID, HALF_GONE = 0.9, 0.5  # share of the pixels that show something near with detail which hit the mesh
MANY_FEW = 0.5  # of what is missing that fewer than three photos may show, before photos are asked for first
MANY_GUESSED = 0.1  # share of the area that closes gaps by a guess, from which on the user is told
MUCH_DENIED = 0.15  # share of the area that photos disagree on, from which on a mesh lacks much; not tuned
HOLES = 0.02  # share of what the mesh fills in pictures that is holes
LITTLE_IN_ONE = 0.5  # share of the area that the largest part has
FEW_LABELS_RIGHT = 0.3  # mIoU
FEW_COMPARED = 3  # photos held out, below which figures are those of single photos
PLACED, HALF = 0.9, 0.5  # share of the photos with a pose
# Share of pairs of photos, and two of them at least: 0.016 and more of a folded can, 0.013 and more of a nave, 0 of others.
# docs/experiments.md, “Which pairs contradict poses”
CONTRADICTING = 0.005

Verdict = dict[str, Any]  # {"level": one of LEVELS, "reasons": [sentences]}


def verdict(findings: Sequence[tuple[str, str]]) -> Verdict:
    """The worst level of (level, sentence) findings, and their sentences, worst first."""
    ordered = sorted(findings, key=lambda finding: -LEVELS.index(finding[0]))
    return {"level": ordered[0][0] if ordered else "good", "reasons": [text for _, text in ordered]}


def poses_verdict(registered: int, total: int, matching: Sequence[tuple[str, int, int]] = ()) -> Verdict:
    """Of `poses`: how many of the photos have one, and whether what matches agrees with them.

    Args:
        matching: of each photo with a pose its name, the number of photos that it matches, and of those whose matches
            contradict the poses of both.
    """
    findings = []
    share = registered / max(total, 1)
    if share < PLACED:
        text = f"Only {registered} of {total} photos have a pose: add photos between those that do not overlap."
        findings.append(("failed" if share < HALF else "weak", text))
    pairs, wrong = sum(mates for _, mates, _ in matching) // 2, sum(bad for *_, bad in matching) // 2
    if wrong > max(1, CONTRADICTING * pairs):
        most = sorted((photo for photo in matching if photo[2]), key=lambda photo: -photo[2])[:4]
        findings.append(
            (
                "weak",
                f"{wrong} of {pairs} pairs of photos match but contradict their poses, most often those of "
                f"{', '.join(name for name, *_ in most)}: parts that look alike were taken for the same, so that photos "
                "stand where others do. Add photos between those, so that neighbours overlap by two thirds, or put "
                "something beside one of the alike parts.",
            )
        )
    return verdict(findings)


def train_verdict(result: Mapping[str, Any], curve: Sequence[Mapping[str, float]], warmup: int, steps: int) -> Verdict:
    """Of `train`: its length and its curve.

    Args:
        result: what `train` returns. curve: "step" and "psnr" in the course of training.
        warmup: steps until the occupancy grid is known. steps: of a training without limits.
    """
    done, psnr = result["steps"], result["psnr_train"]
    each = result["seconds"] / max(done, 1)
    if done < warmup:
        text = (
            f"Only {done} steps were trained; a field takes shape after {warmup} (about {_duration(each * warmup)} here), and "
            f"the settings plan {steps} (about {_duration(each * steps)}): raise the limit of time or steps, or choose "
            "smaller images (setting scene.image_size)."
        )
        return verdict([("failed", text)])
    found = []
    if psnr is None or psnr < UNRECOGNISABLE:
        text = f"Renders of the training photos do not resemble them ({psnr} dB): look at poses and masks."
        found.append(("failed", text))
    elif psnr < POOR:
        found.append(
            ("weak", f"Renders of the training photos are coarse ({psnr:.1f} dB): train longer, look at poses.")
        )
    rise = _rise(curve)
    if rise > STILL_RISING and done < steps:
        text = (
            f"Training ended while it still improved ({rise:.1f} dB over its second half): twice as long takes about "
            f"{_duration(each * done)} more here (resume it with a higher limit of time or steps)."
        )
        found.append(("weak", text))
    return verdict(found)


def evaluate_verdict(
    result: Mapping[str, Any], psnr_train: float | None, opaque: bool, labelled: bool, environment: bool = False
) -> Verdict:
    """Of `evaluate`: photos held out against those trained on, opacity, depth, labels.

    Args:
        result: what `evaluate` returns; "opacity" is the mean of the renders, "depth_spread" the 95th percentile of
            their depths over the 5th, "images" how many photos were compared.
        opaque: whether the field must fill the frames: no masks, no transparency, no environment behind it.
        environment: whether there is one, which shows what the field does not.
    """
    found, psnr = [], result["psnr"]
    if psnr < UNRECOGNISABLE:
        found.append(
            ("failed", f"Renders do not resemble the photos ({psnr:.1f} dB): train longer, look at the poses.")
        )
    elif result["split"] == "test" and psnr_train is not None and psnr < psnr_train - UNSEEN:
        text = (
            f"Photos held out are {psnr_train - psnr:.1f} dB worse than those trained on: too few photos from too few "
            "places, or wrong poses."
        )
        found.append(("weak", text))
    compared = result.get("images")
    if result["split"] == "test" and compared is not None and compared < FEW_COMPARED:
        photos = "one photo was" if compared == 1 else f"{compared} photos were"
        text = f"Only {photos} compared, which says little of others: hold out more photos, or give more time."
        found.append(("good", text))
    opacity = result.get("opacity")
    if opaque and opacity is not None and opacity < THIN:
        text = f"The field is fog: renders are {opacity:.0%} opaque. Train longer, or look at the poses."
        found.append(("failed" if opacity < EMPTY else "weak", text))
    if environment and opacity is not None and opacity < NOTHING:
        text = f"The field is empty: all that renders show lies at infinity ({opacity:.1%} opaque). Look at the poses."
        found.append(("failed", text))
    spread = result.get("depth_spread")
    if spread is not None and spread < FLAT:
        found.append(("weak", "The depths of renders hardly differ: the field may be a picture before each camera."))
    if labelled and result["miou"] is not None and result["miou"] < FEW_LABELS_RIGHT:
        text = f"Classes are mostly wrong (mIoU {result['miou']:.2f}): label more photos, and check that labels agree."
        found.append(("weak", text))
    return verdict(found)


def mesh_verdict(
    hit: float | None,
    solid: float | None = None,
    holes: float = 0.0,
    largest: float = 1.0,
    overlapped: float | None = None,
    few: float = 0.0,
    guessed: float | None = 0.0,
    denied: float = 0.0,
) -> Verdict:
    """Of `mesh`.

    Args:
        hit: share of the photos' pixels that show it; None where `solid` says how much of the region is there.
        solid, holes, overlapped, few: shares as `mesh.coverage.Coverage` has them.
        largest: share of the area that its largest connected part has. guessed: share of it that closes gaps; None: nobody
            asked for that. denied: share of the area that was left out, as photos disagree on it.
    """
    found = []
    hint = "" if guessed is not None else " Small gaps can be closed by a guess (“close gaps”)."
    if hit is not None and (hit < MISSED or (solid is None and hit < PARTLY)):
        text = (
            f"The mesh fills {hit:.1%} of the photos: the rest of what they show is missing. Train longer, or enlarge the "
            "region (“photos” takes in all they show)."
        )
        found.append(("failed" if hit < MISSED else "weak", text))
    elif solid is not None and solid < SOLID:
        text = f"Of what the photos show near, {1 - solid:.0%} is missing in the mesh"
        if overlapped is not None and overlapped >= SOLID:
            text += f", and {few:.0%} is in fewer than three photos: take more photos of that, from other places."
        elif few > MANY_FEW * (1 - solid):
            text += f", and {few:.0%} is in fewer than three photos: take more photos of that, and train longer."
        else:
            text += ". Train longer, add photos of what is missing, or enlarge the region."
        found.append(("failed" if solid < HALF_GONE else "weak", text + hint))
    if holes > HOLES:
        text = f"The mesh has holes: {holes:.0%} of it in the photos. Train longer, or add photos."
        found.append(("weak", text + hint))
    if denied > MUCH_DENIED:
        text = (
            f"The photos disagree on {denied:.0%} of the surface that the field shows, so that part is left out: take photos of "
            "it from nearer or from a steeper angle, or train longer."
        )
        found.append(("weak", text))
    if guessed is not None and guessed > MANY_GUESSED:
        found.append(
            ("weak", f"Of the mesh's area, {guessed:.0%} closes gaps by a guess: train longer, or add photos of that.")
        )
    if largest < LITTLE_IN_ONE:
        text = (
            f"The mesh is in pieces, the largest with {largest:.0%} of the area: more photos or training may join them."
        )
        found.append(("weak", text))
    return verdict(found)


def worst(verdicts: Mapping[str, Verdict | None]) -> Verdict:
    """The verdict on a chain of stages, by verb; sentences begin with the verb."""
    found = [
        (each["level"], f"{verb}: {reason}") for verb, each in verdicts.items() if each for reason in each["reasons"]
    ]
    return verdict(found)


def _rise(curve: Sequence[Mapping[str, float]]) -> float:
    """PSNR gained over the second half of the steps: mean of the last tenth against that about the middle."""
    if len(curve) < 10:
        return 0.0
    step, psnr = np.array([row["step"] for row in curve]), np.array([row["psnr"] for row in curve])
    share = step / step[-1]
    middle = psnr[(share > 0.45) & (share < 0.55)]
    return float(psnr[share > 0.9].mean() - middle.mean()) if len(middle) else 0.0


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
