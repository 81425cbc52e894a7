"""Between the pages and the worker: who may steer, who is told what, and what becomes of a dead worker."""

import asyncio
import json
import multiprocessing
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from lerobot_swr.interactive.messages import MessageError, parse_message
from lerobot_swr.interactive.training import Training, new_folder, train_command

MAX_PAGES = 8
MAX_EVENTS = 64  # that wait for a slow page
MAX_PER_SECOND = 240  # messages of one page
STATES = ("welcome", "state", "training")  # what a page that comes later has to know
HAND_OFF = {"type": "hand", "place": None, "push": [0, 0, 0], "n": 0}
SHORTEST_LIFE_S = 20  # of a worker that is started anew when it dies


@dataclass(eq=False)
class Page:
    """One open page.

    Attributes:
        tab: Its name for itself, which a reload keeps.
        frame: The newest picture; older ones are left out for a slow page.
        events: What it is to be told.
        has_news: Set when there is either.
    """

    tab: str
    frame: bytes | None = None
    events: deque[str] = field(default_factory=lambda: deque(maxlen=MAX_EVENTS))
    has_news: asyncio.Event = field(default_factory=asyncio.Event)
    is_closed: bool = False
    _second: int = 0
    _count: int = 0

    def tell(self, event: dict[str, Any]) -> None:
        """Let the page know something."""
        self.events.append(json.dumps(event))
        self.has_news.set()

    def show(self, frame: bytes) -> None:
        """Let the page see something."""
        self.frame = frame
        self.has_news.set()

    def close(self) -> None:
        """Let the page go."""
        self.is_closed = True
        self.has_news.set()

    def may_speak(self, now: float) -> bool:
        """Whether the page keeps within its share of messages."""
        if int(now) != self._second:
            self._second, self._count = int(now), 0
        self._count += 1
        return self._count <= MAX_PER_SECOND


