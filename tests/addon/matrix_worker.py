"""Runs inside one Blender of the matrix: install the zip, work with it, take it away, leave nothing.

`python matrix_worker.py REQUEST.json`, or `blender -b --python matrix_worker.py -- REQUEST.json`.
"""

import importlib
import json
import os
import sys
import time
import traceback
from pathlib import Path

import bpy

MODULE = "bl_ext.user_default.fieldwork"


def state():
    """Everything an add-on could have left behind."""
    handlers = [getattr(bpy.app.handlers, name) for name in dir(bpy.app.handlers)]
    return {
        "types": sorted(name for name in dir(bpy.types) if "fieldwork" in name.lower()),
        "operators": dir(bpy.ops.fieldwork),
        "properties": sorted(name for name in dir(bpy.types) if hasattr(getattr(bpy.types, name), "fieldwork")),
        "handlers": sum(len(value) for value in handlers if isinstance(value, list)),
        "status_bar": len(getattr(bpy.types.STATUSBAR_HT_header.draw, "_draw_funcs", [0])),
        "modules": [],
    }


def installed():
    return Path(bpy.utils.user_resource("EXTENSIONS")) / "user_default" / "fieldwork"


def capture_to_mesh(request, out):
    """A tiny capture all the way to its mesh in the scene, by the operators and an engine."""
    os.environ["FIELDWORK_ENGINE_PYTHON"] = request["engine"]
    begin = time.perf_counter()
    bpy.ops.fieldwork.import_dataset(directory=request["capture"], project=str(out / "project"), format="transforms")
    settings = bpy.context.scene.fieldwork
    assert len(settings.images) == 12, "the photos are missing from the list"
    assert len(settings.classes) >= 5, "the classes are missing from the list"
    bpy.ops.fieldwork.train(preset="draft", steps=120)
    bpy.ops.fieldwork.mesh(resolution=48)
    bpy.ops.fieldwork.import_scene()
    surface = [
        o for o in bpy.data.objects if o.get("fieldwork_role") == "mesh" and o.get("fieldwork_project") == "project"
    ]
    assert len(surface) == 1, "there is no mesh in the scene"
    bpy.ops.fieldwork.export(to="glb", out=str(out / "project.glb"))
    assert (out / "project.glb").read_bytes()[:4] == b"glTF"
    bpy.ops.fieldwork.stop_engine()
    return {"faces": len(surface[0].data.polygons), "mesh_s": round(time.perf_counter() - begin, 1)}


def run(request):
    import addon_utils  # exists once bpy is imported

    facts = {"blender": bpy.app.version_string, "python": sys.version.split()[0]}
    before = state()
    bpy.ops.extensions.package_install_files(filepath=request["zip"], repo="user_default", enable_on_install=True)
    assert MODULE in bpy.context.preferences.addons, "the extension was not enabled"
    assert (installed() / "blender_manifest.toml").is_file()
    facts["operators"] = len(dir(bpy.ops.fieldwork))
    assert facts["operators"] > 10, "operators are missing"

    out = Path(request["out"])
    package = importlib.import_module(MODULE + ".addon.scene.package").read_package(request["package"])
    imported = importlib.import_module(MODULE + ".addon.scene.build").import_package(bpy.context.scene, package)
    assert len(imported.cameras) == 2
    assert len(imported.meshes[0].data.polygons) == 12
    bpy.ops.wm.save_as_mainfile(filepath=str(out / "scene.blend"), copy=True)
    assert (out / "scene.blend").stat().st_size > 10_000

    scenes = importlib.import_module(MODULE + ".addon.simulate.task").SCENES
    photograph = importlib.import_module(MODULE + ".addon.photograph.shoot")
    begin = time.perf_counter()
    for name, module in scenes.items():
        shot = photograph.Shot(name, module.poses(4, 0)[0], photograph.Lens(96, 64, 75.0))
        photograph.photograph(module.build(0), [shot], out, samples=1)
    facts["photo_s"] = round(time.perf_counter() - begin, 1)
    facts["oidn"] = photograph.has_denoiser()
    for name in scenes:
        for suffix in (".png", ".label.png", ".depth.npy"):
            assert (out / f"{name}{suffix}").is_file(), name + suffix

    facts |= capture_to_mesh(request, out)

    begin = time.perf_counter()
    addon_utils.disable(MODULE, default_set=True)
    addon_utils.enable(MODULE, default_set=True)
    facts["enable_ms"] = round(1000 * (time.perf_counter() - begin))
    bpy.ops.preferences.addon_disable(module=MODULE)
    after = state()
    assert after == before, {key: (before[key], after[key]) for key in before if before[key] != after[key]}
    repos = bpy.context.preferences.extensions.repos
    index = next(i for i, repo in enumerate(repos) if repo.module == "user_default")
    bpy.ops.extensions.package_uninstall(repo_index=index, pkg_id="fieldwork")
    assert not installed().exists(), "files are left after uninstalling"
    assert MODULE not in bpy.context.preferences.addons
    return facts


def main():
    request = json.loads(Path(sys.argv[-1]).read_text())
    try:
        answer = {"ok": True, **run(request)}
    except BaseException as error:  # noqa: BLE001 - the caller must hear of it
        traceback.print_exc()
        answer = {"ok": False, "blender": bpy.app.version_string, "error": f"{type(error).__name__}: {error}"}
    Path(request["answer"]).write_text(json.dumps(answer))
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0 if answer["ok"] else 1)  # some bpy versions hang or crash while they shut down


main()
