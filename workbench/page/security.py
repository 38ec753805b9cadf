"""What keeps the app to the person in front of it: host, origin and content rules, as one ASGI
layer.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any, Final, final

CSP: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src "
    "'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HEADERS: Final = (
    (b"content-security-policy", CSP.encode()),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"x-frame-options", b"DENY"),
)
SAFE_METHODS: Final = frozenset({"GET", "HEAD"})
MARK: Final = b"x-irj"
"""Header the page sends with every change: another site cannot send it without being asked
first.
"""

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
Application = Callable[[Scope, Receive, Send], Awaitable[None]]


@final
class Guard:
    """Answers only to the loopback names, only to its own page, and adds the security headers.

    Parameters
    ----------
    app : ASGI application
    hosts : collection of str
        Values of the Host header that are served, with port.
    end : callable, optional
        Ends the answers that would go on for ever, before the server stops.
    """

    def __init__(
        self, app: Application, hosts: frozenset[str], end: Callable[[], None] = lambda: None
    ) -> None:
        self.app = app
        self.hosts = hosts
        self.end = end

    def refusal(self, method: str, headers: dict[bytes, bytes]) -> tuple[int, str] | None:
        """Status and sentence where a request is not served."""
        host = headers.get(b"host", b"").decode("latin-1").lower()
        if host not in self.hosts:
            return 400, "this address is not served; open the one that was printed at the start"
        origin = headers.get(b"origin")
        if origin is not None and origin.decode("latin-1").lower() != f"http://{host}":
            return 403, "request from another site"
        if headers.get(b"sec-fetch-site", b"none") not in (b"same-origin", b"none"):
            return 403, "request from another site"
        if method not in SAFE_METHODS and MARK not in headers:
            return 403, "a change needs the header X-IRJ"
        return None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            if scope["type"] == "lifespan":
                await self.app(scope, receive, send)
            return

        async def guarded(message: MutableMapping[str, Any]) -> None:
            if message["type"] == "http.response.start":
                own = {name for name, _ in HEADERS}
                kept = [pair for pair in message.get("headers", []) if pair[0].lower() not in own]
                message = {**message, "headers": [*kept, *HEADERS]}
            await send(message)

        refused = self.refusal(scope["method"], dict(scope["headers"]))
        if refused is None:
            await self.app(scope, receive, guarded)
            return
        status, text = refused
        await guarded(
            {
                "type": "http.response.start",
                "status": status,
                "headers": [(b"content-type", b"text/plain; charset=utf-8")],
            }
        )
        await guarded({"type": "http.response.body", "body": text.encode()})


def loopback_hosts(port: int) -> frozenset[str]:
    """Host headers of the loopback interface; without the port where it is the default one."""
    names = ("127.0.0.1", "localhost", "[::1]")
    plain = names if port == 80 else ()
    return frozenset({f"{name}:{port}" for name in names} | set(plain))
