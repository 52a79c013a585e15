"""The verb `new`: photos or a video become a capture project with upright, shrunk, labelled working copies."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ..errors import InputError, ProjectError
from ..files import file_hash
from ..images.decode import float_exposure, is_linear
from ..images.labels import Colors, drawn_as_stored
from ..images.suffixes import VIDEO_SUFFIXES
from ..params import NewParams
from ..progress import Reporter, shortened
from ..project.classes import make_classes, read_found_classes, unnamed_values
from ..project.fingerprints import Earlier, Fingerprint, compare, digest, files_digest, stamps_digest
from ..project.kept import (
    BESIDE,
    earlier_cut_outs,
    from_project,
    keep_later_labels,
    resized_labels,
    same_source,
    with_earlier_names,
)
from ..project.schema import ImageRecord, Project
from ..project.store import FRAMES_FOLDER, PROJECT_FILE, create_folder, edit_project, load_project
from .backdrop import mask_objects
from .find import Source, classes_beside, find_sources, list_photos, subfolder
from .mask_mode import MaskMode, chosen_mask_mode
from .select import reject_blurred, reject_duplicates
from .working_copies import Settings, make_working_copies

WORKING_FOLDERS = ("images", "labels", "masks", "confidence")  # of the project
Classes = tuple[dict[int, str], int, Colors]  # names, void id, colours


def new(params: NewParams, report: Reporter) -> dict[str, Any]:
    """Ingest a folder of photos, or a video, into a project.

    Running it again over the same photos only does what is missing, and keeps photos and labels that were added since; with
    `add` it puts further photos into an existing project.

    Returns:
        {"images": count, "rejected": [{"file", "reason"}], "labelled", "masked", "classes": [names]}
    Raises:
        InputError: there is no usable photo, or the classes file is unusable.
        ProjectError: the folder holds another capture.
        DiskError: it cannot be written.
    """
    params = _absolute(params)
    folder, photos = Path(params.project), Path(params.photos)
    inputs = ingest_inputs(params)
    previous = _previous_project(params)
    labels_folder = params.labels or subfolder(photos, "labels")
    masks_folder = params.masks or subfolder(photos, "masks")
    classes_file = params.classes or classes_beside(labels_folder)
    classes: Classes = ({}, 0, {})
    if classes_file is not None:
        classes = read_found_classes(classes_file, given=params.classes is not None)
    create_folder(folder)
    _remove_halves(folder)
    paths, skipped, root = _photos(params, report)
    kept = _kept(previous, params, paths, root) if previous else []
    if params.add:
        paths, there = _not_there(paths, kept)
        skipped += there
    # Of two paths to one file the name of the photo that is used counts.
    ranked = sorted(previous.images, key=lambda record: record.status != "rejected") if previous else []
    known = {Path(record.source).resolve(): record.name for record in ranked}
    taken = {record.name for record in kept}
    known = {path: name for path, name in known.items() if name not in taken}
    sources = find_sources(paths, root, labels_folder, masks_folder, taken, known)
    settings, exposed = _settings(params, previous, paths, sources, classes, report)

    report.stage("Reading photos")
    records, pictures = make_working_copies(sources, settings, report)
    # Video frames were chosen for sharpness, and a still camera on a tripod may well repeat itself there.
    reject_duplicates(records, pictures, [record for record in kept if record.status != "rejected"])
    if not params.keep_blurry:
        reject_blurred(records, folder)
    fresh, records = records, kept + records if params.add else records + kept
    _check_usable(records, photos, skipped)
    asked = records if params.add else fresh
    wanted, made = _masks_wanted(params, previous, asked), earlier_cut_outs(previous)
    cut_out = wanted and mask_objects(_without_mask(records), folder, report, made)
    if previous:
        later = keep_later_labels(fresh, previous.images, folder)
        resized = resized_labels(fresh, previous.images)
        if resized:
            text = (
                "Labels that photos got later do not fit their new size and were left out; import or accept them again"
            )
            report.warn(shortened(text, resized))
        if classes[0]:  # else the project keeps its own
            there = _present_ids(folder, kept + later, report)
            names, ignore_id, colors = classes
            classes = with_earlier_names(names, previous.classes, there), ignore_id, colors
    present = _present_ids(folder, records, report)
    result = _summary(records, skipped)
    _warn(records, result["rejected"], report)
    if classes_file and classes[0]:
        for text in unnamed_values(present, *classes[:2], classes_file):
            report.warn(text)
    origin = {"cut_out": cut_out} | ({"video_sha256": file_hash(photos)} if photos.is_file() else {})
    mask_mode = "empty" if cut_out else _mask_mode(params, previous, folder, records, report)
    with edit_project(folder, Project()) as project:
        _put_in(project, records, set(present), classes, params, previous is not None)
        project.mask_mode = mask_mode
        result["classes"] = [c.name for c in project.classes]
        told = result | origin | exposed | {BESIDE: from_project(photos, folder)}
        project.record("new", params.model_dump(mode="json"), told, inputs)
    return result


def ingest_inputs(params: NewParams) -> Fingerprint:
    """What the working copies of a capture depend on, by the names, sizes and times of its files.

    Raises:
        InputError: there are no photos, or the project would write over them.
    """
    photos = Path(params.photos)
    paths, root = [photos], photos.parent
    if photos.suffix.lower() not in VIDEO_SUFFIXES or not photos.is_file():
        paths, _, root = list_photos(photos, exclude=[params.labels, params.masks, params.project])
    labels = params.labels or subfolder(photos, "labels")
    masks = params.masks or subfolder(photos, "masks")
    of_photos = None if photos.is_file() else root
    _require_apart(Path(params.project), {"photos": of_photos, "labels": labels, "masks": masks})
    sources = find_sources(paths, root, labels, masks, set())
    if paths == [photos]:  # frames of a video are named later
        sources_of = {
            "labels": sorted(labels.rglob("*")) if labels else [],
            "masks": sorted(masks.rglob("*")) if masks else [],
        }
    else:
        sources_of = {
            "labels": [f for s in sources for f in (s.label, s.confidence)],
            "masks": [s.mask for s in sources],
        }
    classes_file = params.classes or classes_beside(labels)
    chosen = params.model_dump(mode="json", include={"mask_mode", "keep_backdrop", "max_size", "frames", "keep_blurry"})
    return {
        "photos": digest([[str(path.relative_to(root)) for path in paths], stamps_digest(paths)]),
        **{name: stamps_digest(files) for name, files in sources_of.items()},
        "classes file": files_digest([("classes", classes_file)]),
        "settings": digest(chosen),
    }


def ingested(params: NewParams) -> Earlier:
    """The working copies that are there, if they are of the present files.

    Raises:
        InputError: as `ingest_inputs`. ProjectError: the folder holds another capture.
    """
    previous = _previous_project(params)
    if previous is None:
        return Earlier()
    made = next((s for s in reversed(previous.provenance) if s.verb == "new" and not s.settings.get("add")), None)
    folder = Path(params.project)
    files = [folder / file for r in previous.images for file in (r.file, r.label, r.mask, r.confidence) if file]
    return compare(made, ingest_inputs(params), files)


def _require_apart(project: Path, given: dict[str, Path | None]) -> None:
    """Raise InputError where working copies would be written over the files that they are made of, or among them."""
    own = [project, *(project / name for name in WORKING_FOLDERS)]
    for what, folder in given.items():
        if folder is not None and folder.resolve() in {place.resolve() for place in own}:
            raise InputError(
                f"The {what} in {folder} lie where the project {project} keeps its own files.",
                f"Choose another folder for the project, such as {folder.resolve().name}_fieldwork beside it.",
            )


def _photos(params: NewParams, report: Reporter) -> tuple[list[Path], list[dict[str, str]], Path]:
    """The photos, or frames of the video; files that are none, with the reason; the folder that names are relative to."""
    photos = Path(params.photos)
    if photos.is_file() and photos.suffix.lower() in VIDEO_SUFFIXES:
        report.stage("Choosing frames of the video")
        root = Path(params.project).absolute() / FRAMES_FOLDER
        from .video import extract_frames  # the library takes its time to load

        return extract_frames(photos, root, params.frames, report), [], root
    return list_photos(photos, exclude=[params.labels, params.masks, params.project])


def _settings(
    params: NewParams,
    previous: Project | None,
    paths: list[Path],
    sources: list[Source],
    classes: Classes,
    report: Reporter,
) -> tuple[Settings, dict[str, float]]:
    """How working copies are made, and the exposure of scene-linear photos for the record, if there are any."""
    _, ignore_id, colors = classes
    linear = [path for path in paths if is_linear(path)]
    steps = previous.provenance if previous and params.add else []
    before = next((step.result["exposure"] for step in reversed(steps) if "exposure" in step.result), None)
    exposure = float_exposure(linear) if before is None else float(before)
    settings = Settings(
        folder=Path(params.project),
        max_size=params.max_size,
        exposure=exposure,
        colors=colors or None,
        ignore_id=ignore_id,
        labels_as_stored=_drawn_as_stored([(s.path, s.label) for s in sources], "label maps", report),
        masks_as_stored=_drawn_as_stored([(s.path, s.mask) for s in sources], "masks", report),
    )
    return settings, {"exposure": exposure} if linear else {}


def _drawn_as_stored(pairs: list[tuple[Path, Path | None]], what: str, report: Reporter) -> bool:
    """Whether maps were drawn on the stored pixels of photos, see `labels.drawn_as_stored`; a guess is said."""
    stored, doubtful = drawn_as_stored(pairs)
    if doubtful:
        text = f"{what} of photos that EXIF turns over or mirrors are taken to show the photos as they are stored"
        report.warn(shortened(text, doubtful))
    return stored


def _previous_project(params: NewParams) -> Project | None:
    """The project that is there already, if these photos may go into it."""
    folder = Path(params.project)
    if not (folder / PROJECT_FILE).exists():
        if params.add:
            raise ProjectError(f"{folder} has no project to add photos to.", "Leave out --add to make a new one.")
        return None
    project = load_project(folder)
    if params.add:
        return project
    first = project.provenance[0] if project.provenance else None
    if first is None or first.verb != "new" or not same_source(first, "photos", params.photos, folder):
        raise ProjectError(
            f"{folder} already holds another capture.", "Choose a new folder, or --add to put these photos into it."
        )
    was, now = str(first.settings["photos"]), str(params.photos)
    for image in project.images if not Path(was).exists() else ():  # both were moved
        if image.source.startswith(was):
            image.source = now + image.source[len(was) :]
    return project


def _kept(previous: Project, params: NewParams, paths: list[Path], root: Path) -> list[ImageRecord]:
    """Photos that stay as they are: where others are added all but those that were left out and are now read again, else those
    that were added from other folders."""
    records = [record for record in previous.images if record.file]
    if params.add:
        again = {path.resolve() for path in paths}
        return [r for r in records if r.status != "rejected" or Path(r.source).resolve() not in again]
    places = [Path(params.photos).resolve(), root.resolve()]

    def is_read(source: Path) -> bool:
        # Frames of a video were noted as their paths were typed once.
        frame = root.name == source.parent.name == FRAMES_FOLDER and not source.is_absolute()
        return frame or any(source.resolve().is_relative_to(place) for place in places)

    return [record for record in records if not is_read(Path(record.source))]


def _not_there(paths: list[Path], kept: list[ImageRecord]) -> tuple[list[Path], list[dict[str, str]]]:
    """Files to add without those that the project has as they are, and these with the reason."""
    known = {Path(record.source).resolve(): record.sha256 for record in kept if record.status != "rejected"}
    there = [path for path in paths if known.get(path.resolve()) and known[path.resolve()] == file_hash(path)]
    skipped = [{"file": path.name, "reason": "it is in the project already"} for path in there]
    return [path for path in paths if path not in set(there)], skipped


def _absolute(params: NewParams) -> NewParams:
    """The same with paths that say where files are whatever folder the next command is given in."""
    paths = {name: value.absolute() for name, value in params if name != "project" and isinstance(value, Path)}
    return params.model_copy(update=paths)


def _remove_halves(folder: Path) -> None:
    """Delete what a run that was killed had half written: hidden files in the folders of working copies."""
    for name in WORKING_FOLDERS:
        for path in (folder / name).glob(".*"):
            path.unlink(missing_ok=True)


def _check_usable(records: list[ImageRecord], photos: Path, skipped: list[dict[str, str]]) -> None:
    if any(record.status != "rejected" for record in records):
        return
    first = next((record for record in records if record.reason), None)
    why = f" ({Path(first.source).name}: {first.reason})" if first else ""
    raise InputError(
        f"None of the {len(records) + len(skipped)} files in {photos} is a usable photo{why}.", "Choose other photos."
    )


def _present_ids(folder: Path, records: list[ImageRecord], report: Reporter) -> dict[int, list[str]]:
    """Class ids that occur in the label maps of the project, and the photos in whose maps they do."""
    present: dict[int, list[str]] = {}
    for record in records:
        if record.label:
            report.check()
            with Image.open(folder / record.label) as image:
                for value in np.unique(np.asarray(image)).tolist():
                    present.setdefault(value, []).append(Path(record.label).name)
    return present


def _summary(records: list[ImageRecord], skipped: list[dict[str, str]]) -> dict[str, Any]:
    """What the verb tells of the photos; `skipped`: files that are none."""
    used = [record for record in records if record.status != "rejected"]
    rejected = [record for record in records if record.status == "rejected"]
    return {
        "images": len(used),
        "rejected": skipped + [{"file": Path(r.source).name, "reason": r.reason} for r in rejected],
        "labelled": sum(record.label is not None for record in used),
        "masked": sum(record.mask is not None for record in used),
    }


def _warn(records: list[ImageRecord], rejected: list[dict[str, str]], report: Reporter) -> None:
    """Say what is wrong with photos that are used, which are not, and when there are too few."""
    used = [record for record in records if record.status != "rejected"]
    for record in used:
        if record.reason:
            report.warn(f"{record.name}: {record.reason}")
    wide = [r.name for r in used if r.focal_px is None and r.width == 2 * r.height]
    if wide:
        told = shortened("Photos are exactly twice as wide as high and say nothing of their lens", wide)
        report.warn(f"{told} If they are panoramas, leave them out: poses need single photos.")
    if rejected:
        reasons = [f"{item['file']} ({item['reason']})" for item in rejected]
        report.warn(shortened(f"{len(rejected)} of {len(used) + len(rejected)} files were left out", reasons))
    if len(used) < 3:
        number = "one usable photo" if len(used) == 1 else f"{len(used)} usable photos"
        report.warn(f"Only {number}: camera poses need at least three, better twenty.")


def _masks_wanted(params: NewParams, previous: Project | None, records: list[ImageRecord]) -> bool:
    """Whether objects may be cut out of photos without masks: nobody gave masks, labels, or another meaning of black; photos
    that are added to others shall be like these."""
    if params.keep_backdrop or params.mask_mode == "ignore" or any(record.label for record in records):
        return False
    if previous is not None and params.add:
        masked = [record for record in previous.images if record.status != "rejected" and record.mask]
        return previous.mask_mode == "empty" and bool(masked)
    return not any(record.mask for record in records)


def _without_mask(records: list[ImageRecord]) -> list[ImageRecord]:
    """Photos that are used and have no mask."""
    return [record for record in records if record.status != "rejected" and record.mask is None]


def _mask_mode(
    params: NewParams, previous: Project | None, folder: Path, records: list[ImageRecord], report: Reporter
) -> MaskMode:
    """What black in masks means: as before where photos are added, else as asked for or as it looks."""
    if previous is not None and params.add and (params.mask_mode is None or not params.masks):
        return previous.mask_mode
    used = [record for record in records if record.status != "rejected"]
    return chosen_mask_mode(
        params.mask_mode, [folder / record.mask for record in used if record.mask], len(used), report
    )


def _put_in(
    project: Project,
    records: list[ImageRecord],
    present: set[int],
    classes: Classes,
    params: NewParams,
    there: bool,
) -> None:
    """Put the photos into the project, and the classes: those named, and those `present` in
    the label maps without a name. `there`: the project was there before."""
    names, ignore_id, colors = classes
    if not params.add:
        # A rerun keeps what was decided about the same photos later.
        old = {record.name: record for record in project.images}
        for record in records:
            before = old.get(record.name)
            if before and before.sha256 == record.sha256:
                record.split = before.split
                if record.status == "ok" and before.status == "unregistered":
                    record.status, record.reason = before.status, before.reason
    project.images = records
    known = {c.id: c for c in project.classes}
    if names or not known:
        project.ignore_id = ignore_id
        named = {**{i: f"class {i}" for i in present}, **names}
    else:
        named = {**{i: f"class {i}" for i in present}, **{c.id: c.name for c in project.classes}}
    # A class keeps what was decided about it earlier, unless the classes file says otherwise now.
    project.classes = make_classes(named, project.ignore_id, colors)
    for i, c in enumerate(project.classes):
        if c.id in known:
            said = {"name": c.name} | ({"color": c.color} if c.id in colors else {})
            project.classes[i] = known[c.id].model_copy(update=said)
