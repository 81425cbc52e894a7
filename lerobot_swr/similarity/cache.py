"""What a survey of a dataset found, kept beside it."""

import hashlib
import logging
import os
import stat
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np
from lerobot.utils.constants import HF_LEROBOT_HOME
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from lerobot_swr.similarity.neighbours import Survey
from lerobot_swr.whole_files import write_whole

CACHE_FOLDER = "lerobot_swr_cache"

logger = logging.getLogger(__name__)


def cached_survey(root: Path, key: str, shape: tuple[int, int], compute: Callable[[], Survey]) -> Survey:
    """A survey, made once and kept in the dataset's folder: O(N k) numbers.

    The key is a hash of all that went in, so a changed dataset never meets a stale cache; the file is written
    under a temporary name and renamed, so processes may race; a file that is truncated or does not carry the
    hash of its own content is made anew.

    Args:
        root: The dataset's folder. Where its owner may not write, the cache lies in LeRobot's home instead.
        key: Hash of the states, the candidates and k.
        shape: (N, k) of the survey.
        compute: Makes it.
    """
    path = _cache_folder(root) / f"neighbours-{key}.safetensors"
    found = _read(path, shape)
    if found is None:
        found = compute()
        _write(path, found)
    return found


def _cache_folder(root: Path) -> Path:
    writable = os.stat(root).st_mode & stat.S_IWUSR and os.access(root, os.W_OK)
    return (root if writable else HF_LEROBOT_HOME) / CACHE_FOLDER


def _read(path: Path, shape: tuple[int, int]) -> Survey | None:
    if not path.is_file():
        return None
    try:
        with safe_open(path, framework="np") as file:
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
            intact = (file.metadata() or {}).get("sha256") == _checksum(arrays)
        found = Survey(**arrays)
    except (SafetensorError, OSError, TypeError) as error:
        logger.warning("Similarity cache %s cannot be read (%s): computed anew.", path, error)
        return None
    if not intact or found.nearest.shape != shape:
        logger.warning("Similarity cache %s is damaged: computed anew.", path)
        return None
    return found


def _write(path: Path, found: Survey) -> None:
    arrays = asdict(found)
    content = save(arrays, metadata={"sha256": _checksum(arrays)})
    try:
        write_whole(path, content)
    except OSError as error:
        logger.warning("Similarity cache %s cannot be written (%s): going on without it.", path, error)


def _checksum(arrays: dict[str, np.ndarray]) -> str:
    digest = hashlib.sha256()
    for name in sorted(arrays):
        digest.update(np.ascontiguousarray(arrays[name]))
    return digest.hexdigest()
