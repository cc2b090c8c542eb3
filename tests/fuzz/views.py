"""Campaign of requests to the server of a view: nobody gets in from outside, and everybody who belongs there does."""

import ipaddress
import socket
from urllib.parse import urlsplit

import numpy as np

from fuzz.child import Finding, run, verdict
from fuzz.mutants import TEXTS, Rng, pick
from orthocas.viewer.window import Guard

OWN = ("localhost:8080", "LOCALHOST", "127.0.0.1:8080", "127.0.0.9:1", "[::1]:8080", "[::1]")
PARTS = (
    *("localhost", "127.0.0.1", "[::1]", "0.0.0.0", "192.0.2.7", "evil.example", ".", ":", "8080", "@", "/", "//", "#"),
    *("?", "\\", " ", "\t", "%00", "%2e", "http", "https", "ws", "file", "null", "://", "data:", "xn--", *TEXTS),
)
HOSTS = ("127.0.0.1", "localhost", "::1", "0.0.0.0", "::", "192.0.2.7")


def views(count: int) -> list[Finding]:
    """Judge so many requests."""
    return run("views", judge, range(count))


def judge(seed: int) -> str | None:
    """What is wrong with the treatment of a request."""
    return verdict(lambda: _ask(np.random.default_rng(seed)))


def _ask(rng: Rng) -> None:
    guard = Guard(pick(rng, HOSTS))
    own = pick(rng, OWN)
    assert guard.admit(f"/{guard.token}/a?b=/c", [own], [f"http://{own}"]) == "/a?b=/c"
    hosts, origins = _headers(rng, own), _headers(rng, f"http://{own}")
    path = f"/{guard.token}" if rng.integers(4) else f"/{_spoiled(rng, guard.token)}"
    if guard.admit(path, hosts, origins) is None:
        return
    assert path.startswith(f"/{guard.token}"), "without the token"
    assert len(hosts) == 1, "no address, or several"
    assert len(origins) <= 1, "several pages"
    for origin in origins:
        assert urlsplit(origin).scheme == "http"
        assert urlsplit(origin).netloc == hosts[0], "a page of others"
    assert _leads_here(urlsplit(f"http://{hosts[0]}").hostname or "", guard.host), "a name of others"


def _headers(rng: Rng, good: str) -> list[str]:
    """One header, mostly; good, spoiled, or anything."""
    return [_spoiled(rng, good) if rng.integers(3) else good for _ in range(int(pick(rng, (0, 1, 1, 1, 1, 2))))]


def _spoiled(rng: Rng, text: str) -> str:
    """Text with something left out, put in, or put in its place."""
    act, place = rng.integers(4), int(rng.integers(len(text) + 1))
    if act == 0:
        return text[:place] + text[place + 1 :]
    if act == 1:
        return text[:place] + str(pick(rng, PARTS)) + text[place:]
    words = "".join(str(pick(rng, PARTS)) for _ in range(int(rng.integers(5))))
    return words if act == 2 else text + words


def _leads_here(name: str, host: str) -> bool:
    """Whether a name can be this machine's: by Python's parser of addresses, not by the guard's."""
    if name in ("localhost", host, socket.gethostname().lower()):
        return True
    found = ipaddress.ip_address(name)
    return found.is_loopback or host not in ("127.0.0.1", "localhost", "::1")
