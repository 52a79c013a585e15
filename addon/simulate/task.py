"""The child process of `fieldwork simulate`: builds the scene, photographs it, writes the surface."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..photograph.shoot import Lens, Shot, has_denoiser, photograph
from . import facade, fence, museum, vase
from .truth import write_truth

SCENES = {"museum": museum, "facade": facade, "fence": fence, "vase": vase}
ANGLE_OF_VIEW_FOCAL = 28 / 36  # focal length over sensor width: a 28 mm lens on full frame


def simulate(request: dict[str, Any], emit: Callable[..., None]) -> dict[str, Any]:
    """Render the views of `request["pending"]` (indices) into `request["folder"]`.

    Request: scene, seed, views, overviews (how many of them), size [w, h], samples, folder, truth (folder of the mesh), pending. Each finished view
    is told as {"kind": "view", "index": i}. The result holds everything that describes the capture.
    """
    module = SCENES[request["scene"]]
    emit(kind="stage", name="Building the scene")
    scene = module.build(request["seed"])
    whole = request.get("overviews", 0)
    poses = module.poses(request["views"] - whole, request["seed"]) + module.overviews(whole, request["seed"])
    width, height = request["size"]
    lens = Lens(width, height, ANGLE_OF_VIEW_FOCAL * max(width, height))
    truth = Path(request["truth"])
    if not (truth / "mesh.ply").is_file():
        truth.mkdir(parents=True, exist_ok=True)
        write_truth(scene, truth)
    emit(kind="stage", name="Photographing")
    pending = request["pending"]
    photograph(
        scene,
        [Shot(f"{index:04d}", poses[index], lens) for index in pending],
        Path(request["folder"]),
        samples=request["samples"],
        progress=lambda order, shot: emit(kind="view", index=pending[order]),
    )
    return {
        "camera_to_world": [pose.tolist() for pose in poses],
        "intrinsics": lens.intrinsics(),
        "classes": {
            str(number): {"name": name, "color": module.COLORS[number]} for number, name in module.CLASSES.items()
        },
        "denoised": has_denoiser(),
    }
