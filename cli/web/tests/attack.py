"""Attacks the server of a live page, and checks that it serves others: attack.py URL#TOKEN."""

import contextlib
import http.client
import json
import resource
import socket
import sys
import urllib.parse

address = urllib.parse.urlsplit(sys.argv[1])
HOST, TOKEN = address.netloc, address.fragment
PORT = address.port
STREAMS_MAX = 16


def connect():
    """Returns a connection."""
    return http.client.HTTPConnection("127.0.0.1", PORT, timeout=60)


def ask(method, path, body=None, **headers):
    """Returns the status of an answer."""
    connection = connect()
    connection.request(method, path, body, {n.replace("_", "-"): v for n, v in headers.items()})
    answer = connection.getresponse()
    answer.read()
    connection.close()
    return answer.status


def order(token):
    """Returns the status of the answer to an order that harms nothing."""
    body = json.dumps({"hand": "mend", "system": "A"})
    return ask("POST", "/hands", body, Authorization=f"Bearer {token}", Content_Type="application/json")


def raw(data):
    """Sends bytes, and returns what the server answers until it closes the connection."""
    with socket.create_connection(("127.0.0.1", PORT), timeout=60) as client:
        said = b""
        # The server may close the connection before all is sent.
        with contextlib.suppress(ConnectionError):
            client.sendall(data)
        with contextlib.suppress(ConnectionError):
            while part := client.recv(65536):
                said += part
        return said


def stream():
    """Returns a connection that gets the events."""
    connection = connect()
    connection.request("GET", "/events")
    return connection, connection.getresponse()


def times(answer):
    """Yields the scenario times of a stream of events, s."""
    for line in answer:
        if line.startswith(b"data: "):
            yield json.loads(line.removeprefix(b"data: "))["state"]["time_s"] or 0.0


def goes_on(news, span_s):
    """Waits until the run has driven for this time."""
    begin = next(news)
    next(time for time in news if time > begin + span_s)


def check_slow_readers(news):
    """Streams that no one reads: the others get theirs, and there is a limit."""
    slow = [stream() for _ in range(STREAMS_MAX - 1)]
    assert all(answer.status == 200 for _, answer in slow)
    assert stream()[1].status == 503
    goes_on(news, 3.0)
    assert ask("GET", "/state", Host=HOST) == 200
    for connection, _ in slow:
        connection.close()


def check_flood(news):
    """A thousand connections that say nothing: the stream goes on, and later all are served."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard if hard < 4096 else 4096, hard))
    flood = []
    for _ in range(1000):
        client = socket.socket()
        client.setblocking(False)
        client.connect_ex(("127.0.0.1", PORT))
        flood.append(client)
    goes_on(news, 3.0)
    for client in flood:
        client.close()
    assert ask("GET", "/") == 200


def check_guesses():
    """Wrong tokens: each is refused, and the right one still works."""
    for guess in range(300):
        assert order(f"{guess:0{len(TOKEN)}x}") == 401
    for odd in [TOKEN[:-1], TOKEN + "0", TOKEN.upper() + " ", "\xff" * len(TOKEN)]:
        assert order(odd) == 401, odd
    assert order(TOKEN) == 200


def check_requests():
    """Requests that are too large, endless or no HTTP."""
    head = f"POST /hands HTTP/1.1\r\nHost: {HOST}\r\nContent-Type: application/json\r\n"
    head = (head + f"Authorization: Bearer {TOKEN}\r\n").encode()
    assert b" 413 " in raw(head + b"Content-Length: 10000000000\r\n\r\n" + b"x" * 4096)
    part = b"400\r\n" + b"x" * 1024 + b"\r\n"
    assert b" 413 " in raw(head + b"Transfer-Encoding: chunked\r\n\r\n" + 8 * part)
    long = raw(b"GET /" + b"x" * 2_000_000 + b" HTTP/1.1\r\n\r\n")
    assert b" 200 " not in long, long[:200]
    assert b" 200 " not in raw(b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" * 100 + b"\r\n\r\n")
    two = f"GET /state HTTP/1.1\r\nHost: {HOST}\r\nHost: evil.example\r\nConnection: close\r\n\r\n"
    assert b" 200 " not in raw(two.encode())
    assert b" 403 " in raw(b"GET /state HTTP/1.0\r\n\r\n")


def main():
    """Does all of it beside a stream that must go on."""
    connection, answer = stream()
    assert answer.status == 200
    news = times(answer)
    next(time for time in news if time > 1.0)
    check_requests()
    check_guesses()
    check_slow_readers(news)
    check_flood(news)
    goes_on(news, 1.0)
    connection.close()


main()
