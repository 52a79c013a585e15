"""Fields ready to be seen by Blender's cameras, and rays of the scene through them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch

from ..data.load import load_scene
from ..data.scene import Scene
from ..errors import ProjectError, SettingError
from ..kernels.march import Samples
from ..kernels.traversal import BEFORE_CUBE, PDF_UNIFORM
from ..mesh.stored import MESH, mesh_folder
from ..progress import Reporter
from ..project.runs import INSTANCES, checkpoint_id
from ..project.store import PROJECT_FILE, load_project
from ..render.baked import META, BakedField, load_baked, voxels_folder
from ..render.fused import ray_renderer
from ..render.image import LEAST
from ..render.model import Geometry, Model, Thin
from ..render.run import RunInfo, load_info, load_trained
from .instance_cells import InstanceCells
from .lens_rays import poses_at
from .shot import ClassLook, FieldItem, Matrix

FAR = 1e9  # a distance that nothing reaches


@dataclass(frozen=True)
class FieldRays:
    """Of R rays: color (R, 3) sRGB with associated alpha, as it is shown; opacity (R,); distance (R,) in the scene of what
    is met, NaN where nothing is; best (R,) index of the most probable class, −1 for void; share (R,) its probability;
    probabilities (R, K) of the classes, or None; sky (R, 3) sRGB behind the field, or None."""

    color: torch.Tensor
    opacity: torch.Tensor
    distance: torch.Tensor
    best: torch.Tensor
    share: torch.Tensor
    probabilities: torch.Tensor | None
    sky: torch.Tensor | None


def light_left(rays: list[FieldRays]) -> torch.Tensor:
    """What is left (F, R) of each of R rays where it comes to each of F fields, the nearest first."""
    opacity = torch.stack([one.opacity for one in rays])
    order = torch.stack([one.distance.nan_to_num(FAR) for one in rays]).argsort(0)
    passed = (1 - opacity.gather(0, order)).cumprod(0)
    before = torch.cat([torch.ones_like(passed[:1]), passed[:-1]])
    return torch.zeros_like(opacity).scatter(0, order, before)


@dataclass(frozen=True)
class LoadedField:
    """A field as it lies in its capture: box_from_world (4, 4), ids, names and colours (K, 3) of its classes; the project
    and the run that it is of, and the revision of the marks that its classes are from, if any."""

    shown: Model | BakedField
    box_from_world: np.ndarray
    class_ids: list[int]
    class_names: list[str]
    class_colors: np.ndarray
    void: int
    project: Path
    run: str
    label_revision: int | None = None

    @cached_property
    def instances(self) -> InstanceCells:
        """Its things. Raises ProjectError: there is no mesh that tells them apart; SettingError: it is not baked."""
        if not isinstance(self.shown, BakedField):
            raise SettingError(
                "Single things are hidden, recoloured and moved in the baked field only.", "Choose the baked field."
            )
        return InstanceCells(self.shown, np.linalg.inv(self.box_from_world), self.class_ids, self.project, self.run)


def load_field(project: Path, run: str, baked: bool) -> LoadedField:
    """Raises ProjectError: there is none, or it is damaged."""
    info = load_info(project, run)
    shown = load_baked(project, run, info) if baked else load_trained(project, run).model
    return described(shown, project, run, info, load_scene(project, info.holdout))


def described(shown: Model | BakedField, project: Path, run: str, info: RunInfo, scene: Scene) -> LoadedField:
    """A model with what its run and its capture say of it. Raises ProjectError: the project is damaged."""
    known = {entry.id: entry for entry in scene.classes}
    ids = info.class_ids if shown_classes(shown) else []
    names = [known[i].name if i in known else f"class {i}" for i in ids]
    colors = np.array([known[i].color if i in known else (0.5, 0.5, 0.5) for i in ids], np.float32).reshape(-1, 3)
    box = info.box(load_project(project)).box_from_world
    return LoadedField(shown, box, list(ids), names, colors, scene.ignore_id, project, run, info.label_revision)


def shown_classes(shown: Model | BakedField) -> int:
    """How many classes it tells apart."""
    return shown.classes if isinstance(shown, BakedField) else shown.field.classes


def _moved(
    matrices: torch.Tensor, origins: torch.Tensor, directions: torch.Tensor, times: torch.Tensor | None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Rays (R, 3) carried by a matrix, or by those (P, 4, 4) at even times, between which it is interpolated."""
    if len(matrices) == 1:
        turn, shift = matrices[0, :3, :3], matrices[0, :3, 3]
        return origins @ turn.T + shift, directions @ turn.T
    matrix = poses_at(matrices, torch.full_like(origins[:, 0], 0.5) if times is None else times)
    places = torch.einsum("nij,nj->ni", matrix[:, :3, :3], origins) + matrix[:, :3, 3]
    return places, torch.einsum("nij,nj->ni", matrix[:, :3, :3], directions)


