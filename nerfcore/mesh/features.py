"""Features of a surface, as geographic and glTF files call them: the classes, and the single instances of these, that
its faces belong to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..data.scene import ClassInfo
from ..project.schema import SemanticClass
from .instances import Instance
from .surface import Surface

VOID_COLOR = (0.15, 0.15, 0.15)


@dataclass(frozen=True)
class Feature:
    """A class, or one instance of it: `color` is sRGB in [0, 1]; instance 0 and no name where no instances are told
    apart."""

    class_id: int
    class_name: str
    color: tuple[float, float, float]
    instance: int = 0
    instance_name: str = ""

    @property
    def name(self) -> str:
        return self.instance_name or self.class_name


@dataclass(frozen=True)
class Features:
    """`rows`: all features that occur, by class and instance; `face` (F,) row of each face; label_revision: of the marks that
    the classes are from, None where they are from none."""

    rows: list[Feature]
    face: np.ndarray
    label_revision: int | None = None

    def groups(self, split: str) -> dict[str, np.ndarray]:
        """Indices of the faces of each object by its name, for `split` "none", "classes" or "instances"."""
        if split == "none":
            return {"mesh": np.arange(len(self.face))}
        called = {row.name for row in self.rows if row.instance}  # a thing may be called as a class is by now
        rest = [f"{row.name}.000" if not row.instance and row.name in called else row.name for row in self.rows]
        names = np.array([row.class_name for row in self.rows] if split == "classes" else rest, object)
        return {str(name): np.flatnonzero((names == name)[self.face]) for name in dict.fromkeys(names)}


def features_of(
    surface: Surface,
    classes: Sequence[ClassInfo | SemanticClass],
    void: int,
    instances: Sequence[Instance] = (),
    label_revision: int | None = None,
) -> Features:
    """The features of a surface's faces.

    A class that `classes` lacks is called "class 3", an instance that `instances` lacks "stone.004".
    """
    known = {c.id: (c.name, c.color) for c in classes}
    called = {instance.id: instance.name for instance in instances}
    number = np.zeros(len(surface.faces), np.int64) if surface.face_instance is None else surface.face_instance
    pairs = np.stack([surface.face_class.astype(np.int64), number.astype(np.int64)], 1)
    pairs, face = np.unique(pairs, axis=0, return_inverse=True)
    rows = []
    for class_id, instance in pairs.tolist():
        name, color = known.get(class_id, ("void" if class_id == void else f"class {class_id}", VOID_COLOR))
        label = called.get(instance, f"{name}.{instance:03d}") if instance else ""
        rows.append(Feature(class_id, name, color, instance, label))
    return Features(rows, face.reshape(-1), label_revision)
