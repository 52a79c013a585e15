"""Which photos are best to begin with, before anything is marked."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from fieldwork.nerfcore.bench.label_trials import labelled
from fieldwork.nerfcore.labels.next_photo import first_photos, next_photo, usefulness
from fieldwork.nerfcore.labels.preparation import current
from fieldwork.nerfcore.labels.stroke import stroke
from fieldwork.nerfcore.params import LabelNextParams, LabelStrokeParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.tests.nerfcore.test_labels import ball, truth  # noqa: F401


def scene(shows: dict[str, list[int]]) -> Any:
    """Three kinds of surfels, 60, 30 and 10 of them, far from each other; `shows`: the kinds in each photo."""
    kind = np.repeat([0, 1, 2], [60, 30, 10])
    random = np.random.default_rng(0)
    features = (kind[:, None] * 10 + random.normal(0, 0.1, (100, 2))).astype(np.float32)
    maps = {name: np.flatnonzero(np.isin(kind, kinds))[None] for name, kinds in shows.items()}
    return SimpleNamespace(
        surfels=kind,
        columns=lambda some: torch.from_numpy(features[some]),
        photos=[SimpleNamespace(name=name) for name in shows],
        map_of=lambda name: (maps[name].astype(np.int32), np.zeros(maps[name].shape, bool)),
    )


def test_photos_that_look_like_all_of_the_scene_come_first() -> None:
    shows = {"empty": [], "floor": [0], "both": [0, 1], "corner": [2], "wall": [1]}
    found = first_photos(scene(shows), list(shows), 3)
    assert [name for name, _ in found[:2]] == ["both", "corner"], "the second adds what the first does not show"
    scores = [score for _, score in found]
    assert scores == sorted(scores, reverse=True)
    assert 0.9 < sum(scores) <= 1


def test_a_photo_of_what_is_in_doubt_and_looks_new_is_next() -> None:
    shows = {"floor": [0], "again": [0], "wall": [1], "corner": [2]}
    ready, sure = scene(shows), np.zeros((100, 2), np.float32)
    sure[:60, 0] = 1
    sure[60:90] = 0.5
    sure[90:, 1] = 1
    worth = usefulness(ready, labelled(sure, [1, 2]), {"floor"})
    assert np.argmax(worth) == 2, "the wall is in doubt and looks unlike the floor"
    assert worth[1] < 0.01, "it shows nothing that was not marked"
    assert (worth >= 0).all()
    assert usefulness(ready, labelled(sure, [1, 2]), set()).max() > 0, "marks may be on the surface alone"


def test_before_any_mark_photos_are_suggested_and_the_run_is_prepared(ball: Path) -> None:  # noqa: F811
    shutil.rmtree(ball / "runs/main/surfels")
    told = next_photo(LabelNextParams(project=ball, count=4), Reporter())
    assert current(ball, "main") is not None
    assert told["revision"] == 0
    assert len({photo["name"] for photo in told["photos"]} & set(truth(ball))) == 4
    assert all((photo["void"], photo["marks"]) == (1.0, 0) for photo in told["photos"])
    mark = LabelStrokeParams(project=ball, photo="01", points=[(20, 10)], class_id=1)
    stroke(mark, Reporter())
    again = next_photo(LabelNextParams(project=ball, count=4, revision=0), Reporter())
    assert again == told, "the revision counts, not the newest mark"
