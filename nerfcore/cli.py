"""The command line: one command a verb, made from the verb's parameter model.

Exit codes: 0 done · 1 failed · 2 wrong usage · 3 done, but with warnings or problems, or not judged good, under
--strict · 130 cancelled.
"""

from __future__ import annotations

import csv
import logging
import os
import sys
from contextlib import nullcontext, suppress
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, TextIO, Union, get_args, get_origin

import click
from pydantic import ValidationError
from pydantic.fields import FieldInfo

from . import __version__
from .console import ConsoleReporter
from .errors import Cancelled, explained, wrong_value
from .project.lock import lockable, project_lock, project_of
from .streams import (
    NoReader,
    give_up_stdout,
    interruptible,
    keep_quiet_about_destructors,
    open_standard_streams,
    print_json,
    stdout_for_results,
    write_log,
)
from .verbs import VERBS, run_verb

# Worker threads that spin while they wait take the cores other programs need; read when OpenMP starts.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

POSITIONAL = ("project", "dataset", "photos", "list", "out")  # where the verb needs them
# Verbs in which one that is needed is an option.
NAMED = {"new": {"photos"}, "render": {"out"}, "reconstruct": {"out"}}
# What verbs of two words have in common.
GROUPS = {
    "label": "Label a scene by a few marks on its photos.",
    "assist": "Let models that you bring help with labelling.",
}
ORDER = {"import": ["dataset", "project"], "compare": ["project", "other"]}
# Parameters that the command line takes from a file only.
FILES = {"classes": {"classes"}}
COLORS = {"weak": "yellow", "failed": "red"}
GOOD = {"level": "good", "reasons": []}
# Whether a path can be read is for the verb to say, in its own words and with exit code 1.
PATH = click.Path(path_type=Path, readable=False)


class Size(click.ParamType):
    name = "WxH"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        if isinstance(value, tuple):
            return value
        try:
            width, height = (int(part) for part in str(value).lower().split("x"))
        except ValueError:
            self.fail(f"{value} is not a size like 800x600", param, ctx)
        return width, height


class Points(click.ParamType):
    """Points of as many numbers each."""

    def __init__(self, numbers: int) -> None:
        self.numbers = numbers
        each = ",".join("XYZ"[:numbers])
        self.name = f"{each} {each} …"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> list[tuple[float, ...]]:
        if isinstance(value, list):
            return value
        try:
            points = [tuple(map(float, point.split(","))) for point in str(value).split()]
        except ValueError:
            points = []
        if not points or any(len(point) != self.numbers for point in points):
            example = "10,20 30,40" if self.numbers == 2 else "1,2,3 4,5,6"
            self.fail(f"{value} is not a list of points like “{example}”", param, ctx)
        return points


class Word(click.ParamType):
    """A number or one of some words, or none: the model of the parameters checks which."""

    def __init__(self, kinds: list[Any], none: bool) -> None:
        names = [
            "|".join(get_args(k)) if get_origin(k) is Literal else click.types.convert_type(k).name.upper()
            for k in kinds
        ]
        self.name = "|".join([*names, "none"] if none else names)

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        return self.name

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        return str(value)


class CommaList(click.ParamType):
    name = "A,B,…"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> list[str]:
        if isinstance(value, list):
            return value
        # A name with a comma in it stands in quotes.
        parts = next(csv.reader([str(value)], skipinitialspace=True), [""])
        return [part.strip() for part in parts]


def _box(ctx: click.Context, param: click.Parameter, value: tuple[float, ...] | None) -> list[list[float]] | None:
    return [list(value[:3]), list(value[3:])] if value else None


def _plain(annotation: Any) -> Any:
    """The type without None, and without the checks that come with it."""
    if get_origin(annotation) in (Union, UnionType):
        kinds = [a for a in get_args(annotation) if a is not type(None)]
        return _plain(kinds[0]) if len(kinds) == 1 else Word(kinds, type(None) in get_args(annotation))
    return _plain(get_args(annotation)[0]) if get_origin(annotation) is Annotated else annotation


