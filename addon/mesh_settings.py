"""What a scene remembers of meshes; a part of `Scene.fieldwork`."""

from .choices import SPLITS, TEXTURE_SIZES
from .props import BoolProperty, EnumProperty, FloatProperty, IntProperty, StringProperty

SOME_FACES = 200_000  # where the user wants fewer than all, at first


def _keep_all_faces(self: "MeshSettings", keep: bool) -> None:
    self.faces = 0 if keep else SOME_FACES


class MeshSettings:
    """Properties of `properties.FieldworkScene`."""

    resolution: IntProperty(
        name="Resolution",
        description="Cells along the longest side of what the photos show; memory grows with the square. 0: 512, or up "
        "to 1024 where the photos are finer",
        default=0,
        min=0,
        max=2048,
    )
    detail: FloatProperty(
        name="Detail",
        description="Side of a cell in millimeters, instead of the resolution; needs a known scale. 0: the resolution",
        default=0.0,
        min=0.0,
        soft_max=100.0,
    )
    mesh_region: EnumProperty(
        name="Region",
        description="What part of the capture becomes surface",
        items=[
            ("auto", "Automatic", "The training region, or what the photos show where there is none"),
            ("photos", "All Photos Show", "Everything that the photos show, whatever the training region"),
        ],
    )
    turntable: StringProperty(
        name="Turntable",
        description="Folder for pictures of the mesh from eight sides, its colors and its classes; empty: none",
        subtype="DIR_PATH",
    )
    faces: IntProperty(
        name="Faces",
        description="Target number of triangles, at least 100; 0: keep all",
        default=200_000,
        min=0,
        soft_max=2_000_000,
    )
    all_faces: BoolProperty(
        name="All",
        description="Keep all triangles, however many",
        get=lambda self: self.faces == 0,
        set=_keep_all_faces,
    )
    lods: IntProperty(
        name="Levels of Detail",
        description="Coarser meshes to write as well, each with a quarter of the triangles",
        default=0,
        min=0,
        max=6,
    )
    watertight: BoolProperty(
        name="Watertight",
        description="Close the surface: what no photo shows counts as inside, and its faces are marked as unseen",
    )
    close_gaps: FloatProperty(
        name="Close Gaps",
        description="Width, in percent of the longest side of the region, up to which holes, cracks and frayed borders "
        "are closed by a guess; its faces are marked as unseen",
        default=0.0,
        min=0.0,
        max=20.0,
        soft_max=10.0,
        precision=1,
        subtype="PERCENTAGE",
    )
    texture: EnumProperty(
        name="Texture",
        description="Size of the texture in pixels",
        items=TEXTURE_SIZES,
        default="auto",
    )
    texture_kind: EnumProperty(
        name="Texture From",
        description="What the texture shows",
        items=[
            ("photo", "Photos", "The photos, as sharp as they are"),
            ("field", "Field", "The field's colors, without what differs from photo to photo"),
        ],
    )
    mesh_file: StringProperty(
        name="Also Write",
        description="File for other programs: .glb, .usdc, .obj, .ply or .stl; empty: none",
        subtype="FILE_PATH",
    )
    split: EnumProperty(
        name="Objects",
        description="What the file holds: one object, or one for each class or instance",
        items=SPLITS,
    )
