"""The process that holds the environment and the policy, so that no slow one stops the page."""

import json
import random
import signal
import sys
import threading
import traceback
from collections import deque
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from lerobot.configs import PreTrainedConfig
from lerobot.envs import EnvConfig

from lerobot_swr.behavior_rules import load_behavior_rule
from lerobot_swr.demos.writer import check_folder
from lerobot_swr.errors import USER_ERRORS, one_line
from lerobot_swr.evaluation.checkpoint import (
    DatasetSource,
    check_environment,
    load_checkpoint,
    load_reference,
)
from lerobot_swr.interactive.driver import Driver
from lerobot_swr.interactive.recorder import Recorder
from lerobot_swr.interactive.session import Session
from lerobot_swr.interactive.steering import Steering

EVENT, FRAME = b"E", b"F"  # first byte of what goes to the server
MAX_WAITING = 64  # messages; those beyond are answered, not obeyed


@dataclass(frozen=True)
class PlayJob:
    """What to play.

    Attributes:
        env: The environment.
        policy: The policy's configuration with its path; None lets a person record.
        dataset: Where is recorded; with a policy its training dataset, if known.
        behavior_rule: ``module:function``; None takes the environment's.
        seed: Of the environment; None differs every time.
    """

    env: EnvConfig
    policy: PreTrainedConfig | None
    dataset: DatasetSource
    behavior_rule: str | None
    seed: int | None


def check_job(job: PlayJob) -> None:
    """Refuse at once what the worker would refuse only when it has loaded everything.

    Raises:
        FileExistsError: If there is something else than a dataset where is to be recorded.
        FileNotFoundError: If a policy's training dataset is not there.
    """
    if job.policy is not None and (job.dataset.root or job.dataset.repo_id):
        job.dataset.metadata()
    if job.policy is None and job.dataset.root is not None:
        check_folder(job.dataset.root)


class Inbox:
    """Messages for the worker, read by a thread of its own, so that the server never waits for a step.

    Args:
        connection: To the server.
    """

    def __init__(self, connection: Connection):
        self._connection = connection
        self._waiting: deque[dict[str, Any]] = deque()
        self._arrived = threading.Event()
        self.is_closed = False
        self.dropped = 0
        threading.Thread(target=self._read, daemon=True).start()

    def take(self) -> list[dict[str, Any]]:
        """What has arrived, in order; of the hand's places only the last of each run."""
        self._arrived.clear()
        messages: list[dict[str, Any]] = []
        while self._waiting:
            message = self._waiting.popleft()
            if messages and message["type"] == messages[-1]["type"] == "hand":
                messages.pop()
            messages.append(message)
        return messages

    def wait(self, seconds: float) -> None:
        """Until something arrives, or the time is over."""
        self._arrived.wait(seconds)

    def _read(self) -> None:
        try:
            while True:
                message = json.loads(self._connection.recv_bytes())
                if message["type"] == "end":
                    break
                if len(self._waiting) < MAX_WAITING or message["type"] in ("watched", "load"):
                    self._waiting.append(message)
                else:
                    self.dropped += 1
                self._arrived.set()
        except (EOFError, OSError):
            pass  # the server has died
        self.is_closed = True
        self._arrived.set()


def work(connection: Connection, job: PlayJob) -> None:
    """Play until the server closes the connection."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the server ends this process

    def tell(news: dict[str, Any] | bytes) -> None:
        packed = FRAME + news if isinstance(news, bytes) else EVENT + json.dumps(news).encode()
        connection.send_bytes(packed)

    try:
        _play(job, Inbox(connection), tell)
    except (BrokenPipeError, ConnectionError):
        pass  # the server is gone
    except USER_ERRORS as error:
        _tell_end(tell, one_line(error))
        sys.exit(2)
    except Exception as error:
        traceback.print_exc()
        _tell_end(tell, f"the environment or the policy failed ({type(error).__name__}: {one_line(error)})")
        sys.exit(1)
    finally:
        connection.close()


def make_driver(job: PlayJob, tell: Any) -> Driver:
    """Load everything that a job names.

    Raises:
        ValueError: If something does not fit together.
    """
    rule = None if job.behavior_rule is None else load_behavior_rule(job.behavior_rule)
    seed = random.randrange(2**31) if job.seed is None else job.seed
    if job.policy is None:
        session = Session(job.env, seed=seed, rule=rule)
        assert job.dataset.root is not None
        recorder = Recorder(session, job.dataset.root, job.dataset.repo_id)
        return Driver(session, tell, recorder=recorder)
    checkpoint = load_checkpoint(job.policy)
    check_environment(job.env, checkpoint.shapes, {}, "the checkpoint")
    demonstrations = None
    if checkpoint.has_styles and job.dataset.root is not None:
        demonstrations = load_reference(job.dataset, checkpoint)
    session = Session(job.env, checkpoint, seed=seed, rule=rule)
    return Driver(session, tell, steering=Steering(session, demonstrations))


def _play(job: PlayJob, inbox: Inbox, tell: Any) -> None:
    driver = make_driver(job, tell)
    driver.tell_scene()
    driver.tell_state()
    while not inbox.is_closed:
        for message in inbox.take():
            if message["type"] == "load":
                driver = _replaced(driver, job, tell, message["path"])
            elif message["type"] == "record":
                driver = _replaced(driver, job, tell)
            else:
                driver.handle(message)
        if inbox.dropped:
            inbox.dropped = 0
            tell({"type": "error", "message": "too many messages at once: some were left out"})
        if driver.is_idle:
            inbox.wait(0.5)
            continue
        driver.beat()
        driver.pace.wait()
    driver.close()


def _replaced(old: Driver, job: PlayJob, tell: Any, path: str | None = None) -> Driver:
    """The driver that goes on with a policy trained meanwhile, or without one; `old` if it cannot."""
    try:
        if path is not None:
            policy = PreTrainedConfig.from_pretrained(path)
            policy.pretrained_path = Path(path)
            job = replace(job, policy=policy)
        elif job.policy is not None:
            raise ValueError("nothing is recorded here: give --dataset.root=FOLDER and no --policy.path")
        if old.recorder is not None:
            old.recorder.writer.close()  # its folder is the new one's
        driver = make_driver(job, tell)
    except USER_ERRORS as error:
        tell({"type": "error", "message": one_line(error)})
        return old
    old.close()
    driver.handle({"type": "watched", "count": old.watched})
    driver.can_record_more = path is not None
    driver.tell_scene()
    driver.tell_state()
    return driver


def _tell_end(tell: Any, message: str) -> None:
    try:
        tell({"type": "error", "message": message, "fatal": True})
    except OSError:
        print(f"error: {message}", file=sys.stderr)
