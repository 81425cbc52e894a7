"""The interactive map: its projections, its page, and what a real browser makes of it."""

import json
import shutil
import subprocess
from html.parser import HTMLParser
from typing import ClassVar

import numpy as np
import pytest
from conftest import save_checkpoint

from lerobot_swr.cli import styles as styles_command
from lerobot_swr.html_pages import as_script, principal_components
from lerobot_swr.styles.map import demonstration_paths, write_style_map
from lerobot_swr.styles.table import StyleTable
from lerobot_swr.trajectories import load_trajectories


def test_principal_components_keep_a_planes_distances():
    """Points of a plane in 5 dimensions are only rotated, whatever their order; the first axis is longest."""
    rng = np.random.default_rng(0)
    basis = np.linalg.qr(rng.normal(size=(5, 2)))[0]
    points = rng.normal(size=(30, 2)) @ np.diag([3, 1]) @ basis.T + 7
    flat = principal_components(points)
    distances = [np.linalg.norm(p[:, None] - p[None], axis=-1) for p in (points, flat)]
    assert np.allclose(*distances)
    assert flat[:, 0].var() > flat[:, 1].var()
    order = rng.permutation(30)
    assert np.allclose(principal_components(points[order]), flat[order])
    assert np.allclose(principal_components(points[:1]), 0)


def test_paths_are_thinned_and_keep_their_ends(small_maze_meta):
    """Two-dimensional states are drawn as they are."""
    trajectories = load_trajectories(small_maze_meta, ["observation.state"])
    states = trajectories.states(["observation.state"])
    for path, state in zip(demonstration_paths(trajectories, list(range(6))), states, strict=True):
        assert np.array_equal(path[[0, -1]], state[[0, -1]])
        assert len(path) <= 120


@pytest.fixture
def page(make_tiny_policy, small_maze, small_maze_meta, tmp_path, run_command):
    """The map of a tiny policy, made by the command."""
    folder = save_checkpoint(make_tiny_policy("zbc").eval(), small_maze_meta, tmp_path / "checkpoint")
    page = tmp_path / "styles.html"
    run_command(styles_command.main, folder, f"--map={page}", f"--dataset.root={small_maze}")
    return page


def test_the_page_needs_no_network(page):
    """Nothing is loaded from anywhere, and every placeholder is filled."""
    text = page.read_text()
    head = text[: text.index("<script>")] + text[text.rindex("<body>") :]
    assert "/*DATA*/" not in text
    assert "/*PLOTLY*/" not in text
    assert "http" not in head
    assert "src=" not in head


HOSTILE = "</script><!--<script> /*PLOTLY*/ & <b>bold</b> \u2028 ' \" `${x}`"


def test_no_string_of_the_data_ends_the_script(tmp_path):
    """A task in any markup is data: a parser finds two scripts, the second with exactly that string."""
    table = StyleTable({"length": [3, 4, 5], "task": [HOSTILE, "<!--<script>", "plain"]}, [[], [], []])
    page = tmp_path / "map.html"
    write_style_map(page, np.random.default_rng(0).normal(size=(3, 4)), [0, 1, 2], table, None, HOSTILE)

    class Scripts(HTMLParser):
        found: ClassVar[list[str]] = []

        def handle_data(self, data):
            if self.lasttag == "script" and data.strip():
                self.found.append(data)

    text = page.read_text()
    Scripts().feed(text)
    scripts = [part for part in Scripts.found if "const data = " in part]
    assert len(scripts) == 1
    line = scripts[0].split("const data = ")[1].splitlines()[0].rstrip(";")
    assert json.loads(line)["columns"]["task"] == table.columns["task"]
    assert json.loads(line)["title"] == HOSTILE
    assert not {"<", ">", "&"} & set(as_script(HOSTILE))
    assert text.count("<!--") == text.split("const data")[0].count("<!--")


def test_a_browser_draws_the_map_and_gives_the_flag(page):
    """One point per trained style; selecting gives the flag, pointing shows the demonstration."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no chromium on this machine")
    script = """<script>
      const points = document.querySelectorAll('#map .scatterlayer path.point').length;
      toggle([4, 1]);
      byId('map').emit('plotly_hover', {points: [{customdata: 2}]});
      const result = document.createElement('pre');
      result.textContent = ['RESULT', points, byId('flag').value, shown, byId('info').textContent].join('|');
      document.body.append(result);
    </script></body>"""
    page.write_text(page.read_text().replace("</body>\n</html>", script + "</html>"))
    flags = "--headless --no-sandbox --disable-gpu --no-first-run --disable-background-networking"
    command = [browser, *flags.split(), "--virtual-time-budget=5000", "--dump-dom", f"file://{page}"]
    dom = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    result = dom.split("<pre>RESULT|")[1].split("</pre>")[0]
    points, flag, shown, info = result.split("|")
    assert points == "6"
    assert flag == "--policy.style_episodes=[1,4]"
    assert shown == "2"
    assert info.startswith("episode 2 · length ")
