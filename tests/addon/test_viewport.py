"""What the viewport does beside drawing, without a window."""

from __future__ import annotations

import pytest

pytest.importorskip("bpy")

from types import SimpleNamespace

from fieldwork.addon.live import viewport as module


def test_what_could_not_be_drawn_is_tried_again_after_a_while(monkeypatch: pytest.MonkeyPatch) -> None:
    own, now, tried = module.Viewport(), [0.0], []
    broken = [True]

    def draw(*_: object) -> None:
        tried.append(now[0])
        if broken[0]:
            raise FileNotFoundError("it is being baked anew")

    monkeypatch.setattr(own, "_draw", draw)
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    context, other = (
        SimpleNamespace(region=SimpleNamespace(as_pointer=lambda n=n: n), region_data=None) for n in (1, 2)
    )
    for _ in range(3):  # redraws at once
        own.draw(context, [])
    assert tried == [0.0]
    assert "baked anew" in own.error
    broken[0] = False
    own.draw(other, [])
    assert len(tried) == 2, "another view is not held up"
    assert "baked anew" in own.error
    now[0] = module.RETRY + 1
    own.draw(context, [])
    own.draw(context, [])
    assert len(tried) == 4
    assert own.error == ""
