"""What the page may say, checked before anybody acts on it; and how pictures travel."""

import json
from collections.abc import Callable, Mapping
from typing import Any

MAX_MESSAGE_BYTES = 131_072
MAX_EPISODES = 10_000  # of one request; page.js knows it, too
MAX_TEXT = 1_000
MAX_STEPS = 1_000_000

Check = Callable[[Any], bool]


class MessageError(ValueError):
    """A message of the page that cannot be understood; the text is for the person who sees the page."""


def _is_number(value: Any, low: float, high: float) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high


def _is_whole(value: Any, low: int, high: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and low <= value <= high


def _is_list(value: Any, lengths: range, is_item: Check) -> bool:
    return isinstance(value, list) and len(value) in lengths and all(map(is_item, value))


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and len(value.strip()) > 0 and len(value) <= MAX_TEXT


_FIELDS: dict[str, dict[str, tuple[Check, str]]] = {
    "hand": {
        "place": (
            lambda v: v is None or _is_list(v, range(2, 3), lambda x: _is_number(x, -1, 2)),
            "null or two shares of the picture's sides",
        ),
        "push": (
            lambda v: _is_list(v, range(3, 4), lambda x: _is_number(x, -1, 1)),
            "three numbers from -1 to 1",
        ),
        "n": (lambda v: _is_whole(v, 0, 2**53), "a whole number"),
    },
    "keep": {},
    "discard": {},
    "undo": {},
    "save": {},
    "restart": {},
    "take": {},
    "perturb": {},
    "free": {},
    "clear": {},
    "stop": {},
    "record": {},
    "pause": {"on": (lambda v: isinstance(v, bool), "true or false")},
    "speed": {"factor": (lambda v: _is_number(v, 0.1, 4), "a number from 0.1 to 4")},
    "style": {
        "episodes": (
            lambda v: _is_list(v, range(1, MAX_EPISODES + 1), lambda x: _is_whole(x, 0, 2**31)),
            f"1 to {MAX_EPISODES} episode numbers",
        )
    },
    "filter": {"text": (_is_text, f"a filter of at most {MAX_TEXT} characters")},
    "train": {"steps": (lambda v: _is_whole(v, 1, MAX_STEPS), f"1 to {MAX_STEPS} steps")},
}


def parse_message(text: str | bytes | None) -> dict[str, Any]:
    """A message of the page, with the fields that its type has and no others.

    Raises:
        MessageError: If it is none; says what was expected.
    """
    if not isinstance(text, str):
        raise MessageError("messages are text (JSON)")
    if len(text.encode(errors="surrogatepass")) > MAX_MESSAGE_BYTES:
        raise MessageError(f"a message has at most {MAX_MESSAGE_BYTES} bytes")
    try:
        message = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise MessageError("the message is no JSON") from error
    if not isinstance(message, dict) or not isinstance(message.get("type"), str):
        raise MessageError('a message is an object with a text "type"')
    fields = _FIELDS.get(message["type"])
    if fields is None:
        raise MessageError(f"unknown type {message['type'][:40]!r}; known: {', '.join(_FIELDS)}")
    unknown = [key[:40] for key in message if key != "type" and key not in fields]
    if unknown:
        raise MessageError(f"{message['type']}: unknown field {unknown[0]!r}")
    for key, (is_good, expected) in fields.items():
        if key not in message:
            raise MessageError(f"{message['type']}: the field {key!r} is missing; expected {expected}")
        if not is_good(message[key]):
            raise MessageError(f"{message['type']}: {key}={_short(message[key])}: expected {expected}")
    return message


def pack_frame(header: Mapping[str, Any], picture: bytes) -> bytes:
    """A picture and what is said of it in one message: length (4 bytes, little-endian), JSON, JPEG."""
    said = json.dumps(header).encode()
    return len(said).to_bytes(4, "little") + said + picture


def unpack_frame(frame: bytes) -> tuple[dict[str, Any], bytes]:
    """The inverse of `pack_frame`."""
    end = 4 + int.from_bytes(frame[:4], "little")
    return json.loads(frame[4:end]), frame[end:]


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:60]}…"
