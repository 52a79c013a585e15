"""Make the pictures of docs/user-guide.md from the screenshots that `make gui` left in build/gui.

python tests/gui/guide_images.py [NAME …]      # all pictures, or those named
"""

from __future__ import annotations

import sys
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
SHOTS, OUT = ROOT / "build" / "gui", ROOT / "docs" / "images"
LIMIT = 150_000  # bytes

SIDEBAR = (1288, 84, 1548, None)
VIEW = (0, 50, 1576, 980)
PHOTO = (0, 250, 788, 790)
# name: (screenshot, part of it, width in the guide)
IMAGES = {
    "reconstruct": ("panels/one-button", SIDEBAR, 260),
    "line": ("panels/measured-line", VIEW, 900),
    "measure": ("panels/measured", SIDEBAR, 260),
    "preferences": ("preferences/preferences", (280, 362, 968, 690), 688),
    "drop": ("capture/drop-menu", (300, 300, 1000, 620), 480),
    "capture": ("panels/all-capture", SIDEBAR, 260),
    "posing": ("capture/posing", SIDEBAR, 260),
    "poses": ("panels/all-poses", SIDEBAR, 260),
    "scene": ("capture/scene", VIEW, 900),
    "align": ("panels/measured-line", SIDEBAR, 260),
    "classes": ("panels/all-classes", SIDEBAR, 260),
    "training": ("panels/locked", SIDEBAR, 260),
    "trained": ("panels/all-train", SIDEBAR, 260),
    "paused": ("interruptions/paused", SIDEBAR, 260),
    "died": ("interruptions/died", SIDEBAR, 260),
    "label": ("labels-sid/next", SIDEBAR, 260),
    "label-first": ("labels-sid/propagating", VIEW, 900),
    "label-next": ("labels-sid/next", PHOTO, 640),
    "label-parts": ("labels-sid/parts", PHOTO, 640),
    "label-confidence": ("labels-sid/confidence", PHOTO, 640),
    "label-kept": ("labels-sid/kept", SIDEBAR, 260),
    "render": ("panels/all-render", SIDEBAR, 260),
    "live": ("live_panel-sid/panel", VIEW, 900),
    "things": ("things-sid/panel", VIEW, 900),
    "mesh": ("panels/all-mesh", SIDEBAR, 260),
    "export": ("panels/all-export", SIDEBAR, 260),
    "engine": ("panels/all-engine", SIDEBAR, 260),
}


def panel_bottom(picture: Image.Image, left: int, top: int) -> int:
    """Where the panels of the sidebar end: below, the background of the viewport shines through for good."""
    column = [picture.getpixel((left + 2, y)) for y in range(top, 980)]
    inside = [y for y, color in enumerate(column) if color == column[40]]
    return min(980, top + (inside[-1] if inside else 600) + 8)


def main() -> int:
    OUT.mkdir(parents=True, exist_ok=True)
    for name in sys.argv[1:] or IMAGES:
        shot, box, width = IMAGES[name]
        picture = Image.open(SHOTS / f"{shot}.png").convert("RGB")
        left, top, right, bottom = box
        part = picture.crop((left, top, right, bottom or panel_bottom(picture, left, top)))
        part = part.resize((width, round(part.height * width / part.width)), Image.Resampling.LANCZOS)
        path = OUT / f"guide-{name}.webp"
        part.save(path, quality=88, method=6)
        size = path.stat().st_size
        print(f"{path.relative_to(ROOT)}  {part.width}×{part.height}  {size / 1000:.0f} kB")
        if size > LIMIT:
            print(f"{path} is larger than {LIMIT} bytes", file=sys.stderr)
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
