"""Pictures of an episode, for people who name what they see."""

import base64
import io
import logging
from collections.abc import Sequence

import numpy as np
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from PIL import Image

HEIGHT = 96  # pixels of a picture
QUALITY = 80  # of its JPEG

logger = logging.getLogger(__name__)


def strips(
    meta: LeRobotDatasetMetadata, episodes: Sequence[int], count: int
) -> dict[int, dict[str, list[str]]]:
    """Evenly spaced pictures of some episodes.

    Args:
        meta: Metadata of the dataset.
        episodes: Which.
        count: Pictures of each camera and episode.

    Returns:
        Episode to camera to pictures as data URLs. What cannot be read is left out, with a warning.
    """
    if not meta.camera_keys or not count:
        return {}
    try:
        dataset = LeRobotDataset(meta.repo_id, root=meta.root)
    except Exception as error:  # whatever LeRobot raises for absent videos
        logger.warning("no pictures: LeRobot cannot open the dataset's videos (%s)", error)
        return {}
    result: dict[int, dict[str, list[str]]] = {}
    starts, ends = meta.episodes["dataset_from_index"], meta.episodes["dataset_to_index"]
    for episode in episodes:
        rows = np.linspace(starts[episode], ends[episode] - 1, count).round().astype(int)
        try:
            items = [dataset[int(row)] for row in rows]
        except Exception as error:  # of a video decoder
            logger.warning("no pictures of episode %d (%s)", episode, error)
            continue
        result[episode] = {key: [_data_url(item[key].numpy()) for item in items] for key in meta.camera_keys}
    return result


def _data_url(picture: np.ndarray) -> str:
    """A (C, H, W) picture in [0, 1] as a small JPEG."""
    pixels = (picture.transpose(1, 2, 0) * 255).round().astype(np.uint8)
    image = Image.fromarray(pixels[..., :3] if pixels.shape[2] >= 3 else pixels[..., 0])
    image = image.convert("RGB").resize((max(1, round(image.width * HEIGHT / image.height)), HEIGHT))
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", quality=QUALITY)
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode()
