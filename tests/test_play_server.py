"""The server of the page: who is let in, who may steer, and what becomes of bad messages."""

import ast
import contextlib
import json
import threading
import time
import urllib.error
import urllib.request
from pathlib import Path

import pytest
import uvicorn
from play_stand_in import stand_in
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from lerobot_swr.interactive import hub as hub_module
from lerobot_swr.interactive import server as server_module
from lerobot_swr.interactive.hub import MAX_PAGES, MAX_PER_SECOND, Hub
from lerobot_swr.interactive.messages import (
    MAX_MESSAGE_BYTES,
    MessageError,
    pack_frame,
    parse_message,
    unpack_frame,
)
from lerobot_swr.interactive.server import bind, serve

HAND = {"type": "hand", "place": [0.5, 0.5], "push": [0, 0, 0], "n": 1}


@pytest.fixture(scope="module")
def address():
    """Host and port of a server whose worker is a stand-in."""
    servers = []
    listener = bind("127.0.0.1", 0)
    patch = pytest.MonkeyPatch()
    patch.setattr(
        server_module, "make_server", lambda config: servers.append(uvicorn.Server(config)) or servers[-1]
    )
    thread = threading.Thread(target=serve, args=(Hub(stand_in, "play"), "127.0.0.1", listener), daemon=True)
    thread.start()
    host, port = listener.getsockname()
    yield f"{host}:{port}"
    servers[-1].should_exit = True
    thread.join(10)
    patch.undo()


@contextlib.contextmanager
def page(address, tab="one", **options):
    """A page of the browser, as the server sees it."""
    headers = {"origin": f"http://{address}"}
    with connect(f"ws://{address}/ws?tab={tab}", additional_headers=headers, **options) as socket:
        yield socket


