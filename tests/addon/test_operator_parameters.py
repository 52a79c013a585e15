"""What the operators ask of the engine is what its verbs take."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from fieldwork.nerfcore.verbs import VERBS
from fieldwork.tests.addon.support import SETUP, make_posed_project

# What an operator cannot do without, and what else is worth asking: the same operator with other words behind a space.
MARKED = {"photo": "a"}
MODEL = {"encoder": "e.onnx", "decoder": "d.onnx"}
ASKED: dict[str, dict[str, Any]] = {
    "new": {"photos": "photos"},
    "import_dataset": {"directory": "dataset"},
    "import_dataset by all": {"directory": "dataset", "format": "colmap", "classes": "c.json", "keep_backdrop": True},
    "poses": {"restart": True},
    "align": {"up": "x", "ground": True, "crop": "auto"},
    "align by distance": {"point_a": (0, 0, 0), "point_b": (1, 2, 3), "distance": 2.0},
    "import_scene": {},
    "dataset": {"out": "set"},
    "dataset by all": {"out": "set", "path_kind": "curve", "curve": "c", "around": "cursor", "radius": 2, "size": (64, 48)},
    "train": {"resume": True},
    "train by all": {"time_limit": 5, "steps": 10, "settings": "loss.semantic=0.1", "holdout": 0},
    "evaluate": {},
    "evaluate by all": {"split": "train", "baked": True, "time_limit": 5, "report_file": "r.html"},
    "bake": {},
    "bake by all": {"memory": 50, "run": "other"},
    "render": {"source": "photos"},
    "render all": {"source": "all", "size": (64, 48), "frame_range": (0, 3), "baked": True, "edits": "e.json"},
    "render around": {"source": "orbit", "orbit": 8, "passes": {"rgb", "depth"}},
    "render cameras": {"camera": "c.json"},
    "mesh": {},
    "mesh preview": {"preview": True},
    "mesh by all": {"detail": 2.0, "faces": 5000, "texture": "auto", "lods": 2, "split": "classes", "out": "m.glb"},
    "blend": {},
    "export": {"to": "glb"},
    "export by all": {"to": "voxels", "out": "v.npz", "resolution": 64},
    "measure": {},
    "measure by all": {"distances": "d.csv", "scale_error": 1.0, "caps": 0.2},
    "turntable": {},
    "turntable by all": {"out": "pictures"},
    "plan": {},
    "plan by all": {"views": {"top", "front"}, "conditions": "stone, gold", "turn": 30, "scale": 50, "out": "drawings"},
    "section": {"plane": "z=1.2"},
    "compare": {"other": "earlier"},
    "compare by all": {"other": "earlier", "other_run": "b", "points": "p.csv", "limit": 0.5, "scale": 50, "out": "o"},
    "report": {},
    "report by all": {"out": "r.pdf"},
    "relations": {"query": "everything on stone"},
    "instances": {},
    "instances renamed": {"things": "a.001", "rename": "b"},
    "instances joined": {"things": "a.001, a.002", "merge": True},
    "instances split": {"things": "a.001", "split": True},
    "label_import": {"filepath": "l.json", "format": "coco", "replace": True},
    "label_export": {"filepath": "l", "format": "masks", "source": "marks", "revision": 2},
    "label_prepare": {},
    "label_prepare by all": {"surfels": 5000, "features": "f.onnx"},
    "label_propagate": {},
    "label_propagate by all": {"revision": 1},
    "label_overlay": MARKED,
    "label_overlay by all": {**MARKED, "kind": "confidence", "revision": 1, "out": "o.png"},
    "label_parts": MARKED,
    "label_parts by all": {**MARKED, "points": "1,2 3.5,4", "level": "fine", "out": "o.png"},
    "label_next": {},
    "label_next by all": {"count": 3, "revision": 1},
    "label_accept": {},
    "label_accept by all": {"seconds": 3, "revision": 1},
    "label_carry": {"other": "earlier"},
    "label_carry by all": {"other": "earlier", "other_run": "b", "points": "p.csv", "author": "Ada"},
    "label_carry confirmed": {"confirm": True},
    "assist_embed": {**MODEL, "photos": "a, b"},
    "assist_segment": {**MODEL, **MARKED, "points": "1,2", "outside": "3,4", "class_id": 1},
    "assist_segment by all": {**MODEL, **MARKED, "box": (1, 2, 30, 40), "void": True, "author": "Ada", "key": "k"},
    "assist_suggest": {"model": "m.onnx", "mapping": "m.json", "photos": "a", "least": 0.6},
    "reconstruct": {"photos": "photos", "out": "p"},
    "reconstruct by all": {"photos": "photos", "out": "p", "texture": "1024", "blend": "b.blend", "report_file": "r.html"},
    "batch": {"list": "l.csv"},
    "batch by all": {"list": "l.csv", "cluster": "auto", "storage": "s3://a/b", "wheel": "w.whl", "dry_run": True},
    "blocks": {},
    "blocks by all": {"count": 4, "steps": 100, "texture": "auto", "lods": 1, "out": "m.glb", "turntable": "t"},
    "doctor": {},
    "simulate": {"out": "museum"},
    "bench": {"out": "b"},
    "bench by all": {"out": "b", "scenes": "museum", "seeds": "0,1", "steps": 5, "settings": "train.steps=5"},
}  # fmt: skip


@pytest.fixture(scope="module")
def queued(bpy_script: Callable[..., Any], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The verb and the parameters that each operator puts into the queue; a sentence where it refuses. `operators`: all
    that there are."""
    folder = tmp_path_factory.mktemp("operators")
    make_posed_project(folder / "capture")
    return bpy_script(
        SETUP
        + """
from fieldwork.addon import registration
from fieldwork.addon.jobs.queue import queue
from fieldwork.operators.base import VerbOperator
os.chdir(folder)
settings.project = folder + "/capture"
settings.mesh_file, settings.turntable = folder + "/m.glb", folder + "/t"
queue.run = lambda job: seen.append([job.verb, job.params])
found = {}
for case, arguments in asked.items():
    seen = []
    values = {name: set(value) if name in sets else value for name, value in arguments.items()}
    said = attempt(lambda: getattr(bpy.ops.fieldwork, case.split(" ")[0])(**values))
    found[case] = seen[0] if seen else said
classes = [cls for module in registration._registered for cls in getattr(module, "CLASSES", ())]
verbs = [cls.bl_idname.split(".")[1] for cls in classes if issubclass(cls, VerbOperator)]
answer({**found, "operators": verbs})
""",
        folder=folder,
        sets=["passes", "views"],
        asked={
            case: {name: sorted(value) if isinstance(value, set) else value for name, value in arguments.items()}
            for case, arguments in ASKED.items()
        },
    )


def test_every_operator_of_a_verb_is_asked(queued: dict[str, Any]) -> None:
    assert sorted({case.split(" ")[0] for case in ASKED}) == sorted(queued["operators"])


@pytest.mark.parametrize("case", ASKED)
def test_what_an_operator_queues_is_what_its_verb_takes(queued: dict[str, Any], case: str) -> None:
    assert isinstance(queued[case], list), queued[case]
    verb, params = queued[case]
    VERBS[verb].params.model_validate(params)


def test_a_preview_does_not_write_the_files_that_the_mesh_is_to_be_written_to(queued: dict[str, Any]) -> None:
    assert queued["mesh"][1].keys() - queued["mesh preview"][1].keys() == {"out", "turntable"}
