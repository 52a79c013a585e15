"""CVAT for images 1.1: one XML file with masks, polygons, boxes and ellipses; also inside the zip that CVAT writes."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from xml.etree import ElementTree as xml

import numpy as np

from ...errors import InputError
from ...files import atomic_path
from ...project.label_revision import label_facts
from .regions import (
    STUFF,
    LabelClass,
    Picture,
    Region,
    Source,
    box_mask,
    checked_size,
    color_hex,
    ellipse_mask,
    from_runs,
    hex_color,
    numbered,
    placed,
    polygon_mask,
    region_of,
    runs_of,
)

INSIDE = "annotations.xml"  # of a zip
_STUFF_ATTRIBUTE = (
    ("name", STUFF),
    ("mutable", "False"),
    ("input_type", "checkbox"),
    ("default_value", "false"),
    ("values", "false"),
)
HINT = "Export the task from CVAT as “CVAT for images 1.1”."


def read(path: Path) -> Source:
    """The labels of an XML file or a zip. Raises InputError."""
    try:
        data = zipfile.ZipFile(path).read(INSIDE) if zipfile.is_zipfile(path) else path.read_bytes()
        root = xml.parse(io.BytesIO(data)).getroot()
    except FileNotFoundError as error:
        raise InputError(f"{path} does not exist.", HINT) from error
    except (OSError, KeyError, xml.ParseError, zipfile.BadZipFile) as error:
        raise InputError(f"{path} cannot be read as CVAT's XML: {error}.", HINT) from error
    if root.tag != "annotations" or root.find("image") is None:
        what = "tracks of a video" if root.find("track") is not None else "no pictures"
        raise InputError(f"{path} has {what}.", HINT)
    classes = {}
    for label in root.iterfind("./meta//labels/label"):
        name = label.findtext("name")
        if name:
            classes[name] = hex_color(label.findtext("color"))
    source = Source(iter(()), classes)
    source.pictures = _pictures(path, root, source)
    return source


def _pictures(path: Path, root: xml.Element, source: Source) -> Iterator[Picture]:
    for image in root.iterfind("image"):
        name = image.get("name", "")
        width, height = checked_size(image.get("width"), image.get("height"), name)
        try:
            shapes = sorted(image, key=lambda shape: int(shape.get("z_order", 0)))
        except ValueError as error:
            raise InputError(f"A z_order of {name} in {path} is no whole number: {error}.", HINT) from error
        groups: dict[str, int] = {}
        regions: list[Region] = []
        for shape in shapes:
            try:
                mask = _mask(shape, width, height)
            except (TypeError, ValueError) as error:
                raise InputError(f"A {shape.tag} of {name} in {path} is damaged: {error}.", HINT) from error
            if mask is None:
                source.skip(shape.tag)
                continue
            group = shape.get("group_id", "0")
            key = group if group != "0" else f"shape {len(regions)}"
            instance = 0 if _is_stuff(shape) else groups.setdefault(key, len(groups) + 1)
            regions.append(region_of(shape.get("label", ""), mask, instance))
        yield Picture(name, width, height, regions)


def _is_stuff(shape: xml.Element) -> bool:
    return any(a.get("name") == STUFF and (a.text or "").strip().lower() == "true" for a in shape.iterfind("attribute"))


def _mask(shape: xml.Element, width: int, height: int) -> np.ndarray | None:
    """The mask (H, W) of a shape; None for one without area."""
    number = lambda name: float(shape.get(name, ""))  # noqa: E731
    degrees = float(shape.get("rotation", 0))
    if shape.tag == "polygon":
        points = [[float(v) for v in pair.split(",")] for pair in shape.get("points", "").split(";")]
        return polygon_mask(points, width, height)
    if shape.tag == "box":
        left, top, right, bottom = (number(name) for name in ("xtl", "ytl", "xbr", "ybr"))
        if not degrees:
            return box_mask(left, top, right, bottom, width, height)
        x, y, turn = (left + right) / 2, (top + bottom) / 2, np.radians(degrees)
        corners = np.array([(left, top), (right, top), (right, bottom), (left, bottom)]) - (x, y)
        turned = corners @ [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]] + (x, y)
        return polygon_mask(turned.tolist(), width, height)
    if shape.tag == "ellipse":
        return ellipse_mask(number("cx"), number("cy"), number("rx"), number("ry"), width, height, degrees)
    if shape.tag == "mask":
        left, top, w, h = (int(number(name)) for name in ("left", "top", "width", "height"))
        runs = [int(run) for run in shape.get("rle", "").split(",")]
        return placed(from_runs(runs, w * h).reshape(h, w), left, top, width, height)
    return None


def write(
    pictures: Iterable[Picture], classes: list[LabelClass], out: Path, label_revision: int | None = None
) -> list[Path]:
    """Write one XML file: every region a mask, regions of one instance in one group; an attribute says which are none."""
    root = xml.Element("annotations")
    xml.SubElement(root, "version").text = "1.1"
    meta = xml.SubElement(root, "meta")
    for fact, value in label_facts(label_revision).items():
        xml.SubElement(meta, fact).text = str(value)
    labels = xml.SubElement(xml.SubElement(meta, "task"), "labels")
    for c in classes:
        label = xml.SubElement(labels, "label")
        for tag, text in (("name", c.name), ("color", color_hex(c.color)), ("type", "mask")):
            xml.SubElement(label, tag).text = text
        attribute = xml.SubElement(xml.SubElement(label, "attributes"), "attribute")
        for tag, text in _STUFF_ATTRIBUTE:
            xml.SubElement(attribute, tag).text = text
    for number, picture in numbered(pictures):
        size = {"width": str(picture.width), "height": str(picture.height)}
        image = xml.SubElement(root, "image", {"id": str(number - 1), "name": picture.name, **size})
        for region in picture.regions:
            left, top, right, bottom = region.bounds
            values = {
                "label": region.class_name,
                "source": "file",
                "occluded": "0",
                "rle": ", ".join(str(run) for run in runs_of(region.patch)),
                "left": str(left),
                "top": str(top),
                "width": str(right - left),
                "height": str(bottom - top),
                "z_order": "0",
                "group_id": str(region.instance),
            }
            mask = xml.SubElement(image, "mask", values)
            if region.instance == 0:
                xml.SubElement(mask, "attribute", {"name": STUFF}).text = "true"
    xml.indent(root)
    with atomic_path(out) as temporary:
        xml.ElementTree(root).write(temporary, "utf-8", xml_declaration=True)
    return [out]