def hear(socket, kind, seconds=5):
    """The next event of a type."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        said = socket.recv(timeout=seconds)
        if isinstance(said, str) and json.loads(said)["type"] == kind:
            return json.loads(said)
    raise TimeoutError(kind)


def say(socket, message):
    socket.send(message if isinstance(message, str | bytes) else json.dumps(message))


def closing_code(socket):
    """With which code the server closes a connection; None where it is cut off."""
    try:
        while True:
            socket.recv(timeout=10)
    except ConnectionClosed as closed:
        return None if closed.rcvd is None else closed.rcvd.code


# --- Messages ---


@pytest.mark.parametrize(
    ("text", "answer"),
    [
        (b"{}", "messages are text"),
        ("", "no JSON"),
        ("[" * 10_000, "no JSON"),
        ("[1]", 'an object with a text "type"'),
        ('{"type": 3}', 'an object with a text "type"'),
        ('{"type": "shutdown"}', "unknown type 'shutdown'; known: hand, keep"),
        ('{"type": "load", "path": "/"}', "unknown type 'load'"),
        ('{"type": "watched", "count": 0}', "unknown type 'watched'"),
        ('{"type": "_on_keep"}', "unknown type"),
        ('{"type": "keep", "self": 1}', "keep: unknown field 'self'"),
        ('{"type": "hand"}', "hand: the field 'place' is missing"),
        (json.dumps({**HAND, "place": [1]}), r"hand: place=\[1\]: expected null or two"),
        (json.dumps({**HAND, "place": [float("nan"), 1]}), r"hand: place=\[NaN, 1\]"),
        (json.dumps({**HAND, "place": [10**400, 1]}), r"hand: place=\[1000"),
        (json.dumps({**HAND, "push": [0, 0, True]}), "hand: push="),
        (json.dumps({**HAND, "n": -1}), "hand: n=-1"),
        ('{"type": "style", "episodes": []}', "style: episodes"),
        ('{"type": "style", "episodes": [0.5]}', "style: episodes"),
        ('{"type": "style", "episodes": "1"}', "style: episodes"),
        ('{"type": "filter", "text": " "}', "filter: text"),
        ('{"type": "speed", "factor": 0}', "speed: factor=0: expected a number from 0.1 to 4"),
        ('{"type": "train", "steps": 10000000}', "train: steps"),
        ('{"type": "pause", "on": 1}', "pause: on=1: expected true or false"),
        (f'{{"type": "filter", "text": "{"x" * MAX_MESSAGE_BYTES}"}}', "at most 131072 bytes"),
    ],
)
def test_bad_messages_are_refused_by_what_is_wrong_with_them(text, answer):
    """Before anybody acts on them."""
    with pytest.raises(MessageError, match=answer):
        parse_message(text)


def test_good_messages_are_what_they_were():
    """All fields and no others."""
    for message in (HAND, {"type": "keep"}, {"type": "style", "episodes": [0, 3]}):
        assert parse_message(json.dumps(message)) == message


def test_frames_are_unpacked_to_what_was_packed():
    """Header and picture."""
    assert unpack_frame(pack_frame({"steps": 3, "behavior": "ü"}, b"\x00JPEG")) == (
        {"steps": 3, "behavior": "ü"},
        b"\x00JPEG",
    )


# --- Who is let in ---


def test_the_page_and_its_parts_are_served_with_their_guards(address):
    """Nothing from elsewhere may run in it or hold it in a frame."""
    for path, part in (
        ("/", b"<canvas"),
        ("/page.js", b"WebSocket"),
        ("/page.css", b"canvas"),
        ("/plotly.js", b""),
    ):
        with urllib.request.urlopen(f"http://{address}{path}") as answer:
            assert part in answer.read()
            assert "frame-ancestors 'none'" in answer.headers["Content-Security-Policy"]
    with pytest.raises(urllib.error.HTTPError, match="404"):
        urllib.request.urlopen(f"http://{address}/../pyproject.toml")


def test_pages_need_nothing_from_the_network():
    """The page works offline: no address is named in it."""
    folder = Path(server_module.__file__).parent
    for name in ("page.html", "page.js", "page.css"):
        assert "//" not in (folder / name).read_text().replace("`${scheme}://", "").replace("// ", "")


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", "http://127.0.0.1:1", "https://{address}.evil.example"]
)
def test_another_page_of_the_same_browser_cannot_connect(address, origin):
    """Its origin gives it away."""
    headers = {"origin": origin.format(address=address)}
    with pytest.raises(InvalidStatus, match="403"), connect(f"ws://{address}/ws", additional_headers=headers):
        pass


def test_a_name_that_others_can_point_here_is_refused(address):
    """So that a page cannot reach the server under a name of its own."""
    request = urllib.request.Request(f"http://{address}/", headers={"Host": "evil.example"})
    with pytest.raises(urllib.error.HTTPError, match="421"):
        urllib.request.urlopen(request)


# --- Who steers ---


def test_the_first_page_steers_and_another_one_can_take_over(address):
    """The others look on, and are told so when they try."""
    with page(address, "one") as one, page(address, "two") as two:
        assert hear(one, "role")["pilot"]
        assert not hear(two, "role")["pilot"]
        say(two, {"type": "keep"})
        assert "another page steers" in hear(two, "error")["message"]
        say(one, HAND)
        assert json.loads(hear(two, "notice")["message"]) == HAND
        say(two, {"type": "take"})
        assert hear(two, "role")["pilot"]
        say(one, {"type": "keep"})
        assert "another page steers" in hear(one, "error")["message"]


@pytest.mark.parametrize("how", ["takes over", "is left over"])
def test_what_the_last_page_held_is_let_go(address, how):
    """Else its pointer would go on pulling, with nobody at it."""
    with page(address, "one") as one, page(address, "two") as two:
        hear(two, "role")
        say(one, HAND)
        assert json.loads(hear(two, "notice")["message"]) == HAND
        if how == "takes over":
            say(two, {"type": "take"})
        else:
            one.close()
        released = json.loads(hear(two, "notice")["message"])
        assert (released["type"], released["place"], released["push"]) == ("hand", None, [0, 0, 0])


def test_a_reload_keeps_the_page_its_place(address):
    """The same tab comes back: it steers at once, and its old connection ends."""
    with page(address, "one") as before, page(address, "one") as after:
        hear(before, "role")
        assert hear(after, "role")["pilot"]
        assert closing_code(before) == 4000


def test_too_many_pages_are_told_so(address):
    """A hundred come; those within the limit stay connected."""
    with contextlib.ExitStack() as stack:
        pages = [stack.enter_context(page(address, f"tab{i}")) for i in range(100)]
        for refused in pages[MAX_PAGES:]:
            assert f"{MAX_PAGES} pages are open already" in hear(refused, "error")["message"]
        say(pages[0], HAND)
        assert hear(pages[0], "notice")


def test_bad_messages_are_answered_and_the_page_goes_on(address):
    """One clear line each, no trace; the next good message is obeyed."""
    with page(address) as socket:
        for text in ("nonsense", b"\x00", '{"type": "hand"}'):
            say(socket, text)
            message = hear(socket, "error")["message"]
            assert "Traceback" not in message
            assert "\n" not in message
        say(socket, HAND)
        assert hear(socket, "notice")


def test_a_message_that_is_too_large_ends_its_connection_only(address):
    """Before it is read: what then lies unread may cut the connection off before the code arrives."""
    with page(address, "large") as large:
        say(large, "x" * (MAX_MESSAGE_BYTES + 1))
        assert closing_code(large) in (1009, None)
    with page(address) as socket:
        assert hear(socket, "welcome")


def test_a_page_has_its_share_of_messages_in_every_second():
    """Counted anew when the next second begins."""
    speaker = hub_module.Page("one")
    assert all(speaker.may_speak(7.0 + n / MAX_PER_SECOND) for n in range(MAX_PER_SECOND))
    assert not speaker.may_speak(7.999)
    assert speaker.may_speak(8.0)


def test_a_flood_is_answered_not_obeyed(address, monkeypatch):
    """More than its share in a second is left out, with a word."""
    monkeypatch.setattr(hub_module, "MAX_PER_SECOND", 2)  # within reach of a slow machine
    with page(address) as socket:
        for _ in range(60):
            say(socket, HAND)
        assert "more than 2 messages" in hear(socket, "error", 30)["message"]


def test_a_dead_worker_is_told_and_started_anew(address, monkeypatch):
    """Where it had lived for a while."""
    monkeypatch.setattr(hub_module, "SHORTEST_LIFE_S", 0)
    with page(address) as socket:
        say(socket, {"type": "perturb"})
        error = hear(socket, "error", 20)
        assert "what was kept is safe on the disk. It is started anew" in error["message"]
        assert not error["fatal"]
        hear(socket, "welcome", 30)
        with page(address, "later") as later:  # to which there is nothing to be told of it
            assert [json.loads(later.recv(timeout=20))["type"] for _ in range(2)] == ["welcome", "role"]
        say(socket, HAND)
        assert hear(socket, "notice", 20)


def test_what_cannot_be_played_ends_the_command_with_its_reason():
    """Instead of a page that waits for ever."""
    with pytest.raises(ValueError, match="there is no such maze"):
        serve(Hub(stand_in, "refuse"), "127.0.0.1", bind("127.0.0.1", 0))


def test_a_port_in_use_is_told(address):
    """With a way out."""
    port = int(address.rpartition(":")[2])
    with pytest.raises(ValueError, match=rf"port={port}: cannot listen there .* or 0"):
        bind("127.0.0.1", port)


def test_the_servers_modules_know_neither_torch_nor_numpy():
    """A slow policy cannot stall the page through them."""
    folder = Path(server_module.__file__).parent
    for name in ("server", "hub", "messages", "training"):
        tree = ast.parse((folder / f"{name}.py").read_text())
        imported = {
            module
            for node in ast.walk(tree)
            if isinstance(node, ast.Import | ast.ImportFrom)
            for module in (
                [node.module] if isinstance(node, ast.ImportFrom) else [a.name for a in node.names]
            )
        }
        own = {m for m in imported if m.startswith("lerobot_swr")}
        assert own <= {f"lerobot_swr.interactive.{m}" for m in ("hub", "messages", "training")}
        assert not {m.partition(".")[0] for m in imported} & {"torch", "numpy", "lerobot"}
