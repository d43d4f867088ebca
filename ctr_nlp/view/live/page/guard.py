"""Guard the page's server: it answers the page itself, and programs that call it by its own name."""

from __future__ import annotations

import asyncio
import gzip
import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from http import HTTPStatus
from importlib import resources
from typing import Any

from ctr_nlp.support.extras import import_extra
from ctr_nlp.support.same_origin import is_same_origin_request

REFUSED = "This server answers only its own page.\n"
NAMES_SCRIPT_FILE = "names.js"
UNREADABLE = "a message to the live page could not be read: %s"


@contextmanager
def guard_websocket_server(
    host: str, pages: Mapping[str, Callable[[], str | None]]
) -> Iterator[Callable[[], bool]]:
    """Guard the WebSocket server that viser starts within the block.

    Viser has no option for this. Its server is therefore made with a check before viser's own: requests of other
    pages, and for other hosts, are answered with 403. Messages that cannot be read are logged in one line each.

    Parameters
    ----------
    host : str
        The host that the server listens on.
    pages : mapping of str to callable
        Further pages by their path, such as ``/report``: each returns its HTML, or None where there is none yet.

    Yields
    ------
    callable
        Says whether a server was started and is guarded.
    """
    module = import_extra("websockets.asyncio.server")
    started = list[str]()
    serve = module.serve

    def serve_own(handler: Any, *where: Any, process_request: Any = None, **options: Any) -> Any:
        def check(connection: Any, request: Any) -> Any:
            # Any page that is open in the browser may connect to this machine; see support/same_origin.py.
            hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
            if not is_same_origin_request(hosts, origins, host, connection.local_address[:2]):
                return connection.respond(HTTPStatus.FORBIDDEN, REFUSED)
            page = pages.get(request.path)
            if page is not None:
                return _answer_with(connection, page())
            answer = None if process_request is None else process_request(connection, request)
            return _with_names(answer) if request.path.partition("?")[0] == "/" else answer

        asyncio.get_running_loop().set_exception_handler(_log_failure)
        started.append(host)
        return serve(handler, *where, process_request=check, logger=_server_log(), **options)

    # viser looks the function up when it starts its server, so that another one can stand in its place until then.
    # A version that no longer does leaves `started` empty.
    module.serve = serve_own
    try:
        yield lambda: bool(started)
    finally:
        module.serve = serve


def _answer_with(connection: Any, html: str | None) -> Any:
    """Return the response with a page in HTML, or 404 where there is none yet."""
    if html is None:
        return connection.respond(HTTPStatus.NOT_FOUND, "There is no such page yet.\n")
    response = connection.respond(HTTPStatus.OK, html)
    del response.headers["Content-Type"]  # text/plain
    response.headers["Content-Type"] = "text/html; charset=utf-8"
    return response


def _with_names(response: Any) -> Any:
    """Return the response with viser's own page, with the script that names its controls at its end."""
    if response is None or not response.body or "text/html" not in response.headers.get("Content-Type", ""):
        return response  # a WebSocket, or an error
    packed = response.headers.get("Content-Encoding") == "gzip"
    html = gzip.decompress(response.body) if packed else response.body
    script = resources.files("ctr_nlp.view.live.page").joinpath(NAMES_SCRIPT_FILE).read_bytes()
    html = html.replace(b"</body>", b"<script>" + script + b"</script></body>")
    body = gzip.compress(html) if packed else html
    headers = response.headers.copy()
    del headers["Content-Length"]  # a header that is given anew is added
    headers["Content-Length"] = str(len(body))
    return replace(response, headers=headers, body=body)


def log_unreadable(error: object) -> None:
    """Log in one line that a message could not be read.

    Parameters
    ----------
    error : object
        What was wrong with it.
    """
    _server_log().warning(UNREADABLE, error)


def _log_failure(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Log the failure that a message has caused, without the traceback that asyncio would print."""
    log_unreadable(_describe_error(context.get("exception")) or context["message"])


def _describe_error(error: BaseException | None) -> str:
    return "" if error is None else f"{type(error).__name__}: {error}".replace("\n", " ")


@cache
def _server_log() -> logging.Logger:
    """The log of the server, in which every failure takes one line."""
    found = logging.getLogger("ctr_nlp.view.live")
    found.addFilter(_keep_without_error)
    return found


def _keep_without_error(record: logging.LogRecord) -> bool:
    """Tell whether a record has no error; an error is logged in one line instead, unless a connection just
    closed.
    """
    error = record.exc_info[1] if record.exc_info else None
    if error is not None and not isinstance(error.__cause__, EOFError | ConnectionError):
        log_unreadable(_describe_error(error))
    return error is None
