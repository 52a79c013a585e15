"""The verb `simulate`: a scene built and photographed in Blender, saved as a photographer's capture with the truth.

OUT/photos/*.jpg            ordinary JPEGs with EXIF
OUT/labels/*.png            uint8 class ids, 0 where there is nothing
OUT/depth/*.exr             float32 metres along the viewing axis, 0 where there is nothing
OUT/classes.json            names and colours of the ids
OUT/ground_truth/           transforms.json (camera-to-world, OpenGL axes, z up), mesh.ply and mesh.npz
OUT/simulate.json           the settings, for resuming
"""

from __future__ import annotations

import json
import shutil
import time
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from PIL.ExifTags import IFD, Base

from ..errors import BlenderError, SettingError
from ..files import atomic_path, write_json
from ..images.encode import write_depth
from ..params import SimulateParams
from ..progress import Reporter
from .folder import claim_folder
from .process import run_in_blender

SCENES = ("museum", "facade", "fence", "vase")
SETTINGS = "simulate.json"
START = datetime(2026, 5, 18, 10, 0, 0)
FOCAL_MM = 28.0  # of a 36 mm wide sensor, noted in the photos' EXIF


def simulate(params: SimulateParams, report: Reporter) -> dict[str, Any]:
    """Build the scene, take the photos that are not there yet, and return {"images", "classes", "seconds"}.

    Raises:
        SettingError: there is no scene of that name, or the size is impossible.
        InputError: the folder holds a capture simulated with other settings.
        BlenderError: Blender is missing or failed.
    """
    started = time.monotonic()
    if params.scene not in SCENES:
        raise SettingError(f"There is no scene {params.scene!r}.", f"Choose one of: {', '.join(SCENES)}.")
    if not all(16 <= side <= 8192 for side in params.size):
        raise SettingError(f"Photos of {params.size[0]}×{params.size[1]} pixels cannot be made.", "Use 16 to 8192.")
    if params.overviews > params.views - 4:
        raise SettingError(
            f"{params.overviews} of {params.views} photos cannot show the whole.",
            "At least 4 have to be taken close by.",
        )
    out = params.out.absolute()
    # Without overviews a capture stays the one that it was before there were any.
    settings = params.model_dump(mode="json", exclude={"out"} if params.overviews else {"out", "overviews"})
    claim_folder(out, SETTINGS, settings, ["photos", "labels", "depth", "ground_truth"])
    pending = [index for index in range(params.views) if not _is_finished(out, index)]
    raw = out / ".raw"
    done = params.views - len(pending)

    def on_event(event: dict[str, Any]) -> None:
        nonlocal done
        if event.get("kind") != "view":
            return
        _develop(out, raw, event["index"])
        done += 1
        report.progress(done / params.views, f"{done} of {params.views} photos")
        report.event("preview", path=str(_photo(out, event["index"])))

    truth = out / "ground_truth"
    if pending or not (truth / "transforms.json").is_file():
        request = {**settings, "folder": str(raw), "truth": str(truth), "pending": pending}
        try:
            described = run_in_blender("simulate", request, report, on_event)
        finally:
            shutil.rmtree(raw, ignore_errors=True)
        missing = [index for index in range(params.views) if not _is_finished(out, index)]
        if missing:
            raise BlenderError(f"Blender did not deliver photo {missing[0]}.", "Run it again.")
        _describe(out, described)
        if not described["denoised"]:
            report.warn("This Blender has no OpenImageDenoise: the photos are noisier than they could be.")
    classes = json.loads((out / "classes.json").read_text("utf-8"))["classes"]
    return {
        "images": params.views,
        "classes": [entry["name"] for entry in classes.values()],
        "seconds": round(time.monotonic() - started, 1),
    }


def _stem(index: int) -> str:
    return f"IMG_{index + 1:04d}"


def _photo(out: Path, index: int) -> Path:
    return out / "photos" / f"{_stem(index)}.jpg"


def _is_finished(out: Path, index: int) -> bool:
    """The photo is written last, so that its presence means that the view is complete."""
    return _photo(out, index).is_file()


def _develop(out: Path, raw: Path, index: int) -> None:
    """Turn Blender's files of one view into the photographer's, and remove them."""
    source = raw / f"{index:04d}"
    depth = np.load(source.with_suffix(".depth.npy"), allow_pickle=False)
    write_depth(out / "depth" / f"{_stem(index)}.exr", depth)
    with atomic_path(out / "labels" / f"{_stem(index)}.png") as temporary:
        shutil.copyfile(source.with_suffix(".label.png"), temporary)
    with atomic_path(_photo(out, index)) as temporary, Image.open(source.with_suffix(".png")) as picture:
        picture.convert("RGB").save(temporary, "JPEG", quality=95, subsampling=0, exif=exif(index))
    for suffix in (".depth.npy", ".label.png", ".png"):
        source.with_suffix(suffix).unlink()


def exif(index: int) -> Image.Exif:
    """What a camera would note: maker, model, upright, focal length, exposure, and a photo every 7 seconds."""
    taken = (START + timedelta(seconds=7 * index)).strftime("%Y:%m:%d %H:%M:%S")
    data = Image.Exif()
    data[Base.Make], data[Base.Model], data[Base.Software] = "Fieldwork", "Simulated 28mm", "Fieldwork"
    data[Base.Orientation], data[Base.DateTime] = 1, taken
    detail = data.get_ifd(IFD.Exif)
    detail[Base.DateTimeOriginal] = detail[Base.DateTimeDigitized] = taken
    detail[Base.FocalLength], detail[Base.FocalLengthIn35mmFilm] = FOCAL_MM, int(FOCAL_MM)
    detail[Base.ExposureTime], detail[Base.FNumber], detail[Base.ISOSpeedRatings] = 1 / 60, 8.0, 200
    return data


def _describe(out: Path, described: dict[str, Any]) -> None:
    frames = [
        {
            "file_path": f"../photos/{_stem(index)}.jpg",
            "label_path": f"../labels/{_stem(index)}.png",
            "depth_file_path": f"../depth/{_stem(index)}.exr",
            "transform_matrix": pose,
        }
        for index, pose in enumerate(described["camera_to_world"])
    ]
    intrinsics = {"camera_model": "OPENCV", "depth_unit_scale_factor": 1.0, **described["intrinsics"]}
    write_json(out / "ground_truth" / "transforms.json", {**intrinsics, "frames": frames})
    for folder in (out, out / "ground_truth"):  # beside the photos, and beside the posed data set
        write_json(folder / "classes.json", {"ignore_id": 0, "classes": described["classes"]})
