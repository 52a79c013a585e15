"""The pages name only what there is: links, files, functions, options, settings, packages, verbs."""

from __future__ import annotations

import ast
import re
import tomllib
from functools import cache
from pathlib import Path

import click
import pytest
from fieldwork.nerfcore.cli import _command
from fieldwork.nerfcore.config import RunConfig
from fieldwork.nerfcore.verbs import VERBS

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
NAMED = pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
# Where a path in a page may begin.
STARTS = (ROOT, ROOT / "nerfcore", ROOT / "addon", ROOT / "docs")


def prose(page: Path) -> str:
    """A page without its fenced blocks."""
    return re.sub(r"^```.*?^```", "", page.read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)


def code(page: Path) -> list[str]:
    """What stands between backticks."""
    return re.findall(r"`([^`\n]+)`", prose(page))


def anchors(page: Path) -> set[str]:
    """The anchors that GitHub gives the headings of a page."""
    headings = re.findall(r"^#+ (.+)$", prose(page), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


@cache
def defined(file: Path) -> frozenset[str]:
    """Functions and classes of a module, methods as Class.method."""
    found = set()
    for node in ast.parse(file.read_text("utf-8")).body:
        if isinstance(node, ast.ClassDef):
            found |= {f"{node.name}.{item.name}" for item in node.body if isinstance(item, ast.FunctionDef)}
        if isinstance(node, (ast.ClassDef, ast.FunctionDef)):
            found.add(node.name)
    return frozenset(found)


@NAMED
def test_links_lead_somewhere(page: Path) -> None:
    lost = []
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        if not file.exists() or (anchor and anchor not in anchors(file)):
            lost.append(target)
    assert lost == []


@NAMED
def test_files_and_functions_that_a_page_names_exist(page: Path) -> None:
    lost = []
    for text in code(page):
        named = re.fullmatch(r"([\w./]+\.(?:py|toml|json|lock))(?::([\w.]+))?", text)
        if named is None or "/" not in text or not (named[1].endswith(".py") or named[2]):
            continue
        file = next((start / named[1] for start in STARTS if (start / named[1]).is_file()), None)
        if file is None or (named[2] and named[2] not in defined(file)):
            lost.append(text)
    assert lost == []


@NAMED
def test_options_that_a_page_names_exist(page: Path) -> None:
    known = {"--help", "--addons", "--python"}  # the last two are Blender's
    known |= {"--head", "--port", "--address", "--generate"}  # of `ray start` and `ray get-auth-token`
    for verb in VERBS:
        known.update(option for param in _command(verb).params for option in (*param.opts, *param.secondary_opts))
    named = re.findall(r"(?<![\w-])--[a-z][a-z-]+", page.read_text("utf-8"))
    assert sorted(set(named) - known) == []


def test_experiments_that_the_code_names_have_an_entry() -> None:
    entries = (ROOT / "docs" / "experiments.md").read_text("utf-8")
    named = set()
    for file in (ROOT / "nerfcore").rglob("*.py"):
        text = re.sub(r"\n\s*# ", " ", file.read_text("utf-8"))
        named.update(re.findall(r"experiments\.md, “([^”]+)”", text))
    assert named
    assert sorted(name for name in named if f": {name}\n" not in entries) == []


@NAMED
def test_settings_that_a_page_names_exist(page: Path) -> None:
    stages = {stage: type(info.default).model_fields for stage, info in RunConfig.model_fields.items()}
    named = [re.match(r"(\w+)\.(\w+)(?:=|$)", text) for text in code(page)]
    found = [
        (m[1], m[2])
        for m in named
        if m and m[1] in stages and m[2] not in ("py", "md", "json", "npz", "png", "safetensors")
    ]
    assert [f"{stage}.{name}" for stage, name in found if name not in stages[stage]] == []


def test_every_package_is_on_the_map() -> None:
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["importlinter"]["contracts"]
    packages = {
        package
        for contract in contracts
        if contract["type"] == "layers"
        for layer in contract["layers"]
        for package in re.split(r" [|:] ", layer)
    }
    named = {part for text in code(ROOT / "docs" / "architecture.md") for part in text.split(", ")}
    assert sorted(packages - named) == []


def test_every_environment_variable_is_explained() -> None:
    files = [file for folder in ("nerfcore", "addon", "operators") for file in (ROOT / folder).rglob("*.py")]
    read = {name for file in files for name in re.findall(r'"(FIELDWORK_[A-Z_]+)"', file.read_text("utf-8"))}
    table = re.findall(r"^\| `(FIELDWORK_[A-Z_]+)` \|", prose(ROOT / "docs" / "cli.md"), flags=re.MULTILINE)
    assert sorted(table) == sorted(read)


def test_every_verb_is_explained() -> None:
    for page in (ROOT / "README.md", ROOT / "docs" / "cli.md"):
        named = code(page)
        assert [verb for verb in VERBS if not any(f"{text} ".startswith(f"{verb} ") for text in named)] == [], page.name


@pytest.mark.parametrize("verb", VERBS)
def test_every_option_says_what_it_is_for(verb: str) -> None:
    silent = [o.opts[0] for o in _command(verb).params if isinstance(o, click.Option) and not (o.help or "").strip()]
    assert not silent


def test_help_names_the_words_that_an_option_takes() -> None:
    shown = {o.name: o.get_help_record(click.Context(_command("render"))) for o in _command("render").params}
    assert "any of rgb, depth, semantic, confidence, normal, unknown" in shown["passes"][1]
    assert "default: rgb, depth, semantic" in shown["passes"][1]
    assert shown["frame_range"][0] == "--frame-range INTEGER INTEGER"
    (texture,) = (o for o in _command("mesh").params if o.name == "texture")
    assert texture.get_help_record(click.Context(_command("mesh")))[0] == "--texture INTEGER|auto|none"
    (query,) = (o for o in _command("relations").params if o.name == "query")
    assert "default" not in query.get_help_record(click.Context(_command("relations")))[1]
    (run,) = (o for o in _command("compare").params if o.name == "other_run")
    assert "run of the earlier epoch" in run.get_help_record(click.Context(_command("compare")))[1]


def test_experiments_are_dated_newest_first() -> None:
    headings = re.findall(r"^## (.*)$", prose(ROOT / "docs" / "experiments.md"), flags=re.MULTILINE)
    dates = [heading.split(": ")[0] for heading in headings]
    assert all(re.fullmatch(r"\d{4}-\d{2}-\d{2}", date) for date in dates)
    assert dates == sorted(dates, reverse=True)
    assert len(set(headings)) == len(headings)


def test_every_page_is_reached_from_the_readme() -> None:
    reached, waiting = set(), [ROOT / "README.md"]
    while waiting:
        page = waiting.pop()
        if page in reached or not page.is_file():
            continue
        reached.add(page)
        links = re.findall(r"\]\(([^)\s#]+\.md)", prose(page))
        waiting += [(page.parent / link).resolve() for link in links]
    assert sorted(page.name for page in PAGES if page not in reached) == []
