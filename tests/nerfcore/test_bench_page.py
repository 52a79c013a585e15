"""The page of figures: made wholly from result sets, and the one of this repository is up to date."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import pytest
from fieldwork.nerfcore.bench import machine
from fieldwork.nerfcore.bench.page import MARK, SUITES, figures_folder, page_text, write_page
from fieldwork.nerfcore.bench.results import Machine, ResultSet, Taken, grouped, read_sets, write_set
from fieldwork.nerfcore.errors import InputError

DOCS = Path(__file__).resolve().parents[2] / "docs"
TAKEN = Taken(
    machine=Machine(cpu="Some CPU", flags=("avx2", "amx_bf16"), cores=2, threads=1),
    date="2026-11-22",
    commit="abc12345",
)
ROW = {
    "scene": "museum",
    "variant": "standard",
    "budget": "5 s",
    "seed": None,
    "psnr": 26.512,
    "ssim": 0.9,
    "miou": None,
}


def some_set(**values: Any) -> ResultSet:
    standard = {"suite": "figures", "title": "Quality", "command": "fieldwork bench", "source": "bench"}
    return ResultSet.model_validate({**standard, "taken": TAKEN, "rows": [ROW], **values})


def test_the_page_of_this_repository_is_what_its_figures_say() -> None:
    assert (DOCS / "benchmarks.md").read_text("utf-8") == page_text(read_sets(DOCS / "figures"))


def test_every_suite_has_a_section_and_says_when_nothing_was_measured() -> None:
    empty = page_text([])
    assert MARK in empty
    for suite, (heading, _) in SUITES.items():
        assert f"\n## {heading}\n" in empty
        if suite != "gpu":
            assert f"`fieldwork bench --suite {suite}`: not measured." in empty
    assert "Not measured: no NVIDIA GPU was at hand." in empty


def test_machine_and_commit_stand_beside_a_table_under_its_command() -> None:
    text = page_text([some_set(notes=["a note"])])
    assert (
        "```\nfieldwork bench\n```\n\nSome CPU (AVX2, AMX BF16), 2 cores, 1 thread, no GPU. Commit abc12345, 2026-11-22."
        in text
    )
    assert "| scene | budget | PSNR (dB) | SSIM |\n| --- | --- | --- | --- |\n| museum | 5 s | 26.51 | 0.900 |" in text
    assert "- a note" in text
    rows = [ROW, {**ROW, "scene": "facade", "miou": 0.5}]
    assert "| museum | 5 s | 26.51 | 0.900 | not measured |" in page_text([some_set(rows=rows)])
    changed = some_set(taken=TAKEN.model_copy(update={"modified": True}))
    assert "Commit abc12345 with changes, 2026-11-22." in page_text([changed])
    by_hand = TAKEN.model_copy(update={"commit": None})
    text = page_text([some_set(taken=by_hand, source="recorded by hand", written_with="fff00000")])
    assert "Recorded by hand with commit fff00000, 2026-11-22." in text
    assert "Commit not recorded, 2026-11-22." in page_text([some_set(taken=by_hand)])


def test_the_newest_table_of_a_suite_stands_first() -> None:
    older = some_set(title="older", taken=TAKEN.model_copy(update={"date": "2026-11-21"}))
    newer = some_set(title="newer")
    text = page_text(sorted([newer, older], key=lambda s: s.taken.date))
    assert text.index("### newer") < text.index("### older")


def test_a_set_replaces_what_the_same_command_measured_with_the_same_code(tmp_path: Path) -> None:
    first = write_set(tmp_path, some_set())
    assert write_set(tmp_path, some_set(rows=[{**ROW, "psnr": 1.0}])) == first
    assert [s.rows[0]["psnr"] for s in read_sets(tmp_path)] == [1.0]
    others = [
        some_set(command="fieldwork bench --steps 5"),
        some_set(taken=TAKEN.model_copy(update={"commit": "fff00000"})),
        some_set(taken=TAKEN.model_copy(update={"modified": True})),
        some_set(taken=TAKEN.model_copy(update={"machine": Machine(cpu="Other CPU")})),
    ]
    assert len({first, *(write_set(tmp_path, other) for other in others)}) == 5


def test_a_file_that_is_no_result_set_is_named(tmp_path: Path) -> None:
    (tmp_path / "broken.json").write_text("{", encoding="utf-8")
    with pytest.raises(InputError, match=r"broken\.json is not a result set"):
        read_sets(tmp_path)
    (tmp_path / "broken.json").write_text(json.dumps({"suite": "figures"}), encoding="utf-8")
    with pytest.raises(InputError, match=r"broken\.json is not a result set"):
        read_sets(tmp_path)


def test_rows_are_grouped_by_the_code_and_machine_of_their_run() -> None:
    def run(commit: str | None, date: str = "2026-11-22") -> dict[str, Any]:
        return {"taken": TAKEN.model_copy(update={"commit": commit, "date": date}).model_dump(mode="json")}

    results = [run("a"), run("b"), run("a", "2026-11-23"), {"error": "diverged"}, {"taken": None}]
    rows = [{**ROW, "psnr": float(k), "error": None} for k in range(5)]
    groups = grouped(results, rows)
    assert [(taken.commit, taken.date, [row["psnr"] for row in own]) for taken, own in groups] == [
        ("a", "2026-11-23", [0.0, 2.0]),
        ("b", "2026-11-22", [1.0]),
    ]
    assert "error" not in groups[0][1][0]


def test_write_page_leaves_other_pages_alone(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    write_set(figures_folder(page), some_set())
    write_page(page)
    assert "26.51" in page.read_text("utf-8")
    write_page(page)
    page.write_text("by hand\n", encoding="utf-8")
    with pytest.raises(InputError, match="was not made by this command"):
        write_page(page)
    assert page.read_text("utf-8") == "by hand\n"


def test_the_commit_of_a_checkout_is_known_with_its_changes(tmp_path: Path) -> None:
    def git(*words: str) -> str:
        identity = ["-c", "user.name=a", "-c", "user.email=a@b"]
        done = subprocess.run(
            ["git", "-C", str(tmp_path), *identity, *words], capture_output=True, text=True, check=True
        )
        return done.stdout.strip()

    assert machine.checked_out(tmp_path / "nowhere") == (None, False)
    git("init", "-q")
    assert machine.checked_out(tmp_path) == (None, False)
    (tmp_path / "nerfcore").mkdir()
    (tmp_path / "nerfcore" / "a.py").write_text("a = 1\n", encoding="utf-8")
    git("add", ".")
    git("commit", "-q", "-m", "first")
    commit = git("rev-parse", "--short=8", "HEAD")
    assert machine.checked_out(tmp_path) == (commit, False)
    (tmp_path / "notes.md").write_text("no code\n", encoding="utf-8")
    assert machine.checked_out(tmp_path) == (commit, False)
    (tmp_path / "nerfcore" / "a.py").write_text("a = 2\n", encoding="utf-8")
    assert machine.checked_out(tmp_path) == (commit, True)
    assert machine.checked_out(tmp_path / "nerfcore") == (None, False)


def test_the_machine_is_described_by_its_processor(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    cpuinfo = tmp_path / "cpuinfo"
    cpuinfo.write_text(
        "processor\t: 0\nmodel name\t: Some CPU\nflags\t\t: fpu avx2 avx512f amx_tile\n", encoding="utf-8"
    )
    monkeypatch.setattr(machine, "CPUINFO", cpuinfo)
    monkeypatch.setenv("FIELDWORK_DEVICE", "cpu")
    monkeypatch.setenv("FIELDWORK_THREADS", "1")
    described = machine.taken().machine
    assert (described.cpu, described.flags, described.threads) == ("Some CPU", ("avx2", "avx512f", "amx_tile"), 1)
    assert described.sentence().startswith("Some CPU (AVX2, AVX-512, AMX), ")
    assert ", 1 thread, no GPU, PyTorch " in described.sentence()
