"""Textures of a stored mesh that are larger than what Pillow opens by itself, or than what anything may decode."""

from __future__ import annotations

import struct
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from fieldwork.nerfcore.errors import ProjectError
from fieldwork.nerfcore.mesh.stored import MESH, TEXTURE, load_surface, mesh_folder
from PIL import Image


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def test_the_largest_texture_that_is_made_is_opened(tmp_path: Path) -> None:
    """By a process that decodes no photos. The file has no pixels: whether it is too large is asked before."""
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 16384, 16384, 8, 2, 0, 0, 0))
    (tmp_path / TEXTURE).write_bytes(b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", b"") + chunk(b"IEND", b""))
    code = (
        "import sys; from fieldwork.nerfcore.mesh import stored; from PIL import Image\n"
        "assert 'fieldwork.nerfcore.images.decode' not in sys.modules\n"
        f"print(*Image.open({str(tmp_path / TEXTURE)!r}).size)"
    )
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True)
    assert done.stdout.split() == ["16384", "16384"], done.stderr


def test_a_texture_beyond_all_measure_is_called_damaged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = mesh_folder(tmp_path, "main")
    folder.mkdir(parents=True)
    corners, faces = np.eye(3, dtype=np.float32), np.array([[0, 1, 2]])
    arrays = {"vertices": corners, "faces": faces, "normals": corners, "colors": np.zeros((3, 3), np.uint8)}
    classes = {"class_id": np.zeros(3, int), "face_class": np.zeros(1, int)}
    np.savez(folder / MESH, **arrays, **classes, uv=np.zeros((1, 3, 2), np.float32))
    Image.new("RGB", (64, 64)).save(folder / TEXTURE)
    load_surface(tmp_path, "main")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 1000)
    with pytest.raises(ProjectError, match=r"texture\.png is damaged.*exceeds limit"):
        load_surface(tmp_path, "main")
