"""Records the picture of docs/play.md: a person at the page, in a headless browser, as a GIF of at most 2 MB.

    python docs/play_recording.py [--screenshots=FOLDER]

Needs Chromium, its driver and selenium; takes some minutes, most of them for the training.
"""

import argparse
import io
import json
import random
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from PIL import Image

sys.path[:0] = [str(Path(__file__).parents[1] / "tests"), str(Path(__file__).parents[1])]

from browser import Person, open_browser  # noqa: E402

from benchmarks.bench_play import scripted_way  # noqa: E402

WIDE, PHONE = (1180, 900), (390, 844)
GIF_WIDTH, MAX_BYTES = 760, 2_000_000
WAYS = ("6410", "7420", "6310", "7520")


class Film:
    """Screenshots of a window, one after the other.

    Args:
        person: Whose window it is.
        folder: Where single pictures go; None for nowhere.
    """

    def __init__(self, person: Person, folder: Path | None):
        self._person, self._folder = person, folder
        self._frames: list[Image.Image] = []

    def shoot(self) -> None:
        """Take a picture."""
        image = Image.open(io.BytesIO(self._person.browser.get_screenshot_as_png())).convert("RGB")
        self._frames.append(image.resize((GIF_WIDTH, image.height * GIF_WIDTH // image.width)))

    def watch(self, until: Callable[[], bool], apart_s: float = 0.2) -> None:
        """Take pictures until something holds."""
        while not until():
            self.shoot()
            time.sleep(apart_s)

    def still(self, name: str) -> None:
        """Take a picture to be looked at."""
        if self._folder is not None:
            self._folder.mkdir(parents=True, exist_ok=True)
            (self._folder / f"{name}.png").write_bytes(self._person.browser.get_screenshot_as_png())

    def save(self, path: Path) -> None:
        """Write the GIF, with fewer frames and colours until it is small enough."""
        for step, colours in ((1, 256), (1, 128), (1, 64), (2, 128), (2, 64), (3, 32), (4, 16)):
            # All frames have one palette, in which small spots of colour have their place.
            shown = self._frames[::step]
            sheet = Image.new("RGB", (GIF_WIDTH, sum(frame.height for frame in shown)))
            for place, frame in enumerate(shown):
                sheet.paste(frame, (0, place * frame.height))
            palette = sheet.quantize(colours, method=Image.Quantize.MAXCOVERAGE)
            frames = [f.quantize(palette=palette, dither=Image.Dither.NONE) for f in shown]
            buffer = io.BytesIO()
            frames[0].save(
                buffer,
                "GIF",
                save_all=True,
                append_images=frames[1:],
                duration=160 * step,
                loop=0,
                optimize=True,
            )
            if buffer.tell() <= MAX_BYTES:
                path.write_bytes(buffer.getvalue())
                print(f"{path}: {len(frames)} frames, {buffer.tell() / 1e6:.2f} MB")
                return
        raise ValueError(f"{path}: even the smallest version has {buffer.tell()} bytes")


def record(film: Film, person: Person, way: str, rng: random.Random, is_filmed: bool) -> None:
    """Lead the agent to the goal and keep it; on a busy machine the hand may be too slow, and tries again."""
    while True:
        for place in scripted_way(way, rng):
            person.lead([place], near=0.03)
            if is_filmed:
                film.shoot()
        person.until(lambda: not person.ask("byId('ended').hidden"))
        is_success = person.ask("frame.success")
        if is_filmed:
            film.shoot()
            film.still(f"record-{way}")
        person.press("keep" if is_success else "discard")
        person.until(lambda: person.ask("frame.phase") == "waiting")
        if is_success:
            return


def main() -> None:
    """Record, train, steer."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--screenshots", type=Path)
    options.add_argument("--steps", type=int, default=5000)
    args = options.parse_args()
    rng = random.Random(0)
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "lerobot_swr.cli.play", "--env.type=maze2d", "--env.task=medium"]
        flags = [f"--dataset.root={folder}/mine", "--port=0", "--open=false", "--seed=0"]
        process = subprocess.Popen([*command, *flags], stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        url = next(filter(None, (re.search(r"http://\S+", line) for line in process.stdout)))[0]
        browser = open_browser(*WIDE)
        try:
            film_all(Person(browser, url), args, rng)
        finally:
            browser.quit()
            process.terminate()


def film_all(person: Person, args: argparse.Namespace, rng: random.Random) -> None:
    """What the picture shows, in order."""
    film = Film(person, args.screenshots)
    film.still("begin")
    for number in range(12):
        person.choose("speed", "1" if number < 2 else "2")
        record(film, person, WAYS[number % 4], rng, is_filmed=number < 2)
    film.shoot()
    film.still("recorded")
    person.browser.execute_script("byId('steps').value = arguments[0]", args.steps)
    person.press("train")
    person.until(lambda: person.ask("!byId('progress').hidden && byId('progress').value > 0.3"), 600)
    film.shoot()
    film.still("training")
    person.until(lambda: person.ask("scene.mode") == "steer", 900)
    person.until(lambda: person.ask("frame.phase") == "running")
    labels = person.ask("scene.map.columns.behavior")
    for way in ("6410", "7520"):
        episode = person.ask("scene.map.episodes")[labels.index(way)]
        person.click_style(episode)
        person.until(lambda e=episode: person.ask("state.steering.asked") == [e])
        person.browser.execute_script("scrollTo(0, 0)")
        person.press("restart")
        person.until(lambda: person.ask("frame.steps") < 8)
        film.watch(lambda: person.ask("frame.phase") == "over")
        film.shoot()
        film.still(f"steer-{way}")
        print(json.dumps(person.ask("[frame.requested, frame.behavior, frame.success]")))
    film.save(Path(__file__).parent / "images" / "play.gif")
    person.browser.set_window_size(*PHONE)
    time.sleep(1)
    film.still("phone")
    person.browser.execute_script("byId('map').scrollIntoView()")
    time.sleep(0.5)
    film.still("phone-map")


if __name__ == "__main__":
    main()