class FieldStore:
    """The fields that were asked for last, kept for the next frame."""

    KEPT = 4

    def __init__(self) -> None:
        self.loaded = 0  # how often a field was read from disk
        self.kept = self.KEPT  # how many are kept
        self._fields: dict[tuple, LoadedField] = {}

    def expect(self, items: list[FieldItem]) -> None:
        """The fields of a frame are asked for next: those that it has in memory at once anyway are all kept for the one after."""
        self.kept = max(self.KEPT, len({(str(item.project), item.run, item.baked) for item in items}))

    def field(self, item: FieldItem, report: Reporter) -> LoadedField:
        """The field of an item. Raises ProjectError."""
        folder = item.project
        if not (folder / PROJECT_FILE).is_file():
            load_project(folder)  # says what is not there
        state = [checkpoint_id(folder, item.run), (folder / PROJECT_FILE).stat().st_mtime_ns]
        if item.baked:
            meta = voxels_folder(folder, item.run) / META
            beside = [mesh_folder(folder, item.run) / name for name in (MESH, INSTANCES)]
            state += [path.stat().st_mtime_ns if path.is_file() else 0 for path in (meta, *beside)]
        key = (str(folder), item.run, item.baked, *state)
        found = self._fields.pop(key, None)
        if found is None:
            report.stage("Loading the field")
            # A field of an earlier training is of no use any more.
            self._fields = {k: v for k, v in self._fields.items() if k[:3] != key[:3]}
            found = load_field(folder, item.run, item.baked)
            self.loaded += 1
        self._fields[key] = found
        for old in list(self._fields)[: -self.kept]:
            del self._fields[old]
        return found


