"""The verb `render` with edits: a file says which classes and things of the field are hidden, dimmed, recoloured, moved or copied."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from ..errors import InputError, wrong_value
from ..kernels.voxel_field import VoxelRays
from ..params import RenderParams
from ..progress import Reporter
from ..render import verb
from ..render.baked import BakedField, BakedRays
from .fields import FAR, LoadedField, PlacedField, light_left, load_field
from .shot import ClassLook, FieldItem, Matrix

Share = Annotated[float, Field(ge=0, le=1)]


class Edit(BaseModel):
    """What is changed about one thing of the mesh (`instance`, its name) or one class (its name).

    opacity: a factor, low for solid things; color: sRGB that it is tinted with, wholly unless `tint` says how much; move: the
    matrix (4, 4) of the world that carries it elsewhere; copies: those that carry copies of it.
    """

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, populate_by_name=True)

    instance: str = ""
    class_name: str = Field(default="", alias="class")
    hide: bool = False
    opacity: float = Field(default=1.0, ge=0, le=1)
    color: tuple[Share, Share, Share] | None = None
    tint: float | None = Field(default=None, ge=0, le=1)
    move: Matrix | None = None
    copies: list[Matrix] = []

    @field_validator("move")
    @classmethod
    def _is_matrix(cls, value: Matrix | None) -> Matrix | None:
        if value is not None and (len(value) != 4 or any(len(row) != 4 for row in value)):
            raise ValueError("is not a matrix of 4 × 4 numbers")
        if value is not None and abs(float(np.linalg.det(np.array(value)[:3, :3]))) < 1e-12:
            raise ValueError("scales to nothing")
        return value

    @field_validator("copies")
    @classmethod
    def _are_matrices(cls, value: list[Matrix]) -> list[Matrix]:
        return [cls._is_matrix(one) or one for one in value]

    @model_validator(mode="after")
    def _of_one(self) -> Edit:
        if bool(self.instance) == bool(self.class_name):
            raise ValueError("needs either “instance” or “class”")
        if self.class_name and (self.move is not None or self.copies):
            raise ValueError("only an instance can be moved or copied, not a class")
        if self.instance and self.tint and self.color is None:
            raise ValueError("the tint of an instance needs a “color”")
        return self

    def look(self, color: tuple[float, float, float]) -> ClassLook:
        """How it looks where it is shown; `color`: without one of its own."""
        tint = self.tint if self.tint is not None else float(self.color is not None)
        return ClassLook(opacity=self.opacity, tint=tint, color=self.color or color)


class EditList(BaseModel):
    """What the file of edits holds."""

    model_config = ConfigDict(extra="forbid")

    version: Literal[1] = 1
    edits: list[Edit]


def render(params: RenderParams, report: Reporter) -> dict[str, Any]:
    """`nerfcore.render.verb.render`, with the edits of `params.edits` if there are any.

    Raises:
        InputError: the file of edits cannot be used, or names what is not there.
    """
    if params.edits is None:
        return verb.render(params, report)
    edits = read_edits(params.edits)
    report.stage("Loading the field")
    field = load_field(params.project, params.run, True)
    return verb.render(params, report, EditedField(field, edited_items(field, edits)))


def read_edits(path: Path) -> list[Edit]:
    """The edits of a file. Raises InputError."""
    names = ", ".join(field.alias or name for name, field in Edit.model_fields.items())
    advice = f'Write {{"version": 1, "edits": [{{"class": "wall", "hide": true}}]}}. An edit may have {names}.'
    try:
        edits = EditList.model_validate(json.loads(path.read_text(encoding="utf-8"))).edits
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.", advice) from error
    except ValidationError as error:
        raise InputError(f"{path}: {wrong_value(error.errors()[0])}.", advice) from error
    except ValueError as error:
        raise InputError(f"{path} is not JSON: {error}.", advice) from error
    edited = Counter((edit.class_name, edit.instance) for edit in edits)
    for (class_name, instance), times in edited.items():
        if times > 1:
            raise InputError(
                f"{path} has {times} edits of “{class_name or instance}”.", "Write one edit with all that changes."
            )
    return edits


def edited_items(field: LoadedField, edits: list[Edit]) -> list[FieldItem]:
    """The field with its edits, then things in other places, in the normalised frame. Raises InputError: there is no such
    class."""
    ids = dict(zip(field.class_names, field.class_ids))
    color_of = dict(zip(field.class_ids, (tuple(color) for color in field.class_colors.tolist())))
    classes: dict[int, ClassLook] = {}
    instances: dict[str, ClassLook] = {}
    places: list[tuple[str, ClassLook, Matrix]] = []
    for edit in edits:
        if edit.class_name:
            if edit.class_name not in ids:
                raise InputError(
                    f"The field has no class “{edit.class_name}”.", f"There are {', '.join(ids) or 'none'}."
                )
            number = ids[edit.class_name]
            look = edit.look(color_of[number])
            classes[number] = look.model_copy(update={"opacity": 0.0}) if edit.hide else look
            continue
        look = edit.look((0.0, 0.0, 0.0))
        places += [(edit.instance, look, matrix) for matrix in edit.copies]
        if edit.move is not None and not edit.hide:
            places.append((edit.instance, look, edit.move))
        gone = edit.hide or edit.move is not None
        instances[edit.instance] = look.model_copy(update={"opacity": 0.0}) if gone else look

    def item(look: dict[str, ClassLook], matrix: np.ndarray, only: str = "") -> FieldItem:
        placed = (field.box_from_world @ matrix).tolist()
        return FieldItem(
            name=only or "field", project=field.project, run=field.run, baked=True, scene_from_capture=placed,
            classes=classes, instances=look, only=only,
        )  # fmt: skip

    return [item(instances, np.eye(4)), *(item({name: look}, np.array(m), name) for name, look, m in places)]


class EditedField(BakedField):
    """A baked field as several items show it, the first of which has the environment; of the others the nearest is over
    those behind it."""

    def __init__(self, field: LoadedField, items: list[FieldItem]) -> None:
        base = field.shown
        assert isinstance(base, BakedField)
        super().__init__(base.field, base.settings, base.environment)
        self._placed = [PlacedField(field, item, 0) for item in items]

    def __call__(
        self,
        origins: torch.Tensor,
        directions: torch.Tensor,
        samples_per_ray: int = 0,
        ends: torch.Tensor | None = None,
    ) -> BakedRays:
        """As a baked field's."""
        begin = torch.zeros_like(origins[:, 0])
        end = torch.full_like(begin, FAR) if ends is None else ends
        seen = [placed.rays(origins, directions, begin, end) for placed in self._placed]
        left = light_left(seen)
        shares = left * torch.stack([one.opacity for one in seen])
        color = (left[..., None] * torch.stack([one.color for one in seen])).sum(0)
        opacity = shares.sum(0)
        # A field that is dense nowhere has no depth.
        met = shares * torch.stack([one.distance.isfinite() for one in seen])
        distance = (met * torch.stack([one.distance.nan_to_num(0) for one in seen])).sum(0)
        depth = distance * opacity / met.sum(0).clamp(min=1e-6)
        classes = [part[:, None] * one.probabilities for part, one in zip(left, seen) if one.probabilities is not None]
        probabilities = torch.stack(classes).sum(0) if classes else None
        behind = None
        if self.environment is not None:
            behind = self.environment.behind(directions, VoxelRays(color, opacity, depth, probabilities))
        return BakedRays(color, opacity, depth, probabilities, environment=behind)
