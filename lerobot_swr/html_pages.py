"""What the offline HTML pages share: data for a script, and points on a plane."""

import json
from typing import Any

import numpy as np


def as_script(data: Any) -> str:
    """Data as an expression that may stand in a page's script element, whatever strings it holds.

    There, ``</script`` and ``<!--`` mean something even within a string.
    """
    text = json.dumps(data)  # all ASCII
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def principal_components(points: np.ndarray) -> np.ndarray:
    """(N, 2) coordinates of (N, d) points along their two directions of largest variance.

    Each direction points to where its largest component is positive, so that a map looks the same each time.
    """
    centred = points - points.mean(axis=0)
    _, _, directions = np.linalg.svd(centred, full_matrices=False)
    directions = (
        directions[:2] * np.sign(directions[:2][range(len(directions[:2])), _largest(directions)])[:, None]
    )
    flat = np.zeros((len(points), 2))
    flat[:, : len(directions)] = centred @ directions.T
    return flat


def _largest(directions: np.ndarray) -> np.ndarray:
    return np.abs(directions[:2]).argmax(axis=1)
