"""OpenUSD: the surface with its classes as subsets, materials and labels, and the photos' cameras; z up, in metres."""

# The members of pxr's modules come into being when these are imported: a type checker sees none.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from pxr import Gf, Kind, Sdf, Tf, Usd, UsdGeom, UsdSemantics, UsdShade, UsdUtils, Vt

from ..data.scene import View
from ..errors import DiskError
from ..files import staged
from ..geometry.cameras import flip_camera_axes
from ..images.picture import srgb_to_linear
from ..project.label_revision import label_facts
from .features import Feature, Features
from .parts import Texture
from .surface import Surface

MATERIALS, CAMERAS = "Materials", "Cameras"  # what else lies beside the meshes
APERTURE = 0.36  # of the cameras: 36 mm in tenths of a metre, USD's unit of lenses
NEAR, FAR = 0.01, 1000.0  # what cameras show at least


def write_usd(
    path: Path,
    surface: Surface,
    features: Features,
    split: str,
    texture: Texture | None,
    png: bytes | None,
    views: Sequence[View],
    check: Callable[[], None],
) -> list[Path]:
    """Write a surface in the world as .usdc, .usda, .usd or .usdz.

    Each class is a GeomSubset with a material of its own and the semantic label `class`, each instance a subset with
    the label `instance`; the ids are the primvars `class_id` and `instance_id`. Materials show the texture, which lies
    beside the file (in a .usdz inside it), or without one `displayColor`, which is linear.

    Args:
        png: the file of the texture, if there is one. split: see `write_surface`; several meshes then lie beside each other.
        views: become cameras without lens distortion; panoramas, for which USD has no camera, are left out.
    Returns:
        the files written.
    Raises:
        DiskError: the file cannot be written.
    """
    picture = f"{path.stem}_texture.png"
    usdz = path.suffix.lower() == ".usdz"
    with staged(path.parent) as here:  # where it comes to, so that no other disk may be full
        made = here / (f"{_identifier(path.stem)}.usdc" if usdz else path.name)
        with _saving(path):
            _write_stage(made, path.stem, surface, features, split, texture, png, picture, views, check)
            if usdz:
                if not UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(made)), str(here / path.name)):
                    raise _unsaved(path)
                made.unlink()
                made.with_name(picture).unlink(missing_ok=True)
    return [path] if usdz or texture is None else [path, path.with_name(picture)]


def _write_stage(
    file: Path,
    name: str,
    surface: Surface,
    features: Features,
    split: str,
    texture: Texture | None,
    png: bytes | None,
    picture: str,
    views: Sequence[View],
    check: Callable[[], None],
) -> None:
    stage = Usd.Stage.CreateNew(str(file))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    root = UsdGeom.Xform.Define(stage, f"/{_identifier(name)}")
    root.GetPrim().SetDisplayName(name)
    Usd.ModelAPI(root).SetKind(Kind.Tokens.component)
    stage.SetDefaultPrim(root.GetPrim())
    for fact, value in label_facts(features.label_revision).items():
        root.GetPrim().SetCustomDataByKey(fact, value)
    if texture is not None:
        assert png is not None
        file.with_name(picture).write_bytes(png)
    materials = _materials(stage, root.GetPath(), features.rows, picture if texture is not None else None)
    names = _Names({root.GetPath().AppendChild(name) for name in (MATERIALS, CAMERAS)})
    for label, chosen in features.groups(split).items():
        check()
        prim = names.under(root.GetPath(), "Surface" if split == "none" else label)
        mesh = _mesh(stage, prim, surface, features, texture, chosen)
        mesh.GetPrim().SetDisplayName(label if split != "none" else "Surface")
        _label_faces(mesh, features, chosen, materials)
    _cameras(stage, root.GetPath(), views, surface.vertices)
    if not stage.GetRootLayer().Save():
        raise _unsaved(file)


@contextmanager
def _saving(path: Path) -> Iterator[None]:
    """Turn the library's failures to write a file into a `DiskError`: it does not say in words why it fails."""
    try:
        yield
    except Tf.ErrorException as error:
        raise _unsaved(path) from error