def _option(name: str, info: FieldInfo) -> click.Option:
    """The option of one field of a parameter model."""
    kind = _plain(info.annotation)
    flags = ["--" + name.replace("_", "-"), name]
    if kind == list[list[float]]:
        shape = {"nargs": 6, "type": float, "metavar": "X0 Y0 Z0 X1 Y1 Z1"}
        return click.Option(["--box", name], callback=_box, help=info.description, **shape)
    shared: dict[str, Any] = {"help": info.description or "", "required": info.is_required()}
    default = None if info.is_required() else info.get_default(call_default_factory=True)
    if kind is bool:
        switch = f"--{flags[0][2:]}/--no-{flags[0][2:]}" if default else flags[0]
        return click.Option([switch, name], is_flag=True, default=default, help=info.description or "")
    if get_origin(kind) is dict:
        return click.Option(flags, multiple=True, metavar="KEY=VALUE", **shared)
    if get_origin(kind) is tuple and get_args(kind) == (int, int) and name == "size":
        written = None if default is None else "x".join(map(str, default))
        return click.Option(flags, type=Size(), default=written, show_default=True, **shared)
    if get_origin(kind) is tuple:
        each = tuple(get_args(kind))
        names = " ".join(click.types.convert_type(t).name.upper() for t in each)
        return click.Option(flags, nargs=len(each), type=each, default=default, metavar=names, **shared)
    if kind in (list[tuple[float, float]], list[tuple[float, float, float]]):
        return click.Option(flags, type=Points(len(get_args(get_args(kind)[0]))), **shared)
    if get_origin(kind) is list:
        (each,) = get_args(kind)
        if get_origin(each) is Literal:
            shared["help"] += ": any of " + ", ".join(get_args(each))
        return click.Option(flags, type=CommaList(), default=default, show_default=bool(default), **shared)
    if get_origin(kind) is Literal:
        kind = click.Choice([str(choice) for choice in get_args(kind)])
    elif kind is Path:
        kind = PATH
    return click.Option(flags, type=kind, default=default, show_default=default not in (None, ""), **shared)


def _command(name: str) -> click.Command:
    """The click command of a verb."""
    verb = VERBS[name]
    fields = verb.params.model_fields
    named = NAMED.get(name, set())
    arguments = ORDER.get(name) or [n for n in POSITIONAL if n in fields and fields[n].is_required() and n not in named]
    params: list[click.Parameter] = [click.Argument([n], type=PATH, metavar=n.upper()) for n in arguments]
    left_out = {*arguments, *FILES.get(name, {})}
    params += [_option(n, info) for n, info in fields.items() if n not in left_out]
    params += [
        click.Option(["--json", "as_json"], is_flag=True, help="print one JSON object on stdout and nothing else"),
        click.Option(["--quiet"], is_flag=True, help="no progress"),
        click.Option(
            ["--strict"],
            is_flag=True,
            help="exit with 3 when there were warnings or problems, or the result is not judged good",
        ),
    ]

    def callback(as_json: bool, quiet: bool, strict: bool, **values: Any) -> int:
        return run_command(name, values, as_json, quiet, strict)

    return click.Command(name, callback=callback, params=params, help=verb.summary, short_help=verb.summary)


def _group(name: str) -> click.Group:
    """The verbs of two words that begin with the same one."""
    verbs = [verb for verb in VERBS if verb.startswith(f"{name} ")]
    return click.Group(name, {verb.split(" ")[1]: _command(verb) for verb in verbs}, help=GROUPS[name])


class _Commands(click.Group):
    def list_commands(self, ctx: click.Context) -> list[str]:
        return [*dict.fromkeys(verb.split(" ")[0] for verb in VERBS), "serve"]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name == "serve":
            return click.Command("serve", callback=_serve, help="Run the engine: JSON-RPC 2.0 on stdio.")
        if cmd_name in GROUPS:
            return _group(cmd_name)
        return _command(cmd_name) if cmd_name in VERBS else None

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        known = self.list_commands(ctx)
        if args[0] not in known and not args[0].startswith("-"):
            raise click.exceptions.NoSuchCommand(args[0], possibilities=known, ctx=ctx)  # says what was meant
        return super().resolve_command(ctx, args)


def _serve() -> int:
    from .engine.server import main as serve

    return serve()


