"""The server of `enerf view --serve`: it answers for what its site lists, to whoever may ask, and for nothing else."""

import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest

from workflows.viewing import server as server_module
from workflows.viewing.server import HEADERS, LOOPBACK, Answer, Server, open_inside

Ask = Callable[..., tuple[int, dict[str, str], bytes]]


def site(path: str) -> Answer | None:
    if path == "/broken":
        raise ValueError("a secret")
    return Answer("text/plain", b"hello") if path == "/" else None


def asked(server: Server, request: bytes) -> tuple[int, dict[str, str], bytes]:
    """Status, headers and body of the answer to the bytes of a request."""
    with socket.create_connection(server.server_address[:2], timeout=10) as connection:
        connection.sendall(request)
        answer = b""
        while part := connection.recv(2**16):
            answer += part
    head, _, body = answer.partition(b"\r\n\r\n")
    lines = head.decode("ascii").split("\r\n")
    assert lines[0].startswith("HTTP/1.0 "), answer
    return int(lines[0].split()[1]), dict(line.split(": ", 1) for line in lines[1:]), body


@pytest.fixture
def server() -> Iterator[Server]:
    with Server(site, LOOPBACK, 0) as made:
        threading.Thread(target=made.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        yield made
        made.shutdown()


@pytest.fixture
def ask(server: Server) -> Ask:
    def call(path: str = "/", *, method: str = "GET", host: str | None = "localhost", more: str = "") -> tuple[int, dict[str, str], bytes]:
        named = "" if host is None else f"Host: {host}\r\n"
        return asked(server, f"{method} {path} HTTP/1.1\r\n{named}{more}\r\n".encode("latin-1"))

    return call


def test_get_and_head_say_the_same(ask: Ask) -> None:
    status, headers, body = ask()
    assert (status, body) == (200, b"hello")
    assert headers.items() >= {**HEADERS, "Content-Type": "text/plain", "Content-Length": "5", "Connection": "close"}.items()
    assert ask(method="HEAD") == (200, headers, b"")
    for method in ("POST", "OPTIONS", "TRACE", "get", "error", "_send"):
        status, headers, _ = ask(method=method, more="Content-Length: 0\r\n")
        assert (status, headers["Allow"]) == (405, "GET, HEAD")
    assert ask("/broken")[::2] == (500, b"500 Internal Server Error\n"), "an error of its own is not told"


HOSTS = ["evil.example", "localhost.evil.example", "127.0.0.1.nip.io", "0.0.0.0", "10.0.0.1", "", "localhost:x", "localhost:123456", "user@localhost", "::1",
         "[::1", "[::1]x", "[localhost]:80", "localhost, evil.example", "127.0.0.1:80:80", "0x7f000001", "127.1", "localhost."]  # fmt: skip


@pytest.mark.parametrize("host", [*HOSTS, None])
def test_it_answers_to_no_other_name(ask: Ask, host: str | None) -> None:
    """DNS rebinding: a name of somebody else's that was made to point to this machine."""
    status, headers, body = ask(host=host)
    assert (status, body) == (421, b"421 Misdirected Request\n")
    assert headers.items() >= HEADERS.items()


@pytest.mark.parametrize(
    ("request_line", "status"),
    [(b"GET", 400), (b"GET / HTTP/9.9.9", 400), (b"GET / HTTP/3.0", 505), (b"\xff\xfe\x00", 400), (b"GET /" + b"a" * 70_000 + b" HTTP/1.1", 414),
     (b"GET / HTTP/1.1" + b"\r\nX: 1" * 200, 431)],
)  # fmt: skip
def test_what_is_no_request_is_refused_and_not_repeated(server: Server, request_line: bytes, status: int) -> None:
    with socket.create_connection(server.server_address[:2], timeout=10) as connection:
        connection.sendall(request_line + b"\r\nHost: localhost\r\n\r\n")
        answer = b""
        with suppress(ConnectionResetError):  # it did not read all of what was too long
            while part := connection.recv(2**16):
                answer += part
    assert str(status).encode() in answer
    assert b"aaaa" not in answer


def test_slow_connections_keep_no_other_request_waiting(server: Server, ask: Ask) -> None:
    """As many as it ever answered at once, and more: none of them says all that it has to."""
    with ExitStack() as held:
        slow = [held.enter_context(socket.create_connection(server.server_address[:2], timeout=10)) for _ in range(3 * server_module.MOST_AT_ONCE)]
        for connection in slow:
            with suppress(OSError):  # of those that others have taken the place of
                connection.sendall(b"GET / HTTP/1.1\r\nHost: local")
        assert [ask()[0] for _ in range(3)] == [200] * 3
        assert slow[0].recv(10) == b"", "the oldest was hung up on"


def test_a_request_that_comes_byte_by_byte_is_hung_up_on(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_module, "READING", 0.3)
    with socket.create_connection(server.server_address[:2], timeout=0.05) as slow:
        for _ in range(1000):
            try:
                slow.sendall(b"G")
                if slow.recv(10) == b"":
                    return
            except TimeoutError:
                continue
            except OSError:
                return
    raise AssertionError("it is still listened to")


def test_an_answer_that_nobody_takes_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_module, "SENDING", 0.1)
    monkeypatch.setattr(server_module, "SLOWEST", 2**40)
    with Server(lambda path: Answer("text/plain", bytes(2**26)), LOOPBACK, 0) as made:
        threading.Thread(target=made.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        with socket.create_connection(made.server_address[:2], timeout=20) as idle:
            idle.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
            for _ in range(server_module.MOST_THREADS):
                assert made.slots.acquire(timeout=20), "its thread has ended"
        made.shutdown()


def test_who_opens_many_connections_takes_no_others_place(server: Server) -> None:
    """Peers of other addresses: the loopback interface has many."""
    with ExitStack() as held:
        first = held.enter_context(socket.create_connection(server.server_address[:2], timeout=10, source_address=("127.0.0.2", 0)))
        for _ in range(3 * server_module.MOST_AT_ONCE):
            held.enter_context(socket.create_connection(server.server_address[:2], timeout=10))
        first.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert first.recv(8) == b"HTTP/1.0"


def test_files_are_opened_through_no_link_and_nothing_but_files(tmp_path: Path) -> None:
    run, outside = tmp_path / "run", tmp_path / "outside"
    for folder in (run / "a", outside):
        folder.mkdir(parents=True)
        (folder / "file").write_bytes(b"12345")
    (run / "link").symlink_to(outside / "file")
    (run / "folder").symlink_to(outside)
    os.mkfifo(run / "pipe")
    before = len(os.listdir("/proc/self/fd")) if Path("/proc/self/fd").is_dir() else None
    for name in ("link", "folder/file", "pipe", "a", "nothing", "../outside/file", "a/../file", "/etc/passwd", "", "a//file", "a/file/", "./a/file", "a\0"):
        assert open_inside(run, name, 100) is None, name
    assert open_inside(run, "a/file", 4) is None, "larger than may be"
    if before is not None:
        assert len(os.listdir("/proc/self/fd")) == before
    found = open_inside(run, "a/file", 5)
    assert found is not None
    assert os.read(found, 10) == b"12345"
    os.close(found)


def test_an_open_file_is_sent_and_closed(tmp_path: Path) -> None:
    (tmp_path / "large").write_bytes(os.urandom(10**6))
    sent: list[int] = []

    def files(path: str) -> Answer | None:
        file = open_inside(tmp_path, "large", 10**7)
        assert file is not None
        sent.append(file)
        return Answer("application/octet-stream", file=file)

    with Server(files, LOOPBACK, 0) as made:
        threading.Thread(target=made.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        status, headers, body = asked(made, b"GET /x HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert (status, headers["Content-Length"], body) == (200, "1000000", (tmp_path / "large").read_bytes())
        assert asked(made, b"HEAD /x HTTP/1.1\r\nHost: localhost\r\n\r\n")[::2] == (200, b"")
        with socket.create_connection(made.server_address[:2], timeout=10) as gone:
            gone.sendall(b"GET /x HTTP/1.1\r\nHost: localhost\r\n\r\n")
        deadline = time.monotonic() + 10
        while (len(sent) < 3 or made.slots._value < server_module.MOST_THREADS) and time.monotonic() < deadline:  # type: ignore[attr-defined]
            time.sleep(0.01)
        made.shutdown()
    assert len(sent) == 3
    assert not any(os.path.samefile(f"/proc/self/fd/{number}", tmp_path / "large") for number in sent if os.path.exists(f"/proc/self/fd/{number}"))
