"""Every setting of a run, with its default: one small model per stage. `docs/settings.md` is made from this file.

Presets (`presets/*.json`) hold only what differs from the defaults. `--set stage.name=value` changes one setting.
"""

from __future__ import annotations

import json
from collections.abc import Container
from difflib import get_close_matches
from pathlib import Path
from types import NoneType
from typing import Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from .errors import SettingError, wrong_value

PRESETS = Path(__file__).parent / "presets"
# Earlier names of settings, still understood in `--set`, in preset files and in stored runs.
RENAMED = {"sampling.interest": "sampling.importance"}
# How a setting's type and limits are called.
TYPES: dict[Any, str] = {int: "a whole number", float: "a number", bool: "true or false", str: "text", NoneType: "null"}
BOUNDS = {"ge": "at least", "gt": "more than", "le": "at most", "lt": "less than", "multiple_of": "a multiple of"}
CLOSE = 0.75  # how like a name has to be to one that may have been meant, of 1; not tuned
MANY = 1_000_000_000  # more steps or seconds than anybody waits for
MOST_VERTICES = 2048  # along a side of the finest level that a run chooses by itself; not tuned


class Stage(BaseModel):
    model_config = ConfigDict(extra="forbid", validate_assignment=True, allow_inf_nan=False)


class SceneConfig(Stage):
    """Which part of the world the field covers, and how the photos are read."""

    contraction: Literal["auto", "on", "off"] = Field(
        default="auto",
        description="contract all of space into the grid: on for captures whose surroundings are visible",
    )
    image_size: int | None = Field(
        default=None,
        ge=32,
        le=16384,
        description="longest side of the training images in pixels; null: 1600 on a GPU, 800 on the CPU",
    )
    background: Literal["auto", "environment", "random", "white", "black"] = Field(
        default="auto",
        description="what is behind the field; environment: sky and whatever is too far away to have a place, learned as "
        "colours of directions; auto: black or white where an object is photographed in front of that, environment "
        "where photos show the same colours in the same directions from everywhere, mostly not between points and, in captures "
        "from inside, above the horizon and with no other name than a sky, else random",
    )
    margin: float = Field(default=1.05, gt=0, le=100, description="size of the box relative to what must fit in")
    photo_memory: float | None = Field(
        default=None,
        ge=0,
        le=10_000,
        description="GB of the device's memory for the training photos; larger ones stay in the host's memory, and lenses "
        "are inverted for each batch; null: half of what is free",
    )


class FieldConfig(Stage):
    """The hybrid field."""

    branch: Literal["hybrid", "explicit", "implicit"] = Field(
        default="hybrid", description="explicit: grid only; implicit: network only"
    )
    fusion: Literal["blend", "concat"] = Field(
        default="concat", description="how the two branches join: their weighted sum, or both weighted and side by side"
    )
    levels: int = Field(default=8, ge=1, le=16, description="levels of the vertex grid, 4 features each")
    coarsest: int = Field(default=16, ge=2, le=1024, description="vertices along a side of the coarsest level")
    finest: int | None = Field(
        default=None,
        ge=2,
        le=65536,
        description="vertices along a side of the finest level; null: one for each pixel of the photos, at most "
        f"{MOST_VERTICES}",
    )
    table_log2: int = Field(
        default=19, ge=10, le=24, description="at most 2^this vertices a level; larger levels are hashed"
    )
    octaves: int = Field(default=8, ge=1, le=16, description="octaves of the implicit branch's frequency encoding")
    width: int = Field(default=64, ge=8, le=1024, description="width of the hidden layers")
    implicit_layers: int = Field(default=2, ge=1, le=16, description="matrix products of the implicit branch")
    color_layers: int = Field(default=3, ge=1, le=16, description="matrix products of the colour head")
    semantic_layers: int = Field(default=2, ge=1, le=16, description="matrix products of the semantic head")
    geometry_features: int = Field(
        default=15, ge=1, le=256, description="features the density head hands to the other heads"
    )
    blend_by: Literal["evidence", "density"] = Field(
        default="evidence", description="density: the original, literal blend weight"
    )
    blend_floor: float = Field(default=0.5, ge=0, le=1, description="share of the grid where nothing was seen (w0)")
    blend_rate: float = Field(default=8.0, gt=0, le=1000, description="how fast evidence raises the grid's share (κ)")
    blend_warmup: int = Field(default=0, ge=0, le=MANY, description="steps with the grid alone")
    voxel_init: Literal["rgb_stats", "cnn", "none"] = Field(
        default="none",
        description="what is written into the dense levels after the coarse stage: mean and variance over the photos "
        "of what they show at a vertex, as colours or as features of a small network; only to compare with the publication: "
        "it gained nothing where it was measured (docs/evidence.md)",
    )
    voxel_init_step: int = Field(default=128, ge=1, le=MANY, description="steps of the coarse stage before voxel_init")
    voxel_init_weights: str | None = Field(
        default=None, description="file with the weights of voxel_init=cnn; null: they are learned with the field"
    )
    appearance: int = Field(default=0, ge=0, le=256, description="length of the per-image appearance code; 0: none")
    density_shift: float = Field(default=-1.0, ge=-20, le=20, description="added to the raw density before exp")
    precision: Literal["auto", "float32", "bfloat16", "float16"] = Field(
        default="auto",
        description="of matrix products; auto: single on a CPU, on a GPU the half precision that it multiplies",
    )


