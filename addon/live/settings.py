"""What scenes, objects and view layers remember of fields that Blender shows."""

from typing import Any

import bpy
from bpy.types import Context, PropertyGroup

from ..props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    FloatVectorProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)
from ..text import t
from . import index
from .redraw import redraw_views

SOURCES = [
    ("field", "Field", "The field itself: exact, but slow without a large graphics card"),
    ("baked", "Baked Field", "The baked field: nearly the same, and fast; bake it first"),
]


def _project_changed(self: PropertyGroup, context: Context) -> None:
    from ..project import file_paths  # not at the top: enabling the extension must be quick

    file_paths.note([self.id_data])
    _changed(self, context)


def _changed(self: PropertyGroup, context: Context) -> None:
    """What the viewport shows has changed."""
    if not bpy.app.background:
        redraw_views()


def _counts_otherwise(self: PropertyGroup, context: Context) -> None:
    """The object became what views look for, or is it no more."""
    index.forget()
    _changed(self, context)


OVERRIDABLE = {"LIBRARY_OVERRIDABLE"}  # where the object is linked from another file
SHOWN: dict[str, Any] = {"update": _changed, "override": OVERRIDABLE}


class FieldworkFieldClass(PropertyGroup):
    """How a field in the scene shows one of its classes. `name` is that of the class."""

    id: IntProperty()
    color: FloatVectorProperty(
        name="Color", description="Color that the class is tinted with", subtype="COLOR_GAMMA", min=0.0, max=1.0,
        **SHOWN,
    )  # fmt: skip
    visible: BoolProperty(
        name="Visible", description="Show the class; what is behind it appears where it is hidden", default=True,
        **SHOWN,
    )  # fmt: skip
    opacity: FloatProperty(
        name="Opacity", description="How much of the class is seen", default=1.0, min=0.0, max=1.0, subtype="FACTOR",
        **SHOWN,
    )  # fmt: skip
    tint: FloatProperty(
        name="Tint", description="How much of its own color the class gets", default=0.0, min=0.0, max=1.0,
        subtype="FACTOR", **SHOWN,
    )  # fmt: skip

    @property
    def shown(self) -> float:
        """Opacity, 0 where it is hidden."""
        return self.opacity if self.visible else 0.0


class FieldworkFieldThing(PropertyGroup):
    """How one thing of a baked field is shown. `name` is that of the instance of the mesh."""

    center: FloatVectorProperty(subtype="XYZ")  # in the capture's own frame
    color: FloatVectorProperty(
        name="Color", description="Color that the thing is tinted with", subtype="COLOR_GAMMA", min=0.0, max=1.0,
        default=(1.0, 1.0, 1.0), **SHOWN,
    )  # fmt: skip
    visible: BoolProperty(
        name="Visible", description="Show the thing where it stands; its copies are objects of their own", default=True,
        **SHOWN,
    )  # fmt: skip
    opacity: FloatProperty(
        name="Opacity", description="How much of the thing and of its copies is seen", default=1.0, min=0.0, max=1.0,
        subtype="FACTOR", **SHOWN,
    )  # fmt: skip
    tint: FloatProperty(
        name="Tint", description="How much of its color the thing and its copies get", default=0.0, min=0.0, max=1.0,
        subtype="FACTOR", **SHOWN,
    )  # fmt: skip

    @property
    def look(self) -> dict[str, object]:
        """How it and its copies look, as nerfcore/film/shot.py has it."""
        return {"opacity": self.opacity, "tint": self.tint, "color": tuple(self.color)}

    @property
    def edited(self) -> bool:
        """Whether it is shown other than it is."""
        return not self.visible or self.opacity < 1 or self.tint > 0


class FieldworkThingCopy(PropertyGroup):
    """What an object says of a thing that is shown where it stands: the field, the thing's name, and the place of the
    thing in the capture's own frame that lies on the object's origin."""

    field: PointerProperty(type=bpy.types.Object, update=_counts_otherwise)
    thing: StringProperty(update=_counts_otherwise)
    center: FloatVectorProperty(subtype="XYZ")


def _is_crop_box(self: PropertyGroup, obj: bpy.types.Object) -> bool:
    return obj.type == "EMPTY"


