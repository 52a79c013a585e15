"""The engine of Fieldwork: capture, poses, field, rendering, meshes. Knows nothing of Blender."""

import os

# Read when torch is first imported: what it cannot do on an Apple GPU it then does on the CPU.
os.environ.setdefault("PYTORCH_ENABLE_MPS_FALLBACK", "1")

__version__ = "0.1.0"