class SamplingConfig(Stage):
    """Where the field is evaluated along a ray."""

    resolution: int = Field(
        default=128, ge=8, le=512, multiple_of=4, description="cells along a side of the occupancy grid"
    )
    samples: int = Field(default=16, ge=1, le=512, description="samples a ray (M_f)")
    bins_per_cell: float = Field(default=1.0, gt=0, le=16, description="bins of the coarse march per grid cell")
    pdf: Literal["default", "uniform", "literal"] = Field(default="default", description="distribution of the samples")
    importance: Literal["priority", "boundary", "none"] = Field(
        default="priority", description="what draws samples besides density"
    )
    beta: float = Field(default=1.0, ge=0, le=1000, description="strength of the importance")
    epsilon: float = Field(default=0.01, gt=0, le=1, description="weight every occupied bin keeps")
    update_every: int = Field(default=16, ge=1, le=MANY, description="steps between updates of the occupancy grid")
    decay: float = Field(default=0.95, gt=0, lt=1, description="of the occupancy grid at each update")
    mean_rate: float = Field(
        default=0.1, gt=0, le=1, description="at which a cell's mean density follows each point read in it"
    )
    optical_depth: float = Field(
        default=1.0, gt=0, le=1000, description="most that a cell may have when samples are drawn"
    )
    warmup_decay: float = Field(
        default=0.25, ge=0, lt=1, description="of the grid where the warm-up reads all of it, to forget the first guess"
    )
    threshold: float = Field(default=0.01, gt=0, lt=1, description="opacity of a bin below which its cell is closed")
    warmup: int = Field(default=256, ge=0, le=MANY, description="steps in which all cells are updated at once")
    close_near_cameras: bool = Field(
        default=True, description="cells nearer to a camera than anything in its photo stay empty"
    )
    close_single_views: bool = Field(
        default=True, description="cells that one camera sees alone, nearer than most of its photo, stay empty"
    )
    close_between_cameras: bool = Field(
        default=True, description="cells on the way between cameras around something, and right before it, stay empty"
    )
    coarse_cache: bool = Field(
        default=True,
        description="choose training rays by which image tiles met the field; not where masks or lenses leave pixels out",
    )
    cache_every: int = Field(default=1000, ge=1, le=MANY, description="steps between updates of the coarse cache")
    outline_rays: float = Field(
        default=0.2, ge=0, le=1, description="share of rays drawn where classes meet in the labels"
    )
    empty_rays: float = Field(
        default=0.1, ge=0, le=1, description="share of rays drawn from everywhere despite the cache"
    )


class RenderConfig(Stage):
    """Compositing."""

    accumulate: Literal["probabilities", "logits"] = Field(
        default="probabilities", description="what is summed along a ray for classes"
    )
    cull: float = Field(
        default=1e-4, ge=0, lt=1, description="rendering weight below which colour and classes are not computed"
    )
    samples: int | None = Field(
        default=32, ge=1, le=512, description="most samples a ray when rendering; null: as in training"
    )
    per_bin: float = Field(
        default=1.25,
        ge=0,
        le=16,
        description="samples for each occupied bin on a ray when rendering, at least 4 a ray; 0: `samples` on every ray",
    )
    refine: Literal[1, 2, 4] = Field(
        default=2,
        description="how many times finer than the occupancy grid the grid is that finished fields render with, up to "
        "1290 cells a side",
    )
    fused: Literal["auto", "on", "off"] = Field(
        default="auto",
        description="march, networks and compositing in fused kernels; auto: on CUDA; on: on the CPU too, slowly (tests)",
    )


