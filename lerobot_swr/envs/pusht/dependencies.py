"""Shapely, which comes with gym-pusht: imported here, to explain once if it is missing."""

from lerobot_swr.installation import MissingExtraError

try:
    import shapely
except ModuleNotFoundError as error:
    raise MissingExtraError("PushT", "pusht", error) from error

__all__ = ["shapely"]
