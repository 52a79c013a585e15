"""The engine of Fieldwork: capture, poses, field, rendering, meshes. Knows nothing of Blender."""

__version__ = "0.1.0"