# Settings of `render` that only pictures depend on: training reads the occupancy grid itself, without the fused kernel.
ONLY_RENDERING = ("samples", "per_bin", "refine", "fused")


class LossConfig(Stage):
    """What training minimises."""

    rgb: Literal["huber", "mse"] = Field(default="huber", description="price of colour errors; mse: squared")
    rgb_warmup: int = Field(default=64, ge=0, le=MANY, description="first steps in which colour errors count squared")
    rgb_weight: float = Field(default=1.0, ge=0, le=1000, description="of colour errors")
    huber_delta: float = Field(default=0.1, gt=0, le=10, description="colour error from which its price grows linearly")
    semantic_weight: float = Field(default=0.04, ge=0, le=1000, description="λ_sem; 0 trains without semantics")
    detach_weights: bool = Field(default=False, description="labels do not move the geometry")
    regularization: float = Field(
        default=1.0, ge=0, le=1000, description="λ_reg, factor of sparsity, distortion, entropy and opacity"
    )
    sparsity: Literal["exponential", "cauchy", "l1"] = Field(
        default="exponential", description="l1: the original, literal form"
    )
    sparsity_weight: float = Field(default=1e-4, ge=0, le=1000, description="of density at random points")
    sparsity_scale: float = Field(default=0.05, gt=0, le=1000, description="ℓ of 1−exp(−ℓσ)")
    distortion_weight: float = Field(
        default=0.01, ge=0, le=1000, description="against floaters and fog before surfaces"
    )
    distortion_start: float = Field(default=0.2, ge=0, le=1, description="share of training before that term")
    opacity_weight: float = Field(default=0.0, ge=0, le=1000, description="entropy of the ray's opacity")
    environment_weight: float = Field(
        default=1e-3,
        ge=0,
        le=1000,
        description="of opacity in front of an environment: what it explains alone is not put anywhere else",
    )
    depth_weight: float = Field(
        default=0.0,
        ge=0,
        le=1000,
        description="pulls surfaces to the sparse points of the poses and to depth maps; 0: off",
    )
    entropy_ratio: float = Field(default=0.02, ge=0, le=1000, description="λ_ent / λ_sem; entropy is raised")
    entropy_start: float = Field(default=0.2, ge=0, le=1, description="share of training before the entropy term")


class TrainConfig(Stage):
    """The course of training."""

    steps: int = Field(default=20000, gt=0, le=MANY, description="optimisation steps when there is no time limit")
    batch_start: int = Field(default=1 << 14, ge=256, le=1 << 26, description="field samples of the first steps")
    batch_samples: int = Field(
        default=1 << 17,
        ge=256,
        le=1 << 26,
        description="field samples of the last steps; grows geometrically, less far where a time limit leaves few steps",
    )
    max_rays: int = Field(default=32768, ge=16, le=1 << 24, description="at most so many rays a step")
    grid_rate: float = Field(default=0.03, gt=0, le=10, description="learning rate of the grid")
    network_rate: float = Field(default=0.01, gt=0, le=10, description="learning rate of the networks")
    decay: float = Field(default=0.33, gt=0, le=1, description="of the rates at ½, ¾ and 9/10")
    fade: float = Field(default=0.2, ge=0, lt=1, description="share of training over which finer levels appear")
    refine_poses: bool = Field(default=False, description="correct the cameras of the training photos while training")
    pose_rate: float = Field(
        default=1e-3,
        gt=0,
        le=1,
        description="learning rate of the cameras, in radians and halves of the box; falls to 1 %",
    )
    environment_start: float = Field(
        default=0.3,
        ge=0,
        le=1,
        description="share of training before an environment that takes what is near is behind all pixels; until then it is not "
        "behind those whose texture no camera nearby sees in the same direction: surfaces form first",
    )
    pose_start: float = Field(default=0.05, ge=0, lt=1, description="share of training before cameras move")
    checkpoint_every: float = Field(default=30.0, gt=0, le=MANY, description="seconds between checkpoints")
    preview_every: float = Field(default=15.0, gt=0, le=MANY, description="seconds between preview pictures")
    seed: int = Field(default=0, ge=0, lt=1 << 32, description="of all random numbers: the same one gives the same run")
    labelled_share: float = Field(
        default=1.0, ge=0, le=1, description="share of the training images whose labels are used"
    )
    noise: float = Field(
        default=0.0, ge=0, le=10, description="σ of Gaussian noise added to the photos (robustness tests)"
    )
    label_noise: float = Field(
        default=0.0, ge=0, le=1, description="share of labels replaced at random (robustness tests)"
    )
    view_share: float = Field(default=1.0, gt=0, le=1, description="share of the training images used")


