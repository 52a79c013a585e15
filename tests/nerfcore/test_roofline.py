"""What a machine can do, and what a field needs of it."""

from __future__ import annotations

import pytest
import torch
from fieldwork.nerfcore.bench import roofline
from fieldwork.nerfcore.bench.roofline import Rates, Work, measure_rates, rendering_work, training_work
from fieldwork.nerfcore.config import FieldConfig
from fieldwork.nerfcore.field.hybrid import HybridField
from fieldwork.nerfcore.kernels.random_reads import READS, sum_random_rows

CPU = torch.device("cpu")


def test_times_add_up() -> None:
    assert Work(6e9, 4e6, 10e9).seconds(Rates(2e9, 1e6, 5e9)) == pytest.approx(3 + 4 + 2)


def test_the_work_is_that_of_the_networks_and_the_corners() -> None:
    field = HybridField(FieldConfig(levels=3, table_log2=10, octaves=2, width=16, geometry_features=3), 5)
    implicit = 15 * 16 + 16 * 12  # 3 + 6 · 2 inputs, 3 levels of 4 features
    density = 24 * 16 + 16 * 4  # both branches, 1 + 3 outputs
    color = 20 * 16 + 16 * 16 + 16 * 3  # 4 features and 16 of the direction, three products
    classes = 28 * 16 + 16 * 5  # 4 features and both branches
    work = rendering_work(field, 100, 40)
    assert work.flops == 2 * (100 * (implicit + density) + 40 * (color + classes))
    assert work.reads == 100 * 8 * 3
    step = training_work(field, 100, 40, 7)
    assert step.flops == 2 * (100 * (implicit + density) + 3 * 40 * (implicit + density + color + classes))
    assert step.reads == (100 + 2 * 40) * 8 * 3
    assert step.bytes == 7 * roofline.BLOCK * 4 * 4 * 4 * 2
    alone = HybridField(FieldConfig(branch="implicit", levels=3, octaves=2, width=16), 0)
    assert rendering_work(alone, 100, 40).reads == 0


def test_rates_are_of_a_possible_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(roofline, "SECONDS", 0.05)
    rates = measure_rates(HybridField(FieldConfig(levels=2, table_log2=12), 0), CPU)
    assert 1e8 < rates.flops < 1e14
    assert 1e6 < rates.reads < 1e11
    assert 1e8 < rates.bytes < 1e13


def test_random_reads_go_everywhere() -> None:
    """As many different rows as that many random ones hit."""
    rows = 1 << 14
    table = torch.zeros(rows, 4)
    table[:, 0] = 1.0
    table[: rows // 2, 1] = 1.0
    out = sum_random_rows(table, 256)
    assert bool((out[:, 0] == READS).all())
    assert float(out[:, 1].mean()) / READS == pytest.approx(0.5, abs=0.02)
