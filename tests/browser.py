"""A real browser without a window, and a person's hand in it."""

import shutil
import time
from collections.abc import Callable, Sequence
from typing import Any

import pytest

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
FLAGS = (
    *("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--disable-gpu", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync", "--disable-quic"),
)
PATIENCE_S = 90  # a busy machine fails no test


def open_browser(width: int, height: int):
    """A headless Chromium; skips the test where there is none."""
    pytest.importorskip("selenium")
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    driver = shutil.which("chromedriver")
    if program is None or driver is None:
        pytest.skip("needs a browser: apt-get install chromium chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = program
    for flag in FLAGS:
        options.add_argument(flag)
    options.add_argument(f"--window-size={width},{height}")
    return webdriver.Chrome(options=options, service=Service(driver))


class Person:
    """Somebody at the page.

    Args:
        browser: A selenium driver.
        url: Of the page.
    """

    def __init__(self, browser: Any, url: str):
        self.browser = browser
        browser.set_script_timeout(PATIENCE_S)
        browser.get(url)
        self.until(lambda: self.ask("frame !== null"))

    def ask(self, expression: str) -> Any:
        """The value of an expression of the page's script."""
        return self.browser.execute_script(f"return {expression};")

    def until(self, holds: Callable[[], Any], seconds: float = PATIENCE_S) -> Any:
        """Wait until something holds."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if found := holds():
                return found
            time.sleep(0.02)
        raise TimeoutError(f"{self.said()!r}, frame {self.ask('frame')}")

    def said(self) -> str:
        """The page's last word."""
        return self.browser.find_element("id", "say").text

    def press(self, name: str) -> None:
        """Click a button."""
        self.browser.find_element("id", name).click()

    def choose(self, name: str, value: str) -> None:
        """Choose of a list."""
        from selenium.webdriver.support.ui import Select

        Select(self.browser.find_element("id", name)).select_by_value(value)

    def lead(self, places: Sequence[tuple[float, float]], near: float = 0.02) -> None:
        """Hold the mouse on the picture and lead the tool through places, as shares of the picture."""
        from selenium.webdriver import ActionChains

        canvas = self.browser.find_element("id", "picture")
        size, is_held = canvas.size, False
        for x, y in places:
            move = ActionChains(self.browser, duration=10).move_to_element_with_offset(
                canvas, round((x - 0.5) * size["width"]), round((y - 0.5) * size["height"])
            )
            (move if is_held else move.click_and_hold()).perform()
            is_held = True
            self.until(lambda x=x, y=y: self._is_there(x, y, near))
        ActionChains(self.browser, duration=10).release().perform()

    def _is_there(self, x: float, y: float, near: float) -> bool:
        frame = self.ask("frame")
        return frame["phase"] == "over" or max(abs(frame["tool"][0] - x), abs(frame["tool"][1] - y)) < near

    def click_style(self, episode: int) -> None:
        """Click a demonstration's point in the map."""
        from selenium.webdriver import ActionChains

        x, y = self.browser.execute_script(
            """
            const graph = document.getElementById("map"), {xaxis, yaxis} = graph._fullLayout;
            for (const trace of graph.data) {
              const k = trace.customdata.indexOf(arguments[0]);
              const {x, y} = trace;
              if (k >= 0) return [xaxis._offset + xaxis.l2p(x[k]), yaxis._offset + yaxis.l2p(y[k])];
            }""",
            episode,
        )
        graph = self.browser.find_element("id", "map")
        self.browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", graph)
        size = graph.size
        offset = (round(x - size["width"] / 2), round(y - size["height"] / 2))
        ActionChains(self.browser, duration=10).move_to_element_with_offset(graph, *offset).pause(
            0.2
        ).click().perform()
