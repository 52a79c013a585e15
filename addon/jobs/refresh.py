"""What a job changed, in the scenes that show its project."""

from __future__ import annotations

import bpy

from ..project import lists, recent, snapshot
from .job import Job


def refresh_scenes(job: Job) -> None:
    """Bring what a job changed in its project into the scenes that show it."""
    for scene in bpy.data.scenes:
        if job.project is not None and snapshot.folder_of(scene.fieldwork) == job.project:
            if job.verb in ("new", "import", "reconstruct") and job.state == "done":
                lists.other_project(scene.fieldwork)  # it may have been made anew
                if not bpy.app.background:
                    recent.remember(job.project)
            else:
                lists.refresh(scene.fieldwork)
