"""A worker that answers at once and needs no environment, for tests of the server around it."""

import json
import os


def stand_in(connection, job):
    """Echo every message as a notice; show a picture after each; die if asked to."""

    def tell(event):
        connection.send_bytes(b"E" + json.dumps(event).encode())

    if job == "refuse":
        tell({"type": "error", "message": "there is no such maze", "fatal": True})
        os._exit(2)
    tell({"type": "welcome", "env": "none"})
    while True:
        try:
            message = json.loads(connection.recv_bytes())
        except (EOFError, OSError):
            return
        if message["type"] == "perturb":
            os._exit(1)
        if message["type"] != "watched":
            tell({"type": "notice", "message": json.dumps(message, sort_keys=True)})
        header = json.dumps({"type": "frame"}).encode()
        connection.send_bytes(b"F" + len(header).to_bytes(4, "little") + header + b"JPEG")
