"""Capture: photos, a video or a posed data set become a project."""

from pathlib import Path
from typing import Any

import bpy
from bpy.types import Context, FileHandler, Operator, OperatorFileListElement

from ..addon import paths
from ..addon.choices import MASK_MODES
from ..addon.project import snapshot
from ..addon.props import BoolProperty, CollectionProperty, EnumProperty, StringProperty
from ..addon.text import t
from ..nerfcore.images.suffixes import PHOTO_SUFFIXES, VIDEO_SUFFIXES
from .base import ProjectOperator, absolute, mask_mode, need_photos, need_project_folder, scene_settings, set_if_empty

READ = PHOTO_SUFFIXES | VIDEO_SUFFIXES
# What Blender's own filters of pictures and movies do not show in a file browser.
OTHERS = sorted(READ - bpy.path.extensions_image - bpy.path.extensions_movie)
PHOTO_FOLDERS = ("photos", "images", "rgb")
FORMATS = [
    ("auto", "Automatic", "Find out"),
    ("transforms", "transforms.json", "NeRF and nerfstudio captures"),
    ("colmap", "COLMAP", "A COLMAP model with its images"),
    ("llff", "LLFF", "poses_bounds.npy with images"),
    ("scannet", "ScanNet", "A ScanNet scene"),
    ("replica", "Replica", "A Replica sequence"),
    ("dtu", "DTU", "A DTU scan"),
    ("strecha", "Strecha", "A Strecha multi-view scene"),
    ("middlebury", "Middlebury", "A Middlebury multi-view set"),
    ("metashape", "Metashape", "Cameras exported from Metashape"),
    ("realityscan", "RealityScan", "Cameras exported from RealityScan"),
    ("meshroom", "Meshroom", "A Meshroom cameras.sfm"),
]


def project_for(source: Path) -> Path:
    """Where the project of a capture goes when the user names no place: beside it."""
    if source.suffix.lower() in VIDEO_SUFFIXES:
        return source.with_name(f"{source.stem}_fieldwork")
    whole = source.parent if source.name.lower() in PHOTO_FOLDERS else source
    return whole.with_name(f"{whole.name}_fieldwork")


def photo_folder(source: Path) -> Path:
    """The folder of photos meant by a folder: one of its own named for photos where it has none itself."""
    if not source.is_dir() or any(path.suffix.lower() in PHOTO_SUFFIXES for path in source.iterdir()):
        return source
    return next((source / name for name in PHOTO_FOLDERS if (source / name).is_dir()), source)


def beside(photos: Path, name: str) -> str:
    """A folder or file of the capture inside the folder of photos, or beside it; empty when there is none."""
    places = [photos, photos.parent] if photos.name.lower() in PHOTO_FOLDERS else [photos]
    return next((str(place / name) for place in places if (place / name).exists()), "")


def choose_source(scene: bpy.types.Scene, source: Path) -> None:
    """Let the scene show a folder of photos, a video, or a project."""
    settings = scene.fieldwork
    if snapshot.has_project(source):
        settings.project = str(source)
        return
    photos = photo_folder(source)
    settings.photos = str(photos)
    settings.labels, settings.masks = beside(photos, "labels"), beside(photos, "masks")
    settings.class_file = beside(photos, "classes.json")
    settings.project = str(project_for(photos))


@scene_settings(
    photos="photos", labels="labels", masks="masks", classes="class_file", mask_mode="mask_mode",
    keep_backdrop="keep_backdrop", max_size="max_size", frames="frames", keep_blurry="keep_blurry",
)  # fmt: skip
class FIELDWORK_OT_new(ProjectOperator):
    """Read the photos, or frames of the video, into the project"""

    bl_idname = "fieldwork.new"
    bl_label = "Read Photos"
    verb = "new"
    needs = (need_photos, need_project_folder)

    add: BoolProperty(name="Add", description="Add the photos to those that the project has", options={"SKIP_SAVE"})

    @classmethod
    def description(cls, context: Context, properties: Any) -> str:
        return t("Add the photos to those that the project has") if properties.add else t(cls.__doc__ or "")

    def parameters(self, context: Context) -> dict[str, Any]:
        photos = self.path(context, "photos")
        if photos is None:
            raise ValueError(t("Choose a folder of photos, or a video, first."))
        project = self.project_path(context)
        set_if_empty(context.scene, project)
        plain = ("keep_backdrop", "max_size", "frames", "keep_blurry")
        return {
            "project": project,
            "photos": photos,
            **{name: self.path(context, name) for name in ("labels", "masks", "classes")},
            "mask_mode": mask_mode(self.value(context, "mask_mode")),
            **{name: self.value(context, name) for name in plain},
            "add": self.add,
        }


