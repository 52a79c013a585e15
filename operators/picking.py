"""Clicks in the viewport: one end of a known distance, or what is known of a place of the surface."""

from typing import TYPE_CHECKING, Any

from bpy.types import Area, Context, Event, Operator, UILayout

from ..addon.props import BoolProperty, EnumProperty, StringProperty
from ..addon.scene import viewing
from ..addon.text import t

if TYPE_CHECKING:
    from ..addon.scene.spot import Spot

MOST_PHOTOS = 6  # in the list of those that show a place


class ViewportPick(Operator):
    """An operator that waits for a click in a 3D viewport; the view can be turned meanwhile."""

    bl_options = {"REGISTER", "UNDO"}

    def prompt(self) -> str:
        """What the status bar says meanwhile."""
        raise NotImplementedError

    def take(self, context: Context, area: Area, x: int, y: int) -> bool:
        """Use what is under the mouse; whether there was anything."""
        raise NotImplementedError

    def wait(self, context: Context) -> set[str]:
        self._area = context.area
        context.window.cursor_modal_set("EYEDROPPER")
        context.workspace.status_text_set(self.prompt())
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: Context, event: Event) -> set[str]:
        if event.type in {"ESC", "RIGHTMOUSE"} and event.value == "PRESS":
            return self._end(context, {"CANCELLED"})
        if event.type == "LEFTMOUSE" and event.value == "PRESS":
            if self.take(context, self._area, event.mouse_x, event.mouse_y):
                return self._end(context, {"FINISHED"})
            return {"RUNNING_MODAL"}
        # The view can be turned meanwhile.
        return {"RUNNING_MODAL"} if event.type in {"LEFTMOUSE", "RIGHTMOUSE"} else {"PASS_THROUGH"}

    def _end(self, context: Context, result: set[str]) -> set[str]:
        context.window.cursor_modal_restore()
        context.workspace.status_text_set(None)
        self._area.tag_redraw()
        return result


class FIELDWORK_OT_pick_point(ViewportPick):
    """Click one end of a known distance in the viewport, on a sparse point or on a surface"""

    bl_idname = "fieldwork.pick_point"
    bl_label = "Pick Point"

    end: EnumProperty(items=[("A", "A", "First point"), ("B", "B", "Second point")], options={"SKIP_SAVE"})
    use_cursor: BoolProperty(
        name="3D Cursor", description="Take the place of the 3D cursor instead of a click", options={"SKIP_SAVE"}
    )

    @classmethod
    def description(cls, context: Context, properties: Any) -> str:
        return t("Take the place of the 3D cursor") if properties.use_cursor else t(cls.__doc__ or "")

    def execute(self, context: Context) -> set[str]:
        """Without a mouse, the place of the 3D cursor."""
        setattr(context.scene.fieldwork, f"point_{self.end.lower()}", context.scene.cursor.location)
        return {"FINISHED"}

    def invoke(self, context: Context, event: Event) -> set[str]:
        if self.use_cursor or context.area is None or context.area.type != "VIEW_3D":
            return self.execute(context)
        return self.wait(context)

    def prompt(self) -> str:
        return t("Point {}: click a sparse point or a surface. Esc or right-click: cancel", self.end)

    def take(self, context: Context, area: Area, x: int, y: int) -> bool:
        from ..addon.scene import picking  # not at the top: it needs numpy, and enabling the extension must be quick

        point = picking.point_under(context, area, x, y)
        if point is None:
            self.report({"WARNING"}, t("There is neither a point nor a surface here"))
            return False
        context.scene.cursor.location = point
        self.execute(context)
        return True


class FIELDWORK_OT_pick_surface(ViewportPick):
    """Click a place of the surface to read its class, instance and confidence, and which photos show it"""

    bl_idname = "fieldwork.pick_surface"
    bl_label = "What Is This?"
    bl_options = {"REGISTER"}

    @classmethod
    def poll(cls, context: Context) -> bool:
        if context.area is None or context.area.type != "VIEW_3D":
            cls.poll_message_set(t("Places are picked in a 3D viewport"))
            return False
        return True

    def invoke(self, context: Context, event: Event) -> set[str]:
        return self.wait(context)

    def prompt(self) -> str:
        return t("Click a place of the surface. Esc or right-click: cancel")

    def take(self, context: Context, area: Area, x: int, y: int) -> bool:
        from ..addon.scene import picking  # not at the top: it needs numpy, and enabling the extension must be quick

        spot = picking.spot_under(context, area, x, y)
        if spot is None:
            self.report({"WARNING"}, t("There is no surface of a capture here"))
            return False
        context.scene.cursor.location = spot.place
        self.report({"INFO"}, spot_text(spot))
        title = spot.instance or spot.class_name
        context.window_manager.popup_menu(lambda menu, _: draw_spot(menu.layout, spot), title=title, icon="EYEDROPPER")
        return True


def spot_text(spot: "Spot") -> str:
    """One line of what is known of a place."""
    name = f"{spot.class_name}, {spot.instance}" if spot.instance else spot.class_name
    if spot.guessed:
        return t("{}: {:.0%} sure, its surface a guess", name, spot.confidence)
    return t("{}: {:.0%} sure, shown by {} photos", name, spot.confidence, len(spot.photos))


def draw_spot(layout: UILayout, spot: "Spot") -> None:
    layout.label(text=spot_text(spot), translate=False)
    for shown in spot.photos[:MOST_PHOTOS]:
        name = shown.camera.name
        layout.operator("fieldwork.show_photo", text=name, translate=False, icon="IMAGE_DATA").camera = name


class FIELDWORK_OT_show_photo(Operator):
    """Look through the camera of a photo, with the photo behind it, and show it in an open image editor"""

    bl_idname = "fieldwork.show_photo"
    bl_label = "Show Photo"
    bl_options = {"REGISTER", "UNDO"}

    camera: StringProperty(name="Camera", description="Name of the camera in the scene", options={"SKIP_SAVE"})

    def execute(self, context: Context) -> set[str]:
        camera = context.scene.objects.get(self.camera)
        if camera is None or camera.type != "CAMERA":
            self.report({"ERROR"}, t("There is no camera “{}” in the scene", self.camera))
            return {"CANCELLED"}
        viewing.look_through(context.scene, camera)
        return {"FINISHED"}


CLASSES = [FIELDWORK_OT_pick_point, FIELDWORK_OT_pick_surface, FIELDWORK_OT_show_photo]
