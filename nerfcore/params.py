"""The parameters of every verb: one typed model each, shared by the command line, JSON-RPC and the panels.

Imports nothing heavy. The verbs themselves are listed in `verbs.py`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from .files import is_text, name_problem, printable

# Bounds that only mistakes go beyond.
LARGEST_PICTURE = 32768  # pixels on a side
MANY = 1_000_000  # photos, frames
LONGEST_RUN = 1_000_000_000  # steps or seconds

MASK_MODE = (
    "what black mask pixels mean; default: empty where masks cut an object out of nearly all photos, else ignore"
)

Preset = Literal["draft", "standard", "high"]
Split = Literal["none", "classes", "instances"]
Pass = Literal["rgb", "depth", "semantic", "confidence", "normal", "unknown"]


def _leaves_some(every: int) -> int:
    if every == 1:
        raise ValueError("1 would hold out every photo; give 0 for none, or 2 and more")
    return every


Holdout = Annotated[
    int,
    Field(
        ge=0,
        le=MANY,
        description="every so many photos, one is held out for `evaluate`; 0: all are trained on, for a final field",
    ),
    AfterValidator(_leaves_some),
]


def _checked_name(name: str) -> str:
    problem = name_problem(name)
    if problem:
        raise ValueError(problem)
    return name


RunName = Annotated[str, Field(description="name of the run"), AfterValidator(_checked_name)]


def _picture(size: tuple[int, int]) -> tuple[int, int]:
    if not all(1 <= side <= LARGEST_PICTURE for side in size):
        raise ValueError(f"{size[0]}x{size[1]} is no size of a picture: sides have 1 to {LARGEST_PICTURE} pixels")
    return size


PictureSize = Annotated[tuple[int, int], AfterValidator(_picture)]


class Params(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    @model_validator(mode="after")
    def _paths_are_text(self) -> Self:
        """project.json and what is printed are UTF-8: a path of other bytes could be read and never written down."""
        for name in type(self).model_fields:
            path = getattr(self, name)
            if isinstance(path, Path) and not is_text(str(path)):
                raise ValueError(f"the path {printable(str(path))} is not UTF-8: rename it")
        return self


class DoctorParams(Params):
    pass


class SimulateParams(Params):
    out: Path = Field(description="folder to write the simulated capture to")
    scene: str = Field(
        default="museum",
        description="built-in scene: museum (exhibits in a room), facade (weathered stone outdoors), fence (thin things: "
        "wire, leaves, a sign) or vase (closed bodies on a table)",
    )
    views: int = Field(default=48, ge=4, le=MANY, description="number of photos")
    size: PictureSize = Field(default=(480, 320), description="photo width and height in pixels")
    seed: int = Field(default=0, ge=0, le=MANY, description="seed of the scene and of the camera path")
    samples: int = Field(default=4, ge=1, le=65536, description="Cycles samples per pixel")


class DatasetParams(Params):
    blend: Path = Field(description=".blend file whose active scene is photographed")
    out: Path = Field(description="folder to write the data set to")
    path: Literal["sphere", "hemisphere", "camera", "curve"] = Field(
        default="hemisphere",
        description="where the photos are taken from: around the scene, the scene's animated camera, a curve",
    )
    views: int = Field(
        default=100, ge=1, le=MANY, description="number of photos (camera: at most; spread over the frame range)"
    )
    center: tuple[float, float, float] | None = Field(
        default=None, description="what is looked at; default: the scene's middle"
    )
    radius: float | None = Field(
        default=None, gt=0, le=1e9, description="distance from it; default: so that all is in the picture"
    )
    curve: str | None = Field(default=None, description="name of the curve object, for path=curve")
    size: PictureSize | None = Field(default=None, description="photo width and height in pixels; default: the scene's")
    samples: int = Field(default=32, ge=1, le=65536, description="Cycles samples per pixel")
    labels: Literal["material", "object", "collection", "none"] = Field(
        default="material",
        description="what tells classes apart: pass index (or name) of materials or objects, or collections",
    )
    depth: bool = Field(default=True, description="write depth maps")
    transparent: bool = Field(
        default=False, description="alpha 0 where there is nothing, instead of the world's background"
    )


class NewParams(Params):
    project: Path
    photos: Path = Field(description="folder of photos, or a video file")
    labels: Path | None = Field(
        default=None,
        description="folder of label maps (or .npy, .npz, .exr probability maps) named like the photos; "
        "confidence/ in it may hold grey maps of how sure they are",
    )
    masks: Path | None = Field(default=None, description="folder of foreground masks named like the photos")
    classes: Path | None = Field(default=None, description="classes.json: names of the label ids")
    mask_mode: Literal["ignore", "empty"] | None = Field(default=None, description=MASK_MODE)
    max_size: int = Field(
        default=1600, ge=64, le=LARGEST_PICTURE, description="long side of the working copies in pixels"
    )
    frames: int = Field(default=80, ge=4, le=MANY, description="number of frames taken from a video")
    keep_blurry: bool = Field(default=False, description="use photos that look blurred too")
    add: bool = Field(default=False, description="add the photos to an existing project")


class ImportParams(Params):
    dataset: Path
    project: Path
    format: Literal[
        "auto",
        "transforms",
        "colmap",
        "llff",
        "scannet",
        "replica",
        "dtu",
        "strecha",
        "middlebury",
        "metashape",
        "realityscan",
        "meshroom",
    ] = "auto"
    mask_mode: Literal["ignore", "empty"] | None = Field(default=None, description=MASK_MODE)


class PosesParams(Params):
    project: Path
    preset: Literal["fast", "standard", "robust"] = "standard"
    restart: bool = Field(default=False, description="place all photos anew, also those that have a pose")
    group: int = Field(
        default=0,
        ge=0,
        le=MANY,
        description="where photos fall into separate groups: which to use, 0 being the largest",
    )


class AlignParams(Params):
    project: Path
    up: str | None = Field(default=None, description="direction that points up: x, -x, …, or three numbers a,b,c")
    scale: tuple[str, str, float] | None = Field(
        default=None, description="two points (x,y,z) or camera names, and their distance in metres"
    )
    gps: bool = Field(default=False, description="take scale and north from the photos' GPS positions")
    ground: bool = Field(default=False, description="level the ground and put it at z = 0")
    crop: str | None = Field(
        default=None, description="region of interest: auto, none, or x0,y0,z0,x1,y1,z1 in the aligned world"
    )


class ClassValues(Params):
    """One class; what is None stays as it is, or gets its default where the class is new."""

    id: int
    name: str
    color: tuple[float, float, float] | None = None  # sRGB in [0, 1]
    priority: float | None = Field(default=None, ge=0)


class ClassesParams(Params):
    project: Path
    classes: list[ClassValues] | None = Field(
        default=None, description="all classes the project shall have; None: list them"
    )
    file: Path | None = Field(
        default=None, description="classes.json with all classes the project shall have; none: list them"
    )


class RegionParams(Params):
    project: Path
    bounds: list[list[float]] | None = Field(
        default=None, description="region of interest x0 y0 z0 x1 y1 z1 in the aligned world"
    )
    clear: bool = Field(default=False, description="no region: everything is trained")


class TrainParams(Params):
    project: Path
    preset: Preset = "standard"
    run: RunName = "main"
    holdout: Holdout = 8
    time_limit: float | None = Field(default=None, gt=0, le=LONGEST_RUN, description="seconds of training")
    steps: int | None = Field(default=None, gt=0, le=LONGEST_RUN, description="optimisation steps")
    set: dict[str, str] = Field(default_factory=dict, description="settings by name, e.g. loss.semantic=0.1")
    resume: bool = False


class EvaluateParams(Params):
    project: Path
    run: RunName = "main"
    split: Literal["test", "train"] = "test"
    speed: bool = Field(default=False, description="measure frames of 800x800 too; on a CPU this can take minutes")
    baked: bool = Field(default=False, description="measure the baked field, and what it lost against the field")
    time_limit: float | None = Field(
        default=None, gt=0, le=LONGEST_RUN, description="seconds; as many photos, evenly spread, as fit: at least one"
    )


class BakeParams(Params):
    project: Path
    run: RunName = "main"
    memory: float = Field(
        default=100, ge=2, le=1500, description="megabytes of graphics memory that the baked field takes at most"
    )


class RenderParams(Params):
    project: Path
    out: Path
    run: RunName = "main"
    test: bool = Field(default=False, description="from the held-out photos")
    all: bool = Field(default=False, description="from every photo, also those of training")
    camera: Path | None = None
    orbit: int | None = Field(default=None, gt=0, le=MANY)
    size: PictureSize | None = Field(
        default=None, description="WxH; cut where a camera has other proportions (held-out and all photos: resampled)"
    )
    passes: list[Pass] = ["rgb", "depth", "semantic"]
    baked: bool = Field(default=False, description="from the baked field, which is faster, instead of the field")
    frame_range: tuple[int, int] | None = Field(
        default=None,
        description="first and last frame of these, counted from 0, to render only a part: several programs may render "
        "parts of one render at the same time, and a render of all keeps what they made",
    )

    @model_validator(mode="after")
    def _range_goes_up(self) -> Self:
        if self.frame_range is not None and not 0 <= self.frame_range[0] <= self.frame_range[1]:
            raise ValueError(f"frame_range: {self.frame_range[0]} to {self.frame_range[1]} is no range of frames")
        return self


class MeshParams(Params):
    project: Path
    run: RunName = "main"
    out: Path | None = None
    faces: int | None = Field(default=None, gt=0, le=1_000_000_000, description="target number of triangles")
    resolution: int = Field(default=512, ge=16, le=2048, description="cells along the longest side of the region")
    detail: float | None = Field(
        default=None,
        gt=0,
        le=1e9,
        description="side of a cell in millimetres, instead of resolution; needs a known scale",
    )
    region: str = Field(
        default="auto",
        description="where to look: auto (the region of interest, or what the photos show where there is none), photos "
        "(what they show), or x0,y0,z0,x1,y1,z1 in the aligned world",
    )
    texture: int | None = Field(
        default=None, ge=64, le=16384, description="texture size in pixels; none: vertex colours only"
    )
    watertight: bool = Field(
        default=False, description="close the surface: what no photo shows counts as inside, and its faces are marked"
    )
    texture_kind: Literal["photo", "field"] = Field(
        default="photo", description="what the texture shows: the photos, or the field's colours"
    )
    split: Split = Field(default="none", description="classes, instances: one object of each in the file of `out`")
    lods: int = Field(
        default=0, ge=0, le=6, description="levels of detail to write as well, each with a quarter of the triangles"
    )
    turntable: Path | None = Field(
        default=None, description="folder for pictures of the mesh from eight sides: its colours and its classes"
    )
    preview: bool = Field(
        default=False,
        description="only a first look, in seconds: exports/RUN/preview.npz; the mesh that is there stays",
    )


class MeasureParams(Params):
    project: Path
    run: RunName = "main"
    distances: Path | None = Field(
        default=None,
        description="table (.csv: name,from,to,metres,u_mm,use) of distances to measure; known ones scale or check",
    )
    scale_error: float | None = Field(
        default=None,
        ge=0,
        le=100,
        description="standard uncertainty of the scale in percent; default: by the distances, or how it was set",
    )
    caps: float = Field(
        default=0.1,
        ge=0,
        lt=1,
        description="share of its area that caps over openings may have of a thing with a volume",
    )


Side = Literal["top", "bottom", "front", "back", "left", "right"]
Turn = Annotated[
    float,
    Field(ge=-360, le=360, description="degrees about z from the world to the front that is drawn, for slanted fronts"),
]
PaperScale = Annotated[
    float | None, Field(gt=0, le=1e9, description="N of the scale 1:N on paper; default: the largest that fits on A3")
]


class PlanParams(Params):
    project: Path
    run: RunName = "main"
    views: list[Side] = ["top", "front", "right", "back", "left"]
    turn: Turn = 0.0
    scale: PaperScale = None
    out: Path | None = Field(
        default=None, description="folder to write to; default: exports/RUN/drawings of the project"
    )


class SectionParams(Params):
    project: Path
    plane: str = Field(description="plane of the section in the aligned world: x=…, y=… or z=…")
    run: RunName = "main"
    turn: Turn = 0.0
    scale: PaperScale = None
    out: Path | None = Field(
        default=None, description="folder to write to; default: exports/RUN/drawings of the project"
    )


class CompareParams(Params):
    project: Path
    other: Path = Field(description="project of an earlier epoch of the same object")
    run: RunName = "main"
    other_run: RunName = "main"
    points: Path | None = Field(
        default=None,
        description="table (.csv: name,x,y,z,other_x,other_y,other_z) of points in both worlds; default: by the surfaces",
    )
    limit: float | None = Field(
        default=None,
        gt=0,
        le=1e9,
        description="distance beyond which surfaces do not belong together, world units; default: 20 cells of the mesh",
    )
    views: list[Side] = ["top", "front", "right", "back", "left"]
    scale: PaperScale = None
    out: Path | None = Field(
        default=None, description="folder to write to; default: exports/RUN/compare of the project"
    )


Revision = Annotated[
    int | None, Field(ge=0, le=MANY, description="revision of the marks; default: the one that is shown")
]


class LabelPrepareParams(Params):
    project: Path
    run: RunName = "main"
    surfels: int = Field(default=200_000, ge=1000, le=5_000_000, description="most surfels to make")


class LabelStrokeParams(Params):
    project: Path
    photo: str = Field(description="name of the photo that the mark is drawn on")
    points: list[tuple[float, float]] = Field(
        description="pixels x,y of the photo, its top-left corner being 0,0: the corners of a line or an outline, or where "
        "clicked; on the command line x,y x,y …",
        min_length=1,
        max_length=100_000,
    )
    shape: Literal["line", "outline", "click", "part"] = Field(
        default="line",
        description="what the points are: a brush's line, the outline of an area, clicks, or clicks that each take the whole "
        "part of the surface that looks alike",
    )
    width: float = Field(default=8.0, gt=0, le=LARGEST_PICTURE, description="width of the brush in pixels")
    class_id: int | None = Field(default=None, ge=0, le=65535, description="id of the class that is marked")
    void: bool = Field(default=False, description="what is marked is none of the classes")
    erase: bool = Field(default=False, description="take away earlier marks here")
    author: str = Field(default="", max_length=200, description="who made the mark")
    key: str = Field(default="", max_length=64, description="a mark sent again with the same key is not made again")

    @model_validator(mode="after")
    def _one_meaning(self) -> Self:
        if (self.class_id is not None) + self.void + self.erase != 1:
            raise ValueError("give one of class_id, void and erase")
        return self


class LabelPropagateParams(Params):
    project: Path
    run: RunName = "main"
    revision: Revision = None


class LabelCheckoutParams(Params):
    project: Path
    revision: int | None = Field(
        default=None, ge=0, le=MANY, description="revision to show, 0 being the one without marks; default: only tell"
    )


class LabelOverlayParams(Params):
    project: Path
    photo: str = Field(description="name of the photo")
    out: Path | None = Field(
        default=None, description="PNG to write; default: runs/RUN/overlays/PHOTO_KIND.png of the project"
    )
    run: RunName = "main"
    revision: Revision = None
    kind: Literal["ids", "colors", "confidence"] = Field(
        default="colors", description="class ids, their colours over the photo, or how sure they are"
    )


class LabelNextParams(Params):
    project: Path
    run: RunName = "main"
    revision: Revision = None
    count: int = Field(default=5, ge=1, le=1000, description="number of photos to suggest")


class LabelAcceptParams(Params):
    project: Path
    run: RunName = "main"
    revision: Revision = None
    seconds: float = Field(default=15.0, gt=0, le=3600, description="time for training the classes")


class LabelImportParams(Params):
    project: Path
    file: Path = Field(description="file or folder that a labelling tool wrote")
    format: Literal["auto", "coco", "cvat", "label-studio", "labelme", "segments", "supervisely", "png", "masks"] = (
        Field(
            default="auto",
            description="what the file is; masks: black and white pictures, as Metashape writes them; default: by its contents",
        )
    )
    class_name: str = Field(
        default="object", min_length=1, max_length=200, description="class of what is white in masks"
    )
    replace: bool = Field(default=False, description="also for photos that have labels of their own")


class LabelExportParams(Params):
    project: Path
    out: Path
    format: Literal[
        "coco",
        "coco-panoptic",
        "cvat",
        "label-studio",
        "labelme",
        "segments",
        "supervisely",
        "png",
        "png-colors",
        "masks",
    ] = Field(default="coco", description="coco, cvat and label-studio are one file, the others a folder")
    source: Literal["maps", "marks"] = Field(
        default="maps", description="label maps of the photos, or what was propagated from marks over all photos"
    )
    run: RunName = "main"
    revision: Revision = None
    class_name: str = Field(default="", max_length=200, description="class that is white in masks")


class AssistEmbedParams(Params):
    project: Path
    encoder: Path = Field(description="ONNX file of the encoder of a SAM, MobileSAM, SAM 2 or EfficientSAM")
    decoder: Path = Field(description="ONNX file of its decoder")
    photos: list[str] = Field(default=[], description="names of the photos; default: all")


class AssistSegmentParams(Params):
    project: Path
    photo: str = Field(description="name of the photo")
    encoder: Path = Field(description="ONNX file of the encoder of a SAM, MobileSAM, SAM 2 or EfficientSAM")
    decoder: Path = Field(description="ONNX file of its decoder")
    points: list[tuple[float, float]] = Field(default=[], max_length=1000, description="pixels x,y inside of the thing")
    outside: list[tuple[float, float]] = Field(default=[], max_length=1000, description="pixels x,y outside of it")
    box: tuple[float, float, float, float] | None = Field(
        default=None, description="left, top, right and bottom of a box around it in pixels"
    )
    class_id: int | None = Field(default=None, ge=0, le=65535, description="class of the mark that is made of it")
    void: bool = Field(default=False, description="make it a mark of what is none of the classes")
    author: str = Field(default="", max_length=200, description="who made the mark")
    key: str = Field(default="", max_length=64, description="a mark sent again with the same key is not made again")

    @model_validator(mode="after")
    def _something(self) -> Self:
        if not self.points and self.box is None:
            raise ValueError("give points or a box")
        if self.class_id is not None and self.void:
            raise ValueError("give one of class_id and void")
        return self


class AssistSuggestParams(Params):
    project: Path
    model: Path = Field(description="ONNX file of a model from pictures to logits of classes, such as SegFormer")
    mapping: Path = Field(description="JSON file with the project's class of each class of the model: {number: name}")
    photos: list[str] = Field(default=[], description="names of the photos; default: all")
    least: float = Field(default=0.5, ge=0, le=1, description="probability from which a pixel gets a class")


class ReportParams(Params):
    project: Path
    run: RunName = "main"
    out: Path | None = Field(
        default=None, description=".html or .pdf file to write; default: exports/RUN/report.html of the project"
    )


class BlendParams(Params):
    project: Path
    out: Path
    run: RunName = "main"
    split: Split = Field(default="none", description="classes, instances: one mesh object for each of them")
    renders: Path | None = Field(
        default=None,
        description="folder of rendered photos to show behind their cameras; default: those Blender's panel rendered",
    )


class ExportParams(Params):
    project: Path
    to: Literal["glb", "obj", "ply", "stl", "usd", "onnx", "voxels", "splats"] = Field(description="format")
    run: RunName = "main"
    out: Path | None = Field(default=None, description="file to write; default: exports/RUN/PROJECT of the project")
    split: Split = Field(default="none", description="classes, instances: one object for each of them")
    resolution: int = Field(default=128, ge=8, le=512, description="voxels: cells along each side of the field's cube")


class PackageParams(Params):
    project: Path
    run: RunName = "main"
    renders: Path | None = Field(
        default=None, description="folder of rendered photos; default: exports/renders/photos of the project"
    )


class ReconstructParams(Params):
    photos: Path
    out: Path
    preset: Preset = "standard"
    labels: Path | None = None
    masks: Path | None = None
    mask_mode: Literal["ignore", "empty"] | None = Field(default=None, description=MASK_MODE)
    classes: Path | None = None
    blend: Path | None = None
    time_limit: float | None = Field(
        default=None,
        gt=0,
        le=LONGEST_RUN,
        description="seconds of training; all that comes after it gets half as much and a minute",
    )
    holdout: Holdout = 8
    set: dict[str, str] = Field(default_factory=dict)
    faces: int = Field(default=200_000, ge=0, le=1_000_000_000, description="triangles of the mesh; 0: all there are")
    texture: int = Field(
        default=4096, ge=0, le=16384, description="size of the mesh's texture in pixels; 0: vertex colours only"
    )
    report: Path | None = Field(default=None, description="report to write, .html or .pdf")
    renders: Path | None = Field(default=None, description="folder for renders of new views")
    render_count: int = Field(
        default=8, ge=1, le=MANY, description="number of renders of new views, around the subject"
    )


class BatchParams(Params):
    list: Path = Field(description=".csv or .json file with one capture a row: the settings of reconstruct by name")
    retries: int = Field(default=1, ge=0, le=1000, description="how often a capture that failed is tried again")
    report: Path | None = Field(default=None, description="JSON report to write; default: LIST-report.json beside it")
    cluster: str | None = Field(
        default=None,
        description="spread the captures over a Ray cluster: HOST:PORT, or auto for one of this machine; default: one "
        "capture after the other",
    )
    storage: str | None = Field(
        default=None,
        description="with --cluster: where workers take files from and leave them, s3://BUCKET/FOLDER for instance; "
        "default: the list's folder, which all of them see at the same place",
    )
    wheel: Path | None = Field(default=None, description="with --cluster: wheel of Fieldwork that workers are to use")
    keep_free: float = Field(
        default=2.0,
        ge=0,
        le=1e6,
        description="with --cluster: a worker with fewer GB free on its disk gets nothing to do",
    )


class BenchParams(Params):
    suite: Literal["figures", "speed", "ablation", "robustness", "baselines", "gpu", "surface", "labels"] = Field(
        description="which table"
    )
    out: Path = Field(default=Path("build/bench"), description="folder for results and scenes; finished runs are kept")
    data: Path | None = Field(default=None, description="folder of data sets; default: ../shared/data when it is there")
    scenes: list[str] | None = Field(
        default=None, description="data sets, simulated scenes (museum, facade, fence, vase), or capture projects"
    )
    variants: list[str] | None = Field(default=None, description="only these variants of the suite")
    seconds: float | None = Field(
        default=None, gt=0, le=LONGEST_RUN, description="seconds of training a run, instead of the suite's"
    )
    steps: int | None = Field(
        default=None, gt=0, le=LONGEST_RUN, description="steps of training a run, instead of the suite's"
    )
    seeds: list[int] | None = Field(default=None, description="a run for each of these seeds, instead of the suite's")
    preset: Preset = "standard"
    set: dict[str, str] = Field(
        default_factory=dict, description="settings changed in every run, but for what a variant changes"
    )
    keep: bool = Field(default=False, description="keep the trained fields in OUT/projects")
    yardstick: Path | None = Field(default=None, description="speed: script of another trainer to run beside ours")
    page: Path | None = Field(
        default=None, description="Markdown page written anew from the folder figures beside it, which gets this table"
    )
    tests: Path | None = Field(default=None, description="gpu: JUnit file of the kernels' tests")
