"""Which instance a point of the field belongs to: that of the nearest face of the mesh with the same class."""

from __future__ import annotations

import numpy as np
import scipy

from ..errors import ProjectError
from ..mesh.instances import read_instances
from ..mesh.stored import load_surface, mesh_folder
from .cryptomatte import id_of
from .fields import LoadedField
from .shot import FieldItem


class InstanceNames:
    """Names of instances as Cryptomatte ids. Without a mesh that tells instances apart a class is one: the object's name
    with that of the class."""

    def __init__(self, field: LoadedField, item: FieldItem) -> None:
        self.names = [*(f"{item.name}.{name}" for name in field.class_names), item.name]
        self._plain = np.array([id_of(name) for name in self.names], np.float32)
        self._trees: dict[int, tuple[scipy.spatial.KDTree, np.ndarray]] = {}
        self._capture_from_scene = np.linalg.inv(np.array(item.scene_from_capture))
        try:
            surface, _ = load_surface(item.project, item.run)
            instances = {one.id: one.name for one in read_instances(mesh_folder(item.project, item.run))}
        except ProjectError:
            return  # it has no mesh, which is no fault
        if surface.face_instance is None or not instances:
            return
        centers = surface.vertices[surface.faces].mean(1)
        for index, class_id in enumerate(field.class_ids):
            own = np.flatnonzero(surface.face_class == class_id)
            if len(own):
                called = [instances.get(int(number), self.names[index]) for number in surface.face_instance[own]]
                self.names += sorted(set(called) - set(self.names))
                known = {name: id_of(name) for name in set(called)}
                ids = np.array([known[name] for name in called], np.float32)
                self._trees[index] = scipy.spatial.KDTree(centers[own]), ids

    def ids(self, points: np.ndarray, classes: np.ndarray) -> np.ndarray:
        """Ids (N,) of points (N, 3) of the scene that have these class indices (N,), −1 for void."""
        found = self._plain[classes]
        local = points @ self._capture_from_scene[:3, :3].T + self._capture_from_scene[:3, 3]
        solid = np.isfinite(local).all(1)
        for index, (tree, ids) in self._trees.items():
            rows = np.flatnonzero((classes == index) & solid)
            if len(rows):
                found[rows] = ids[tree.query(local[rows])[1]]
        return found
