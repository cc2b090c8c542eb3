"""Who may talk to the server of a page: those who have its whole address, and no other page in their browser (ours)."""

import hmac
import ipaddress
import re
import secrets
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from http import HTTPStatus
from importlib import import_module
from threading import Lock
from typing import Any

_VISER = "viser.infra._infra"  # the module that starts the server
_LARGEST = 2**20  # bytes of a message from a browser; sliders and cameras need hundreds
_HOST = re.compile(r"(?P<name>\[[0-9a-f:.]+\]|[0-9a-z._-]+)(?::\d{1,5})?")
_starting = Lock()


@dataclass(frozen=True)
class Guard:
    """Judges requests for pages and websockets by their path and by the headers `Host` and `Origin`.

    A browser sets both headers, and no page can change them. `Host` is the address that the browser asked; a name of
    somebody else there means that his name leads here (DNS rebinding). `Origin` is the page that asks; it must be one
    of this server's own. The path begins with a random token, so who has not been told the address gets nothing, not
    even viser's own page, which an address could make connect to another server.
    """

    host: str  #: the address that the server listens at
    token: str = field(default_factory=lambda: secrets.token_urlsafe(16))
    seen: list[bool] = field(default_factory=list)  #: not empty once a server is guarded

    def admitted(self, path: str, hosts: list[str], origins: list[str]) -> str | None:
        """The path of a request behind the token; None if the request is refused.

        Args:
            path: path and query, as they came.
            hosts: all headers `Host`.
            origins: all headers `Origin`; programs that are no browsers, and browsers that open a page, send none.
        """
        place, mark, query = path.partition("?")
        first, _, rest = place.removeprefix("/").partition("/")
        known = hmac.compare_digest(first.encode(errors="replace"), self.token.encode())
        own = len(hosts) == 1 and self._is_own(hosts[0]) and origins in ([], [f"http://{hosts[0]}"])
        return f"/{rest}{mark}{query}" if known and own else None

    def _is_own(self, host: str) -> bool:
        """Whether a header `Host` can name this server. Any port can: tunnels change it.

        A server that other machines reach has addresses that it does not know, behind routers and in containers. So it
        takes all that are numbers: no name of somebody else can lead to them.
        """
        found = _HOST.fullmatch(host.lower())
        if found is None:
            return False
        name = found["name"].strip("[]")
        own = is_local(self.host)
        if name in ("localhost", self.host.lower()):
            return True
        try:
            return ipaddress.ip_address(name).is_loopback or not own
        except ValueError:
            return not own and name == socket.gethostname().lower()


def is_local(host: str) -> bool:
    """Whether only this machine can reach an address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


@contextmanager
def guarded(host: str) -> Iterator[Guard]:
    """Guard the server that viser starts within the block.

    viser has no option for that. It looks `serve` of the package websockets up when it starts, so another function
    stands there for that time, which puts the guard before viser's own answers.

    A later viser may start it in another way: then `Guard.seen` stays empty.
    """
    guard, module = Guard(host), _serving()
    with _starting:
        serve = module.serve
        module.serve = _with_guard(serve, guard)
        try:
            yield guard
        finally:
            module.serve = serve


def _serving() -> Any:
    """The module whose function `serve` is looked up."""
    return import_module("websockets.asyncio.server")


def _with_guard(serve: Callable[..., Any], guard: Guard) -> Callable[..., Any]:
    """`serve`, which asks the guard before anything else; servers that are not viser's stay as they are."""
    answer_of = import_module("websockets.http11").Response
    headers_of = import_module("websockets.datastructures").Headers

    def serve_guarded(handler: Any, *arguments: Any, process_request: Any = None, **options: Any) -> Any:
        if getattr(handler, "__module__", None) != _VISER:
            return serve(handler, *arguments, process_request=process_request, **options)
        guard.seen.append(True)

        def judge(connection: Any, request: Any) -> Any:
            headers = request.headers
            path = guard.admitted(request.path, headers.get_all("Host"), headers.get_all("Origin"))
            if path is None:
                text = b"Open the whole address that orthocas printed.\n"
                told = headers_of({"Content-Type": "text/plain", "Content-Length": str(len(text))})
                return answer_of(HTTPStatus.FORBIDDEN, "Forbidden", told, text)
            return process_request(connection, replace(request, path=path))

        return serve(handler, *arguments, process_request=judge, **{**options, "max_size": _LARGEST})

    return serve_guarded
