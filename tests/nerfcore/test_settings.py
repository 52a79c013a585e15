"""The settings as a whole: all described, all tested, presets and boundary cases."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import torch
from fieldwork.nerfcore import config as config_module
from fieldwork.nerfcore.bench.suites import ABLATION
from fieldwork.nerfcore.cli import main
from fieldwork.nerfcore.config import ONLY_RENDERING, RunConfig, make_config, what_it_takes
from fieldwork.nerfcore.errors import SettingError
from fieldwork.nerfcore.field.hybrid import HybridField
from fieldwork.nerfcore.kernels.traversal import PDF_UNIFORM
from fieldwork.nerfcore.render.model import Model
from fieldwork.nerfcore.sampling.occupancy import OccupancyGrid
from fieldwork.nerfcore.verbs import VERBS
from fieldwork.tests.nerfcore.support.ball import ball_project
from fieldwork.tests.nerfcore.support.settings import trainer_of
from pydantic import BaseModel
from pydantic.fields import FieldInfo

ROOT = Path(__file__).resolve().parents[2]
NAMES = [
    f"{stage}.{name}" for stage, info in RunConfig.model_fields.items() for name in type(info.default).model_fields
]


def test_every_setting_is_described() -> None:
    bare = [
        f"{stage}.{name}"
        for stage, info in RunConfig.model_fields.items()
        for name, setting in type(info.default).model_fields.items()
        if not setting.description
    ]
    assert bare == []


def test_every_setting_has_a_test_of_what_it_changes() -> None:
    marked: set[str] = set()
    for file in Path(__file__).parent.glob("test_*.py"):
        for marker in re.findall(r"pytest\.mark\.setting\(([^)]*)\)", file.read_text("utf-8")):
            marked.update(re.findall(r'"([\w.]+)"', marker))
    assert sorted(set(NAMES) - marked) == []
    assert sorted(marked - set(NAMES)) == []


def test_every_setting_is_reached_by_its_name() -> None:
    for name in NAMES:
        stage, key = name.split(".")
        default = getattr(getattr(RunConfig(), stage), key)
        text = default if isinstance(default, str) else json.dumps(default)
        assert getattr(getattr(make_config("standard", {name: text}), stage), key) == default


def test_earlier_names_are_understood_in_settings_and_presets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert make_config("draft", {"sampling.interest": "none"}).sampling.importance == "none"
    (tmp_path / "old.json").write_text('{"sampling": {"interest": "boundary", "samples": 9}}')
    monkeypatch.setattr(config_module, "PRESETS", tmp_path)
    sampling = make_config("old").sampling
    assert (sampling.importance, sampling.samples) == ("boundary", 9)


def test_training_does_not_read_the_settings_of_pictures(tmp_path: Path) -> None:
    """The same field to the bit, so that it need not be trained anew for other ones."""
    project = ball_project(tmp_path / "ball", views=6, side=24)

    def trained(**settings: str) -> list[torch.Tensor]:
        trainer = trainer_of(project, **settings)
        for step in range(12):
            trainer.step(step / 12)
        return list(trainer.model.state_dict().values())

    other = {"render.samples": "5", "render.per_bin": "3", "render.refine": "4", "render.fused": "off"}
    assert sorted(other) == sorted(f"render.{name}" for name in ONLY_RENDERING)
    usual = trained()
    assert all(torch.equal(a, b) for a, b in zip(usual, trained(**other)))
    assert not all(torch.equal(a, b) for a, b in zip(usual, trained(**{"render.accumulate": "logits"})))


def test_boundary_cases_are_settings_of_one_pipeline() -> None:
    def model(variant: str, classes: int = 3) -> Model:
        small = {"field.levels": "3", "field.finest": "48", "sampling.resolution": "16"}
        return Model(make_config("standard", {**small, **ABLATION[variant]}), classes, 2, contracted=False)

    explicit, implicit, uniform = (model(name) for name in ("explicit", "implicit", "uniform pdf"))
    assert (explicit.field.grid is not None, explicit.field.implicit is not None) == (True, False)
    assert (implicit.field.grid is not None, implicit.field.implicit is not None) == (False, True)
    assert uniform.occupancy.march_settings().mode == PDF_UNIFORM
    assert make_config("standard", ABLATION["no semantics"]).loss.semantic_weight == 0
    assert model("no semantics", 0).field.semantic_head is None
    origins = torch.tensor([[-3.0, 0.0, 0.0]]).repeat(4, 1)
    directions = torch.nn.functional.normalize(torch.tensor([[1.0, 0.01 * k, 0.02] for k in range(4)]), dim=1)
    for boundary in (explicit, implicit, uniform, model("no semantics", 0)):
        out = boundary.render(origins, directions, 8)
        assert bool(torch.isfinite(out.color).all())
        assert (out.probabilities is None) == (boundary.field.semantic_head is None)


def test_presets_grow_and_the_standard_one_stays_within_its_parameters() -> None:
    counts = [HybridField(make_config(name).field, 101).parameter_count() for name in ("draft", "standard", "high")]
    assert counts == sorted(counts)
    assert counts[1] <= 15.6e6
    samples = [make_config(name).sampling.samples for name in ("draft", "standard", "high")]
    assert samples == sorted(samples)
    for name in ("draft", "standard", "high"):
        assert len(OccupancyGrid(make_config(name).sampling, False).cells) == make_config(name).sampling.resolution ** 3


def limits(info: FieldInfo) -> tuple[list[float], list[float]]:
    """Lower and upper limits of a number."""
    lower = [getattr(m, name) for m in info.metadata for name in ("ge", "gt") if hasattr(m, name)]
    return lower, [getattr(m, name) for m in info.metadata for name in ("le", "lt") if hasattr(m, name)]


def numbers(model: type[BaseModel]) -> dict[str, FieldInfo]:
    """The fields of a model that hold one number."""
    kinds = (int, float, int | None, float | None)
    return {name: info for name, info in model.model_fields.items() if info.annotation in kinds}


@pytest.mark.parametrize("model", [type(info.default) for info in RunConfig.model_fields.values()])
def test_every_number_has_limits(model: type[BaseModel]) -> None:
    assert [name for name, info in numbers(model).items() if not all(limits(info))] == []


@pytest.mark.parametrize("verb", VERBS)
def test_every_number_of_a_verb_has_limits(verb: str) -> None:
    assert [name for name, info in numbers(VERBS[verb].params).items() if not all(limits(info))] == []


@pytest.mark.parametrize(
    "setting",
    ["train.grid_rate=1e30", "scene.image_size=100000000", "train.network_rate=nan", "loss.rgb_weight=Infinity"],
)
def test_absurd_settings_are_refused(setting: str) -> None:
    name, value = setting.split("=")
    with pytest.raises(SettingError, match=name):
        make_config("standard", {name: value})


@pytest.mark.parametrize("size", ["0x0", "-5x-5", "100000x100000", "10x"])
@pytest.mark.parametrize("verb", ["render", "simulate", "dataset"])
def test_absurd_picture_sizes_are_refused(
    tmp_path: Path, verb: str, size: str, capfd: pytest.CaptureFixture[str]
) -> None:
    positional = {"render": ["p", "--out", "o"], "simulate": ["o"], "dataset": ["--blend", "a.blend", "o"]}[verb]
    assert main([verb, *positional, "--size", size]) == 2
    assert "size" in capfd.readouterr().err


def test_time_is_a_number(tmp_path: Path) -> None:
    for limit in ("nan", "inf", "-1"):
        assert main(["train", str(tmp_path), "--time-limit", limit]) == 2


@pytest.mark.parametrize("name", ["field.appearance", "train.grid_rate"])
def test_true_is_no_number(name: str) -> None:
    with pytest.raises(SettingError, match=name):
        make_config("draft", {name: "true"})


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("loss.semantic", "Did you mean loss.semantic_weight?"),
        ("holdout_rate", "stages are scene, field, sampling, render, loss, train"),
        ("image_size", "Did you mean scene.image_size?"),
        ("samples", "sampling.samples or render.samples"),
        ("field.colour_of_it", "Settings of field are"),
        ("loss", "semantic_weight"),
    ],
)
def test_names_of_no_setting_say_which_may_be_meant(name: str, hint: str) -> None:
    with pytest.raises(SettingError, match=name) as caught:
        make_config("draft", {name: "1"})
    assert hint in caught.value.hint


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("sampling.samples", "a whole number, at least 1, at most 512 (default: 16)"),
        ("field.branch", "hybrid or explicit or implicit"),
        ("field.finest", "a whole number or null, at least 2"),
    ],
)
def test_impossible_values_say_what_is_possible(name: str, hint: str) -> None:
    with pytest.raises(SettingError, match=name) as caught:
        make_config("draft", {name: "-7"})
    assert hint in caught.value.hint


@pytest.mark.parametrize("name", NAMES)
def test_every_setting_says_what_it_takes(name: str) -> None:
    assert name in what_it_takes(*name.split("."))


def test_the_examples_of_settings_are_settings() -> None:
    sources = [(ROOT / path).read_text("utf-8") for path in ("nerfcore/params/base.py", "operators/train.py")]
    examples = [example for text in sources for example in re.findall(r"e\.g\. ([a-z_]+\.\w+=[\w.]+\w)", text)]
    assert len(examples) == 2
    for example in examples:
        name, _, value = example.partition("=")
        make_config("draft", {name: value})


def test_settings_that_do_nothing_beside_the_others_are_told() -> None:
    from fieldwork.nerfcore.train.prepare import without_effect

    for settings, classes, told in (
        ({}, 0, []),
        ({"field.levels": "1"}, 2, []),
        ({"field.levels": "1", "field.finest": "64"}, 2, ["field.finest"]),
        ({"field.levels": "1", "field.finest": "64", "field.branch": "implicit"}, 2, []),
        ({"sampling.pdf": "literal"}, 2, []),
        ({"sampling.pdf": "literal"}, 0, ["sampling.pdf=literal"]),
    ):
        found = without_effect(make_config("standard", settings), classes)
        assert [text.split(" has no effect")[0] for text in found] == told
