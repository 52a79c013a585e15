"""Fields in the scene: adding one, cropping it, its classes and things, and the compositor that puts it among objects."""

from typing import Any

import bpy
from bpy.types import Context, Operator

from ..addon import paths
from ..addon.errors import SceneError
from ..addon.live import fields, index, things
from ..addon.project import snapshot
from ..addon.props import BoolProperty, CheckExisting, IntProperty, StringProperty
from ..addon.roles import is_local
from ..addon.scene.frame import root_of, scene_from_capture
from ..addon.text import t
from .base import need_run, with_suffix


def active_field(context: Context) -> bpy.types.Object | None:
    """The active object, if it is a field; else the only field of the scene."""
    obj = context.object
    if obj is not None and obj.fieldwork.is_field:
        return obj
    found = fields.field_objects(index.current().in_scene(context.scene))
    return found[0] if len(found) == 1 else None


def need_field(context: Context) -> str | None:
    """Why there is no field to add; one in training is one."""
    settings = context.scene.fieldwork
    folder = snapshot.folder_of(settings)
    if folder is not None:
        from ..addon.live.training import trainings  # not at the top: enabling the extension must be quick

        if trainings.run_of(folder) == settings.run:
            return None
    return need_run(context)


class _OfField(Operator):
    """An operator for the active field."""

    bl_options = {"REGISTER", "UNDO"}
    changes = True  # the field

    @classmethod
    def poll(cls, context: Context) -> bool:
        obj = active_field(context)
        reason = None if obj is not None else t("Choose a field in the scene")
        if obj is not None and obj.library is not None and cls.changes:
            reason = t("“{}” is linked from another file: make a library override of it first", obj.name)
        if reason:
            cls.poll_message_set(reason)
        return reason is None


class FIELDWORK_OT_add_field(Operator):
    """Add the field of the project to the scene, where the capture stands; one in training is shown as it converges"""

    bl_idname = "fieldwork.add_field"
    bl_label = "Add Field"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: Context) -> bool:
        reason = None if bpy.app.background else need_field(context)
        if reason:
            cls.poll_message_set(reason)
        return reason is None

    def execute(self, context: Context) -> set[str]:
        if reason := need_field(context):
            self.report({"ERROR"}, reason)
            return {"CANCELLED"}
        scene, settings = context.scene, context.scene.fieldwork
        folder = snapshot.folder_of(settings)
        obj = bpy.data.objects.new(f"{folder.name} · {settings.run}", None)
        obj.empty_display_type, obj.empty_display_size = "PLAIN_AXES", 0.25
        collection = context.collection if is_local(context.collection) else scene.collection
        collection.objects.link(obj)
        owner = snapshot.owner(folder)
        root = root_of(scene, owner)
        if root is not None:
            obj.parent = root
        else:
            obj.matrix_world = scene_from_capture(scene, owner)
        own = obj.fieldwork
        own.is_field, own.project, own.run = True, settings.project, settings.run
        fields.refresh(obj)
        for other in context.selected_objects:
            other.select_set(False)
        obj.select_set(True)
        context.view_layer.objects.active = obj
        return {"FINISHED"}


class FIELDWORK_OT_add_crop_box(_OfField):
    """Add an empty cube that the field is cut to; move, turn and scale it"""

    bl_idname = "fieldwork.add_crop_box"
    bl_label = "Add Crop Box"

    def execute(self, context: Context) -> set[str]:
        obj = active_field(context)
        box = bpy.data.objects.new(t("Crop of {}", obj.name), None)
        box.empty_display_type, box.empty_display_size = "CUBE", 1.0
        things.put_beside(obj, box)
        box.parent = obj
        obj.fieldwork.crop = box
        return {"FINISHED"}


class FIELDWORK_OT_isolate_class(_OfField):
    """Show only this class of the field; once more, all of them"""

    bl_idname = "fieldwork.isolate_class"
    bl_label = "Isolate Class"

    index: IntProperty(
        name="Class", description="Which class of the field's list", min=0, options={"SKIP_SAVE", "HIDDEN"}
    )

    def execute(self, context: Context) -> set[str]:
        entries = active_field(context).fieldwork.classes
        if self.index >= len(entries):
            self.report({"ERROR"}, t("The field has no such class."))
            return {"CANCELLED"}
        alone = all(entry.visible == (number == self.index) for number, entry in enumerate(entries))
        for number, entry in enumerate(entries):
            entry.visible = alone or number == self.index
        return {"FINISHED"}


