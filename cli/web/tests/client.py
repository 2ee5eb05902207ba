"""Checks the server of a live page with Python's own HTTP client: client.py URL#TOKEN."""

import http.client
import json
import sys
import urllib.error
import urllib.parse
import urllib.request

address = urllib.parse.urlsplit(sys.argv[1])
HOST, TOKEN = address.netloc, address.fragment
BASE = f"http://{HOST}"
# No proxy of the environment.
OPENER = urllib.request.build_opener(urllib.request.ProxyHandler({}))
KILL = {"hand": "kill-supply", "system": "master"}


def request(path, body=None, **headers):
    """Returns status, headers and text of an answer."""
    headers = {name.replace("_", "-"): value for name, value in headers.items()}
    data = None if body is None else json.dumps(body).encode()
    asked = urllib.request.Request(BASE + path, data, headers)
    try:
        with OPENER.open(asked, timeout=60) as answer:
            return answer.status, answer.headers, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.headers, error.read().decode()


def order(body=KILL, token=TOKEN, **headers):
    """Returns status and text of the answer to an order."""
    headers = {"Content_Type": "application/json"} | headers
    if token is not None:
        headers["Authorization"] = f"Bearer {token}"
    status, _, text = request("/hands", body, **headers)
    return status, json.loads(text)["said"]


def expect(what, found, wanted):
    """Fails unless both are equal."""
    assert found == wanted, f"{what}: {found}, not {wanted}"


def states(connection):
    """Yields the states of the event stream, with the parts of the page."""
    connection.request("GET", "/events")
    answer = connection.getresponse()
    expect("the stream", answer.status, 200)
    assert answer.headers["Content-Type"].startswith("text/event-stream"), answer.headers
    for line in answer:
        if line.startswith(b"data: "):
            event = json.loads(line.removeprefix(b"data: "))
            assert not event["state"]["ended"], "the run has ended"
            yield event["state"], event["parts"]


def main():
    """Kills the master's supply, and returns when the stream has shown the takeover."""
    status, headers, page = request("/")
    expect("the page", status, 200)
    assert TOKEN not in page, "the page contains the token"
    assert "frame-ancestors 'none'" in headers["Content-Security-Policy"], headers
    expect("a page that is not there", request("/nothing")[0], 404)
    for path in ["/", "/state", "/events", "/hands"]:
        expect("another host", request(path, Host="evil.example")[0], 403)
        expect("another site", request(path, Origin="http://evil.example")[0], 403)

    connection = http.client.HTTPConnection(HOST, timeout=60)
    stream = states(connection)
    both = lambda state: sorted(it["state"] for it in state["systems"]) == ["master", "standby"]
    before = next(state for state, _ in stream if state["obeyed"] and both(state))

    expect("no token", order(token=None)[0], 401)
    expect("a wrong token", order(token="0" * len(TOKEN))[0], 401)
    expect("an empty token", order(token="")[0], 401)
    expect("a token under another host", order(Host="evil.example")[0], 403)
    expect("a token from another site", order(Origin="http://evil.example")[0], 403)
    expect("a form", order(Content_Type="text/plain")[0], 415)
    expect("no such hand", order({"hand": "wave", "system": "A"})[0], 422)
    expect("too long", order({"hand": "mend", "system": "A" * 2000})[0], 413)
    expect("a GET", request("/hands")[0], 405)
    now = json.loads(request("/state")[2])
    assert "off" not in [it["state"] for it in now["systems"]], "a refused order has acted"

    status, said = order(Origin=BASE)
    # On a busy machine the driver may have changed since: the answer says which one was killed.
    expect("the order", (status, said[:-1]), (200, "kill the supply of "))
    master, other = said[-1], "B" if said[-1] == "A" else "A"
    takeover = lambda state: state["obeyed"] == other and state["takeovers"] > before["takeovers"]
    after, parts = next((state, parts) for state, parts in stream if takeover(state))
    assert "the vehicle obeys it" in parts[f"system_{other.lower()}"], parts
    told = lambda state: any("takes over" in event["what"] for event in state["events"])
    assert told(after) or any(told(state) for state, _ in stream), after["events"]
    expect("a supply that is dead", order({"hand": "kill-supply", "system": master})[0], 409)
    connection.close()


main()