class FIELDWORK_OT_import_dataset(ProjectOperator):
    """Make a project from photos whose camera poses are known"""

    bl_idname = "fieldwork.import_dataset"
    bl_label = "Import Posed Data Set"
    verb = "import"

    directory: StringProperty(
        name="Data Set", description="Folder of the data set", subtype="DIR_PATH", options={"SKIP_SAVE"}
    )
    format: EnumProperty(name="Format", description="Kind of the data set", items=FORMATS, options={"SKIP_SAVE"})
    classes: StringProperty(
        name="Classes",
        description="File classes.json that names the label ids, where it is not beside the labels",
        subtype="FILE_PATH",
        options={"SKIP_SAVE"},
    )
    mask_mode: EnumProperty(
        name="Black in Masks",
        description="What black pixels of a mask mean",
        items=MASK_MODES,
        default="automatic",
        options={"SKIP_SAVE"},
    )
    keep_backdrop: BoolProperty(
        name="Keep Dark Surroundings",
        description="Make no masks where the photos show an object before dark surroundings",
        options={"SKIP_SAVE"},
    )

    def invoke(self, context: Context, event: bpy.types.Event) -> set[str]:
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def parameters(self, context: Context) -> dict[str, Any]:
        if not self.directory:
            raise ValueError(t("Choose the folder of a data set first."))
        source = paths.absolute(self.directory)
        # A scene that shows another capture gets a new project, not that capture's.
        given = self.properties.is_property_set("project") and bool(self.project)
        project = Path(self.project_path(context)) if given else project_for(source)
        context.scene.fieldwork.project = str(project)
        return {
            "dataset": str(source),
            "project": str(project),
            "format": self.format,
            "classes": absolute(self.classes),
            "mask_mode": mask_mode(self.mask_mode),
            "keep_backdrop": self.keep_backdrop,
        }


class FIELDWORK_OT_open(Operator):
    """Choose a folder of photos, a video, or an existing project"""

    bl_idname = "fieldwork.open"
    bl_label = "Open Photos or Project"
    bl_options = {"UNDO"}

    filepath: StringProperty(subtype="FILE_PATH", options={"SKIP_SAVE"})
    directory: StringProperty(subtype="DIR_PATH", options={"SKIP_SAVE"})
    files: CollectionProperty(type=OperatorFileListElement, options={"SKIP_SAVE", "HIDDEN"})
    filter_folder: BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})
    filter_image: BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})
    filter_movie: BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})
    filter_glob: StringProperty(default=";".join(f"*{suffix}" for suffix in OTHERS), options={"HIDDEN", "SKIP_SAVE"})

    def invoke(self, context: Context, event: bpy.types.Event) -> set[str]:
        # Dropped onto the viewport: the path is known already.
        if self.directory or self.filepath:
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: Context) -> set[str]:
        try:
            source = source_of(self.chosen())
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        choose_source(context.scene, source)
        show_sidebar(context)
        return {"FINISHED"}

    def chosen(self) -> Path:
        """The folder, or the first of the files. Raises ValueError with a sentence for the user: there is none."""
        names = [file.name for file in self.files if file.name]
        path = self.filepath or self.directory
        if self.directory and names:
            return paths.absolute(self.directory) / names[0]
        if not path:
            raise ValueError(t("Choose a folder of photos, a video, or an existing project."))
        return paths.absolute(path)


def source_of(chosen: Path) -> Path:
    """The folder or video meant: a photo stands for its folder, project.json for its project.

    Raises ValueError with a sentence for the user: it does not exist, or is JSON of another kind.
    """
    source = chosen if chosen.is_dir() or chosen.suffix.lower() in VIDEO_SUFFIXES else chosen.parent
    if not source.exists():
        raise ValueError(t("There is nothing at {}.", source))
    is_json = source != chosen and chosen.suffix.lower() == ".json"
    if is_json and (chosen.name.lower() != snapshot.PROJECT_FILE or snapshot.project(source) is None):
        raise ValueError(
            t(
                "{} is no project of Fieldwork: choose a project.json, or a folder of photos. Photos with known cameras, "
                "such as those of a transforms.json, are read by Import Posed Data Set.",
                chosen,
            )
        )
    return source


def show_sidebar(context: Context) -> None:
    """Open the sidebar at Fieldwork's tab, where there is a 3D viewport."""
    area = context.area
    if area is not None and area.type == "VIEW_3D":
        area.spaces.active.show_region_ui = True
        for region in area.regions:
            # The tab can only be set once the sidebar has been drawn.
            if region.type == "UI" and region.active_panel_category not in ("", "UNSUPPORTED"):
                region.active_panel_category = "Fieldwork"


def shows_fieldwork(area: bpy.types.Area | None) -> bool:
    """Whether an area is a 3D viewport whose sidebar is open at Fieldwork's tab."""
    if area is None or area.type != "VIEW_3D" or not area.spaces.active.show_region_ui:
        return False
    return any(region.type == "UI" and region.active_panel_category == "Fieldwork" for region in area.regions)


class FIELDWORK_FH_capture(FileHandler):
    """A photo stands for its folder. Only where Fieldwork is open: elsewhere Blender makes of a picture what it always
    does, without asking."""

    bl_idname = "FIELDWORK_FH_capture"
    bl_label = "Fieldwork Photos or Video"
    bl_import_operator = "fieldwork.open"
    bl_file_extensions = ";".join(sorted(READ))

    @classmethod
    def poll_drop(cls, context: Context) -> bool:
        return shows_fieldwork(context.area)


class FIELDWORK_FH_project(FileHandler):
    """A project.json stands for its project."""

    bl_idname = "FIELDWORK_FH_project"
    bl_label = "Fieldwork Project"
    bl_import_operator = "fieldwork.open"
    bl_file_extensions = ".json"

    @classmethod
    def poll_drop(cls, context: Context) -> bool:
        return context.area is not None and context.area.type == "VIEW_3D"


CLASSES = [
    FIELDWORK_OT_new,
    FIELDWORK_OT_import_dataset,
    FIELDWORK_OT_open,
    FIELDWORK_FH_capture,
    FIELDWORK_FH_project,
]
