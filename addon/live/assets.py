"""Baked fields as textures of Blender's GPU module."""

from __future__ import annotations

import time
from typing import Any

from . import voxels
from .thing_texels import Told


class Asset:
    """The textures of a baked field; they are loaded one in each redraw."""

    def __init__(self, found: voxels.Baked) -> None:
        self.found, self.used = found, time.monotonic()
        self.error = ""
        self.index: Any = None
        self.texels: list[Any] = []
        self.told: Told | None = None  # which of its things have class indices of their own

    @property
    def ready(self) -> bool:
        return self.index is not None and len(self.texels) == len(voxels.TEXELS)

    def load(self) -> None:
        """Load the next texture."""
        from ...nerfcore.files import UNREADABLE_ARRAYS  # not at the top: enabling the extension must be quick

        try:
            if self.index is None:
                self.index = texture((self.found.meta["side"],) * 3, "R32F", voxels.read_index(self.found))
            elif not self.ready:
                name = list(voxels.TEXELS)[len(self.texels)]
                self.texels.append(self._texels(name, voxels.read_texels(self.found, name)))
        except (*UNREADABLE_ARRAYS, RuntimeError, MemoryError) as error:
            self.error = str(error)

    def tell_apart(self, told: Told) -> None:
        """Give things class indices of their own, once everything is loaded."""
        self.told = told
        try:
            self.texels[1] = self._texels("T1", voxels.numbers(told.texels, self.found.meta, "T1"))
        except ValueError:
            pass  # of a field that was baked meanwhile, which is another asset
        except (RuntimeError, MemoryError) as error:
            self.error = str(error)

    def _texels(self, name: str, values: Any) -> Any:
        return texture(voxels.texture_size(self.found.meta, name), "RGBA8", values)


def texture(size: tuple[int, ...], kind: str, values: Any) -> Any:
    """A texture of flat float32 values."""
    import gpu

    return gpu.types.GPUTexture(size, format=kind, data=gpu.types.Buffer("FLOAT", len(values), values))
