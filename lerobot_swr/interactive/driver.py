"""Drives a session at its real rate by what the page says, and tells the page what happens; knows no web."""

import io
import random
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from PIL import Image

from lerobot_swr.envs.pointer import Command
from lerobot_swr.errors import USER_ERRORS, one_line
from lerobot_swr.interactive.messages import pack_frame
from lerobot_swr.interactive.pace import Pace
from lerobot_swr.interactive.recorder import Recorder
from lerobot_swr.interactive.session import Session
from lerobot_swr.interactive.steering import Steering

JPEG_QUALITY = 80
SHOWN_S = 1.2  # how long the end of a policy's rollout stays in sight
PUSHED_STEPS = 8  # of a perturbation
TRAILS = 30  # past rollouts whose paths stay in sight
PATH_POINTS = 80  # of each


class Driver:
    """One person, one session.

    Args:
        session: Where to act.
        tell: Takes what the page is to know: an event as an object, or a packed frame.
        recorder: Keeps successes; None where nothing is recorded.
        steering: Requests styles; None where no policy acts.

    Attributes:
        pace: The beat.
        watched: How many pages look on.
        can_record_more: Whether recording can go on after this.
    """

    def __init__(
        self,
        session: Session,
        tell: Callable[[dict[str, Any] | bytes], None],
        recorder: Recorder | None = None,
        steering: Steering | None = None,
    ):
        self.session, self._tell = session, tell
        self.recorder, self.steering = recorder, steering
        self.can_record_more = False
        self.pace = Pace(session.task.rate_hz)
        self._hand, self._seen = Command(), 0
        self._paused, self.watched = False, 0
        self._phase = "waiting" if steering is None else "running"
        self._rest = 0
        self._push: tuple[float, float, float] = (0.0, 0.0, 0.0)
        self._pushed = 0
        self._trails: deque[dict[str, Any]] = deque(maxlen=TRAILS)
        self._behavior = ""
        self._has_news = True

    # --- What the page says ---

    def handle(self, message: Mapping[str, Any]) -> None:
        """Do what a checked message asks; what cannot be done is told to the page."""
        try:
            getattr(self, f"_on_{message['type']}")(**{k: v for k, v in message.items() if k != "type"})
        except USER_ERRORS as error:
            self._tell({"type": "error", "message": one_line(error)})
        self._has_news = True

    def _on_watched(self, count: int) -> None:
        self.watched = count
        if count == 0:
            self._hand = Command()
        self.pace.restart()

    def _on_hand(self, place: list[float] | None, push: list[float], n: int) -> None:
        if self.session.pointer is None:
            raise ValueError("this environment does not say how a pointer acts in it: watch and steer only")
        x, y, z = push
        self._hand = Command(None if place is None else (place[0], place[1]), (x, y, z))
        self._seen = n
        if self._phase == "waiting" and not self._hand.is_idle:
            self._phase = "running"
            self.pace.restart()

    def _on_keep(self) -> None:
        self._recorder().keep()
        self._begin()
        self.tell_state()

    def _on_discard(self) -> None:
        self._begin()

    def _on_undo(self) -> None:
        self._recorder().undo()
        self.tell_state()

    def _on_save(self) -> None:
        total = self._recorder().save()
        self.pace.restart()
        self.tell_state()
        self._tell({"type": "notice", "message": f"saved: {total} demonstrations in {self._recorder().root}"})

    def _on_train(self, steps: int) -> None:
        recorder = self._recorder()
        total = recorder.save()
        self.tell_state()
        if total < 2:
            raise ValueError(f"{total} demonstrations are too few to train on: keep at least 2")
        self._tell(
            {
                "type": "train",
                "root": str(recorder.root),
                "steps": steps,
                "behavior_rule": recorder.behavior_rule,
            }
        )

    def _on_restart(self) -> None:
        self._begin()

    def _on_pause(self, on: bool) -> None:
        self._paused = on
        self.pace.restart()

    def _on_speed(self, factor: float) -> None:
        self.pace.speed = float(factor)

    def _on_style(self, episodes: list[int]) -> None:
        self._steering().request(episodes)
        self.tell_state()

    def _on_filter(self, text: str) -> None:
        self._steering().request_filter(text)
        self.tell_state()

    def _on_free(self) -> None:
        self._steering().free()
        self.tell_state()

    def _on_clear(self) -> None:
        self._trails.clear()
        self.tell_state()

    def _on_perturb(self) -> None:
        if self.session.pointer is None:
            raise ValueError("this environment does not say how a pointer acts in it: nothing to push with")
        angle = random.uniform(0, 2 * np.pi)
        self._push, self._pushed = (float(np.cos(angle)), float(np.sin(angle)), 0.0), PUSHED_STEPS

    # --- The beat ---

    @property
    def is_idle(self) -> bool:
        """Whether nobody waits for a picture."""
        return self.watched == 0

    def beat(self) -> None:
        """Take a step, if it is time for one, and show what is to be seen."""
        if self._phase == "running" and not self._paused:
            self._step()
        elif self._phase == "over" and self.steering is not None and not self._paused:
            self._rest -= 1
            if self._rest <= 0:
                self._begin()
        elif not self._has_news:
            return  # the page has this picture already
        self._show()

    def _step(self) -> None:
        command = self._hand
        if self._pushed > 0:
            command, self._pushed = Command(push=self._push), self._pushed - 1
        by_hand = self.steering is None or not command.is_idle
        scene = self.session.step(self.session.follow(command) if by_hand else None)
        if scene.steps == 1:
            self._begin_rollout()
        if scene.steps % 4 == 0 or scene.over:
            self._behavior = self.session.behavior()
        if scene.over:
            self._end()

    def _begin_rollout(self) -> None:
        if self.steering is not None:
            self.steering.begin()

    def _end(self) -> None:
        self._phase = "over"
        self._rest = round(SHOWN_S * self.session.task.rate_hz)
        scene = self.session.scene
        if self.steering is not None:
            self.steering.end()
        path = self.session.path()
        chosen = np.linspace(0, len(path) - 1, min(len(path), PATH_POINTS)).round().astype(int)
        self._trails.append(
            {
                "path": np.round(path[chosen].astype(float), 4).tolist(),
                "behavior": self._behavior,
                "success": scene.success,
                "requested": self._requested(),
            }
        )
        self.tell_state()

    def _begin(self) -> None:
        self.session.reset()
        self._behavior = ""
        self._pushed = 0
        self._phase = "waiting" if self.steering is None else "running"
        self._has_news = True
        self.pace.restart()

    def _show(self) -> None:
        scene = self.session.scene
        place = self.session.place()
        header = {
            "type": "frame",
            "phase": self._phase,
            "paused": self._paused,
            "speed": self.pace.speed,
            "steps": scene.steps,
            "success": scene.success,
            "behavior": self._behavior,
            "requested": self._requested(),
            "style": scene.style,
            "tool": None if place is None else [round(x, 4) for x in place],
            "seen": self._seen,
            "beats": self.pace.beats,
            "late": self.pace.late,
        }
        self._has_news = False
        self._tell(pack_frame(header, as_jpeg(self.session.picture())))

    def tell_state(self) -> None:
        """Tell everything but pictures that a page needs to be drawn."""
        self._tell(
            {
                "type": "state",
                "recording": None if self.recorder is None else self.recorder.state(),
                "steering": None if self.steering is None else self.steering.state(),
                "trails": list(self._trails),
            }
        )

    def tell_scene(self) -> None:
        """Tell what does not change."""
        config = self.session.task.env_cfg
        self._tell(
            {
                "type": "welcome",
                "env": config.type,
                "task": config.task,
                "instruction": self.session.instruction,
                "rate": round(self.session.task.rate_hz, 2),
                "axes": self.session.action_dim,
                "has_pointer": self.session.pointer is not None,
                "can_record_more": self.can_record_more,
                "mode": "record" if self.steering is None else "steer",
                "map": None if self.steering is None else self.steering.map(),
            }
        )

    def close(self) -> None:
        """Let go of the environment and the dataset's folder."""
        self.session.close()
        if self.recorder is not None:
            self.recorder.writer.close()

    def _requested(self) -> str:
        return "" if self.steering is None else self.steering.requested()

    def _recorder(self) -> Recorder:
        if self.recorder is None or self.steering is not None:
            raise ValueError("nothing is recorded here: give --dataset.root=FOLDER and no --policy.path")
        return self.recorder

    def _steering(self) -> Steering:
        if self.steering is None:
            raise ValueError("there is no policy to steer: train one, or give --policy.path=CHECKPOINT")
        return self.steering


def as_jpeg(picture: np.ndarray) -> bytes:
    """An (h, w, 3) uint8 picture as a JPEG file."""
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "JPEG", quality=JPEG_QUALITY)
    return buffer.getvalue()
