"""Which device a connection leads to, however its address is spelled: one device has one name."""

from __future__ import annotations

import ipaddress
import os
import socket
from urllib.parse import urlsplit

from ctr_nlp.hardware.description import Connection
from ctr_nlp.hardware.devices.ros2.messages import parse_controller_url

LOCAL = "localhost"
"""Stands for every address of this machine."""


def canonical_address(connection: Connection) -> str:
    """Name the device that a connection leads to, the same for every spelling of its address.

    Hosts are resolved, and all addresses of this machine are one; links to serial ports are followed. A host
    whose name cannot be resolved keeps that name.

    Parameters
    ----------
    connection : Connection
        Of a hardware file; its device is not "simulated".

    Returns
    -------
    str
        Kind and place of the device, such as ``"tcp 192.168.1.5:23"`` or ``"serial /dev/ttyUSB0"``.

    Raises
    ------
    HardwareError
        The url of a ROS 2 controller is no such url.
    """
    url = connection.url
    if connection.device == "ros2":
        found = parse_controller_url(url)
        return f"ros2 {found.controller}@{_canonical_host(found.host or LOCAL)} domain {found.domain}"
    if "://" in url:
        parts = urlsplit(url)
        return f"tcp {_canonical_host(parts.hostname or LOCAL)}:{parts.port}"
    return f"serial {os.path.normcase(os.path.realpath(url))}"


def _canonical_host(name: str) -> str:
    """Return the least of a host's IP addresses, IPv4 first, or LOCAL where one is this machine's."""
    try:
        found = {str(entry[4][0]) for entry in socket.getaddrinfo(name, None)}
    except (OSError, UnicodeError):
        return name.lower()
    # Resolvers give addresses in any order; the least is the same every time.
    addresses = sorted(map(_parse_ip_address, found), key=lambda address: (address.version, int(address)))
    return LOCAL if any(map(_is_local, addresses)) else str(addresses[0])


def _parse_ip_address(text: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
    """Return an IP address, where IPv4 written as IPv6 (::ffff:1.2.3.4) becomes IPv4."""
    address = ipaddress.ip_address(text)
    return getattr(address, "ipv4_mapped", None) or address


def _is_local(address: ipaddress.IPv4Address | ipaddress.IPv6Address) -> bool:
    """Whether it is an address of this machine: only to these a socket can be bound."""
    family = socket.AF_INET if address.version == 4 else socket.AF_INET6
    try:
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.bind((str(address), 0))
    except OSError:
        return address.is_loopback
    return True
