"""MuJoCo and numba, which only the D3IL tasks need: imported here, to explain once if one is missing."""

from lerobot_swr.installation import MissingExtraError

try:
    import mujoco
    import numba
except ModuleNotFoundError as error:
    raise MissingExtraError("a D3IL task", "d3il", error) from error

__all__ = ["mujoco", "numba"]
