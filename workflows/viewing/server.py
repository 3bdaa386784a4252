"""A server of a few pages for one browser: it reads, and answers GET and HEAD for the names that its site lists, and nothing else.

Any program on this machine may ask it, a page of another site in this machine's browser too. Hence: it listens on the loopback interface unless asked
otherwise; requests must name it by that (a name that was made to point here, DNS rebinding, is refused); no other site may embed or read its answers; no
part of a request becomes part of a path; files are opened from the run's folder downwards, through no link; slow clients delay no others.
"""

import ipaddress
import os
import re
import shutil
import socket
import stat
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from pipeline.errors import UsageError

LOOPBACK = "127.0.0.1"
READING = 10.0  # seconds that a request may take to come
SENDING, SLOWEST = 20.0, 2**15  # seconds, and bytes a second, that its answer may take to go
MOST_AT_ONCE, MOST_OF_A_PEER = 32, 16  # connections; a browser opens six. A new one takes the place of the oldest
MOST_THREADS = 2 * MOST_AT_ONCE  # those that are hung up on may still be at work on an answer
HEADERS = {
    "Cache-Control": "no-store",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "SAMEORIGIN",
}
_HOST = re.compile(r"(?:\[([0-9A-Fa-f:.]+)\]|([0-9A-Za-z.-]+))(?::[0-9]{1,5})?")
NOTHING = "default-src 'none'; frame-ancestors 'none'"


@dataclass(frozen=True)
class Answer:
    """An answer: bytes, or an open file, which the sender closes."""

    kind: str  # content type
    data: bytes = b""
    file: int | None = None
    policy: str = NOTHING  # content security policy


@dataclass
class _Connection:
    """peer: its address; due: when it is hung up on, None while its answer is made"""

    peer: str
    due: float | None


Site = Callable[[str], Answer | None]  # the answer to a path, as the request spells it; None: there is none


class Server(ThreadingHTTPServer):
    """Serves a site until it is shut down. Raises UsageError where the address is taken, or is none of this machine.

    site     says what there is
    address  of an interface of this machine
    port     0: one that is free
    """

    daemon_threads = True
    allow_reuse_address = True
    request_queue_size = 128  # connections that wait to be taken; with Python's five, those of a burst try again after seconds

    def __init__(self, site: Site, address: str, port: int) -> None:
        self.site, self.address = site, address
        self.slots = threading.BoundedSemaphore(MOST_THREADS)
        self._open: dict[socket.socket, _Connection] = {}  # the oldest first
        self._opened = threading.Lock()
        self.address_family = socket.AF_INET6 if ":" in address else socket.AF_INET
        try:
            super().__init__((address, port), _Handler)
        except OSError as error:
            why = error.strerror or type(error).__name__
            raise UsageError(f"--serve {port}: cannot listen on {address} ({why}). Give another port; 0 takes one that is free.") from error

    @property
    def url(self) -> str:
        host = f"[{self.address}]" if ":" in self.address else self.address
        return f"http://{host}:{self.server_address[1]}/"

    def server_bind(self) -> None:
        """As the base class, which would look up the name of this machine."""
        if self.allow_reuse_address:
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.socket.bind(self.server_address)
        self.server_address = self.socket.getsockname()
        self.server_name, self.server_port = self.address, self.server_address[1]

    def process_request(self, request: Any, client_address: Any) -> None:
        if not self.slots.acquire(blocking=False):
            self.shutdown_request(request)
            return
        with self._opened:
            self._make_room(client_address[0])
            self._open[request] = _Connection(client_address[0], time.monotonic() + READING)
        try:
            super().process_request(request, client_address)
        except BaseException:
            self._forget(request)
            raise

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._forget(request)

    def _forget(self, request: socket.socket) -> None:
        with self._opened:
            self._open.pop(request, None)
        self.slots.release()

    def _make_room(self, peer: str) -> None:
        """Close the oldest connection of a peer at its limit, or, at the total limit, of the peer that has most."""
        peers = Counter(each.peer for each in self._open.values())
        if peers[peer] < MOST_OF_A_PEER:
            if len(self._open) < MOST_AT_ONCE:
                return
            peer = peers.most_common(1)[0][0]
        self._hang_up(next(request for request, each in self._open.items() if each.peer == peer))

    def _hang_up(self, request: socket.socket) -> None:
        """Its thread's reads end, and its writes fail."""
        del self._open[request]
        with suppress(OSError):
            request.shutdown(socket.SHUT_RDWR)

    def service_actions(self) -> None:
        """Now and then: hang up on those whose time is over."""
        now = time.monotonic()
        with self._opened:
            for request in [request for request, each in self._open.items() if each.due is not None and each.due < now]:
                self._hang_up(request)

    def set_due(self, request: socket.socket, seconds: float | None) -> None:
        """When a connection is hung up on: so many seconds from now."""
        with self._opened:
            if (found := self._open.get(request)) is not None:
                found.due = None if seconds is None else time.monotonic() + seconds

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A browser that goes away is no news."""

    def is_named(self, host: str | None) -> bool:
        """Whether a request's Host is one by which this server may be reached: localhost or a number of the loopback interface; any number where it listens
        elsewhere, too. Ports may differ: a tunnel has its own."""
        name = _name_of(host or "")
        if name.lower() == "localhost":
            return True
        try:
            number = ipaddress.ip_address(name)
        except ValueError:
            return False
        return number.is_loopback or not ipaddress.ip_address(self.address).is_loopback


def _name_of(host: str) -> str:
    """Without the port, and a number's brackets; "" for what is no host and port."""
    found = _HOST.fullmatch(host)
    return "" if found is None else found[1] or found[2]


