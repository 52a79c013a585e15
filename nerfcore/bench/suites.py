"""What each suite trains: scenes × variants × budgets, as data."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

from ..errors import SettingError
from ..params import BenchParams
from .jobs import COUNTING_SIDE, Job
from .scenes import scene_name

SCENES = {
    "figures": ["lego_400", "museum", "replica_room", "facade"],
    "speed": ["lego_400"],
    "ablation": ["replica_room", "museum", "facade"],
    "robustness": ["museum", "replica_room"],
    "gpu": ["lego_400", "replica_room"],
    "surface": ["museum", "facade", "fence", "vase"],
    "labels": ["museum", "facade", "replica_room"],
    "live": ["lego_400", "museum", "replica_room"],
}
REFERENCE = {"ablation": "hybrid", "robustness": "clean"}
SECONDS = {"speed": 120.0, "ablation": 180.0, "robustness": 180.0, "gpu": 30.0}
SIDES = {"speed": (400, 800), "gpu": (800,), "surface": (), "live": (400,)}
LONGER = 5.0  # the speed suite's second run
STEPS = {"figures": 600, "ablation": 4000, "surface": 600, "live": 2000}
SEEDS = {"figures": [0, 1]}
# Published drops of PSNR (dB) and of mIoU (points) under input noise.
PUBLISHED_DROPS = {"noise 0.01": (1.6, 2.5), "noise 0.03": (3.7, 4.7), "noise 0.05": (5.4, 8.1)}

ABLATION = {
    "hybrid": {},
    "explicit": {"field.branch": "explicit"},
    "implicit": {"field.branch": "implicit"},
    "blend": {"field.fusion": "blend"},
    "literal blend": {"field.fusion": "blend", "field.blend_by": "density"},
    "semantic pdf": {"sampling.importance": "boundary"},
    "density pdf": {"sampling.importance": "none"},
    "uniform pdf": {"sampling.pdf": "uniform"},
    "literal pdf": {"sampling.pdf": "literal"},
    "no semantics": {"loss.semantic_weight": "0"},
    "voxel_init rgb_stats": {"field.voxel_init": "rgb_stats"},
    "voxel_init cnn": {"field.voxel_init": "cnn"},
}
# Pictures of all variants take the same number of samples on every ray.
EQUAL_SAMPLES = {"ablation": {"render.per_bin": "0"}}
# Of these, figures at equal time stand beside those at equal steps.
TIMED = ("hybrid", "explicit", "implicit", "semantic pdf", "uniform pdf", "literal pdf")

ROBUSTNESS = {
    "clean": {},
    "noise 0.01": {"train.noise": "0.01"},
    "noise 0.03": {"train.noise": "0.03"},
    "noise 0.05": {"train.noise": "0.05"},
    "half of the views": {"train.view_share": "0.5"},
    "10 % labelled": {"train.labelled_share": "0.1"},
    "30 % label noise": {"train.label_noise": "0.3"},
}


def variants(suite: str) -> dict[str, dict[str, str]]:
    """Name and settings of everything a suite compares."""
    if suite == "ablation":
        return ABLATION
    if suite == "robustness":
        return ROBUSTNESS
    return {"standard": {}}


def chosen_variants(params: BenchParams) -> list[str]:
    """The variants of the suite that are asked for. Raises SettingError where it does not have one."""
    found = variants(params.suite)
    for name in params.variants or []:
        if name not in found:
            raise SettingError(f"The suite {params.suite} has no variant “{name}”.", f"It has: {', '.join(found)}.")
    return params.variants or list(found)


def limits(params: BenchParams, steps: int) -> dict[str, float | int | None]:
    """Where a training ends: after the seconds or steps that were asked for, else after `steps`, the suite's own."""
    own = params.seconds is None and params.steps is None
    return {"steps": steps if own else params.steps, "time_limit": params.seconds}


def plan(params: BenchParams, scenes: list[str]) -> list[Job]:
    """The jobs of a suite on some scenes.

    Without `seconds` and `steps` the suite's own budgets hold. Either of them replaces both kinds of budget. Without
    `seeds` the suite's own are taken, unless `set` has one.

    Raises:
        SettingError: a variant the suite does not have.
    """
    suite, found, wanted = params.suite, variants(params.suite), chosen_variants(params)
    own = params.seconds is None and params.steps is None
    seconds = SECONDS.get(suite) if own else params.seconds
    steps = STEPS.get(suite) if own else params.steps
    seeds = params.seeds or (None if "train.seed" in params.set else SEEDS.get(suite)) or [None]
    timed = TIMED if own and suite == "ablation" else wanted
    jobs = []
    for scene in map(scene_name, scenes):
        for name, seed in product(wanted, seeds):
            own_seed = {} if seed is None else {"train.seed": str(seed)}
            # a variant is what its name says
            settings = {**EQUAL_SAMPLES.get(suite, {}), **params.set, **own_seed, **found[name]}
            job = Job(scene, name, settings, preset=params.preset, sides=SIDES.get(suite, (COUNTING_SIDE,)), seed=seed)
            if steps is not None:
                jobs.append(replace(job, steps=steps))
            if seconds is not None and name in timed:
                limits = (seconds, seconds * LONGER) if suite == "speed" else (seconds,)
                jobs += [replace(job, seconds=s) for s in limits]
    return jobs
