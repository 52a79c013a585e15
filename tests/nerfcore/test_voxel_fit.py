"""What rays say about the vertices of a baked field: its backends against each other, and a field that is fitted to another."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from fieldwork.nerfcore.kernels import voxel_fit, voxel_march_torch
from fieldwork.nerfcore.kernels.voxel_field import TEXELS, VERTICES, VoxelField
from fieldwork.nerfcore.kernels.voxel_fit import add_errors
from fieldwork.nerfcore.kernels.voxel_march import march

from .test_voxel_march import CONTRACTED, moved, random_field, random_rays, settings


@pytest.fixture(autouse=True, params=["host", "every device"])
def kernels_of(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """The CPU runs its own kernels, and those that GPUs run."""
    if request.param == "every device":
        monkeypatch.setattr(voxel_fit, "on_host", lambda device: False)


def opaque(field: VoxelField) -> VoxelField:
    return replace(field, class_opacity=torch.ones(256))


def asked(device: torch.device, contracted: bool, count: int = 600) -> tuple[list[torch.Tensor], VoxelField]:
    """Rays with colours, and a field."""
    generator = torch.Generator().manual_seed(3)
    origins, directions = random_rays(count)
    colors = [torch.rand(count, 3, generator=generator) for _ in range(2)]
    return [value.to(device) for value in (origins, directions, *colors)], moved(opaque(random_field()[1]), device)


@CONTRACTED
def test_backends_say_the_same(device: torch.device, contracted: bool) -> None:
    rays, field = asked(device, contracted)
    here = settings(contracted)
    expected, found = (torch.zeros(len(field.vertices) // TEXELS, 6, device=device) for _ in range(2))
    errors = voxel_march_torch.add_errors(expected, *rays, field, here)
    assert torch.allclose(add_errors(found, *rays, field, here), errors, atol=1e-4)
    assert float(expected[:, 3].sum()) > 50
    assert torch.allclose(found, expected, rtol=1e-2, atol=2e-3)


@CONTRACTED
def test_the_error_is_that_of_the_picture_and_its_slopes_are_right(contracted: bool) -> None:
    """Against the march itself: the error of each ray, and how the sum of all changes with colours and roots."""
    device = torch.device("cpu")
    rays, field = asked(device, contracted)
    here = settings(contracted)
    sums = torch.zeros(len(field.vertices) // TEXELS, 6)
    errors = add_errors(sums, *rays, field, here)

    def picture(shown: VoxelField) -> torch.Tensor:
        found = march(rays[0], rays[1], shown, here)
        return found.color + (1 - found.opacity)[:, None] * rays[3]

    before = picture(field)
    assert torch.allclose((rays[2] - before).square().mean(1), errors, atol=1e-3)
    bytes_ = field.vertices.view(torch.uint8).view(-1, TEXELS, 4)
    vertex = int((sums[:, 3] * (bytes_[:, 0, 3] > 20) * (bytes_[:, 0, 3] < 80)).argmax())
    for channel, expected in ((0, sums[vertex, 0]), (3, sums[vertex, 4])):
        other = bytes_.clone()
        step = -8 if other[vertex, 0, channel] > 128 else 8
        other[vertex, 0, channel] = int(other[vertex, 0, channel]) + step
        changed = picture(replace(field, vertices=other.reshape(-1).view(torch.int32)))
        slope = ((changed - before) * (rays[2] - before)).sum() / (step / 255)
        assert float(slope) == pytest.approx(float(expected), rel=0.3, abs=0.05), channel


def test_rays_without_a_field_say_nothing(device: torch.device) -> None:
    rays, field = asked(device, False)
    away = [rays[0] + 10, torch.nn.functional.normalize(torch.ones_like(rays[1]), dim=1), *rays[2:]]
    sums = torch.zeros(len(field.vertices) // TEXELS, 6, device=device)
    errors = add_errors(sums, *away, field, settings(False))
    assert float(sums.abs().sum()) == 0
    assert torch.allclose(errors, (rays[2] - rays[3]).square().mean(1), atol=1e-6)
    assert len(field.vertices) % VERTICES**3 == 0
