"""The interactive map of a cookbook: one HTML file that opens offline."""

import importlib.util
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.utils.constants import OBS_STATE

from lerobot_swr.html_pages import as_script, principal_components
from lerobot_swr.installation import MissingExtraError
from lerobot_swr.styles.filters import column_kind
from lerobot_swr.styles.table import StyleTable
from lerobot_swr.trajectories import Trajectories
from lerobot_swr.whole_files import write_whole

MAX_PATH_POINTS = 120


def project_styles(styles: np.ndarray) -> dict[str, np.ndarray]:
    """Projections of (N, style_dim) styles to (N, 2): PCA and, if ``umap-learn`` is installed, UMAP."""
    projections = {"PCA": principal_components(styles)}
    if importlib.util.find_spec("umap") and len(styles) > 3:
        from umap import UMAP

        projections["UMAP"] = UMAP(random_state=0, n_jobs=1).fit_transform(styles)
    return projections


def demonstration_paths(trajectories: Trajectories, episodes: list[int]) -> list[np.ndarray]:
    """(P, 2) path of each episode: two-dimensional states as they are, others along their main directions."""
    states = trajectories.columns[OBS_STATE]
    flat = states if states.shape[1] == 2 else principal_components(states)
    starts = trajectories.starts
    paths = []
    for i in episodes:
        length = trajectories.lengths[i]
        chosen = np.linspace(0, length - 1, min(length, MAX_PATH_POINTS)).round().astype(int)
        paths.append(flat[starts[i] + chosen])
    return paths


def _plotly_js() -> str:
    try:
        from plotly.offline import get_plotlyjs
    except ModuleNotFoundError as error:
        raise MissingExtraError("the interactive map", "map", error) from error
    return get_plotlyjs()


def write_style_map(
    path: Path,
    styles: np.ndarray,
    episodes: list[int],
    table: StyleTable,
    trajectories: Trajectories | None,
    title: str,
) -> None:
    """Write the map.

    Args:
        path: The HTML file.
        styles: (M, style_dim) styles.
        episodes: Their M episodes.
        table: What is known of each demonstration.
        trajectories: The training dataset, for the paths; None leaves the paths out. Styles beyond its
            episodes (added ones) have no path.
        title: Heading.
    """
    columns = {name: [values[i] for i in episodes] for name, values in table.columns.items()}
    with_path = [] if trajectories is None else [i for i in episodes if i < len(trajectories)]
    paths = [] if trajectories is None else demonstration_paths(trajectories, with_path)
    plane = trajectories is not None and trajectories.columns[OBS_STATE].shape[1] == 2
    data: dict[str, Any] = {
        "title": title,
        "episodes": episodes,
        "projections": {
            name: np.round(flat, 4).tolist() for name, flat in project_styles(np.asarray(styles)).items()
        },
        "columns": columns,
        "kinds": {name: column_kind(values) for name, values in columns.items()},
        "color": "behavior" if "behavior" in columns else "length",
        "paths": {i: np.round(p.astype(float), 4).tolist() for i, p in zip(with_path, paths, strict=True)},
        "path_axes": ["state 0", "state 1"] if plane else ["states, PC 1", "states, PC 2"],
    }
    page = files("lerobot_swr.styles").joinpath("map.html").read_text(encoding="utf-8")
    before, after = page.split("/*DATA*/")
    page = before.replace("/*PLOTLY*/", _plotly_js()) + as_script(data) + after
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, page)