class RunConfig(Stage):
    """All settings of one run."""

    scene: SceneConfig = SceneConfig()
    field: FieldConfig = FieldConfig()
    sampling: SamplingConfig = SamplingConfig()
    render: RenderConfig = RenderConfig()
    loss: LossConfig = LossConfig()
    train: TrainConfig = TrainConfig()


def preset_names() -> list[str]:
    return sorted(path.stem for path in PRESETS.glob("*.json"))


def with_present_names(values: dict[str, Any]) -> dict[str, Any]:
    """{stage: {name: value}} with the settings that have earlier names under their present ones."""
    found = {stage: dict(part) if isinstance(part, dict) else part for stage, part in values.items()}
    for old, new in RENAMED.items():
        stage, name = old.split(".")
        if isinstance(found.get(stage), dict) and name in found[stage]:
            new_stage, new_name = new.split(".")
            found.setdefault(new_stage, {})[new_name] = found[stage].pop(name)
    return found


def with_rendering_of(config: RunConfig, asked: RunConfig, named: Container[str] | None = None) -> RunConfig:
    """`config` with those settings of `asked` that only pictures depend on; of the `named` ones, or all."""
    names = [name for name in ONLY_RENDERING if named is None or f"render.{name}" in named]
    rendering = {name: getattr(asked.render, name) for name in names}
    return config.model_copy(update={"render": config.render.model_copy(update=rendering)})


def make_config(preset: str, settings: dict[str, str] | None = None) -> RunConfig:
    """A preset with single settings changed, e.g. {"field.branch": "explicit"}.

    Raises:
        SettingError: unknown preset or setting, or a value it cannot take.
    """
    path = PRESETS / f"{preset}.json"
    if not path.is_file():
        raise SettingError(f"There is no preset “{preset}”.", f"Choose one of {', '.join(preset_names())}.")
    values = with_present_names(json.loads(path.read_text(encoding="utf-8")))
    for name, text in (settings or {}).items():
        stage, _, key = RENAMED.get(name, name).partition(".")
        model = RunConfig.model_fields.get(stage)
        if model is None or key not in type(model.default).model_fields:
            raise SettingError(f"There is no setting “{name}”.", _hint_for(name))
        try:
            value = json.loads(text)
        except json.JSONDecodeError:
            value = text
        if isinstance(value, bool) and type(model.default).model_fields[key].annotation is not bool:
            value = text  # which is no number, where pydantic would take true for 1
        values.setdefault(stage, {})[key] = value
    try:
        return RunConfig.model_validate(values)
    except ValidationError as error:
        detail = error.errors()[0]
        raise SettingError(
            f"The setting {wrong_value(detail)}.", what_it_takes(*map(str, detail["loc"][:2]))
        ) from error


def _hint_for(name: str) -> str:
    """Which setting may have been meant by a name that is none."""
    keys = {stage: list(type(info.default).model_fields) for stage, info in RunConfig.model_fields.items()}
    known = [f"{stage}.{key}" for stage, names in keys.items() for key in names]
    near = [full for full in known if full.partition(".")[2] == name] + get_close_matches(name, known, 3, CLOSE)
    if near:
        return f"Did you mean {' or '.join(dict.fromkeys(near))}?"
    stage = name.partition(".")[0]
    if stage in keys:
        return f"Settings of {stage} are {', '.join(keys[stage])}."
    return f"Settings are called stage.name, and stages are {', '.join(keys)}."


def what_it_takes(stage: str, key: str) -> str:
    """A sentence on the values of a setting."""
    setting = type(RunConfig.model_fields[stage].default).model_fields[key]
    kinds = [TYPES.get(kind, str(kind)) for kind in get_args(setting.annotation) or (setting.annotation,)]
    bounds = [f"{BOUNDS[n]} {getattr(m, n):g}" for m in setting.metadata for n in BOUNDS if hasattr(m, n)]
    values = ", ".join([" or ".join(kinds), *bounds])
    return f"{stage}.{key} takes {values} (default: {json.dumps(setting.default)})."
