"""The server of the page: on a free port, for this machine alone, and never through a server of others."""

from __future__ import annotations

import contextlib
import io
import socket
from collections.abc import Callable, Mapping
from typing import Any

from ctr_nlp.exceptions import OptionError
from ctr_nlp.support.extras import import_extra
from ctr_nlp.support.value_checks import whole_number
from ctr_nlp.view.live.page.guard import guard_websocket_server

HOST, PORT = "127.0.0.1", 8080
"""Default address and port of the page."""
LABEL = "ctr-nlp live"


def start_server(host: str, port: int, pages: Mapping[str, Callable[[], str | None]]) -> Any:
    """Start a viser server that answers only its own page.

    Viser would take the next port that is free, print messages on standard output, answer whatever page is open
    in a browser, and open a public tunnel through its makers' server where a page asks for one. None of this
    happens here.

    Parameters
    ----------
    host : str
        Host or address to listen on.
    port : int
        Port to listen on; 0 takes any that is free.
    pages : mapping of str to callable
        Further pages by their path: each returns its HTML, or None where there is none yet.

    Returns
    -------
    viser.ViserServer
        The server, which is already listening.

    Raises
    ------
    OptionError
        The port cannot be served, or viser is not installed or cannot be guarded.
    """
    viser = import_extra("viser")
    if whole_number(OptionError, "port", port, 0) > 65535:
        raise OptionError(f"port is {port}; it must be a whole number from 0 to 65535")
    try:
        # viser would take the next free port without a word. Another program may still take this one before viser
        # binds it; Live.url then has the port that viser got.
        socket.create_server((host, port)).close()
    except OSError as error:
        why = error.strerror or str(error)
        raise OptionError(
            f"port {port} of {host} cannot be served ({why.lower()}); give another, or 0 for any that is free"
        ) from error

    class Unshared(viser.ViserServer):  # type: ignore[name-defined]
        def request_share_url(self, verbose: bool = True) -> None:
            """Do nothing: nobody is let in from outside."""

    with contextlib.redirect_stdout(io.StringIO()), guard_websocket_server(host, pages) as is_guarded:
        server = Unshared(host, port, LABEL, verbose=False)
    if not is_guarded():
        stop_server(server)
        raise OptionError("this version of viser cannot be kept from answering other pages; install viser 1.1")
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    server.gui.main_panel.dock_right()
    return server


def stop_server(server: Any) -> None:
    """End a server without the messages that it would print."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()
