"""Check of HTTP requests by their headers Host and Origin: only the server's own pages may send them.

A browser lets any page send requests to servers of this machine. It says in `Origin` which page sends one, and in
`Host` under which name the page has reached the server: a foreign name that leads here (DNS rebinding) gives the
foreign page the rights of an own one, unless the server refuses it.
"""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Sequence
from contextlib import suppress
from functools import cache

HTTP_PORT = 80
"""The port that addresses without one mean."""
LOOPBACK_NAMES = "localhost", "127.0.0.1", "[::1]"


def is_same_origin_request(
    hosts: Sequence[str], origins: Sequence[str], listening: str, reached: tuple[str, int]
) -> bool:
    """Check that a request is meant for this server and does not come from another server's page.

    Parameters
    ----------
    hosts, origins : sequence of str
        All values of the headers ``Host`` and ``Origin``. Programs other than browsers send no ``Origin``.
    listening : str
        The host that the server listens on, as it was configured.
    reached : tuple of str and int
        Address and port at which the request arrived.

    Returns
    -------
    bool
        False unless there is one host, at most one origin, and both are this server's own.
    """
    address, port = reached
    own = {f"{name}:{port}" for name in _names(listening, address)}
    if port == HTTP_PORT:
        # Browsers leave out the default port in both headers.
        own |= {name.removesuffix(f":{port}") for name in own}
    # Exactly one Host, as HTTP/1.1 asks for (RFC 9112, section 3.2): of two, a proxy might have checked the other
    # one.
    if [host.lower() in own for host in hosts] != [True]:
        return False
    pages = {f"http://{host}" for host in own}
    return len(origins) <= 1 and all(origin.lower() in pages for origin in origins)


def is_loopback(host: str) -> bool:
    """Return whether a host can only be reached from this machine.

    Parameters
    ----------
    host : str
        A name or an address.

    Returns
    -------
    bool
        False for names other than ``localhost``.
    """
    with suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return host == "localhost"


@cache
def _names(listening: str, address: str) -> frozenset[str]:
    """Return the names, in lower case, of a server that listens on `listening` and was reached at `address`."""
    found = {listening.lower(), f"[{address}]" if ":" in address else address}
    if is_loopback(address):
        found |= set(LOOPBACK_NAMES)
    if not is_loopback(listening):
        found |= {socket.gethostname().lower(), socket.getfqdn().lower()}
    return frozenset(found)
