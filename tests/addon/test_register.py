"""Registering is quick, imports nothing heavy, and unregistering leaves nothing behind."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import textwrap

import pytest

pytest.importorskip("bpy")


def run(script: str, **environment: str) -> dict:
    """What a fresh Blender prints: bpy cannot be loaded twice in one process."""
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        env=os.environ | environment,
    )
    assert done.returncode == 0, done.stderr
    # Blender goes on without a property that it refuses.
    assert "registration error" not in done.stderr
    return json.loads(done.stdout.splitlines()[-1])


RUNS = 20
ADDING = 0.025  # seconds in which an ordinary machine adds a million numbers one by one
REGISTER = """
    import json, os, sys, time
    import bpy
    before = set(sys.modules)
    busy_since = time.process_time()
    import fieldwork
    fieldwork.register()
    busy = time.process_time() - busy_since

    def adding():
        since, total = time.process_time(), 0
        for number in range(10**6):
            total += number
        return time.process_time() - since

    print(json.dumps({"busy": busy, "adding": min(adding() for _ in range(3)), "new": sorted(set(sys.modules) - before)}))
    sys.stdout.flush()
    os._exit(0)
    """


def test_enabling_takes_less_than_50_ms_and_imports_nothing_heavy(tmp_path):
    """From nothing to registered, in a fresh Blender, as when the extension is enabled or Blender starts."""
    # Blender keeps compiled modules, whatever the environment of the tests asks for; the first run only makes them.
    kept = {"PYTHONDONTWRITEBYTECODE": "", "PYTHONPYCACHEPREFIX": str(tmp_path)}
    run(REGISTER, **kept)
    # Processor time: other programs on the machine count only where they push memory out of its caches; slower where Python
    # is, on old or throttled processors. The quickest run tells what it takes.
    times = []
    while len(times) < RUNS and not (times and min(times) < 0.05):
        facts = run(REGISTER, **kept)
        # What a bare Blender has not loaded itself yet would come on top of Fieldwork's own modules.
        foreign = {name.partition(".")[0] for name in facts["new"]} - {"fieldwork", "bpy"}
        assert foreign & {"torch", "pycolmap", "OpenImageIO", "pydantic", "warp", "av", "PIL", "scipy"} == set()
        assert foreign & {"numpy", "subprocess", "tempfile", "logging", "urllib", "hashlib", "ssl"} == set()
        times.append(facts["busy"] / max(1.0, facts["adding"] / ADDING))
    assert min(times) < 0.05, times


def test_nothing_is_left_after_unregister():
    facts = run(
        """
        import json, os, sys
        import bpy
        import fieldwork

        def state():
            types = {n for n in dir(bpy.types) if "fieldwork" in n.lower()}
            types |= {c.__name__ for c in bpy.types.PropertyGroup.__subclasses__() if c.is_registered
                      and "fieldwork" in c.__name__.lower()}
            return {
                "types": sorted(types),
                "operators": [n for n in dir(bpy.ops) if n == "fieldwork"] and dir(bpy.ops.fieldwork),
                "properties": [t for t in dir(bpy.types) if hasattr(getattr(bpy.types, t), "fieldwork")],
                "handlers": sum(
                    len(getattr(bpy.app.handlers, h)) for h in dir(bpy.app.handlers)
                    if isinstance(getattr(bpy.app.handlers, h), list)
                ),
                "status_bar": len(getattr(bpy.types.STATUSBAR_HT_header.draw, "_draw_funcs", [0])),
            }

        before = state()
        fieldwork.register()
        between = state()
        fieldwork.unregister()
        print(json.dumps({"before": before, "between": between, "after": state()}))
        sys.stdout.flush()
        os._exit(0)
        """
    )
    assert "FIELDWORK_PT_main" in facts["between"]["types"]
    assert "train" in facts["between"]["operators"]
    assert facts["between"]["properties"]
    assert facts["after"] == facts["before"]


def test_what_loads_with_the_first_field_that_is_seen_ends_as_well():
    facts = run(
        """
        import json, os, sys
        import bpy
        import fieldwork
        fieldwork.register()
        loaded = [name for name in sys.modules if name.startswith("fieldwork.addon.live.")]
        from fieldwork.addon.live import scene_depth, training, views
        handlers = bpy.app.handlers.depsgraph_update_post
        before = len(handlers)
        for _ in range(2):
            scene_depth._listen()
        bpy.app.timers.register(training.tick)
        between = len(handlers)
        fieldwork.unregister()
        facts = {"loaded": [name.rpartition(".")[2] for name in loaded], "later": views.LATER}
        facts["listening"] = [between - before, scene_depth._updated in handlers]
        facts["looking"] = bpy.app.timers.is_registered(training.tick)
        print(json.dumps(facts))
        sys.stdout.flush()
        os._exit(0)
        """
    )
    assert not set(facts["loaded"]) & {*facts["later"], "compositor"}
    assert facts["listening"] == [1, False]
    assert not facts["looking"]


def test_paths_may_begin_at_the_open_file_but_for_those_of_the_preferences():
    facts = run(
        """
        import json, os, sys, warnings
        import bpy
        import fieldwork
        fieldwork.register()
        from fieldwork.addon import registration
        classes = [cls for module in registration._registered for cls in getattr(module, "CLASSES", ())]
        types = [cls.bl_rna for cls in classes]
        types += [getattr(bpy.ops.fieldwork, name).get_rna_type() for name in dir(bpy.ops.fieldwork)]
        relative, plain = [], []
        for rna in types:
            for prop in rna.properties:
                if getattr(prop, "subtype", "") in ("DIR_PATH", "FILE_PATH"):
                    # Before Blender 4.5 all may.
                    may = getattr(prop, "is_path_supports_blend_relative", True)
                    (relative if may else plain).append(f"{rna.identifier}.{prop.identifier}")
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            bpy.context.scene.fieldwork.photos = "//photos"
        facts = {"relative": relative, "plain": plain, "warned": [str(each.message) for each in warned]}
        print(json.dumps({**facts, "version": list(bpy.app.version)}))
        sys.stdout.flush()
        os._exit(0)
        """
    )
    assert len(facts["relative"]) > 40
    preferences = [f"FIELDWORK_AP_preferences.{name}" for name in ("engine_python", "base_python", "wheels")]
    assert facts["plain"] == (preferences if facts["version"] >= [4, 5, 0] else [])
    assert facts["warned"] == []
