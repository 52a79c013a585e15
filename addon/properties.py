"""What a scene remembers of its capture: `Scene.fieldwork`. The capture itself lives in the project folder."""

import bpy
from bpy.types import Context, PropertyGroup

from .choices import CAMERAS, EXPORTS, MASK_MODES, PASSES, POSE_PRESETS, PRESETS, SPLITS, UP
from .label_settings import LabelSettings
from .measure_settings import MeasureSettings
from .mesh_settings import MeshSettings
from .props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    FloatVectorProperty,
    IntProperty,
    IntVectorProperty,
    PointerProperty,
    StringProperty,
)


def _project_changed(self: "FieldworkScene", context: Context) -> None:
    """Another project folder was chosen."""
    from .jobs.follow import reattach
    from .jobs.queue import queue
    from .project import file_paths, lists, recent, snapshot

    if file_paths.rewriting:
        return
    lists.other_project(self)
    folder = snapshot.folder_of(self)
    if folder is not None and not bpy.app.background:
        reattach(queue, folder)
        if snapshot.has_project(folder):
            recent.remember(folder)


def _row_chosen(self: "FieldworkScene", context: Context) -> None:
    """A click on a photo in the table of poses looks through its camera, where it is in the scene."""
    from .project import snapshot
    from .scene import viewing

    folder = snapshot.folder_of(self)
    if bpy.app.background or folder is None or not 0 <= self.pose_index < len(self.images):
        return
    camera = viewing.photo_camera_of(self.id_data, snapshot.owner(folder), self.images[self.pose_index].name)
    if camera is not None:
        viewing.look_through(self.id_data, camera)


def _run_changed(self: "FieldworkScene", context: Context) -> None:
    """Another run, another mesh: the areas of the classes are those of its mesh."""
    from .project import classes

    classes.fill(self)


def _classes_edited(self: PropertyGroup, context: Context) -> None:
    from .project import classes

    classes.edited(self.id_data.fieldwork)


def _class_visibility(self: "FieldworkClass", context: Context) -> None:
    from .project import classes

    classes.show(self.id_data.fieldwork)


class FieldworkImage(PropertyGroup):
    """One photo of the project. `name` is its name there."""

    file: StringProperty()
    status: StringProperty()
    reason: StringProperty()
    width: IntProperty()
    height: IntProperty()
    sharpness: FloatProperty()
    points: IntProperty()
    error_px: FloatProperty()
    labelled: BoolProperty()
    masked: BoolProperty()


class FieldworkClass(PropertyGroup):
    """One class of the label maps."""

    id: IntProperty(name="Id", description="Value of the class in the label maps")
    name: StringProperty(name="Name", description="Name of the class", update=_classes_edited)
    color: FloatVectorProperty(
        name="Color",
        description="Color of the class in label images and on the mesh",
        subtype="COLOR_GAMMA",
        min=0.0,
        max=1.0,
        update=_classes_edited,
    )
    priority: FloatProperty(
        name="Priority",
        description="How strongly training samples are drawn to the class; 1 is normal, 0 is not at all",
        default=1.0,
        min=0.0,
        soft_max=10.0,
        update=_classes_edited,
    )
    visible: BoolProperty(
        name="Visible", description="Show the class on the mesh in the scene", default=True, update=_class_visibility
    )
    area: FloatProperty(name="Area", description="Area of the class on the mesh", unit="AREA")


