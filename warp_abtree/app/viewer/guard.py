"""Requests that the viewer's server refuses: those of pages that it did not serve itself.

A browser lets any page open a websocket to this machine, and tells the page's origin; a page whose name was made to
lead here (DNS rebinding) has an origin that matches, but asks for a host that is none of this machine. viser checks
neither.
"""

import contextlib
import http
import ipaddress
import socket
import threading
from typing import Any
from urllib.parse import urlsplit

_PATCHING = threading.Lock()


def is_refused(request, host: str) -> bool:
    """Return whether a request of HTTP is refused by a server at an address or a name, `host`.

    Without an origin it comes from no page; what is asked for has to be `host` or a name or address of this machine.
    """
    hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
    if len(hosts) > 1 or len(origins) > 1 or (origins and not hosts):
        return True
    try:
        asked = urlsplit("//" + hosts[0].lower() if hosts else "//localhost")
        page = urlsplit(origins[0].lower()) if origins else asked
        of_this_machine = page.port == asked.port and _is_loopback(page.hostname) and _is_loopback(asked.hostname)
        own = page.netloc == asked.netloc or of_this_machine
        return not (own and _is_here(asked.hostname, host.lower()))
    except ValueError:  # no address
        return True


def _is_here(name: str | None, host: str) -> bool:
    """Return whether a name or address leads to a server at `host`, whatever a foreign name server says."""
    if name == host or _is_loopback(name):
        return True
    if name is None or _is_loopback(host):
        return False
    machine = socket.gethostname().lower()
    short = machine.partition(".")[0]
    return _address(name) is not None or name in (machine, short, f"{short}.local")  # an address is nobody's name


def _is_loopback(name: str | None) -> bool:
    address = _address(name)
    return (name or "").removesuffix(".") == "localhost" if address is None else address.is_loopback


def _address(text: str | None):
    try:
        return ipaddress.ip_address(text or "")
    except ValueError:
        return None


@contextlib.contextmanager
def refuse_foreign(host: str):
    """Let a server of websockets that is made meanwhile answer refused requests with 403; raise ValueError for none."""
    import websockets.asyncio.server

    module: Any = websockets.asyncio.server
    plain, made = module.serve, []

    def serve(*arguments, process_request=None, **options):
        def process(connection, request):
            if is_refused(request, host):
                told = "refused: a page, or a name of this machine, that the viewer does not know; see --host\n"
                return connection.respond(http.HTTPStatus.FORBIDDEN, told)
            return None if process_request is None else process_request(connection, request)

        made.append(host)
        return plain(*arguments, process_request=process, **options)

    with _PATCHING:
        module.serve = serve
        try:
            yield
        finally:
            module.serve = plain
    if not made:
        raise ValueError("view: this version of viser cannot be kept from foreign pages; another is needed")
