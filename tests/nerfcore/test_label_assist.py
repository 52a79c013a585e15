"""Models that users bring: clicks and boxes cut out what lies there, whatever the model; files that do not fit are told."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fieldwork.nerfcore.cli import main
from fieldwork.nerfcore.errors import Cancelled, InputError
from fieldwork.nerfcore.images.working import read_label
from fieldwork.nerfcore.labels import models as loaded
from fieldwork.nerfcore.labels.assist.embeddings import FOLDER
from fieldwork.nerfcore.labels.assist.outline import outline_of
from fieldwork.nerfcore.labels.assist.segmenter import EfficientSam, HuggingSam2, Prompt, Sam2, Segmenter, segmenter
from fieldwork.nerfcore.labels.assist.verbs import embed, segment, suggest
from fieldwork.nerfcore.labels.drawing import covered
from fieldwork.nerfcore.labels.journal import append_mark, marks_at, read_marks, show, shown_revision
from fieldwork.nerfcore.params import AssistEmbedParams, AssistSegmentParams, AssistSuggestParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.store import edit_project, load_project
from fieldwork.tests.nerfcore.support import onnx_models as tiny
from fieldwork.tests.nerfcore.support.ball import ball_project
from PIL import Image
from pydantic import ValidationError

SIZE = WIDTH, HEIGHT = 60, 40
CLICK = (41.5, 12.5)
SAM2_OUTPUTS = ("image_embed", "high_res_feats_0", "high_res_feats_1")
HUGGING_OUTPUTS = ("image_embeddings.0", "image_embeddings.1", "image_embeddings.2")
KINDS: dict[str, tuple[type[Segmenter], Callable[[Path], Path], Callable[[Path], Path]]] = {
    "sam": (Segmenter, tiny.encoder, tiny.sam_decoder),
    "sam, raw pictures": (Segmenter, tiny.raw_encoder, tiny.sam_decoder),
    "sam 2": (Sam2, lambda path: tiny.encoder(path, "image", outputs=SAM2_OUTPUTS), tiny.sam2_decoder),
    "sam 2, hugging face": (
        HuggingSam2,
        lambda path: tiny.encoder(path, "pixel_values", outputs=HUGGING_OUTPUTS),
        tiny.hugging_decoder,
    ),
    "efficient sam": (EfficientSam, lambda path: tiny.encoder(path, "batched_images", None), tiny.efficient_decoder),
}


@pytest.fixture(params=KINDS)
def files(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[str, Path, Path]:
    _, encoder, decoder = KINDS[request.param]
    return request.param, encoder(tmp_path / "encoder.onnx"), decoder(tmp_path / "decoder.onnx")


def photo() -> np.ndarray:
    return np.full((HEIGHT, WIDTH, 3), 255, np.uint8)


def radii(kind: str) -> tuple[float, float]:
    """Of the best disc in pixels of the photo, along x and y."""
    low = tiny.RADII[1]
    return (low * WIDTH / tiny.LOW, low * HEIGHT / tiny.LOW) if "sam 2" in kind else (low, low)


def disc(center: tuple[float, float], kind: str) -> np.ndarray:
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rx, ry = radii(kind)
    return ((x - center[0]) / rx) ** 2 + ((y - center[1]) / ry) ** 2 < 1


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / max(1, (a | b).sum()))


def test_a_click_cuts_out_what_lies_there(files: tuple[str, Path, Path]) -> None:
    kind, encoder, decoder = files
    model = segmenter(encoder, decoder)
    assert type(model) is KINDS[kind][0]
    embeddings = model.encode(photo())
    assert len(embeddings) == len(model.embeddings)
    for prompt in (Prompt([CLICK], []), Prompt([CLICK], [(3.0, 4.0)])):
        mask, score = model.cut(embeddings, SIZE, prompt)
        assert mask.shape == (HEIGHT, WIDTH)
        assert overlap(mask, disc(CLICK, kind)) > (0.5 if "sam 2" in kind else 0.9)
        assert score == pytest.approx(0.9), "the best of the candidates"


def test_a_box_cuts_out_what_lies_in_it(files: tuple[str, Path, Path]) -> None:
    kind, encoder, decoder = files
    model = segmenter(encoder, decoder)
    mask, _ = model.cut(model.encode(photo()), SIZE, Prompt([], [], (10.0, 20.0, 30.0, 34.0)))
    assert overlap(mask, disc((20.0, 27.0), kind)) > (0.5 if "sam 2" in kind else 0.9)


def test_photos_come_to_the_encoder_as_it_was_trained(tmp_path: Path) -> None:
    """SAM pads below, SAM 2 fills the square, EfficientSAM takes the picture as it is."""
    white = (1 - 0.485) / 0.229
    made = {
        kind: segmenter(KINDS[kind][1](tmp_path / f"{i}e.onnx"), KINDS[kind][2](tmp_path / f"{i}d.onnx"))
        for i, kind in enumerate(KINDS)
    }
    red = {kind: model.encode(photo())[0][0] for kind, model in made.items()}
    np.testing.assert_allclose(red["sam"][0, :42], white, rtol=1e-4)
    np.testing.assert_allclose(red["sam"][0, 43:], 0, atol=1e-6)
    np.testing.assert_allclose(red["sam, raw pictures"][:, 0, 0], [683, 1024, 3, 255], rtol=0.01)
    np.testing.assert_allclose(red["sam 2"][0], white, rtol=1e-4)
    np.testing.assert_allclose(red["sam 2, hugging face"][0], white, rtol=1e-4)
    np.testing.assert_allclose(red["efficient sam"][0], 1, rtol=1e-4)
    assert red["efficient sam"].shape[1:] == (3, 4)


def test_an_outline_holds_parts_and_holes() -> None:
    mask = np.zeros((30, 40), bool)
    mask[3:20, 5:25] = True
    mask[8:14, 10:18] = False
    mask[10:12, 12:15] = True
    mask[24:28, 30:40] = True
    outline = outline_of(mask)
    drawn = covered("outline", np.array(outline), 1.0, 40, 30)
    assert overlap(drawn, mask) > 0.97
    assert not drawn[13, 11]
    whole = outline_of(np.ones((30, 40), bool))
    assert covered("outline", np.array(whole), 1.0, 40, 30).mean() > 0.98
    with pytest.raises(InputError, match="found nothing"):
        outline_of(np.zeros((30, 40), bool))


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """Two photos: left half red, right half blue."""
    folder = ball_project(tmp_path / "p", views=2, side=8)
    pixels = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    pixels[:, : WIDTH // 2, 0] = pixels[:, WIDTH // 2 :, 2] = 255
    with edit_project(folder) as edited:
        for image in edited.images:
            Image.fromarray(pixels).save(folder / image.file)
            image.width, image.height, image.label = WIDTH, HEIGHT, None
    return folder


def cut(folder: Path, encoder: Path, decoder: Path, **values: Any) -> dict[str, Any]:
    given = {"project": folder, "photo": "00", "encoder": encoder, "decoder": decoder, **values}
    return segment(AssistSegmentParams.model_validate(given), Reporter())


def test_what_was_clicked_becomes_a_mark_and_photos_are_encoded_once(tmp_path: Path, project: Path) -> None:
    encoder, decoder = tiny.encoder(tmp_path / "e.onnx"), tiny.sam_decoder(tmp_path / "d.onnx")
    looked = cut(project, encoder, decoder, points=[CLICK])
    assert (looked["revision"], looked["cached"]) == (None, False)
    assert read_marks(project) == []
    told = cut(project, encoder, decoder, points=[CLICK], class_id=2, author="Ada", key="k")
    assert (told["revision"], told["cached"]) == (1, True)
    again = cut(project, encoder, decoder, points=[CLICK], class_id=2, author="Ada", key="k")
    assert again["revision"] == 1, "sent twice it is one mark"
    (mark,) = read_marks(project)
    assert (mark.class_id, mark.shape, mark.author, mark.photo) == (2, "outline", "Ada", "00")
    drawn = covered("outline", np.array(mark.points), 1.0, WIDTH, HEIGHT)
    assert overlap(drawn, disc(CLICK, "sam")) > 0.85
    assert cut(project, encoder, decoder, box=(10, 20, 30, 34), void=True)["revision"] == 2
    assert read_marks(project)[1].void
    ahead = embed(AssistEmbedParams(project=project, encoder=encoder, decoder=decoder), Reporter())
    assert (ahead["photos"], ahead["encoded"]) == (2, 1)
    for file in (project / FOLDER).iterdir():
        file.write_bytes(b"damaged")
    assert cut(project, encoder, decoder, points=[CLICK])["cached"] is False
    tiny.encoder(encoder, "x")
    assert cut(project, encoder, decoder, points=[CLICK])["cached"] is False, "another model encodes anew"


@pytest.mark.parametrize("said", [None, 1])
def test_marks_drawn_while_something_is_cut_out_stay_on_top_of_it(
    tmp_path: Path, project: Path, monkeypatch: pytest.MonkeyPatch, said: int | None
) -> None:
    """The one drawn later counts, also where the earlier one takes longer; without a word of it the one shown at its begin."""
    encoder, decoder = tiny.encoder(tmp_path / "e.onnx"), tiny.sam_decoder(tmp_path / "d.onnx")
    drawn = {"photo": "00", "shape": "click", "class_id": 1}
    append_mark(project, {**drawn, "points": [(1, 1)], "key": "first"})
    if said is not None:  # asked for on 1, it waited for its turn
        append_mark(project, {**drawn, "points": [(2, 2)], "key": "second", "author": "Ada"})
    cut_out = Segmenter.cut

    def slow(*given: Any) -> Any:
        append_mark(project, {**drawn, "points": [(3, 3)], "key": "third"})
        return cut_out(*given)

    monkeypatch.setattr(Segmenter, "cut", slow)
    told = cut(project, encoder, decoder, points=[CLICK], class_id=2, key="model", drawn_on=said)
    marks = read_marks(project)
    assert told["revision"] == shown_revision(project, len(marks)) == len(marks)
    at = marks_at(marks, len(marks))
    assert [mark.key for mark in at] == ["first", "model", *(["second"] if said else []), "third"]
    assert [mark.author for mark in at if mark.key == "second"] == (["Ada"] if said else [])
    again = append_mark(project, {**drawn, "points": [(3, 3)], "key": "third"})
    assert again.revision == len(marks), "a mark that is sent again is found where it is now"
    model = {"photo": "00", "shape": "click", "class_id": 2, "points": [(9, 9)], "key": "model"}
    assert append_mark(project, model, said).revision == len(marks), "with what was put on top of it"
    show(project, 2 if said is None else 3)  # as one that was killed before it showed what it had written
    assert append_mark(project, model, said).revision == len(marks) == shown_revision(project, len(marks))


def test_what_is_cut_out_of_undone_marks_goes_on_those_that_are_shown(tmp_path: Path, project: Path) -> None:
    for place in (1, 2):
        append_mark(project, {"photo": "00", "shape": "click", "class_id": 1, "points": [(place, place)]})
    show(project, 1)
    told = cut(
        project,
        tiny.encoder(tmp_path / "e.onnx"),
        tiny.sam_decoder(tmp_path / "d.onnx"),
        points=[CLICK],
        class_id=2,
        drawn_on=2,
    )
    assert told["revision"] == 3
    assert [mark.revision for mark in marks_at(read_marks(project), 3)] == [1, 3]


def test_models_that_do_not_fit_are_told_what_was_expected_and_found(tmp_path: Path, project: Path) -> None:
    encoder, decoder = tiny.encoder(tmp_path / "e.onnx"), tiny.sam_decoder(tmp_path / "d.onnx")
    for wrong, expected, found in (
        (tiny.sam_decoder(tmp_path / "a.onnx", without="has_mask_input"), "has_mask_input", "point_labels 1×?"),
        (tiny.sam_decoder(tmp_path / "b.onnx", points_rank=4), "point_coords of 3 dimensions", "point_coords 1×1×?×2"),
        (tiny.segformer(tmp_path / "c.onnx"), "image_embeddings", "pixel_values 1×3×?×?"),
    ):
        with pytest.raises(InputError) as error:
            cut(project, encoder, wrong, points=[CLICK])
        assert wrong.name in error.value.message
        assert expected in error.value.message.partition("found")[0]
        assert found in error.value.message.partition("found")[2]
    with pytest.raises(InputError, match=r"found outputs|expected outputs"):
        cut(project, tiny.encoder(tmp_path / "f.onnx"), tiny.sam2_decoder(tmp_path / "g.onnx"), points=[CLICK])
    with pytest.raises(InputError, match="is not the encoder"):
        cut(project, decoder, decoder, points=[CLICK])
    (tmp_path / "h.onnx").write_bytes(b"weights")
    with pytest.raises(InputError, match="no ONNX model"):
        cut(project, tmp_path / "h.onnx", decoder, points=[CLICK])
    with pytest.raises(InputError, match="no model at"):
        cut(project, tmp_path / "nothing.onnx", decoder, points=[CLICK])
    assert read_marks(project) == []


def test_an_input_with_another_name_is_found_by_its_shape(tmp_path: Path) -> None:
    model = loaded.load(tiny.encoder(tmp_path / "e.onnx", "my_picture"))
    (port,) = model.bind("an encoder", [Segmenter.image])
    assert port.name == "my_picture"
    assert model.session.get_providers() == ["CPUExecutionProvider"]
    assert str(port) == "my_picture 1×3×1024×1024"


def test_wrong_requests_are_refused(tmp_path: Path, project: Path) -> None:
    encoder, decoder = tiny.encoder(tmp_path / "e.onnx"), tiny.sam_decoder(tmp_path / "d.onnx")
    for values in ({}, {"points": [CLICK], "class_id": 1, "void": True}):
        with pytest.raises(ValidationError):
            cut(project, encoder, decoder, **values)
    with pytest.raises(InputError, match="no class 9"):
        cut(project, encoder, decoder, points=[CLICK], class_id=9)
    with pytest.raises(InputError, match="no photo"):
        cut(project, encoder, decoder, points=[CLICK], photo="x")


def guess(folder: Path, model: Path, mapping: Any, report: Reporter | None = None, **values: Any) -> dict[str, Any]:
    path = folder.parent / "mapping.json"
    path.write_text(mapping if isinstance(mapping, str) else json.dumps(mapping))
    given = {"project": folder, "model": model, "mapping": path, **values}
    return suggest(AssistSuggestParams.model_validate(given), report or Reporter())


@pytest.mark.parametrize("side", [None, 64])
def test_a_first_guess_has_the_classes_of_the_project(tmp_path: Path, project: Path, side: int | None) -> None:
    model = tiny.segformer(tmp_path / "m.onnx", side)
    told = guess(project, model, {"0": "top", "2": "bottom"})
    assert (told["photos"], told["kept"]) == (2, 0)
    image = load_project(project).images[0]
    label = read_label(project / str(image.label))
    assert label.shape == (HEIGHT, WIDTH)
    assert (label[:, : WIDTH // 2 - 4] == 1).all()
    assert (label[:, WIDTH // 2 + 4 :] == 2).all()
    sure = read_label(project / str(image.confidence))
    assert sure[:, :20].min() > 240
    guess(project, model, {"0": "top"})
    label = read_label(project / str(load_project(project).images[0].label))
    assert (label[:, WIDTH // 2 + 4 :] == 0).all(), "what is no class of the project stays unlabelled"


def test_a_guess_that_is_cancelled_leaves_earlier_ones(tmp_path: Path, project: Path) -> None:
    model = tiny.segformer(tmp_path / "m.onnx")
    guess(project, model, {"0": "top"})
    before = {path: path.read_bytes() for path in (project / "labels").rglob("*") if path.is_file()}

    class Stops(Reporter):
        def progress(self, fraction: float, message: str = "") -> None:
            if fraction > 0:
                self.cancel()
                self.check()

    with pytest.raises(Cancelled):
        guess(project, model, {"0": "bottom"}, Stops())
    assert {path: path.read_bytes() for path in (project / "labels").rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("own", ["labels/own.png", "labels/suggested_view.png"])
def test_guesses_leave_labels_of_photos_alone(tmp_path: Path, project: Path, own: str) -> None:
    with edit_project(project) as edited:
        edited.images[0].label = own
    told = guess(project, tiny.segformer(tmp_path / "m.onnx"), {"0": "top"})
    assert (told["photos"], told["kept"]) == (1, 1)
    assert load_project(project).images[0].label == own


def test_wrong_mappings_and_models_are_told(tmp_path: Path, project: Path) -> None:
    model = tiny.segformer(tmp_path / "m.onnx")
    for mapping, words in (
        ("{", "another form"),
        ([1], "another form"),
        ({"a": "top"}, "another form"),
        ({}, "names no class"),
        ({"0": "gold"}, "“gold”"),
        ({"150": "top"}, "the model has 3"),
    ):
        with pytest.raises(InputError, match=words):
            guess(project, model, mapping)
    with pytest.raises(InputError, match="model of classes"):
        guess(project, tiny.sam_decoder(tmp_path / "d.onnx"), {"0": "top"})
    assert all(image.label is None for image in load_project(project).images)


def test_the_command_line_cuts_out(tmp_path: Path, project: Path, capfd: pytest.CaptureFixture[str]) -> None:
    encoder, decoder = tiny.encoder(tmp_path / "e.onnx"), tiny.sam_decoder(tmp_path / "d.onnx")
    words = ["assist", "segment", str(project), "--photo", "00", "--encoder", str(encoder), "--decoder", str(decoder)]
    assert main([*words, "--points", "41.5,12.5", "--class-id", "1", "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["revision"] == 1
    assert main([*words, "--box", "10", "20", "30", "34", "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["pixels"] > 50


def test_the_command_line_encodes_and_guesses(tmp_path: Path, project: Path, capfd: pytest.CaptureFixture[str]) -> None:
    encoder, decoder = tiny.encoder(tmp_path / "e.onnx"), tiny.sam_decoder(tmp_path / "d.onnx")
    words = ["assist", "embed", str(project), "--encoder", str(encoder), "--decoder", str(decoder), "--json"]
    assert main([*words, "--photos", "01"]) == 0
    assert json.loads(capfd.readouterr().out)["photos"] == 1
    assert main(words) == 0
    assert json.loads(capfd.readouterr().out)["photos"] == 2, "all photos, where none is named"
    mapping = tmp_path / "mapping.json"
    mapping.write_text('{"0": "top"}')
    model = tiny.segformer(tmp_path / "m.onnx")
    assert main(["assist", "suggest", str(project), "--model", str(model), "--mapping", str(mapping), "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["photos"] == 2
