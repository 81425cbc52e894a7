"""Shapely, which comes with gym-pusht: imported here, to explain once if it is missing."""

try:
    import shapely
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        f"PushT needs the package {error.name!r}: run pip install 'lerobot_policy_swr[pusht]'",
        name=error.name,
    ) from error

__all__ = ["shapely"]