class _Handler(BaseHTTPRequestHandler):
    """One request, one answer, and the connection is closed."""

    server: Server
    protocol_version = "HTTP/1.0"

    def do_GET(self) -> None:
        self.server.set_due(self.connection, None)
        hosts = self.headers.get_all("Host") or []
        if len(hosts) != 1 or not self.server.is_named(hosts[0]):
            self.send_error(HTTPStatus.MISDIRECTED_REQUEST)
            return
        try:
            answer = self.server.site(self.path)
        except Exception:  # any error is reported where the command runs, not here
            self.send_error(HTTPStatus.INTERNAL_SERVER_ERROR)
            return
        if answer is None:
            self.send_error(HTTPStatus.NOT_FOUND)
        else:
            self._send(HTTPStatus.OK, answer)

    do_HEAD = do_GET

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Also for what the class above refuses: requests that are none, too long, or of another method. Nothing of the request is repeated."""
        status = HTTPStatus(code)
        if status is HTTPStatus.NOT_IMPLEMENTED:
            status = HTTPStatus.METHOD_NOT_ALLOWED
        self._send(status, Answer("text/plain; charset=utf-8", f"{status.value} {status.phrase}\n".encode("ascii")))

    def _send(self, status: HTTPStatus, answer: Answer) -> None:
        try:
            length = len(answer.data) if answer.file is None else os.fstat(answer.file).st_size
            self.server.set_due(self.connection, SENDING + length / SLOWEST)
            self.close_connection = True
            self.send_response_only(status)
            allowed = {"Allow": "GET, HEAD"} if status is HTTPStatus.METHOD_NOT_ALLOWED else {}
            facts = {"Content-Type": answer.kind, "Content-Length": str(length), "Content-Security-Policy": answer.policy, "Connection": "close"}
            # A page in a sandbox has no origin that others could share, and browsers refuse one that says that others may not.
            opener = {"Cross-Origin-Opener-Policy": "unsafe-none"} if "sandbox" in answer.policy else {}
            for name, value in {**facts, **HEADERS, **opener, **allowed}.items():
                self.send_header(name, value)
            self.end_headers()
            if self.command == "HEAD":
                return
            if answer.file is None:
                self.wfile.write(answer.data)
            else:
                with open(answer.file, "rb", closefd=False) as file:
                    shutil.copyfileobj(file, self.wfile, 2**18)
        finally:
            if answer.file is not None:
                os.close(answer.file)

    def log_message(self, format: str, *arguments: Any) -> None:
        """Nothing: what is on a terminal is of the command."""


def open_inside(folder: Path, name: str, most: int) -> int | None:
    """A descriptor of a plain file of at most `most` bytes, opened from the folder downwards through no link; None where there is none.

    name  relative, of our own making
    """
    parts = name.split("/")
    if any(part in ("", ".", "..") for part in parts):
        return None
    flags = os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
    at = -1
    try:
        at = os.open(folder, os.O_RDONLY | os.O_CLOEXEC | os.O_DIRECTORY)
        for part in parts[:-1]:
            below = os.open(part, flags | os.O_DIRECTORY, dir_fd=at)
            os.close(at)
            at = below
        status = os.stat(parts[-1], dir_fd=at, follow_symlinks=False)
        if not stat.S_ISREG(status.st_mode) or status.st_size > most:
            return None  # a device is not even opened
        found = os.open(parts[-1], flags, dir_fd=at)
    except (OSError, ValueError):
        return None
    finally:
        if at >= 0:
            os.close(at)
    if not stat.S_ISREG(os.fstat(found).st_mode):
        os.close(found)
        return None
    return found