class Hub:
    """Everything that lives as long as the server.

    Args:
        target: What the worker process runs, with its end of a connection and the job.
        job: What to play; passed on unseen.
        repo_id: Of the dataset that is recorded.
        behavior_rule: ``module:function`` for trainings; None lets the dataset say.

    Attributes:
        pages: Those that are open.
        pilot: The one that steers.
        failure: Why there is nothing to play, if the worker could not begin.
        give_up: Called then.
    """

    def __init__(
        self,
        target: Callable[[Connection, Any], None],
        job: Any,
        repo_id: str | None = None,
        behavior_rule: str | None = None,
    ):
        self._target, self._job = target, job
        self._repo_id, self._behavior_rule = repo_id, behavior_rule
        self.pages: list[Page] = []
        self.pilot: Page | None = None
        self._states: dict[str, dict[str, Any]] = {}
        self._connection: Connection | None = None
        self._process: BaseProcess | None = None
        self._training: Training | None = None
        self._tasks: set[asyncio.Task] = set()
        self._is_ending = False
        self._last_words: str | None = None
        self.failure: str | None = None
        self.give_up: Callable[[], None] = lambda: None

    # --- The worker ---

    def start(self) -> None:
        """Start the worker; to be called in the event loop."""
        self._loop = asyncio.get_running_loop()
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=self._target, args=(theirs, self._job), daemon=True)
        self._process.start()
        theirs.close()
        self._born = self._loop.time()
        self._send({"type": "watched", "count": len(self.pages)})
        threading.Thread(target=self._listen, args=(self._connection,), daemon=True).start()

    def stop(self) -> None:
        """End the worker and a training."""
        self._is_ending = True
        if self._training is not None:
            self._training.stop()
        self._send({"type": "end"})
        if self._process is not None:
            self._process.join(5)
            self._process.terminate()

    def _listen(self, connection: Connection) -> None:
        """In a thread: hand on what the worker says."""
        try:
            while True:
                said = connection.recv_bytes()
                self._loop.call_soon_threadsafe(self._hear, said)
        except (EOFError, OSError):
            pass
        if not self._is_ending:
            self._loop.call_soon_threadsafe(self._lose_worker)

    def _hear(self, said: bytes) -> None:
        if said[:1] == b"F":
            for page in self.pages:
                page.show(said[1:])
            return
        event = json.loads(said[1:])
        if event["type"] == "train":
            self._train(Path(event["root"]), event["steps"], self._behavior_rule or event["behavior_rule"])
        elif event.get("fatal"):
            self._last_words = event["message"]  # told when it has ended
        else:
            self._broadcast(event)

    def _broadcast(self, event: dict[str, Any]) -> None:
        if event["type"] in STATES:
            self._states[event["type"]] = event
        for page in self.pages:
            page.tell(event)

    def _send(self, message: dict[str, Any]) -> None:
        try:
            assert self._connection is not None
            self._connection.send_bytes(json.dumps(message).encode())
        except (OSError, ValueError):
            pass  # the worker is gone, which `_listen` tells

    def _lose_worker(self) -> None:
        assert self._process is not None
        self._process.join(3)
        why, self._last_words = self._last_words, None
        if self._process.exitcode == 2 and "welcome" not in self._states:
            self.failure = why
            self.give_up()
            return
        again = self._loop.time() - self._born > SHORTEST_LIFE_S and self._process.exitcode != 2
        message = f"{why or "the environment's process has ended"}; what was kept is safe on the disk. "
        message += "It is started anew." if again else "End the command and start it again."
        event = {"type": "error", "message": message, "fatal": not again}
        self._broadcast(event)
        if again:
            self.start()
        else:
            self._states["error"] = event  # for pages that come later, too

    # --- Pages ---

    def join(self, page: Page) -> bool:
        """Let a page look on, and steer if nobody does; False if there are too many."""
        same = [other for other in self.pages if other.tab == page.tab]
        for other in same:  # the page was loaded anew
            self.leave(other)
            other.close()
        if len(self.pages) >= MAX_PAGES:
            return False
        self.pages.append(page)
        if self.pilot is None:
            self.pilot = page
        for event in self._states.values():
            page.tell(event)
        self._tell_roles()
        return True

    def leave(self, page: Page) -> None:
        """Forget a page; another one may steer then."""
        if page not in self.pages:
            return
        self.pages.remove(page)
        if self.pilot is page:
            self._hand_over(self.pages[-1] if self.pages else None)
        self._tell_roles()

    def hear_page(self, page: Page, text: str | bytes | None) -> None:
        """Do what a page says, or answer why not."""
        if not page.may_speak(self._loop.time()):
            page.tell({"type": "error", "message": f"more than {MAX_PER_SECOND} messages in a second"})
            return
        try:
            message = parse_message(text)
        except MessageError as error:
            page.tell({"type": "error", "message": str(error)})
            return
        if message["type"] == "take":
            self._hand_over(page)
            self._tell_roles()
        elif page is not self.pilot:
            page.tell({"type": "error", "message": "another page steers; press 'Take over' to steer here"})
        elif message["type"] == "stop":
            if self._training is not None:
                self._training.stop()
        else:
            self._send(message)

    def _hand_over(self, page: Page | None) -> None:
        """Let another page steer; what the last one held is let go."""
        if page is not self.pilot:
            self._send(HAND_OFF)
        self.pilot = page

    def _tell_roles(self) -> None:
        self._send({"type": "watched", "count": len(self.pages)})
        for page in self.pages:
            page.tell({"type": "role", "pilot": page is self.pilot, "pages": len(self.pages)})

    # --- Training ---

    def _train(self, root: Path, steps: int, rule: str | None) -> None:
        if self._training is not None:
            self._broadcast({"type": "error", "message": "a training is under way; stop it first"})
            return
        command = train_command(root, self._repo_id, steps, new_folder(root), rule)
        self._training = Training(command, self._broadcast)
        task = self._loop.create_task(self._run(self._training))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _run(self, training: Training) -> None:
        await training.run()
        self._training = None
        if training.folder is not None:
            self._send({"type": "load", "path": training.folder})