class PlacedField:
    """A field in the scene, as one item of a shot shows it.

    Args:
        pixels: rays of a picture.
    Raises:
        ProjectError: the item's matrices cannot be inverted, or no mesh tells the instances apart that it names.
        InputError: there is no such instance. SettingError: it names some, and the field is not baked.
    """

    def __init__(self, field: LoadedField, item: FieldItem, pixels: int) -> None:
        self.field, self.item, self.device = field, item, field.shown.device
        self.shown, instances, of_class = field.shown, [], []
        if item.told_apart:
            told, instances, of_class = field.instances.told_apart(item.told_apart)
            assert isinstance(field.shown, BakedField)
            self.shown = BakedField(told, field.shown.settings, None if item.only else field.shown.environment)
        try:
            self.box_from_scene = self._matrices(field.box_from_world, item.scene_from_capture, item.motion)
            self.crops = [] if item.crop is None else [self._matrices(np.eye(4), item.crop, item.crop_motion)]
            if item.only:  # where it is not, nothing need be looked for
                cube_from_world = np.linalg.inv(field.instances.world_from_cube(item.only))
                self.crops.append(self._matrices(cube_from_world, item.scene_from_capture, item.motion))
        except np.linalg.LinAlgError as error:
            raise ProjectError(
                f"“{item.name}” or its crop box is scaled to nothing.", "Give it a scale other than 0."
            ) from error
        self.now_from_box = self._tensor(np.array(item.scene_from_capture) @ np.linalg.inv(field.box_from_world))
        looks = self._looks(instances, of_class)
        self.colors = self._tensor([look.color for look in looks[: len(field.class_ids)]]).reshape(-1, 3)
        self.of_class = torch.tensor(of_class, dtype=torch.long, device=self.device)
        self.opacity = self._tensor([look.opacity for look in looks])
        self.tint = self._tensor([look.tint for look in looks])
        self.tint_colors = self._tensor([look.color for look in looks]).reshape(-1, 3)
        self.hides = bool(looks) and bool((self.opacity < 1).any())
        self.pixels = pixels
        self._prepare()

    def _prepare(self) -> None:
        shown = self.shown
        baked = isinstance(shown, BakedField)
        self.settings = shown.settings if baked else shown.render_grid().settings
        self._plain = None if baked else ray_renderer(shown, self.pixels, True)

    def refine(self, origins: torch.Tensor, directions: torch.Tensor, pixels: float, check: Callable[[], None]) -> None:
        """Read the field more finely where rays of the scene (R, 3) meet it, if that pays for so many pixels."""
        if isinstance(self.shown, BakedField):
            return
        valid = ~directions[:, 0].isnan()
        places, turned = _moved(self.box_from_scene, origins[valid], directions[valid], None)
        turned = turned / turned.norm(dim=1, keepdim=True)
        self.shown.refine(pixels, check, [(places.contiguous(), turned.contiguous())])
        self._prepare()

    def _looks(self, instances: list[str], of_class: list[int]) -> list[ClassLook]:
        """How the classes are shown, and after them the instances that are told apart."""
        item, field = self.item, self.field
        looks = [item.classes.get(i, ClassLook(color=tuple(c))) for i, c in zip(field.class_ids, field.class_colors)]
        for name, index in zip(instances, of_class):
            own, look = item.instances.get(name), looks[index]
            if own is not None:
                tinted = own if own.tint > 0 else look
                look = ClassLook(opacity=own.opacity * look.opacity, tint=tinted.tint, color=tinted.color)
            looks.append(look)
        if item.only:
            shown = len(field.class_ids) + instances.index(item.only)
            looks = [look if n == shown else ClassLook(opacity=0, color=look.color) for n, look in enumerate(looks)]
        return looks

    def _tensor(self, values: object) -> torch.Tensor:
        return torch.tensor(np.asarray(values, np.float32), device=self.device)

    def _matrices(self, after: np.ndarray, still: Matrix, motion: list[Matrix]) -> torch.Tensor:
        """`after` times the inverses of poses (P, 4, 4), one where it stands still."""
        poses = np.array(motion if len(motion) > 1 else [still])
        return self._tensor(after @ np.linalg.inv(poses))

    def still(self, points: torch.Tensor, times: torch.Tensor | None) -> torch.Tensor:
        """Where points (R, 3) of the field, which are in the scene at `times`, would be if it stood where it does now."""
        if len(self.box_from_scene) == 1:
            return points
        place, _ = _moved(self.box_from_scene, points, points, times)
        return place @ self.now_from_box[:3, :3].T + self.now_from_box[:3, 3]

    def rays(
        self,
        origins: torch.Tensor,
        directions: torch.Tensor,
        begin: torch.Tensor,
        end: torch.Tensor,
        times: torch.Tensor | None = None,
    ) -> FieldRays:
        """What rays of the scene (R, 3), unit directions, show of the field between two distances (R,); `times` (R,) in
        [0, 1] while the shutter is open, None: when it is half over."""
        begin, end = self._cropped(origins, directions, begin, end, times)
        places, turned = _moved(self.box_from_scene, origins, directions, times)
        stretch = turned.norm(dim=1)
        turned = turned / stretch[:, None]
        first = self._first(places, turned)
        # Rays that begin later than they would do by themselves are moved to where they do.
        shifted = bool((begin * stretch > first).any())
        shift = torch.maximum(begin * stretch, first) - self.settings.near if shifted else torch.zeros_like(first)
        places = places + turned * shift[:, None]
        color, opacity, depth, probabilities, sky = self._rendered(
            places.contiguous(), turned.contiguous(), end * stretch - shift, shifted
        )
        opacity = opacity.clamp(0, 1)
        empty = LEAST if sky is None else 0.5  # haze before the sky has no depth
        met = depth / opacity.clamp(min=LEAST) + shift
        distance = torch.where(opacity > empty, met / stretch, torch.nan)
        best = torch.full_like(opacity, -1, dtype=torch.long)
        share = torch.zeros_like(opacity)
        if probabilities is not None:
            color = self._tinted(color, opacity, probabilities)
            probabilities = self._of_classes(probabilities)
            share, index = probabilities.max(1)
            best = torch.where(probabilities.sum(1) > 0.5 * opacity.clamp(min=LEAST), index, -1)
            color = self._looked(color, probabilities, share)
        return FieldRays(color, opacity, distance, best, share, probabilities, sky)

    def _cropped(
        self,
        origins: torch.Tensor,
        directions: torch.Tensor,
        begin: torch.Tensor,
        end: torch.Tensor,
        times: torch.Tensor | None,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """The part of the rays that is within the crop boxes."""
        for crop in self.crops:
            place, along = _moved(crop, origins, directions, times)
            inverse = 1 / torch.where(along.abs() < 1e-12, 1e-12, along)
            one, other = (-1 - place) * inverse, (1 - place) * inverse
            begin = torch.maximum(begin, torch.minimum(one, other).amax(1))
            end = torch.minimum(end, torch.maximum(one, other).amin(1))
        return begin, end

    def _first(self, places: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
        """Where rays of the cube's frame begin: what the march would do, were they not shifted."""
        s = self.settings
        least = torch.full_like(places[:, 0], s.near)
        if not (s.contracted and s.empty_distance > 0):
            return least
        inverse = 1 / torch.where(directions.abs() < 1e-9, 1e-9, directions)
        entry = torch.minimum((-1 - places) * inverse, (1 - places) * inverse).amax(1)
        return torch.maximum(least, (float(BEFORE_CUBE) * entry).clamp(max=s.empty_distance))

    def _leave(self, places: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
        """Where rays of the cube's frame end by themselves."""
        if self.settings.contracted:
            return torch.full_like(places[:, 0], self.settings.far)
        inverse = 1 / torch.where(directions.abs() < 1e-9, 1e-9, directions)
        return torch.maximum((-1 - places) * inverse, (1 - places) * inverse).amin(1)

    def _rendered(
        self, places: torch.Tensor, directions: torch.Tensor, ends: torch.Tensor, shifted: bool
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor | None, torch.Tensor | None]:
        shown = self.shown
        # Rays that were moved to where they begin take nothing to be empty before them.
        settings = replace(self.settings, empty_distance=0.0) if shifted else self.settings
        limited = bool((ends < self._leave(places, directions)).any())
        if isinstance(shown, BakedField):
            baked = shown.field
            if self.hides:
                opacity = baked.class_opacity.clone()
                opacity[: len(self.opacity)] *= self.opacity
                baked = replace(baked, class_opacity=opacity)
            out = BakedField(baked, settings, shown.environment)(places, directions, ends=ends if limited else None)
        else:
            count = shown.config.render.samples or shown.config.sampling.samples
            if not (limited or self.hides or (shifted and settings.contracted)):
                assert self._plain is not None
                out = self._plain(places, directions, count)
            else:
                # What hidden classes leave to be seen is not where the field is densest.
                settings = replace(settings, mode=PDF_UNIFORM) if self.hides else settings
                grid = replace(shown.render_grid(), settings=settings)
                thin = self._thin(shown, ends) if limited or self.hides else None
                out = shown.render(places, directions, count, grid=grid, thin=thin, ends=ends if limited else None)
        behind = out.environment
        sky = None if behind is None else behind.color
        return out.color, out.opacity, out.depth, out.probabilities, sky

    def _thin(self, model: Model, ends: torch.Tensor) -> Thin:
        def thin(geometry: Geometry, samples: Samples) -> torch.Tensor:
            within = (samples.t <= ends[samples.packed_info.ray_indices.long()]).float()
            if not self.hides:
                return within
            opacity = model.field.class_probabilities(geometry) @ self.opacity
            return within * dimmed(opacity, geometry.density * samples.deltas)

        return thin

    def _tinted(self, color: torch.Tensor, opacity: torch.Tensor, probabilities: torch.Tensor) -> torch.Tensor:
        """The colour with tints of classes and instances."""
        if not bool((self.tint > 0).any()):
            return color
        tinted = probabilities * self.tint
        plain = color / opacity.clamp(min=LEAST)[:, None]
        return color + tinted @ self.tint_colors - tinted.sum(1)[:, None] * plain

    def _of_classes(self, probabilities: torch.Tensor) -> torch.Tensor:
        """The probabilities with those of instances that are told apart added to their classes'."""
        if not len(self.of_class):
            return probabilities
        classes = len(self.field.class_ids)
        return probabilities[:, :classes].index_add(1, self.of_class, probabilities[:, classes:])

    def _looked(self, color: torch.Tensor, probabilities: torch.Tensor, share: torch.Tensor) -> torch.Tensor:
        """The colour, towards those of the classes, and on towards their probability."""
        look = self.item.look
        if look > 0:
            labels = probabilities @ self.colors
            color = torch.lerp(color, labels, min(look, 1.0))
        if look > 1:
            color = torch.lerp(color, share[:, None].expand_as(color), look - 1)
        return color


def dimmed(opacity: torch.Tensor, thickness: torch.Tensor) -> torch.Tensor:
    """Factor (N,) of the density of samples of an optical thickness (N,) with which their alpha is `opacity` (N,) times what it
    was, as in a baked field."""
    # Rounding makes a sum of probabilities more than 1, of which there is no logarithm.
    opacity, thickness = opacity.clamp(0, 1 - 1e-6), thickness.clamp(1e-6, 1e9)
    return -torch.log1p(opacity * torch.expm1(-thickness)) / thickness
