"""What a scene remembers of labelling and of the things on the surface; a part of `Scene.fieldwork`."""

from .props import BoolProperty, EnumProperty, FloatProperty, IntProperty, StringProperty

LABEL_TOOLS = [
    ("brush", "Brush", "Draw over what belongs to the class", "BRUSH_DATA", 0),
    (
        "click",
        "Click",
        "Click a small part of the surface that looks alike, or with a model a thing: all of it belongs to the class",
        "RESTRICT_SELECT_OFF",
        1,
    ),
    ("part", "Part", "Click a whole part of the surface: all of it belongs to the class", "OUTLINER_OB_SURFACE", 4),
    ("erase", "Erase", "Draw over marks to take them away; also with Ctrl held", "X", 2),
    ("void", "Void", "Draw over what belongs to none of the classes", "GHOST_DISABLED", 3),
]
LABEL_VIEWS = [
    ("labels", "Labels", "The colors of the classes over the photo"),
    ("confidence", "Confidence", "Hatched where the class is unsure, dark where there is none"),
    ("parts", "Parts", "The outlines of the parts that the tool Part takes"),
    ("photo", "Photo", "The photo alone"),
]
PART_LEVELS = [
    ("coarse", "Large", "Parts that end where color, direction or what the field learned change much"),
    ("fine", "Small", "Parts that end at small changes, too"),
]


class LabelSettings:
    """Properties of `properties.FieldworkScene`."""

    label_tool: EnumProperty(name="Tool", description="What a stroke on a photo does", items=LABEL_TOOLS)
    label_width: FloatProperty(
        name="Size",
        description="Diameter of the brush in pixels of the photo",
        default=12.0,
        min=1.0,
        soft_max=200.0,
        subtype="PIXEL",
    )
    label_level: EnumProperty(name="Parts", description="How large the parts are that are clicked", items=PART_LEVELS)
    label_view: EnumProperty(name="Show", description="What lies over the photo", items=LABEL_VIEWS)
    label_opacity: FloatProperty(
        name="Opacity",
        description="How much of the photo the colors of the classes cover",
        default=0.5,
        min=0.0,
        max=1.0,
        subtype="FACTOR",
    )
    label_strokes: BoolProperty(name="Marks", description="Show the marks that were drawn on the photo", default=True)
    label_author: StringProperty(name="Author", description="Who draws the marks: it is noted with each of them")
    label_seconds: FloatProperty(
        name="Accept Time",
        description="For how many seconds Accept trains the classes",
        default=15.0,
        min=1.0,
        soft_max=120.0,
    )
    label_encoder: StringProperty(
        name="Encoder",
        description="ONNX file of the encoder of a SAM, MobileSAM, SAM 2 or EfficientSAM, by which Click cuts things out; "
        "empty: Click takes a small part of the surface",
        subtype="FILE_PATH",
    )
    label_decoder: StringProperty(
        name="Decoder", description="ONNX file of the decoder of the same model", subtype="FILE_PATH"
    )
    label_features: StringProperty(
        name="Features",
        description="ONNX file of a model such as DINOv2, whose features help to tell apart what looks alike; empty: none",
        subtype="FILE_PATH",
    )
    label_revision: IntProperty(
        name="Revision", description="Which revision of the marks undo comes back to", default=-1, options={"HIDDEN"}
    )

    # Things
    thing_query: StringProperty(
        name="Question",
        description="Things to select: “everything on the table”, “vase next to wall.001”, a name or a class",
    )
