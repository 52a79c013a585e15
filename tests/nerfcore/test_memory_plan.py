"""The memory of a graphics card that training takes, planned by shapes, beside what a step really keeps."""

from __future__ import annotations

import pytest
import torch
from fieldwork.nerfcore.config import RunConfig, make_config
from fieldwork.nerfcore.render.model import Model
from fieldwork.nerfcore.train.memory_plan import PHOTOS, memory_plan, preset_plans, saved_bytes


@pytest.mark.parametrize(("classes", "precision"), [(0, "bfloat16"), (7, "bfloat16"), (40, "float32")])
def test_a_sample_keeps_as_much_as_planned(classes: int, precision: str) -> None:
    config = RunConfig()
    config.field.table_log2, config.field.finest, config.sampling.resolution = 12, 64, 32
    config.field.precision = precision  # type: ignore[assignment]
    torch.manual_seed(0)
    model = Model(config, classes, 1, False)
    model.host_visible_share = 1.0
    model.visible_share.fill_(1.0)  # one pass
    rays = 512
    origins = torch.rand(rays, 3) * 0.2 - torch.tensor([0.1, 0.1, 3.0])
    directions = torch.nn.functional.normalize(torch.tensor([0.0, 0.0, 1.0]) + 0.1 * torch.randn(rays, 3), dim=1)
    kept: dict[int, int] = {}
    alive = []

    def keep(x: torch.Tensor) -> torch.Tensor:
        alive.append(x)
        kept[x.untyped_storage().data_ptr()] = x.untyped_storage().nbytes()
        return x

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda x: x):
        rendered = model.render(origins, directions, 16)
    for x in [*model.parameters(), *model.buffers()]:
        kept.pop(x.untyped_storage().data_ptr(), None)
    planned = saved_bytes(config, classes, precision != "float32") * rendered.evaluated
    assert rendered.evaluated > 2000
    assert 0.6 * planned < sum(kept.values()) < 1.15 * planned


def test_presets_fit_on_a_card_of_eight_gigabytes() -> None:
    plans = preset_plans(["draft", "standard", "high"])
    assert plans["draft"].needed < plans["standard"].needed < plans["high"].needed < 7e9
    assert plans["standard"].photos == PHOTOS * 5


def test_what_is_larger_takes_more() -> None:
    def needed(**settings: str) -> int:
        return memory_plan(make_config("standard", settings)).needed

    plain = needed()
    for name, value in (("field.table_log2", "21"), ("train.batch_samples", "262144"), ("sampling.resolution", "256")):
        assert needed(**{name: value}) > plain
    assert memory_plan(make_config("standard"), half=False).step > memory_plan(make_config("standard")).step
