"""The stages of a reconstruction. What one needs loads when it is reached: photos are copied without waiting for torch."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from ..progress import Reporter
from ..project.fingerprints import Earlier


class Stage(NamedTuple):
    """`earlier` says whether what an earlier call made may be used again."""

    run: Callable[[Any, Reporter], dict[str, Any]]
    earlier: Callable[[Any], Earlier]


def _new() -> Stage:
    from ..capture.ingest import ingested, new

    return Stage(new, ingested)


def _poses() -> Stage:
    from ..poses.inputs import posed
    from ..poses.reuse import poses_or_gains

    return Stage(poses_or_gains, posed)


def _train() -> Stage:
    from ..train.reuse import finished, train_or_keep

    return Stage(train_or_keep, finished)


def _mesh() -> Stage:
    from ..mesh.verb import mesh, meshed

    return Stage(mesh, meshed)


def _blend() -> Stage:
    from ..blender.blend import blend, blended

    return Stage(blend, blended)


def _evaluate() -> Stage:
    from ..evaluate.verb import evaluate, evaluated

    return Stage(evaluate, evaluated)


def _render() -> Stage:
    from ..render.verb import render, rendered

    return Stage(render, rendered)


# The mesh and the .blend come before what says how good they are.
STAGES: dict[str, Callable[[], Stage]] = {
    "new": _new,
    "poses": _poses,
    "train": _train,
    "mesh": _mesh,
    "blend": _blend,
    "evaluate": _evaluate,
    "render": _render,
}
