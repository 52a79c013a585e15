"""JSON-RPC 2.0, one message a line: reading requests, writing answers, typed errors."""

from __future__ import annotations

import json
from pathlib import PurePath
from typing import Any, NamedTuple

from pydantic import ValidationError
from pydantic_core import PydanticSerializationError, to_json

from ..errors import Cancelled, UnexpectedError, explained, wrong_value
from ..files import printable
from ..params import Params
from ..verbs import VERBS

VERSION = 1

PARSE_ERROR = -32700
INVALID_REQUEST = -32600
METHOD_NOT_FOUND = -32601
INVALID_PARAMS = -32602
INTERNAL_ERROR = -32603
FAILED = -32000
CANCELLED = -32001


class RpcError(Exception):
    """An answer of the error kind. `request` is the id it answers, None when the request had no readable id."""

    def __init__(self, code: int, message: str, data: dict[str, Any] | None = None, request: Any = None) -> None:
        super().__init__(message)
        self.code, self.message, self.data, self.request = code, message, data, request


class Request(NamedTuple):
    """`id` is None for a notification, which gets no answer."""

    id: int | str | None
    method: str
    params: dict[str, Any]


def parse_request(line: bytes) -> Request:
    """Read one line.

    Raises:
        RpcError: it is not JSON, or not a JSON-RPC 2.0 request with named parameters.
    """
    try:
        value = json.loads(line)
    except ValueError as error:  # also of bytes that are no Unicode, and of integers with thousands of digits
        raise RpcError(PARSE_ERROR, f"This line is not JSON: {error}.") from error
    except RecursionError as error:
        raise RpcError(PARSE_ERROR, "This line is nested too deeply.") from error
    if not isinstance(value, dict):
        raise RpcError(INVALID_REQUEST, "A request is a JSON object; batches are not supported.")
    request = value.get("id")
    if isinstance(request, bool) or not isinstance(request, (int, str, type(None))):
        raise RpcError(INVALID_REQUEST, "The id of a request is a number or a string.")
    if value.get("jsonrpc") != "2.0" or not isinstance(value.get("method"), str):
        raise RpcError(INVALID_REQUEST, 'A request has "jsonrpc": "2.0" and a "method".', request=request)
    params = value.get("params", {})
    if not isinstance(params, dict):
        raise RpcError(INVALID_PARAMS, "Parameters are given by name, as a JSON object.", request=request)
    return Request(request, value["method"], params)


def parse_params(verb: str, values: dict[str, Any]) -> Params:
    """Validate the parameters of a verb.

    Raises:
        RpcError: INVALID_PARAMS with one clause for each thing that is wrong.
    """
    try:
        return VERBS[verb].params.model_validate(values)
    except ValidationError as error:
        clauses = [wrong_value(detail) for detail in error.errors(include_url=False)]
        raise RpcError(INVALID_PARAMS, f"{verb}: {'; '.join(clauses)}.") from error


def encode(message: dict[str, Any]) -> bytes:
    """One line of JSON. Paths become strings, NumPy values plain ones, NaN and infinity null."""
    return _json({"jsonrpc": "2.0", **message}) + b"\n"


def plain(value: Any) -> Any:
    """The value as it looks after a trip through JSON."""
    return json.loads(_json(value))


def _json(value: Any) -> bytes:
    try:
        return to_json(value, inf_nan_mode="null", fallback=_plain)
    except PydanticSerializationError:  # half a surrogate pair, which JSON can ask for and UTF-8 has not
        return to_json(_unicode(value), inf_nan_mode="null", fallback=_plain)


def _unicode(value: Any) -> Any:
    """The value with “?” where its text is no Unicode."""
    if isinstance(value, dict):
        return {_unicode(key): _unicode(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_unicode(item) for item in value]
    return printable(str(value)) if isinstance(value, (str, PurePath)) else value


def _plain(value: Any) -> Any:
    if hasattr(value, "tolist"):
        return value.tolist()
    return str(value)


def answer(request: Any, result: Any) -> dict[str, Any]:
    return {"id": request, "result": result}


def failure(request: Any, error: RpcError) -> dict[str, Any]:
    body: dict[str, Any] = {"code": error.code, "message": error.message}
    if error.data is not None:
        body["data"] = error.data
    return {"id": request, "error": body}


def notification(method: str, **params: Any) -> dict[str, Any]:
    return {"method": method, "params": params}


def as_rpc_error(error: BaseException, log: str | None, tail: list[str]) -> RpcError:
    """The typed answer for what a verb raised. `log` is where the traceback went, `tail` its last lines."""
    if isinstance(error, Cancelled):
        return RpcError(CANCELLED, "Cancelled.")
    known = explained(error)
    data = {"code": known.code, "message": known.message, "hint": known.hint}
    if isinstance(known, UnexpectedError):
        return RpcError(INTERNAL_ERROR, str(known), {**data, "log": log, "traceback": tail})
    return RpcError(FAILED, str(known), data if known is error else {**data, "log": log})
