"""The page of a campaign as a browser shows it."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from fieldwork.nerfcore.cluster import status as st
from PIL import Image

BROWSER = next(
    (found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), ""
)
WIDTH, HEIGHT = 1000, 900
RED = np.array([214, 40, 30])

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not BROWSER, reason="there is no Chromium to open the page with"),
]


def campaign(folder: Path) -> Path:
    """A campaign with a capture of each state; the finished one has a red picture."""
    project = folder / "vase"
    (project / "exports/main/renders").mkdir(parents=True)
    Image.new("RGB", (640, 480), tuple(RED.tolist())).save(project / "exports/main/renders/orbit_0000.png")
    place = folder / "objects-campaign"
    verdict = {"level": "weak", "reasons": ["Held-out photos are matched poorly."]}
    figures = {"photos": "20", "placed": "20", "held out (dB)": "24.1", "mIoU": "0.81", "triangles": "118204"}
    rows = [
        st.capture_row(
            str(project), "done", fraction=1.0, figures=figures, verdict=verdict, seconds=854.0,
            picture=st.add_picture(place, project, 0),
        ),
        st.capture_row("/c/jug", "waiting", stage="new", eta_s=900.0),
        st.capture_row("/c/bowl", "running", stage="train", fraction=0.4, eta_s=75.0),
        st.capture_row("/c/mask", "failed", error="The photos do not overlap.", hint="Take more of them."),
    ]  # fmt: skip
    nodes = [{"cores": 1.0}, {"cores": 1.0}]
    st.write_status(place, st.status("objects", "running", 0.0, rows, nodes, 1000.0), page=True)
    return place / st.PAGE


def shown(page: Path, target: Path) -> np.ndarray:
    """What a browser shows of a page, (H, W, 3) uint8."""
    command = [BROWSER, "--headless", "--disable-gpu", "--hide-scrollbars", f"--user-data-dir={target.parent / 'user'}"]
    command += ["--no-sandbox"] if hasattr(os, "geteuid") and os.geteuid() == 0 else []
    command += [f"--window-size={WIDTH},{HEIGHT}", f"--screenshot={target}", page.as_uri()]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    with Image.open(target) as picture:
        return np.asarray(picture.convert("RGB"))


def test_a_browser_shows_the_picture_and_the_failure_above_it(tmp_path: Path) -> None:
    page = campaign(tmp_path)
    picture = shown(page, tmp_path / "page.png")
    assert picture.shape == (HEIGHT, WIDTH, 3)
    red = (np.abs(picture.astype(int) - RED) < 12).all(2)
    assert red.sum() > 3000, "the picture of the finished capture is not there"
    rows, columns = np.nonzero(red)
    assert red[rows.min() : rows.max(), columns.min() : columns.max()].mean() > 0.9, "it is one rectangle"
    # Without the failure there is less above it.
    text = page.read_text()
    assert "The photos do not overlap." in text
    shorter = page.with_name("shorter.html")
    shorter.write_text(text.replace("The photos do not overlap.", "").replace("Take more of them.", ""))
    other = shown(shorter, tmp_path / "shorter.png")
    first = np.flatnonzero((picture != other).any((1, 2)))
    assert 0 < first[0] < rows.min(), "what failed is told above what is done"