def _unsaved(path: Path) -> DiskError:
    return DiskError(f"USD cannot be written to {path.parent}.", "Free some space there, or choose another folder.")


def _mesh(
    stage: Usd.Stage,
    path: Sdf.Path,
    surface: Surface,
    features: Features,
    texture: Texture | None,
    chosen: np.ndarray,
) -> UsdGeom.Mesh:
    used, corners = np.unique(surface.faces[chosen], return_inverse=True)
    points = np.ascontiguousarray(surface.vertices[used], np.float32)
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(chosen), 3, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(corners.reshape(-1).astype(np.int32)))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(0), points.max(0)])))
    mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(surface.normals[used], np.float32)))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    color = srgb_to_linear(surface.colors[used] / 255).astype(np.float32)
    mesh.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex).Set(Vt.Vec3fArray.FromNumpy(color))
    primvars = UsdGeom.PrimvarsAPI(mesh)
    kinds = {"class_id": "class_id", "instance_id": "instance"}
    for name, field in kinds.items():
        values = np.array([getattr(row, field) for row in features.rows], np.int32)[features.face[chosen]]
        if name == "class_id" or values.any():
            primvar = primvars.CreatePrimvar(name, Sdf.ValueTypeNames.IntArray, UsdGeom.Tokens.uniform)
            primvar.Set(Vt.IntArray.FromNumpy(values))
    if texture is not None:
        index = texture.unwrapped.faces[chosen].reshape(-1)
        place, index = np.unique(index, return_inverse=True)
        st = primvars.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
        st.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(texture.unwrapped.uv[place], np.float32)))
        st.SetIndices(Vt.IntArray.FromNumpy(index.reshape(-1).astype(np.int32)))
    return mesh


def _label_faces(
    mesh: UsdGeom.Mesh, features: Features, chosen: np.ndarray, materials: dict[int, UsdShade.Material]
) -> None:
    """Subsets of a mesh for its classes, which have the materials, and for its instances."""
    face, names = features.face[chosen], _Names()
    ids = np.array([row.class_id for row in features.rows])[face]
    instances = np.array([row.instance for row in features.rows])[face]
    for number in np.unique(ids).tolist():
        row = next(row for row in features.rows if row.class_id == number)
        subset = _subset(mesh, names, row.class_name, ids == number, UsdShade.Tokens.materialBind)
        UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(materials[number])
        _label(subset.GetPrim(), "class", row.class_name)
    UsdGeom.Subset.SetFamilyType(mesh, UsdShade.Tokens.materialBind, UsdGeom.Tokens.partition)
    for index in np.unique(face[instances > 0]).tolist():
        row = features.rows[index]
        subset = _subset(mesh, names, row.name, face == index, "instance")
        _label(subset.GetPrim(), "class", row.class_name)
        _label(subset.GetPrim(), "instance", row.name)
    if (instances > 0).any():
        UsdGeom.Subset.SetFamilyType(mesh, "instance", UsdGeom.Tokens.nonOverlapping)


def _subset(mesh: UsdGeom.Mesh, names: _Names, name: str, mask: np.ndarray, family: str) -> UsdGeom.Subset:
    path = names.under(mesh.GetPath(), name)
    subset = UsdGeom.Subset.Define(mesh.GetPrim().GetStage(), path)
    subset.CreateElementTypeAttr(UsdGeom.Tokens.face)
    subset.CreateFamilyNameAttr(family)
    subset.CreateIndicesAttr(Vt.IntArray.FromNumpy(np.flatnonzero(mask).astype(np.int32)))
    subset.GetPrim().SetDisplayName(name)
    return subset


def _label(prim: Usd.Prim, taxonomy: str, text: str) -> None:
    UsdSemantics.LabelsAPI.Apply(prim, taxonomy).CreateLabelsAttr([text])