class FieldworkField(PropertyGroup):
    """A field in the scene: its object, an empty, says where it lies."""

    is_field: BoolProperty(update=_counts_otherwise)
    project: StringProperty(
        name="Project", description="Project folder of the field", subtype="DIR_PATH", update=_project_changed
    )
    folder: StringProperty(
        name="Folder", description="Where a project beside the file was last, for what is pasted", options={"HIDDEN"}
    )
    run: StringProperty(name="Run", description="Training run that is shown", default="main", **SHOWN)
    look: FloatProperty(
        name="Look", description="What is shown: 0 the photos' colors, 1 the classes, 2 how certain they are",
        default=0.0, min=0.0, max=2.0, **SHOWN,
    )  # fmt: skip
    crop: PointerProperty(
        name="Crop Box", description="Empty whose cube cuts the field; none: all of it is shown",
        type=bpy.types.Object, poll=_is_crop_box, update=_counts_otherwise, override=OVERRIDABLE,
    )  # fmt: skip
    classes: CollectionProperty(type=FieldworkFieldClass, override=OVERRIDABLE)
    class_index: IntProperty(name="Class", description="Selected class")
    things: CollectionProperty(type=FieldworkFieldThing, override=OVERRIDABLE)
    thing_index: IntProperty(name="Thing", description="Selected thing")


class FieldworkLayer(PropertyGroup):
    """Passes of a view layer that Blender has no switch for."""

    use_class_index: BoolProperty(name="Class Index", description="The id of the class", update=lambda s, c: _passes(s))
    use_class_color: BoolProperty(
        name="Class Color", description="The color of the class", update=lambda s, c: _passes(s)
    )
    use_confidence: BoolProperty(
        name="Confidence", description="How certain the class is", update=lambda s, c: _passes(s)
    )


def _passes(self: PropertyGroup) -> None:
    """Let the nodes of the compositor know of the passes."""
    if hasattr(self.id_data, "view_layers"):
        for layer in self.id_data.view_layers:
            layer.update_render_passes()


class FieldworkLive(PropertyGroup):
    """How a scene renders and draws fields."""

    source: EnumProperty(name="Render", description="What is rendered", items=SOURCES, default="field")
    samples: IntProperty(
        name="Samples", description="Rays through each pixel: smoother edges, softer blur", default=4, min=1,
        max=4096, soft_max=256,
    )  # fmt: skip
    objects_hide: BoolProperty(
        name="Objects in Front", description="The scene's meshes hide what of the field is behind them, and the passes "
        "FieldFront and FieldBehind say what to composite over and under them", default=False,
        update=lambda self, context: _passes(self),
    )  # fmt: skip
    viewport: BoolProperty(
        name="Draw in Viewport", description="Draw the baked fields of the scene in its viewports", default=True,
        update=_changed,
    )  # fmt: skip
    quality: EnumProperty(
        name="Resolution",
        description="Resolution of the viewport's picture; while the view moves, it is half of that",
        items=[
            ("1", "Full", "Every pixel of the viewport"),
            ("2", "Half", "Every other pixel"),
            ("4", "Quarter", "Every fourth pixel: for weak graphics cards"),
        ],
        update=_changed,
    )


def look_name(look: float) -> str:
    """What a look shows, in a word."""
    return t("Photo") if look < 0.5 else t("Labels") if look < 1.5 else t("Confidence")


CLASSES = [FieldworkFieldClass, FieldworkFieldThing, FieldworkThingCopy, FieldworkField, FieldworkLayer, FieldworkLive]


def register() -> None:
    bpy.types.Object.fieldwork = PointerProperty(type=FieldworkField, override=OVERRIDABLE)
    bpy.types.Object.fieldwork_copy = PointerProperty(type=FieldworkThingCopy)
    bpy.types.ViewLayer.fieldwork = PointerProperty(type=FieldworkLayer)
    bpy.types.Scene.fieldwork_live = PointerProperty(type=FieldworkLive)


def unregister() -> None:
    del bpy.types.Object.fieldwork
    del bpy.types.Object.fieldwork_copy
    del bpy.types.ViewLayer.fieldwork
    del bpy.types.Scene.fieldwork_live