def run_command(name: str, values: dict[str, Any], as_json: bool, quiet: bool, strict: bool) -> int:
    """Run a verb for the command line; returns the exit code."""
    values = {k: v for k, v in values.items() if v is not None}
    verb = VERBS[name]
    try:
        if isinstance(values.get("set"), tuple):
            values["set"] = dict(_assignment(text) for text in values["set"])
        params = verb.params.model_validate(values)
    except ValidationError as error:
        clauses = "; ".join(wrong_value(detail) for detail in error.errors())
        raise click.UsageError(f"{name}: {clauses}.") from error
    with stdout_for_results() as stdout, ConsoleReporter(quiet or as_json) as report, interruptible(report):
        try:
            with nullcontext() if verb.immediate else project_lock(lockable(params), name):
                result = run_verb(name, params, report)
            report.close()
            if as_json:
                print_json({**result, "warnings": report.warnings}, stdout)
            else:
                report.table(name, result, stdout)
            stdout.flush()
        except (Cancelled, KeyboardInterrupt):
            return _cancelled(getattr(params, "resume", True), as_json, stdout)
        except Exception as error:  # noqa: BLE001 - the boundary: whatever happened becomes a sentence
            return _failed(error, name, project_of(params), as_json, stdout)
        judged = result.get("verdict", GOOD)
        if judged["reasons"]:
            click.secho(f"{judged['level']}: {' '.join(judged['reasons'])}", fg=COLORS.get(judged["level"]), err=True)
        good = judged["level"] == "good" and result.get("ok", True)
        return 3 if strict and (report.warnings or not good) else 0


def _cancelled(goes_on: bool, as_json: bool, stdout: TextIO) -> int:
    """Tell how to go on: by the command as it was, if that `goes_on` by itself."""
    hint = f"Run the same command again {'' if goes_on else 'with --resume '}to go on."
    click.echo(f"Cancelled. {hint}", err=True)
    if as_json:
        with suppress(NoReader):  # whoever cancels may be gone
            print_json({"error": {"code": "cancelled", "message": "Cancelled.", "hint": hint}}, stdout)
            stdout.flush()
    return 130


def _failed(error: Exception, verb: str, project: Path | None, as_json: bool, stdout: TextIO) -> int:
    """Tell of a failure in a sentence; the traceback of one that nobody foresaw goes into a log file."""
    known = explained(error)
    told: dict[str, Any] = {"code": known.code, "message": known.message, "hint": known.hint}
    lines = [known.hint] if known.hint else []
    if known is not error:
        told["log"] = str(write_log(error, verb, project))
        lines.append(f"Details are in {told['log']}.")
    click.secho(known.message, fg="red", err=True)
    for line in lines:
        click.echo(line, err=True)
    if as_json and not isinstance(error, NoReader):
        try:
            print_json({**known.result, "error": told}, stdout)
            stdout.flush()
        except NoReader as silent:
            click.echo(silent.message, err=True)
    return 1


def _assignment(text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not equals:
        raise click.UsageError(f"--set {text}: write it as stage.name=value.")
    return key.strip(), value.strip()


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    open_standard_streams()
    keep_quiet_about_destructors()
    logging.basicConfig(level=logging.ERROR, format="%(message)s", stream=sys.stderr)
    group = _Commands(
        "fieldwork",
        help="Photos to a semantic radiance field, and the field into labelled meshes.",
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    group.params.append(
        click.Option(
            ["--version"],
            is_flag=True,
            is_eager=True,
            expose_value=False,
            callback=_print_version,
            help="print the version",
        )
    )
    try:
        code = group.main(arguments, prog_name="fieldwork", standalone_mode=False)
    except click.exceptions.Exit as stop:
        return stop.exit_code
    except click.Abort:
        return 130
    except click.ClickException as error:
        if "--json" in (sys.argv[1:] if arguments is None else arguments):
            failure = {"code": "usage", "message": error.format_message(), "hint": "fieldwork --help"}
            with suppress(NoReader), stdout_for_results() as stdout:
                print_json({"error": failure}, stdout)
                stdout.flush()
        error.show()
        return error.exit_code
    except OSError as error:  # of help that nobody takes; verbs tell of their own
        click.echo(f"Nothing can be printed: {error.strerror} on standard output.", err=True)
        give_up_stdout()
        return 1
    return code if isinstance(code, int) else 0


def _print_version(ctx: click.Context, param: click.Parameter, value: bool) -> None:
    if value and not ctx.resilient_parsing:
        click.echo(__version__)
        ctx.exit()