def _materials(
    stage: Usd.Stage, root: Sdf.Path, rows: list[Feature], picture: str | None
) -> dict[int, UsdShade.Material]:
    """A matt material for each class: all show the texture, or the display colours."""
    scope, names, made = UsdGeom.Scope.Define(stage, root.AppendChild(MATERIALS)).GetPath(), _Names(), {}
    for row in rows:
        if row.class_id in made:
            continue
        material = UsdShade.Material.Define(stage, names.under(scope, row.class_name))
        prim = material.GetPrim()
        prim.SetDisplayName(row.class_name)
        prim.SetCustomDataByKey("class_id", row.class_id)
        prim.SetCustomDataByKey("class_color", Gf.Vec3f(*row.color))  # sRGB
        shader = UsdShade.Shader.Define(stage, material.GetPath().AppendChild("Surface"))
        shader.CreateIdAttr("UsdPreviewSurface")
        shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(1.0)
        shader.CreateInput("metallic", Sdf.ValueTypeNames.Float).Set(0.0)
        diffuse = shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
        diffuse.ConnectToSource(_color_source(stage, material.GetPath(), picture))
        material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
        made[row.class_id] = material
    return made


def _color_source(stage: Usd.Stage, path: Sdf.Path, picture: str | None) -> UsdShade.Output:
    """What gives a material its colour: the texture at `st`, or `displayColor`."""
    if picture is None:
        reader = UsdShade.Shader.Define(stage, path.AppendChild("Color"))
        reader.CreateIdAttr("UsdPrimvarReader_float3")
        reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("displayColor")
        return reader.CreateOutput("result", Sdf.ValueTypeNames.Float3)
    reader = UsdShade.Shader.Define(stage, path.AppendChild("Place"))
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
    texture = UsdShade.Shader.Define(stage, path.AppendChild("Texture"))
    texture.CreateIdAttr("UsdUVTexture")
    texture.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(f"./{picture}")
    texture.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set("sRGB")
    for side in ("wrapS", "wrapT"):
        texture.CreateInput(side, Sdf.ValueTypeNames.Token).Set("clamp")
    place = reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
    texture.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(place)
    return texture.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)


def _cameras(stage: Usd.Stage, root: Sdf.Path, views: Sequence[View], vertices: np.ndarray) -> None:
    names, scope = _Names(), root.AppendChild(CAMERAS)
    low, high = vertices.min(0), vertices.max(0)
    for view in views:
        lens = view.camera.undistorted() if view.camera.model != "EQUIRECTANGULAR" else None
        if lens is None:
            continue
        UsdGeom.Scope.Define(stage, scope)
        camera = UsdGeom.Camera.Define(stage, names.under(scope, view.name))
        camera.GetPrim().SetDisplayName(view.name)
        focal, height = lens.fx / lens.width * APERTURE, lens.height / lens.fy * lens.fx / lens.width * APERTURE
        camera.CreateFocalLengthAttr(focal)
        camera.CreateHorizontalApertureAttr(APERTURE)
        camera.CreateVerticalApertureAttr(height)
        camera.CreateHorizontalApertureOffsetAttr((0.5 - lens.cx / lens.width) * APERTURE)
        camera.CreateVerticalApertureOffsetAttr((lens.cy / lens.height - 0.5) * height)
        # All of the surface, however small or large the unit.
        far = float(np.linalg.norm(np.maximum(view.camera_to_world[:3, 3] - low, high - view.camera_to_world[:3, 3])))
        camera.CreateClippingRangeAttr(Gf.Vec2f(min(NEAR, far / 1000), max(FAR, 2 * far)))
        # USD's cameras look along −z with y up, and its matrices act on rows.
        pose = flip_camera_axes(view.camera_to_world)
        camera.AddTransformOp().Set(Gf.Matrix4d(*pose.T.reshape(-1).tolist()))


class _Names:
    """Names of prims: identifiers, each once, and none of the `taken` paths."""

    def __init__(self, taken: Iterable[Sdf.Path] = ()) -> None:
        self.taken = set(taken)

    def under(self, parent: Sdf.Path, name: str) -> Sdf.Path:
        path = parent.AppendChild(_identifier(name))
        number = 1
        while path in self.taken:
            path, number = parent.AppendChild(f"{_identifier(name)}_{number}"), number + 1
        self.taken.add(path)
        return path


def _identifier(name: str) -> str:
    return Tf.MakeValidIdentifier(name)
