"""One HTML page that shows the behaviours of a dataset and lets a person name them; opens offline."""

from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_swr.discovery.discover import Discovery
from lerobot_swr.html_pages import as_script, principal_components
from lerobot_swr.trajectories import Trajectories
from lerobot_swr.whole_files import write_whole

REPORT_FILE = "report.html"
DRAWN = 60  # paths of each behaviour that are drawn
SHOWN_REASONS = 200
MAPPED = 3000  # episodes on the map
BINS = 16
TOLD = 3  # differences of a behaviour that are told


def write_report(
    path: Path,
    found: Discovery,
    data: Mapping[str, Any],
    trajectories: Trajectories,
    dimensions: Sequence[str],
    pictures: Mapping[int, Mapping[str, list[str]]],
) -> None:
    """Write the report.

    Args:
        path: The HTML file.
        found: The behaviours.
        data: What ``behaviors.json`` holds; the page saves it again with other names.
        trajectories: The episodes.
        dimensions: Names of the dimensions that were compared; empty for a user's function.
        pictures: Typical episode to camera to pictures.
    """
    names = [dimensions[d] if len(dimensions) else f"feature {d}" for d in found.paths.scaling.moving]
    flat, axes = draw_paths(found, names)
    edges = np.histogram_bin_edges(trajectories.lengths, BINS)
    behaviours = []
    for k in range(len(found.names)):
        members = np.flatnonzero(found.groups == k)
        lengths = trajectories.lengths[members]
        nearest = members[
            np.argsort(np.linalg.norm(found.places[members] - found.places[found.medoids[k]], axis=1))
        ]
        behaviours.append(
            {
                "episodes": nearest.tolist(),
                "typical": found.medoids[k],
                "lengths": np.quantile(lengths, [0, 0.5, 1]).tolist(),
                "histogram": np.histogram(lengths, edges)[0].tolist(),
                "told": differences(found, k, names),
                "pictures": pictures.get(found.medoids[k], {}),
            }
        )
    drawn = {int(i) for b in behaviours for i in b["episodes"][:DRAWN]} | set(
        list(found.reasons)[:SHOWN_REASONS]
    )
    rng = np.random.default_rng(0)
    mapped = np.arange(len(found.groups))
    if len(mapped) > MAPPED:
        mapped = np.sort(rng.choice(mapped, MAPPED, replace=False))
    page_data = {
        "rule": data,
        "title": Path(str(data["dataset"])).name,
        "episodes": len(found.groups),
        "fps": trajectories.fps,
        "behaviours": behaviours,
        "outliers": [[i, why] for i, why in list(found.reasons.items())[:SHOWN_REASONS]],
        "edges": edges.tolist(),
        "axes": axes,
        "paths": {i: np.round(flat[i], 4).tolist() for i in sorted(drawn)},
        "map": [[int(i), int(found.groups[i]), *np.round(found.flat[i], 4).tolist()] for i in mapped],
        "compared": compared_by(found),
        "no_groups": no_groups(found),
        "separation": found.separation,
        "stability": found.stability,
    }
    page = files("lerobot_swr.discovery").joinpath("report.html").read_text(encoding="utf-8")
    before, after = page.split("/*DATA*/")
    write_whole(path, before + as_script(page_data) + after)


def draw_paths(found: Discovery, names: Sequence[str]) -> tuple[np.ndarray, list[str]]:
    """(N, P, 2) paths as they are drawn, and the names of the two axes.

    Two moving dimensions are drawn as they are, more along the main directions of all paths.
    """
    scaling, paths = found.paths.scaling, found.paths.paths
    moving = paths / scaling.weights
    if paths.shape[2] == 2:
        return moving * scaling.spread[scaling.moving] + scaling.centre[scaling.moving], list(names)
    flat = principal_components(moving.reshape(-1, moving.shape[2])).reshape(*moving.shape[:2], 2)
    return flat, ["main direction 1", "main direction 2"]


def differences(found: Discovery, behaviour: int, names: Sequence[str]) -> list[str]:
    """In what a behaviour differs most from the others, in words; nothing where there is only one.

    The measure is the difference of the means in units of the spread within behaviours.
    """
    own, others = found.groups == behaviour, (found.groups >= 0) & (found.groups != behaviour)
    if not others.any():
        return []
    paths = found.paths.paths / found.paths.scaling.weights
    within = np.zeros(paths.shape[1:])
    for k in range(len(found.names)):
        members = found.groups == k
        within += members.sum() * paths[members].var(axis=0)
    spread = np.sqrt(within / (found.groups >= 0).sum())
    apart = paths[own].mean(axis=0) - paths[others].mean(axis=0)  # (P, m)
    strength = np.abs(apart) / (spread + 0.05)
    told = []
    for d in np.argsort(-strength.max(axis=0))[:TOLD]:
        at = int(strength[:, d].argmax())
        direction = "higher" if apart[at, d] > 0 else "lower"
        when = "" if len(paths[0]) == 1 else f", {at / (len(paths[0]) - 1):.0%} of the way along"
        size = abs(apart[at, d]) * found.paths.scaling.spread[found.paths.scaling.moving[d]]
        told.append(f"{names[d]} {direction} by {size:.3g}{when}")
    return told


def compared_by(found: Discovery) -> str:
    """What the episodes were compared by, in words."""
    source = found.features.scaling.source
    what = f"the function {source.function}" if source.function else ", ".join(source.keys)
    if found.features.points == 1:
        return what
    scene = ""
    if len(found.features.scene):
        scene = ", less what the scene at the start explains"
    elif len(found.paths.scene):
        scene = ", the scene at the start included, since that shows clearly better groups"
    return f"the path of {what}, at an even pace{scene}"


def no_groups(found: Discovery) -> str:
    """A sentence where the behaviours that were asked for are no groups in the data; else nothing."""
    if found.supported:
        return ""
    return f"The data show no {len(found.names)} groups: these behaviours are parts of one cloud."
