"""Requests that arrive by halves: they take neither files nor time from the others."""

import socket
import threading
import time
from contextlib import ExitStack, closing, contextmanager, suppress

import pytest
import uvicorn

from service.connections import bounded_protocol

HEAD = b"POST / HTTP/1.1\r\nhost: localhost\r\ncontent-length: 4\r\n\r\n"
NEVER_S = 3600.0


async def app(scope, receive, send):
    """Answer with the body that came."""
    body = b""
    while (message := await receive())["type"] == "http.request":
        body += message["body"]
        if not message["more_body"]:
            break
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"%d" % len(body))]})
    await send({"type": "http.response.body", "body": body})


@contextmanager
def serving(**limits):
    """Yield a function that connects to a server."""
    listener = socket.create_server(("127.0.0.1", 0))
    config = uvicorn.Config(
        app, http=bounded_protocol(**limits), lifespan="off", log_level="warning", timeout_graceful_shutdown=1
    )
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    while not server.started:
        time.sleep(0.01)
    try:
        yield lambda: socket.create_connection(listener.getsockname(), timeout=60)
    finally:
        server.should_exit = True
        thread.join()
        listener.close()


def read_all(connection):
    """Return what comes until the other side closes."""
    received = b""
    try:
        while part := connection.recv(4096):
            received += part
    except ConnectionResetError:
        pass
    return received


@pytest.mark.parametrize("sent", [b"", b"G", b"GET / HTTP/1.1\r\nhost: local", HEAD, HEAD + b"abc"])
def test_a_request_that_stays_half_is_not_waited_for(sent):
    with serving(patience_s=0.2) as connect, closing(connect()) as connection:
        connection.sendall(sent)
        assert read_all(connection) == b""


def test_neither_is_the_second_one_of_a_connection():
    with serving(patience_s=0.2) as connect, closing(connect()) as connection:
        connection.sendall(HEAD + b"abcd")
        assert connection.recv(4096).startswith(b"HTTP/1.1 200 OK")
        connection.sendall(HEAD)
        assert b"200" not in read_all(connection)


def test_a_request_in_pieces_is_answered():
    with serving() as connect, closing(connect()) as connection:
        for byte in HEAD + b"abcd":
            connection.sendall(bytes([byte]))
        connection.shutdown(socket.SHUT_WR)
        assert read_all(connection).endswith(b"abcd")


def test_of_many_half_requests_the_oldest_go_and_others_are_answered_meanwhile():
    with serving(patience_s=NEVER_S, most_waiting=20) as connect, ExitStack() as stack:
        halves = [stack.enter_context(closing(connect())) for _ in range(60)]
        for half in halves:
            with suppress(ConnectionError):  # it is closed already
                half.sendall(HEAD)
        with closing(connect()) as connection:
            connection.sendall(HEAD + b"abcd")
            assert connection.recv(4096).startswith(b"HTTP/1.1 200 OK")
        assert [read_all(half) for half in halves[:40]] == [b""] * 40
        for half in halves[45:]:
            half.sendall(b"wxyz")
            assert half.recv(4096).startswith(b"HTTP/1.1 200 OK")
