"""What a scene remembers of measures, drawings, comparisons and reports; a part of `Scene.fieldwork`."""

from .choices import SIDES
from .props import EnumProperty, FloatProperty, StringProperty


class MeasureSettings:
    """Properties of `properties.FieldworkScene`."""

    distances: StringProperty(
        name="Distances",
        description="Table (.csv) of distances to measure, some known to scale by or to check with; empty: none",
        subtype="FILE_PATH",
    )
    scale_error: FloatProperty(
        name="Scale Error",
        description="Standard uncertainty of the scale in percent; 0: by the distances, or by how the scale was set",
        default=0.0,
        min=0.0,
        soft_max=5.0,
        subtype="PERCENTAGE",
    )
    caps: FloatProperty(
        name="Caps",
        description="How much of its area caps over openings may have of a thing whose volume is given",
        default=0.1,
        min=0.0,
        max=0.95,
        subtype="FACTOR",
    )
    sides: EnumProperty(
        name="Views",
        description="Which sides are drawn",
        items=SIDES,
        options={"ENUM_FLAG"},
        default={"top", "front", "right", "back", "left"},
    )
    conditions: StringProperty(
        name="Conditions",
        description="Classes to map as conditions, such as damages, with commas between them: hatched over the drawings, "
        "numbered, listed with their areas; or all",
    )
    turn: FloatProperty(
        name="Turn",
        description="Degrees about Z from the world to the front that is drawn, for slanted fronts",
        default=0.0,
        min=-180.0,
        max=180.0,
    )
    paper_scale: FloatProperty(
        name="Scale 1:",
        description="Scale of drawings on paper; 0: the largest that fits on A3",
        default=0.0,
        min=0.0,
        soft_max=1000.0,
    )
    section_plane: StringProperty(
        name="Section", description="Plane of the section in the aligned world: x=…, y=… or z=…", default="z=1"
    )
    drawings: StringProperty(
        name="Drawings",
        description="Folder for drawings; empty: in the exports of the project",
        subtype="DIR_PATH",
    )
    other_project: StringProperty(
        name="Earlier Epoch", description="Project of an earlier epoch of the same object", subtype="DIR_PATH"
    )
    other_run: StringProperty(name="Its Run", description="Training run of the earlier epoch", default="main")
    common_points: StringProperty(
        name="Common Points",
        description="Table (.csv) of points in both worlds; empty: the surfaces themselves say how they lie",
        subtype="FILE_PATH",
    )
    compare_limit: FloatProperty(
        name="Limit",
        description="Distance beyond which surfaces do not belong together; 0: 20 cells of the mesh",
        default=0.0,
        min=0.0,
        unit="LENGTH",
    )
    compare_path: StringProperty(
        name="Comparison",
        description="Folder for the comparison; empty: in the exports of the project",
        subtype="DIR_PATH",
    )
    report_path: StringProperty(
        name="Report",
        description="Report to write, .html or .pdf; empty: report.html in the exports of the project",
        subtype="FILE_PATH",
    )
