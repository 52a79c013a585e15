"""Photos encoded ahead with the model that clicks ask: the one that is shown and the next three, while nothing else is done."""

from __future__ import annotations

from pathlib import Path

import bpy

from ..jobs.queue import queue
from ..project import snapshot
from . import editor, pending

AHEAD = 3  # photos after the one that is shown

_asked: set[tuple[Path, str, str, str]] = set()  # project, encoder, decoder, photo: each once, whatever came of it


def encode(scene: bpy.types.Scene) -> None:
    """Let the engine encode the next photo that a click may come to. One a job: what is asked meanwhile waits for one at
    most. What is on disk already is not encoded again."""
    settings, folder = scene.fieldwork, snapshot.folder_of(scene.fieldwork)
    shown = editor.shown_photo(folder)
    if folder is None or not shown or settings.label_tool != "click" or queue.busy or pending.waiting():
        return
    encoder, decoder = (bpy.path.abspath(path) for path in (settings.label_encoder, settings.label_decoder))
    if not (Path(encoder).is_file() and Path(decoder).is_file()):
        return
    for photo in ahead_of(list(editor.photos(folder)), shown):
        key = (folder, encoder, decoder, photo)
        if key not in _asked:
            _asked.add(key)
            params = {"project": str(folder), "encoder": encoder, "decoder": decoder, "photos": [photo]}
            queue.submit(queue.make("assist embed", params))
            return


def ahead_of(names: list[str], shown: str) -> list[str]:
    """The photo that is shown and those after it, around the end."""
    first = names.index(shown) if shown in names else 0
    return [names[(first + step) % len(names)] for step in range(min(AHEAD + 1, len(names)))]


def clear() -> None:
    """Forget what was asked."""
    _asked.clear()
