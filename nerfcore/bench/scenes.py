"""The scenes of a benchmark as capture projects inside its output folder."""

from __future__ import annotations

import shutil
from pathlib import Path

from ..blender.simulate import SCENES, simulate
from ..data.importer import import_dataset
from ..errors import InputError
from ..params import ImportParams, SimulateParams
from ..progress import Reporter
from ..project.store import is_project, load_project

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"


def data_folder(given: Path | None) -> Path | None:
    """The folder of data sets: the one given, else ../shared/data beside the repository or the working folder."""
    if given is not None:
        if not given.is_dir():
            raise InputError(f"{given} is not a folder.", "Give the folder that holds the data sets with --data.")
        return given
    return next((d for d in (DATA, Path("../shared/data")) if d.is_dir()), None)


def available(scene: str, data: Path | None) -> bool:
    """Whether the scene can be had: a capture project, a data set in the folder, or a simulated one."""
    return scene in SCENES or is_project(Path(scene)) or (data is not None and (data / scene).is_dir())


def require_scenes(scenes: list[str], data: Path | None, out: Path) -> None:
    """Look at all scenes that were named, before the first is made.

    Raises:
        InputError: there is no such scene, or two have the same name.
    """
    names = [scene_name(scene) for scene in scenes]
    for scene, name in zip(scenes, names):
        if not available(scene, data) and not is_project(out / "projects" / name):
            raise _no_scene(scene, data)
        if names.count(name) > 1:
            raise InputError(f"Two scenes are called “{name}”.", "Rename one of the folders, or name it once.")


def _no_scene(scene: str, data: Path | None) -> InputError:
    return InputError(
        f"There is no scene “{scene}” in {data or 'a data folder'}.",
        f"Name a data set there, {', '.join(SCENES)} or a project.",
    )


def scene_name(scene: str) -> str:
    return Path(scene).name


def prepare(scene: str, data: Path | None, out: Path, report: Reporter) -> Path:
    """The project of a scene, made on first use: imported with its poses, or simulated with the true ones.

    `scene`: the name of a data set in `data` or of a scene of `simulate`, or the path of a capture project, which is
    copied.

    Raises:
        InputError: there is no such scene, or `out` has another project of its name. BlenderError: simulating needs the
        `bpy` package and it is missing.
    """
    project = out / "projects" / scene_name(scene)
    if is_project(project):
        if is_project(Path(scene)) and load_project(Path(scene)).uuid != load_project(project).uuid:
            raise InputError(
                f"{project} is a scene of the same name, but not a copy of {scene}.",
                "Choose another folder with --out, or rename the project's folder.",
            )
        return project
    half_made = project.with_name(f".{project.name}")
    shutil.rmtree(half_made, ignore_errors=True)
    report.stage(f"Preparing {scene_name(scene)}")
    if is_project(Path(scene)):
        shutil.copytree(scene, half_made, ignore=shutil.ignore_patterns("runs", "jobs", "exports"))
        (half_made / "runs").mkdir()
    elif data is not None and (data / scene).is_dir():
        import_dataset(ImportParams(dataset=data / scene, project=half_made), report)
    elif scene in SCENES:
        capture = out / "captures" / scene
        simulate(SimulateParams(out=capture, scene=scene), report)
        import_dataset(ImportParams(dataset=capture / "ground_truth", project=half_made), report)
    else:
        raise _no_scene(scene, data)
    half_made.rename(project)
    return project


def is_labelled(project: Path) -> bool:
    """Whether any image of a project has labels."""
    return any(image.label for image in load_project(project).images)
