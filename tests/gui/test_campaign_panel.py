"""The Campaign panel in a real window. The screenshots stay in build/gui/campaign/."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fieldwork.tests.gui import window
from PIL import Image

HERE = Path(__file__).parent


REASON = window.missing()
pytestmark = [
    pytest.mark.gui,
    pytest.mark.slow,
    pytest.mark.timeout(600 * window.PATIENCE),
    pytest.mark.skipif(REASON is not None, reason=str(REASON)),
]


def test_the_panel_follows_a_campaign():
    session = window.Window("campaign")
    session.play("campaign", timeout=400)
    running, ended = (
        np.asarray(Image.open(session.folder / f"{name}.png").convert("RGB")) for name in ("running", "ended")
    )
    side = np.s_[:, -600:]
    assert (running[side] != ended[side]).any(2).sum() > 2000, "the panel does not follow the campaign"