class FieldworkScene(LabelSettings, MeshSettings, MeasureSettings, PropertyGroup):
    project: StringProperty(
        name="Project",
        description="Folder that holds everything known about the capture",
        subtype="DIR_PATH",
        update=_project_changed,
    )
    project_uuid: StringProperty(
        name="Project UUID", description="Which project was in the folder when it was last there", options={"HIDDEN"}
    )
    campaign: StringProperty(
        name="Campaign",
        description="List of captures, or folder beside it, of a batch on a cluster that the panel follows",
        subtype="FILE_PATH",
    )

    # Capture
    photos: StringProperty(name="Photos", description="Folder of photos, or a video file", subtype="FILE_PATH")
    labels: StringProperty(
        name="Labels", description="Folder of label maps named like the photos; may be empty", subtype="DIR_PATH"
    )
    masks: StringProperty(
        name="Masks", description="Folder of masks named like the photos; may be empty", subtype="DIR_PATH"
    )
    class_file: StringProperty(
        name="Class Names", description="classes.json with the names of the label values", subtype="FILE_PATH"
    )
    mask_mode: EnumProperty(
        name="Black in Masks",
        description="What black pixels of a mask mean",
        items=MASK_MODES,
        default="automatic",
    )
    max_size: IntProperty(
        name="Working Size",
        description="Long side of the working copies of the photos in pixels",
        default=1600,
        min=64,
        soft_max=4096,
        subtype="PIXEL",
    )
    frames: IntProperty(
        name="Video Frames", description="How many frames are taken from a video", default=80, min=4, soft_max=400
    )
    keep_backdrop: BoolProperty(
        name="Keep Dark Surroundings",
        description="Make no masks where the photos show an object before dark surroundings",
    )
    keep_blurry: BoolProperty(name="Keep Blurry Photos", description="Use photos that look blurred too")
    images: CollectionProperty(type=FieldworkImage)
    image_index: IntProperty(name="Image", description="Selected photo")
    pose_index: IntProperty(name="Camera", description="The photo whose camera is looked through", update=_row_chosen)

    # Poses
    pose_preset: EnumProperty(name="Preset", description="How hard to try", items=POSE_PRESETS, default="standard")
    pose_group: IntProperty(
        name="Group",
        description="Where the photos fall into separate groups: which one to use; 0 is the largest",
        default=0,
        min=0,
        soft_max=5,
    )
    keep_exposure: BoolProperty(
        name="Keep Exposures",
        description="Do not bring photos that differ in exposure or white balance to a common one",
    )
    up: EnumProperty(name="Up", description="Which direction of the scene is up", items=UP)
    point_a: FloatVectorProperty(name="Point A", description="One end of a known distance", subtype="TRANSLATION")
    point_b: FloatVectorProperty(name="Point B", description="Other end of a known distance", subtype="TRANSLATION")
    distance: FloatProperty(
        name="Distance", description="True distance of the two points", default=1.0, min=1e-4, unit="LENGTH"
    )

    region_box: PointerProperty(
        name="Region Box", description="Empty whose bounds are the training region", type=bpy.types.Object
    )

    # Classes
    classes: CollectionProperty(type=FieldworkClass)
    class_index: IntProperty(name="Class", description="Selected class")

    # Training
    preset: EnumProperty(name="Preset", description="Trade quality for time", items=PRESETS, default="standard")
    run: StringProperty(
        name="Run",
        description="Name of the training run; several runs may stand side by side",
        default="main",
        update=_run_changed,
    )
    hold_out: BoolProperty(
        name="Hold Out Photos",
        description="Leave every eighth photo out of the training to measure the result with; off: train the final field "
        "on all photos",
        default=True,
    )
    time_limit: FloatProperty(
        name="Time Limit",
        description="Training ends after so many seconds; 0: when the preset is done",
        default=0.0,
        min=0.0,
        soft_max=7200.0,
        step=1000,
        subtype="TIME_ABSOLUTE",
    )
    steps: IntProperty(name="Steps", description="Optimization steps; 0: as many as the preset says", default=0, min=0)
    settings: StringProperty(name="Settings", description="More settings of the run: name=value, separated by spaces")

    # Rendering
    render_from: EnumProperty(
        name="From",
        description="Which cameras to render from",
        items=[
            ("camera", "Scene Camera", "The active camera of the scene at the current frame"),
            ("animation", "Animation", "The active camera of the scene over its frame range"),
            ("photos", "Held-Out Photos", "The photos that training did not see"),
            ("all", "All Photos", "Every photo, also those of training"),
            ("orbit", "Orbit", "Around the scene, as far as photos were taken"),
        ],
    )
    orbit: IntProperty(name="Frames", description="Images around the scene", default=24, min=2, soft_max=360)
    size: IntVectorProperty(
        name="Size",
        description="Width and height in pixels; 0: that of the camera",
        size=2,
        default=(0, 0),
        min=0,
        soft_max=4096,
    )
    passes: EnumProperty(
        name="Passes",
        description="What to render",
        items=PASSES,
        options={"ENUM_FLAG"},
        default={"rgb", "depth", "semantic"},
    )
    show_as: EnumProperty(
        name="Show As",
        description="What becomes of the rendered images in the scene",
        items=[
            ("none", "Images", "Image datablocks only"),
            ("background", "Camera Background", "Behind the camera they were rendered from"),
            ("plane", "Image Planes", "On planes in front of the cameras"),
        ],
    )

    # In the scene
    scene_cameras: EnumProperty(
        name="Cameras", description="How the photos' cameras appear in the scene", items=CAMERAS
    )
    scene_split: EnumProperty(name="In the Scene", description="How the surface appears in the scene", items=SPLITS)

    # Export
    export_to: EnumProperty(name="Format", description="What is written", items=EXPORTS)
    export_split: EnumProperty(
        name="Objects",
        description="What the file holds: one object, or one for each class or instance",
        items=SPLITS,
    )
    voxels: IntProperty(
        name="Voxels", description="Cells along each side of the field's cube", default=128, min=8, max=512
    )
    export_path: StringProperty(
        name="File",
        description="File to write, or folder of masks and COLMAP models; empty: in the exports of the project",
        subtype="FILE_PATH",
    )


# By name, those that a scene has from its parts too: a class knows only its own.
PARTS = (LabelSettings, MeshSettings, MeasureSettings, FieldworkScene)
SETTINGS = {name: made for part in PARTS for name, made in part.__annotations__.items()}
CLASSES = [FieldworkImage, FieldworkClass, FieldworkScene]


def register() -> None:
    bpy.types.Scene.fieldwork = PointerProperty(type=FieldworkScene)


def unregister() -> None:
    del bpy.types.Scene.fieldwork