class FIELDWORK_OT_refresh_field_classes(_OfField):
    """Read the classes and things of the field from its project anew; what is set for them stays"""

    bl_idname = "fieldwork.refresh_field_classes"
    bl_label = "Refresh Classes and Things"

    def execute(self, context: Context) -> set[str]:
        obj = active_field(context)
        if not fields.refresh(obj):
            self.report({"ERROR"}, t("The project of the field cannot be read at {}.", fields.folder_of(obj.fieldwork)))
            return {"CANCELLED"}
        return {"FINISHED"}


class FIELDWORK_OT_place_thing(_OfField):
    """Add an object where the thing stands: the thing is shown where this object is moved, turned and scaled to"""

    bl_idname = "fieldwork.place_thing"
    bl_label = "Move Thing"

    thing: StringProperty(
        name="Thing", description="Name of the thing; empty: the one chosen in the list", options={"SKIP_SAVE"}
    )
    copy: BoolProperty(
        name="Copy", description="The thing also stays where it stands", default=False, options={"SKIP_SAVE"}
    )

    def execute(self, context: Context) -> set[str]:
        obj = active_field(context)
        own = obj.fieldwork
        entry = own.things.get(self.thing) if self.thing else None
        if not self.thing and 0 <= own.thing_index < len(own.things):
            entry = own.things[own.thing_index]
        if entry is None:
            self.report({"ERROR"}, t("The field has no such thing: extract the mesh, then refresh the list."))
            return {"CANCELLED"}
        placed = things.add_copy(obj, entry, t("Copy of {}", entry.name) if self.copy else entry.name)
        entry.visible = entry.visible and self.copy
        for other in context.selected_objects:
            other.select_set(False)
        if context.view_layer.objects.get(placed.name) == placed:  # not where the field's collection is excluded
            placed.select_set(True)
        return {"FINISHED"}


class FIELDWORK_OT_save_field_edits(_OfField):
    """Write what is edited about the field into a file, for renders on the command line"""

    bl_idname = "fieldwork.save_field_edits"
    bl_label = "Save Field Edits…"
    bl_options = {"REGISTER"}
    changes = False

    filepath: StringProperty(name="File", description="File to write", subtype="FILE_PATH", options={"SKIP_SAVE"})
    filter_glob: StringProperty(default="*.json", options={"HIDDEN"})
    check_existing: CheckExisting()

    def check(self, context: Context) -> bool:
        before, self.filepath = self.filepath, with_suffix(self.filepath, ".json")
        return self.filepath != before  # the file browser then knows which file it is

    def invoke(self, context: Context, event: bpy.types.Event) -> set[str]:
        self.filepath = self.filepath or "edits.json"
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: Context) -> set[str]:
        from ..nerfcore.errors import FieldworkError  # not at the top: enabling the extension must be quick
        from ..nerfcore.files import write_json

        path = paths.absolute(with_suffix(self.filepath, ".json"))
        found = things.edits(active_field(context), context.view_layer.objects)
        try:
            write_json(path, {"version": 1, "edits": found})
        except FieldworkError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, t("The edits of the field are at {}.", path))
        return {"FINISHED"}


class FIELDWORK_OT_setup_compositor(Operator):
    """Render the field in a scene of its own and composite it before and behind the objects of this one"""

    bl_idname = "fieldwork.setup_compositor"
    bl_label = "Composite with Objects"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: Context) -> set[str]:
        from ..addon.live import compositor  # not at the top: enabling the extension must be quick

        try:
            made: Any = compositor.set_up(context.scene)
        except SceneError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, t("The scene “{}” renders the field; F12 here renders both.", made.name))
        return {"FINISHED"}


class FIELDWORK_OT_catch_shadows(Operator):
    """Let the surface of the capture catch the shadows of the scene's objects and hide what is behind it, and composite the field,
    darkened by them, with the objects"""

    bl_idname = "fieldwork.catch_shadows"
    bl_label = "Catch Shadows"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: Context) -> set[str]:
        from ..addon.live import compositor, shadows

        scene = context.scene
        if not shadows.surfaces(scene):
            self.report({"ERROR"}, t("The scene has no surface of a capture: extract the mesh, or press Update Scene."))
            return {"CANCELLED"}
        try:
            compositor.check(scene)
            shadows.catch(scene)
            compositor.set_up(scene)
        except SceneError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, t("The surface catches shadows; F12 renders the objects and the field with them."))
        return {"FINISHED"}


CLASSES = [
    FIELDWORK_OT_add_field,
    FIELDWORK_OT_add_crop_box,
    FIELDWORK_OT_isolate_class,
    FIELDWORK_OT_refresh_field_classes,
    FIELDWORK_OT_place_thing,
    FIELDWORK_OT_save_field_edits,
    FIELDWORK_OT_setup_compositor,
    FIELDWORK_OT_catch_shadows,
]
