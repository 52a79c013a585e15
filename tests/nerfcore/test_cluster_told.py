"""What is told of a campaign: sentences on settings, the page, the table in the terminal, growth."""

from __future__ import annotations

import importlib.util
import json
import re
from typing import Any

import pytest
from fieldwork.nerfcore import cli
from fieldwork.nerfcore.cluster import link
from fieldwork.nerfcore.cluster import status as st
from fieldwork.nerfcore.cluster.link import Link
from fieldwork.nerfcore.console import ConsoleReporter, campaign_table
from fieldwork.nerfcore.errors import InputError, SettingError
from PIL import Image
from rich.console import Console


def test_without_the_extra_it_is_said_how_to_install_it(tmp_path, monkeypatch, capfd):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: None if name == "ray" else find(name, *rest))
    path = tmp_path / "list.csv"
    path.write_text("photos\na\n")
    assert cli.main(["batch", str(path), "--cluster", "auto", "--json"]) == 1
    error = json.loads(capfd.readouterr().out)["error"]
    assert error["code"] == "setting"
    assert 'pip install "fieldwork[cluster]"' in error["hint"]


@pytest.mark.parametrize("address", ["", "local", "http://x:1", "head", "head:port", "ray://", "a b:1"])
def test_only_addresses_are_taken(address, monkeypatch):
    monkeypatch.setattr(link, "require_ray", lambda: None)
    with pytest.raises(SettingError, match="no address of a cluster"):
        Link(address)
    for fine in ("auto", "head:6379", "10.0.0.1:6379", "ray://head.lan:10001", "[::1]:6379"):
        Link(fine)


def test_a_wheel_that_is_none_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr(link, "require_ray", lambda: None)
    (tmp_path / "a.whl").write_text("no archive")
    for wheel in (tmp_path / "a.whl", tmp_path / "none.whl", tmp_path):
        with pytest.raises(InputError, match="is no wheel"):
            Link("auto", wheel)


def rows() -> list[dict[str, Any]]:
    return [
        st.capture_row("/c/done <1>", "done", fraction=1.0, figures={"held out (dB)": "24.1"}),
        st.capture_row("/c/wait", "waiting", stage="new"),
        st.capture_row("/c/bad", "failed", error="No poses <b>at all</b>.", hint="Take more."),
        st.capture_row("/c/run", "running", stage="train", fraction=0.4, eta_s=75.0),
    ]


def test_the_page_tells_of_failures_first_and_shows_pictures(tmp_path):
    project = tmp_path / "vase"
    (project / "exports/main/renders").mkdir(parents=True)
    Image.new("RGB", (800, 600), (200, 30, 30)).save(project / "exports/main/renders/orbit_0000.png")
    Image.new("RGB", (800, 600), (0, 0, 0)).save(project / "exports/main/renders/orbit_0000_depth.png")
    folder = tmp_path / "list-campaign"
    picture = st.add_picture(folder, project, 3)
    with Image.open(folder / picture) as small:
        assert small.size == (320, 240)
        assert abs(small.getpixel((100, 100))[0] - 200) < 8
    made = rows()
    made[0]["picture"] = picture
    value = st.status("list", "running", 0.0, made, [{"cores": 4.0}], 130.0)
    st.write_status(folder, value, page=True)
    assert json.loads((folder / st.STATUS_FILE).read_text())["counts"] == {
        "failed": 1,
        "running": 1,
        "waiting": 1,
        "done": 1,
    }
    page = (folder / st.PAGE).read_text()
    places = [page.index(f"{name}</a>") for name in ("bad", "run", "wait", "done &lt;1&gt;")]
    assert places == sorted(places)
    assert "No poses &lt;b&gt;at all&lt;/b&gt;." in page
    assert f'src="{picture}"' in page
    assert "24.1" in page
    assert "about 2 min left" in re.sub(r"\s+", " ", page)
    assert st.add_picture(folder, tmp_path / "nothing", 4) == ""


def test_what_somebody_has_to_look_at_comes_first(tmp_path):
    """A capture that went through may still have failed: its verdict says so, on the page with all reasons."""
    levels = {"fine": "good", "torn": "failed", "old": None, "thin": "weak"}
    rows = [
        st.capture_row(f"/c/{name}", "done", verdict=level and {"level": level, "reasons": [f"{name} <1>.", "More."]})
        for name, level in levels.items()
    ]
    rows.append(st.capture_row("/c/bad", "failed", error="No poses."))
    value = st.status("list", "failed", 0.0, rows, [], None)
    assert [row["name"] for row in value["captures"]] == ["bad", "torn", "thin", "fine", "old"]
    st.write_status(tmp_path, value, page=True)
    page = (tmp_path / st.PAGE).read_text()
    assert "done, with failures ·" in page
    assert re.findall(r'class="(capture [a-z ]+)"', page) == [
        "capture failed", "capture done bad", "capture done weak", "capture done", "capture done",
    ]  # fmt: skip
    assert "<li>torn &lt;1&gt;.</li><li>More.</li>" in page
    assert "<li>fine" not in page


def test_a_capture_that_failed_shows_a_photo(tmp_path):
    (tmp_path / "vase/images").mkdir(parents=True)
    Image.new("RGB", (64, 48), (20, 30, 200)).save(tmp_path / "vase/images/a.png")
    with Image.open(tmp_path / "c" / st.add_picture(tmp_path / "c", tmp_path / "vase", 1)) as picture:
        assert abs(picture.getpixel((9, 9))[2] - 200) < 8


def test_the_table_in_the_terminal():
    value = st.status("list", "running", 0.0, rows(), [{"cores": 4.0}], 6000.0)
    console = Console(width=110, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    console.print(campaign_table(value))
    lines = console.export_text().splitlines()
    title = " ".join(line.strip() for line in lines[: next(i for i, line in enumerate(lines) if "┏" in line)])
    assert "1 done, 1 failed, 1 running, 1 waiting, 1 worker, about 1.7 h left" in title
    assert next(i for i, line in enumerate(lines) if "bad" in line) < next(
        i for i, line in enumerate(lines) if "run " in line
    )
    assert any("train" in line and "40%" in line and "75 s" in line for line in lines)


def test_without_a_terminal_there_are_no_tables(capfd):
    with ConsoleReporter(quiet=False) as report:
        report.event("campaign", **st.status("list", "running", 0.0, rows(), [], None))
    assert capfd.readouterr().err == ""


def test_growth_is_drawn_from_measured_times(tmp_path):
    from fieldwork.nerfcore.cluster import growth

    report = tmp_path / "list-report.json"
    entries = {
        "a": {"state": "done", "stages": {"new": 1.0, "train": 9.0, "render": 0.0}},
        "b": {"state": "failed", "error": "", "hint": ""},
    }
    report.write_text(json.dumps({"captures": entries}))
    chains = growth.measured(report)
    assert chains == [{"new": 1.0, "train": 9.0}]
    assert growth.makespan(chains, 4, 1, 0.0) == 40.0
    assert growth.makespan(chains, 4, 2, 0.5) == 22.0
    assert growth.makespan(chains, 4, 64, 0.0) == 10.0
    growth.main([str(report), str(tmp_path / "growth.png"), "--captures", "4", "8"])
    with Image.open(tmp_path / "growth.png") as picture:
        assert len(picture.convert("RGB").getcolors(1 << 20)) > 20
    report.write_text("{}")
    with pytest.raises(Exception, match="no report of a batch"):
        growth.measured(report)
